"""Benchmarks of the import and of quick commands, against the imports that they need."""

from __future__ import annotations

import subprocess
import sys

from scripts.speed.measuring import Row, take_turns, times


def starting_rows(rounds: int) -> list[Row]:
    """Measure imports and the commands ``list`` and ``show``."""

    def python(*arguments: str) -> None:
        subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)

    python("-c", "import imujoco_minari, minari")
    seconds = take_turns(
        {
            "import imujoco_minari": lambda: python("-c", "import imujoco_minari"),
            "import gymnasium": lambda: python("-c", "import gymnasium"),
            "import minari": lambda: python("-c", "import minari"),
            "imujoco list": lambda: python("-m", "imujoco_minari", "list"),
            "imujoco show": lambda: python("-m", "imujoco_minari", "show", "hopper-massdec_25_leggeom"),
        },
        rounds,
        processes=True,
    )
    pairs = zip(seconds["import imujoco_minari"], seconds["import gymnasium"], strict=True)
    over = sorted(ours - theirs for ours, theirs in pairs)[rounds // 2]
    figures = times(seconds, 1000)
    return [
        Row(
            "import imujoco_minari",
            {name: figures[name] for name in ("import imujoco_minari", "import gymnasium", "import minari")},
            "ms",
            {"ms over import gymnasium": over * 1000},
            {"ms over import gymnasium": ("most", 30.0)},
        ),
        Row(
            "imujoco list, imujoco show",
            {name: figures[name] for name in ("imujoco list", "imujoco show")},
            "ms",
            {"list, s": figures["imujoco list"] / 1000, "show, s": figures["imujoco show"] / 1000},
            {"list, s": ("most", 0.4), "show, s": ("most", 0.6)},
        ),
    ]
