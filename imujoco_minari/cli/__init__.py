"""The command line: parse, call, render. The only place that prints or exits.

Each module of this package holds commands that belong together and adds them to :data:`app`.
Exit codes: 0 done, 1 failed, 2 asked for something that does not exist, 130 interrupted.
"""

from __future__ import annotations

from imujoco_minari.cli.app import app, main
from imujoco_minari.cli.catalogue import list_variants, show
from imujoco_minari.cli.datasets import combine, publish_datasets, verify_datasets

__all__ = ["app", "combine", "list_variants", "main", "publish_datasets", "show", "verify_datasets"]
