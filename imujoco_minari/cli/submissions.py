"""``imujoco benchmark check``: whether the results of others can stand beside the published ones."""

from __future__ import annotations

import typer

from imujoco_minari.cli import options
from imujoco_minari.cli.benchmark import Folder, benchmark
from imujoco_minari.cli.printing import out, print_json


@benchmark.command()
def check(folder: Folder, as_json: options.AsJson = False) -> None:
    """Check whether the results of your method can stand beside the published ones.

    The lines must have every variant, seed and budget of each split that they name, be of the published data,
    protocol and versions, and state the method's settings. The command prints what is missing or wrong, one
    line each. The exit status is then 1.

    Example: `imujoco benchmark check docs/results/others/nearest-neighbour`
    """
    from imujoco_minari.benchmark.submissions import check_submission

    faults = check_submission(folder)
    if as_json:
        print_json({"whole": not faults, "faults": faults})
    else:
        for fault in faults:
            out.print(fault)
        if not faults:
            out.print(f"{folder}: whole, and of the published data, protocol and versions")
    if faults:
        raise typer.Exit(1)
