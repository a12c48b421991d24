"""The command line: parse the arguments, call the package, show the result.

Only this package prints or exits. Each module holds a group of commands and adds them to :data:`app`. Exit
codes: 0 done, 1 failed, 2 asked for something that does not exist, 130 interrupted.
"""

from __future__ import annotations

# Each import adds its module's commands to the application, in the order that the help shows.
from imujoco_minari.cli import catalogue, datasets, export, gallery, importing, plot, remote, render, training
from imujoco_minari.cli.app import app, main

__all__ = [
    "app",
    "catalogue",
    "datasets",
    "export",
    "gallery",
    "importing",
    "main",
    "plot",
    "remote",
    "render",
    "training",
]
