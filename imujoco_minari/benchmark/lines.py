"""Result lines: one JSON object for each cell, with everything that decided the result.

A line's *identity* is all of it but the measured entries. A cell is computed once for each identity: when a
dataset, a policy, a setting or a version changes, the old line no longer matches and the cell runs again.

A file stores what many lines share once: an entry ``{"name": ..., "facts": {...}}`` precedes the entries that
name it. A line is an entry with the facts that it names, or an entry that has all of them itself.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from imujoco_minari.errors import (
    BenchmarkError,
    ImujocoError,
    JobError,
    PolicyNotFoundError,
    StorageError,
    clipped,
)
from imujoco_minari.parallel import run_jobs
from imujoco_minari.policies import expert_actor
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.variants import Variant

Line = Mapping[str, Any]

_MEASURED = ("references", "results", "seconds")
# What an entry has of its own. The rest are the facts of its data and those of its method.
_OWN = ("seed", "budget", "results", "seconds")
_OF_DATA = ("variant", "variants", "robot", "data_sha256", "policies_sha256", "references")
# Facts are small, and an entry names few of them: a small file cannot stand for many large lines.
_MOST_FACTS, _MOST_NAMED = 20, 2
# The metadata that decide a dataset, beside its number of episodes.
_DECIDES = ("source_sha256", "seed", "policy_sha256", "policy_deterministic", "hyperparameters")
_PACKAGES = ("imujoco-minari", "mujoco", "gymnasium", "numpy", "jax", "optax")


def _has_results(line: Line) -> None:
    line["results"].items()


def read_lines(path: Path, check: Callable[[Line], object] = _has_results) -> list[Line]:
    """Return the lines of a results file; none if it does not exist.

    The last entry may be incomplete, because a run was killed: it is left out.

    Args:
        path: the file.
        check: called with each line. It raises an error if the line is not a result.

    Raises:
        BenchmarkError: if another entry is malformed.
    """
    return _read(path, check)[0]


def _read(path: Path, check: Callable[[Line], object]) -> tuple[list[Line], dict[str, Line]]:
    """Return the lines of a results file, and the facts that it states by name."""
    lines: list[Line] = []
    facts: dict[str, Line] = {}
    if not path.exists():
        return lines, facts
    try:
        *whole, _ = path.read_bytes().split(b"\n")
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from None
    for number, text in enumerate(whole, start=1):
        try:
            if (line := parsed(text, facts)) is not None:
                check(line)
                lines.append(line)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            why = f"it has no {error.args[0]}" if isinstance(error, KeyError) else clipped(error)
            raise BenchmarkError(f"{path}, line {number}: not a result of the benchmark: {why}") from None
    return lines, facts


def parsed(text: bytes, facts: dict[str, Line]) -> Line | None:
    """Return the line that an entry, JSON in UTF-8, stands for, or None if it only adds to the facts.

    Raises:
        ValueError: if the entry is malformed, or names facts that are not stated before it.
    """
    try:
        # Of bytes, json would take other encodings too.
        entry = json.loads(text.decode("utf-8"))
    # Deep nesting exhausts the stack.
    except (ValueError, RecursionError):
        entry = None
    if not isinstance(entry, dict):
        raise ValueError("not a JSON object")
    stated, name = entry.get("facts", []), entry.get("name")
    if isinstance(stated, dict) and isinstance(name, str) and len(stated) <= _MOST_FACTS:
        facts[name] = stated
        return None
    if not isinstance(stated, list) or len(stated) > _MOST_NAMED:
        raise ValueError("its facts are malformed")
    line: dict[str, Any] = {}
    for name in stated:
        if not isinstance(name, str) or name not in facts:
            raise ValueError("its facts are not stated before it")
        line |= facts[name]
    return line | {key: value for key, value in entry.items() if key != "facts"}


def append_lines(path: Path, lines: Sequence[Line], stated: set[str] | None = None) -> None:
    """Add lines to a results file. It removes an incomplete last entry.

    ``stated`` has the names of the facts that the file already states. The new ones are added to it.

    Raises:
        StorageError: if the file cannot be written.
    """
    stated = set() if stated is None else stated
    entries: list[Line] = []
    for line in lines:
        facts = _facts(line)
        entries += ({"name": name, "facts": facts[name]} for name in facts if name not in stated)
        stated.update(facts)
        entries.append({"facts": list(facts), **{key: line[key] for key in _OWN if key in line}})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            end = file.tell()
            file.seek(max(0, end - 2**20))
            tail = file.read()
            file.truncate(end - (len(tail) - tail.rfind(b"\n") - 1))
            for entry in entries:
                file.write(json.dumps(entry, separators=(",", ":")).encode() + b"\n")
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from None


def _facts(line: Line) -> dict[str, Line]:
    """Return what a line may share with others, by names that are digests: of its method, and of its data."""
    found: dict[str, Line] = {}
    for of_data in (False, True):
        facts = {key: line[key] for key in line if key not in _OWN and (key in _OF_DATA) is of_data}
        found[sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]] = facts
    return found


def identity(line: Line) -> str:
    """Return the identity of a line as text: all of it but the measured entries."""
    return json.dumps({key: line[key] for key in line if key not in _MEASURED}, sort_keys=True)


def run_lines(
    path: Path,
    compute: Callable[[Sequence[Line]], Iterable[Line]],
    wanted: Sequence[Line],
    on_cells: Callable[[int], None],
) -> list[Line]:
    """Compute the lines that a results file lacks, and return all that are wanted.

    Args:
        path: the results file. Each line is written as soon as it is known.
        compute: yields each line that it gets with its measured entries.
        wanted: lines without measured entries.
        on_cells: called with the number of lines that have become known.

    Raises:
        StorageError: if a line cannot be written.
    """
    lines, facts = _read(path, _has_results)
    known, stated = {identity(line): line for line in lines}, set(facts)
    # A cell that is asked for twice is computed once.
    asked = {identity(line): line for line in wanted}
    done = [known[each] for each in asked if each in known]
    missing = [line for each, line in asked.items() if each not in known]
    on_cells(len(done))
    # A file that cannot be written is found before the first cell is computed.
    if missing:
        append_lines(path, [])
    for line in compute(missing):
        append_lines(path, [line], stated)
        done.append(line)
        on_cells(1)
    return done


def measure_each(measure: Callable[[Line], Line], jobs: int, lines: Sequence[Line]) -> Iterator[Line]:
    """Yield each line with its measured entries, which ``measure`` adds in one of several processes.

    Raises:
        BenchmarkError: if a process was lost.
    """
    for number, line in run_jobs(measure, lines, jobs=jobs):
        if isinstance(line, JobError):
            raise BenchmarkError(f"{lines[number]['method']}, seed {lines[number]['seed']}: {line}")
        yield line


@contextmanager
def named(line: Line) -> Iterator[None]:
    """Put the cell of a line before the errors of this package that are raised inside."""
    try:
        yield
    except ImujocoError as error:
        where = [line["method"], line.get("variant") or f"{line['robot']} {line['tier']}", line.get("budget")]
        raise BenchmarkError(f"{', '.join(filter(None, where))}, seed {line['seed']}: {error}") from None


def latest(lines: Iterable[Line], keys: tuple[str, ...]) -> list[Line]:
    """Return the last line of each cell, where ``keys`` identify a cell."""
    return list({tuple(json.dumps(line.get(key)) for key in keys): line for line in lines}.values())


def versions() -> dict[str, str]:
    """Return the versions of the packages that decide a result."""
    found = {}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def data_sha256(dataset_ids: Iterable[str]) -> str:
    """Return a digest of what decides published datasets: their ids, policies, seeds and numbers of episodes.

    Their arrays depend on the processor architecture too, in the last bits. They are left out, so that
    results can be continued and compared on any machine.

    Raises:
        DatasetNotFoundError: if one is not in the Minari root.
    """
    recipes = [[dataset_id, _recipe(dataset_id)] for dataset_id in dataset_ids]
    return sha256(json.dumps(recipes, sort_keys=True).encode()).hexdigest()


def _recipe(dataset_id: str) -> dict[str, Any]:
    """Return the metadata that decide a dataset."""
    if not minari_root.exists(dataset_id):
        raise not_in_root(dataset_id)
    metadata = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    found = {key: metadata[key] for key in _DECIDES if key in metadata}
    if not found:
        return {"content_sha256": metadata.get("content_sha256", "")}
    # How many episodes a training run has depends on the processor.
    return found if "hyperparameters" in found else found | {"total_episodes": metadata["total_episodes"]}


@cache
def policies_sha256(variants: tuple[Variant, ...]) -> str:
    """Return a digest of the experts of variants; a variant without an expert counts too."""
    digests = []
    for variant in variants:
        try:
            digests.append(expert_actor(variant).sha256)
        except PolicyNotFoundError:
            digests.append("none")
    return sha256(" ".join(digests).encode()).hexdigest()


def expert_variants(line: Line) -> tuple[Variant, ...]:
    """Return the variants whose experts decided a line; the published comparison has none."""
    if "variants" in line:
        return tuple(map(Variant.parse, line["variants"]))
    if "variant" in line:
        variant = Variant.parse(line["variant"])
        return variant.base, variant
    return ()


def is_of_earlier_experts(line: Line) -> bool:
    """Return whether the experts of a line are others than those of now."""
    variants = expert_variants(line)
    return bool(variants) and policies_sha256(variants) != line["policies_sha256"]


@cache
def references(variant: Variant) -> list[float]:
    """Return the returns of a variant that are scored 0 and 1: a random policy's and its expert's.

    Raises:
        BenchmarkError: if the variant has no expert.
    """
    scores = reference_scores(variant)
    if "ref_max_score" not in scores:
        raise BenchmarkError(f"{variant} has no expert to score by: train one with `imujoco train {variant}`")
    return [scores["ref_min_score"], scores["ref_max_score"]]
