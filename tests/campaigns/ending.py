"""How a campaign ends: with what its inputs led to, its failures, and an exit status."""

import sys
from collections.abc import Mapping, Sequence
from typing import NoReturn


def finish(summary: str, ends: Mapping[str, int], failures: Sequence[str]) -> NoReturn:
    """Print the summary, the number of inputs for each end, and the failures; exit with 1 if any failed."""
    print(summary)
    print("  ".join(f"{key} {value}" for key, value in sorted(ends.items())))
    for failure in failures[:20]:
        print("FAILED", failure)
    sys.exit(bool(failures))
