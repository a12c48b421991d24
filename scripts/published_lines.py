"""Put the newest line of each cell of a results folder into another.

python -m scripts.published_lines FROM TO
"""

from __future__ import annotations

import sys
from pathlib import Path

from imujoco_minari.benchmark.lines import append_lines, latest, read_lines
from imujoco_minari.benchmark.page import CELLS


def main(source: Path, target: Path) -> None:
    """Write the newest lines of each results file below ``source`` to the same place below ``target``."""
    for file in sorted(source.rglob("*.jsonl")):
        lines = latest(read_lines(file), CELLS[file.name])
        written = target / file.relative_to(source)
        written.unlink(missing_ok=True)
        append_lines(written, lines)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
