"""Result lines of others: whether they can stand beside the published ones.

The input is untrusted. Its size is limited, and nothing in it is run.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import groupby, product
from operator import itemgetter
from pathlib import Path
from typing import Any

from imujoco_minari.benchmark import few_shot, offline, protocol
from imujoco_minari.benchmark.lines import Line, parsed
from imujoco_minari.benchmark.scores import TYPICAL_BUDGET
from imujoco_minari.errors import BenchmarkError, clipped
from imujoco_minari.variants import EXPERT, held_out

# The digests, references and versions of the published results: `scripts/generate-docs` writes it.
PUBLISHED = Path(__file__).with_name("published.json")
# All lines of a method take about 1.5 MB.
MAX_BYTES, MAX_LINES, MAX_LINE, MAX_FAULTS = 2**23, 100_000, 2**17, 50
# The versions that decide the data and the episodes. A method need not use the others.
VERSIONS = ("imujoco-minari", "mujoco", "gymnasium", "numpy")
_FEW: dict[str, type] = dict.fromkeys(("method", "split", "tier", "variant", "budget", "train_sha256"), str)
_OFFLINE: dict[str, type] = {"method": str, "robot": str, "tier": str, "checkpoints": list, "variants": list}
_BOTH: dict[str, type] = {"seed": int, "episodes": int, "settings": dict, "versions": dict, "results": dict}
_BOTH |= {"data_sha256": str, "policies_sha256": str}


def check_submission(folder: Path) -> list[str]:
    """Return what is missing or wrong in the lines of a method: a sentence each, none if they are whole.

    Each split and tier, and each offline dataset, of which the folder has a line must be whole.

    Args:
        folder: has ``few-shot.jsonl``, ``offline.jsonl`` or both.

    Raises:
        BenchmarkError: if the folder has neither file.

    Example:
        >>> check_submission(Path("docs/results/others/nearest-neighbour"))  # doctest: +SKIP
        []
    """
    files = [folder / each.FILE for each in (few_shot, offline) if (folder / each.FILE).is_file()]
    if not files:
        raise BenchmarkError(f"{folder} has neither {few_shot.FILE} nor {offline.FILE}")
    faults: list[str] = []
    methods: set[str] = set()
    for file in files:
        lines, found = _read(file)
        own = {line["method"] for line in lines}
        methods |= own
        if len(own) == 1:
            found += [f"{file.name}: {fault}" for fault in _faults_together(lines)]
        faults += found if lines or found else [f"{file.name}: no lines"]
    if len(methods) > 1:
        faults.append(f"a folder has one method, but these lines are of {len(methods)}")
    return faults


def _read(file: Path) -> tuple[list[Line], list[str]]:
    """Return the lines without a fault, as far as they are compared with each other, and the faults."""
    is_few = file.name == few_shot.FILE
    faults_of, kinds = (few_shot_fault, _FEW) if is_few else (offline_fault, _OFFLINE)
    lines: list[Line] = []
    facts: dict[str, Line] = {}
    # Not the numbers of all lines: eight million empty lines would take 320 MiB.
    counts: Counter[str] = Counter()
    first: dict[str, int] = {}
    faults = []
    try:
        for number, text in _texts(file):
            try:
                line = parsed(text, facts)
                found = [] if line is None else faults_of(line)
            except ValueError as error:
                line, found = None, [str(error)]
            if not text.endswith(b"\n"):
                found = ["it has no line break at its end, so it may be incomplete"]
            if line is not None and not found:
                # The rest of an untrusted line may be large.
                kept = {key: line[key] for key in (*kinds, "seed", "settings")}
                lines.append(kept | {"results": sorted(line["results"])})
            for each in found:
                fault = each if each in counts or len(counts) < MAX_FAULTS else "other faults"
                counts[fault] += 1
                first.setdefault(fault, number)
    except (BenchmarkError, OSError) as error:
        faults.append(f"{file.name}: {error}")
    return lines, [
        *faults,
        *(f"{file.name}, line {first[fault]}: {fault} (lines: {count})" for fault, count in counts.items()),
    ]


def _texts(file: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the bytes of each line."""
    if file.stat().st_size > MAX_BYTES:
        raise BenchmarkError(f"larger than {MAX_BYTES // 2**20} MiB: not read")
    with file.open("rb") as opened:
        for number in range(1, MAX_LINES + 1):
            text = opened.readline(MAX_LINE + 1)
            if not text:
                return
            if len(text) > MAX_LINE:
                raise BenchmarkError(
                    f"line {number} is longer than {MAX_LINE // 2**10} KiB: not read further"
                )
            yield number, text
    raise BenchmarkError(f"more than {MAX_LINES:,} lines: not read further")


def few_shot_fault(line: Line) -> list[str]:
    """Return what is wrong with one few-shot line."""
    if found := _shape(line, _FEW, protocol.NAME):
        return found
    split, tier, variant = line["split"], line["tier"], line["variant"]
    published = _published()[protocol.NAME]
    if f"{split} {tier}" not in published["train"] or variant not in held_out(split).test:
        which = f"{_shown(variant)} in the split {_shown(split)} with the tier {_shown(tier)}"
        return [f"the published results do not have {which}"]
    own, train = published["variants"][f"{variant} {tier}"], published["train"][f"{split} {tier}"]
    # A method need not learn from the training data.
    wanted = own | ({"train_sha256": train} if line["train_sha256"] else {})
    return _differences_from(line, wanted) + _measured(line["results"])


def offline_fault(line: Line) -> list[str]:
    """Return what is wrong with one offline line."""
    if found := _shape(line, _OFFLINE, offline.NAME):
        return found
    own = _published()[offline.NAME].get(f"{line['robot']} {line['tier']}")
    if own is None:
        which = f"the tier {_shown(line['tier'])} of {_shown(line['robot'])}"
        return [f"the published results do not have {which}"]
    # An expensive algorithm may stop early.
    checkpoints = own["checkpoints"][: max(1, len(line["checkpoints"]))]
    found = _differences_from(line, own | {"checkpoints": checkpoints})
    if set(line["results"]) != set(own["variants"]):
        return [*found, "its results are not of the protocol's variants"]
    steps = set(map(str, checkpoints))
    for result in line["results"].values():
        if not isinstance(result, dict) or set(result) != steps:
            return [*found, f"its results are not of the protocol's checkpoints: {', '.join(sorted(steps))}"]
        found += _measured(result, errors=False)
    return list(dict.fromkeys(found))


def _shape(line: Line, kinds: dict[str, type], name: str) -> list[str]:
    """Return faults of the keys, types and protocol."""
    if line.get("protocol") != name:
        return [f"the protocol is {_shown(line.get('protocol'))}, not {name}"]
    found = [
        f"{key} is missing or not {kind.__name__}"
        for key, kind in (kinds | _BOTH).items()
        if not isinstance(line.get(key), kind) or isinstance(line.get(key), bool)
    ]
    if not found and not (line["settings"] and all(map(_plain, line["settings"].values()))):
        found.append("its settings are not stated as texts, numbers, truth values or lists of them")
    return found


def _differences_from(line: Line, published: Mapping[str, Any]) -> list[str]:
    """Return what decided a line otherwise than the published lines."""
    wanted = published | _published()["versions"] | {"episodes": protocol.EVALUATION_EPISODES}
    stated = {**line, **{name: line["versions"].get(name) for name in VERSIONS}}
    return [
        f"{key} is {_shown(stated.get(key))}; the published results have {value}"
        for key, value in wanted.items()
        if stated.get(key) != value
    ]


def _measured(results: Mapping[str, Any], errors: bool = True) -> list[str]:
    """Return faults of the results by number of gradient steps."""
    episodes = protocol.EVALUATION_EPISODES
    if not results:
        return ["it has no results"]
    for steps, result in results.items():
        if not (steps.isascii() and steps.isdecimal() and len(steps) < 10):
            return [f"{_shown(steps)} is not a number of gradient steps"]
        returns = result.get("returns") if isinstance(result, dict) else None
        if not isinstance(returns, list) or len(returns) != episodes or not all(map(_finite, returns)):
            return [f"returns are not {episodes} finite numbers"]
        if errors and not _finite(result.get("error")):
            return ["the error of the actions is not a finite number"]
    return []


def _shown(value: object) -> str:
    """Return an untrusted value as a short text of one line, without control characters."""
    return clipped(ascii(value) if isinstance(value, str | int | float | None) else type(value).__name__)


def _finite(value: object) -> bool:
    # An integer of many digits is no return, and cannot become a float.
    return type(value) in (int, float) and abs(value) < 1e12 and math.isfinite(value)  # type: ignore[arg-type]


def _plain(value: object) -> bool:
    values = value if isinstance(value, list) else [value]
    return all(isinstance(each, bool | int | float | str) for each in values)


def _faults_together(lines: Sequence[Line]) -> Iterator[str]:
    """Yield how lines differ, and the cells that their splits or datasets lack or have twice."""
    stated = {json.dumps(line["settings"], sort_keys=True) for line in lines}
    if len(stated) > 1:
        yield f"the lines have {len(stated)} different settings; a method has one"
    few = "split" in lines[0]
    of_group = itemgetter("split" if few else "robot", "tier")
    of_cell = itemgetter("variant", "budget", "seed") if few else lambda line: (line["seed"],)
    for (group, tier), grouped in groupby(sorted(lines, key=of_group), of_group):
        own, name = list(grouped), f"{group}, {tier}"
        if few:
            split = held_out(group)
            # Sampled actions are compared with one budget.
            budgets = map(str, protocol.budgets_of(split)) if tier == EXPERT else [TYPICAL_BUDGET]
            wanted: list[tuple[Any, ...]] = list(product(split.test, budgets, range(protocol.SEEDS)))
        else:
            number = max(offline.LEAST_SEEDS, min(offline.SEEDS, len({line["seed"] for line in own})))
            wanted = [(seed,) for seed in range(number)]
        yield from _differences(name, wanted, Counter(map(of_cell, own)))
        if len({line.get("train_sha256") for line in own}) > 1:
            yield f"{name}: some lines have training data, others none"
        if len({tuple(line["results"]) for line in own}) > 1:
            yield f"{name}: the lines differ in their gradient steps"


def _differences(
    name: str, wanted: Sequence[tuple[Any, ...]], cells: Mapping[tuple[Any, ...], int]
) -> Iterator[str]:
    missing = [cell for cell in wanted if not cells.get(cell)]
    unknown = sorted(set(cells) - set(wanted))
    twice = [cell for cell, count in cells.items() if count > 1]
    for what, found in (("lacks", missing), ("has what the protocol lacks:", unknown), ("repeats", twice)):
        if found:
            shown = ", ".join([*map(_shown, found[0][:-1]), f"seed {_shown(found[0][-1])}"])
            more = f" and {len(found) - 1} more" if len(found) > 1 else ""
            yield f"{name}: {what} {shown}{more} ({len(wanted) - len(missing)} of {len(wanted)} cells)"


@cache
def _published() -> Mapping[str, Any]:
    content: Mapping[str, Any] = json.loads(PUBLISHED.read_text("utf-8"))
    return content
