"""How demonstrations are drawn."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_arrays import synthetic

from imujoco_minari.benchmark.protocol import BUDGETS, Budget, draw_demonstrations
from imujoco_minari.errors import BenchmarkError
