"""Whether result lines still match the datasets, the policies and the settings of today."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache

from imujoco_minari.benchmark import offline, reproduction
from imujoco_minari.benchmark.few_shot import datasets_of, train_tier
from imujoco_minari.benchmark.lines import Line, data_sha256, expert_variants, is_of_earlier_experts
from imujoco_minari.benchmark.methods import METHODS, settings_of
from imujoco_minari.errors import DatasetNotFoundError, VariantError
from imujoco_minari.variants import held_out


def changes(lines: Iterable[Line]) -> list[str]:
    """Return a sentence for each change since the lines were computed, with the number of lines.

    Lines of your own methods and splits are compared as far as this package knows them.
    """
    _digest.cache_clear()
    counts = Counter(change for line in lines for change in set(_changes(line)))
    return [f"{change} (lines: {count})" for change, count in sorted(counts.items())]


def _changes(line: Line) -> Iterator[str]:
    method, settings, variants = line["method"], None, expert_variants(line)
    if line["protocol"] == reproduction.NAME:
        train, data = reproduction.published_split()
        yield from _data(train, line["train_sha256"])
        settings = asdict(reproduction.DEFAULT)
    elif line["protocol"] in (offline.NAME, offline.ACROSS):
        across = line["protocol"] == offline.ACROSS
        learnt, _ = offline.OfflineGrid(across=across, tiers=()).variants(line["robot"], line["tier"])
        data = [variant.dataset_id(line["tier"]) for variant in learnt]
        known = offline.ACROSS_ALGORITHMS if across else offline.ALGORITHMS
        settings = offline.algorithm_settings(known[method]) if method in known else None
    else:
        data = [variants[-1].dataset_id(line["tier"])]
        settings = settings_of(METHODS[method](0)) if method in METHODS else None
        if line["train_sha256"]:
            # A split of your own is not known here.
            with suppress(VariantError):
                ids = datasets_of(held_out(line["split"]).train, train_tier(line))
                yield from _data(ids, line["train_sha256"])
    yield from _data(data, line["data_sha256"])
    if is_of_earlier_experts(line):
        yield f"the expert of {' or '.join(map(str, variants))} has changed"
    if settings is not None and settings != line["settings"]:
        yield f"the settings of {method} have changed"


def _data(dataset_ids: Sequence[str], digest: str) -> Iterator[str]:
    found = _digest(tuple(dataset_ids))
    if found is None:
        yield "not compared, because their datasets are not in the Minari root"
    elif found != digest:
        first, last = dataset_ids[0], dataset_ids[-1]
        named = first if first == last else f"a dataset from {first} to {last}"
        yield f"{named} is not the data of these lines: another policy, seed or number of episodes"


@cache
def _digest(dataset_ids: tuple[str, ...]) -> str | None:
    try:
        return data_sha256(dataset_ids)
    except DatasetNotFoundError:
        return None
