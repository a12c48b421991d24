"""The command line. It is the only package that prints or exits.

- ``app`` holds the application, runs commands and gathers the outcomes of a batch. ``printing`` prints.
- ``options`` holds the options that commands share, ``selection`` the filters, ``estimates`` the costs.
- Each other module holds commands that belong together and adds them to :data:`app`.

Exit codes: 0 done, 1 failed, 2 something that was asked for does not exist, 130 interrupted.
"""

from __future__ import annotations

from imujoco_minari.cli import (  # noqa: F401  Each adds its commands to the help, in this order.
    benchmark,
    catalogue,
    datasets,
    export,
    importing,
    pictures,
    remote,
    training,
)
from imujoco_minari.cli.app import app, main

__all__ = ["app", "main"]
