"""The benchmark's results: few-shot imitation and offline baselines, computed, tabulated and reproduced.

A run computes cells and writes a line for each. Tables, figures and pages are made from the lines.
"""

from imujoco_minari.benchmark.few_shot import FewShotGrid, run_few_shot
from imujoco_minari.benchmark.lines import read_lines
from imujoco_minari.benchmark.methods import METHODS, Method
from imujoco_minari.benchmark.offline import OfflineGrid, run_offline
from imujoco_minari.benchmark.protocol import Budget
from imujoco_minari.benchmark.reproduction import run_reproduction
from imujoco_minari.benchmark.scores import MethodScore, few_shot_scores, offline_scores

__all__ = [
    "METHODS",
    "Budget",
    "FewShotGrid",
    "Method",
    "MethodScore",
    "OfflineGrid",
    "few_shot_scores",
    "offline_scores",
    "read_lines",
    "run_few_shot",
    "run_offline",
    "run_reproduction",
]
