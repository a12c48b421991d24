"""How much disk and time long work will take. The constants were measured on one core of a 2-core machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import filesize

from imujoco_minari.cli.printing import counted
from imujoco_minari.errors import DatasetError, ImujocoError, clipped
from imujoco_minari.policies import own_record
from imujoco_minari.policies.tiers import MEDIUM_REPLAY
from imujoco_minari.storage import minari_root
from imujoco_minari.variants import BASE, Variant, parse_dataset_id, specification

if TYPE_CHECKING:
    from imujoco_minari.publishing.recipes import Recipe

# Publishing.
SECONDS_PER_STEP, SECONDS_PER_EPISODE = 1.1e-4, 5e-3
# The training run of medium-replay: means over the three bases.
STEPS_TO_MEDIUM, SECONDS_PER_TRAINING_STEP = 100_000, 2.6e-3
# Training: means over the shipped experts, and about 400 s for the search of the context of a start. A base
# comes with its whole agent and its ladder.
SECONDS_PER_EXPERT, BYTES_PER_EXPERT = 245 + 400, 160_000
SECONDS_PER_BASE, BYTES_PER_BASE = 2200, 4_000_000
# The original's archive: the table of a dataset, and a policy's zip; importing torch is most of the start.
SECONDS_PER_TABLE_STEP, SECONDS_PER_ZIP, SECONDS_TO_START = 3e-6, 0.04, 5.0
BYTES_PER_ZIP = 1_480_000
# The gallery: a clip, a portrait and a page.
SECONDS_PER_CLIP, BYTES_PER_CLIP = 4.0, 45_000


@dataclass(frozen=True)
class Planned:
    """What ``imujoco publish`` would do for one dataset.

    Attributes:
        dataset_id: the dataset's id.
        action: ``publish``, ``replace`` or ``leave alone``.
        episodes: number of episodes; 0 for a training run, whose number is not known before.
        bytes: about how much disk it takes.
        seconds: about how long one process works on it.
        error: why it would fail; empty when it would not.
        missing: whether it would fail because something that was asked for does not exist.
    """

    dataset_id: str
    action: str = "publish"
    episodes: int = 0
    bytes: int = 0
    seconds: float = 0.0
    error: str = ""
    missing: bool = False


def plan(recipe: Recipe, *, force: bool = False) -> Planned:
    """Return what publishing a recipe would do, without doing it."""
    from imujoco_minari.publishing.new_dataset import find_published
    from imujoco_minari.publishing.sizes import bytes_per_step, expected_bytes, steps_per_episode

    exists = minari_root.exists(recipe.dataset_id)
    action = "replace" if exists else "publish"
    if recipe.tier == MEDIUM_REPLAY:
        if exists and not force:
            return Planned(recipe.dataset_id, "leave alone")
        size = STEPS_TO_MEDIUM * bytes_per_step(recipe.nominal)
        return Planned(recipe.dataset_id, action, 0, size, STEPS_TO_MEDIUM * SECONDS_PER_TRAINING_STEP)
    try:
        if find_published(recipe.dataset_id, recipe.stated(recipe.parts()), force=force):
            return Planned(recipe.dataset_id, "leave alone")
    except ImujocoError as error:
        return Planned(recipe.dataset_id, error=str(error), missing=error.missing)
    steps = recipe.episodes * steps_per_episode(recipe)
    seconds = steps * SECONDS_PER_STEP + recipe.episodes * SECONDS_PER_EPISODE
    return Planned(recipe.dataset_id, action, recipe.episodes, expected_bytes(recipe), seconds)


def publishing_line(planned: Sequence[Planned], jobs: int) -> str:
    """Return one line with the disk and the time that publishing the plan takes."""
    wanted = [each for each in planned if each.action != "leave alone" and not each.error]
    return work_line(
        "dataset", "publish", len(planned), [(each.bytes, each.seconds) for each in wanted], jobs
    )


def training_line(variants: Sequence[Variant], policies: Path | None, jobs: int, *, improve: bool) -> str:
    """Return one line with the disk and the time that training takes: the missing experts, or all of them."""
    base, expert = (BYTES_PER_BASE, SECONDS_PER_BASE), (BYTES_PER_EXPERT, SECONDS_PER_EXPERT)
    wanted = [variant for variant in variants if improve or not own_record(variant, policies)]
    costs = [base if variant.category == BASE else expert for variant in wanted]
    return work_line("expert", "train", len(variants), costs, jobs)


def work_line(noun: str, verb: str, count: int, costs: Sequence[tuple[int, float]], jobs: int) -> str:
    """Return one line with the cost of work: the bytes and seconds of each item that is not done yet."""
    line = counted(count, noun)
    if len(costs) < count:
        line += f", {len(costs)} of them to {verb}"
    sizes, seconds = zip(*costs, strict=True) if costs else ((), ())
    return f"{line}: {cost(sum(sizes), sum(seconds), jobs)}"


def gallery_line(count: int) -> str:
    """Return one line with the disk and the time that a gallery of ``count`` variants and bases takes."""
    drawing = cost(count * BYTES_PER_CLIP, count * SECONDS_PER_CLIP)
    return f"{count} variants and bases: {drawing}, less for those that are drawn already"


def plan_export(dataset_ids: Sequence[str], *, archive: bool) -> dict[str, Any]:
    """Return the numbers of datasets, episodes and steps of an export, its bytes and its seconds.

    The last two are 0 unless it is an ``archive``, which means the original's layout.

    Raises:
        DatasetError: if a dataset does not state its numbers of episodes and steps.
    """
    counts = [_stated_counts(dataset_id) for dataset_id in dataset_ids]
    steps = sum(own_steps for _, own_steps in counts)
    size, seconds = 0, 0.0
    if archive:
        seconds = SECONDS_TO_START + SECONDS_PER_TABLE_STEP * steps + SECONDS_PER_ZIP * len(dataset_ids)
        for dataset_id, (_, own_steps) in zip(dataset_ids, counts, strict=True):
            observation, action = specification(parse_dataset_id(dataset_id)[0].robot).sizes
            # Two observations, the action, the reward and two flags, all as float64.
            size += BYTES_PER_ZIP + 8 * (2 * observation + action + 3) * own_steps
    episodes = sum(own_episodes for own_episodes, _ in counts)
    numbers = {"datasets": len(dataset_ids), "episodes": episodes, "steps": steps}
    return numbers | {"bytes": size, "seconds": seconds}


def export_line(planned: Mapping[str, Any]) -> str:
    """Return the numbers of :func:`plan_export` in one line."""
    line = ", ".join(counted(planned[f"{noun}s"], noun) for noun in ("dataset", "episode", "step"))
    return f"{line}: {cost(planned['bytes'], planned['seconds'])}" if planned["bytes"] else line


def _stated_counts(dataset_id: str) -> tuple[int, int]:
    """Return the numbers of episodes and steps that a dataset states."""
    from imujoco_minari.storage.metadata import read_metadata

    stated = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    for key in ("total_episodes", "total_steps"):
        count = stated.get(key)
        if not isinstance(count, int) or not 0 <= count < 2**53:
            raise DatasetError(
                f"{dataset_id}: {key} in metadata.json is {clipped(repr(count))}, which is no count; "
                f"see `imujoco verify {dataset_id}`"
            )
    return stated["total_episodes"], stated["total_steps"]


def cost(size: int, seconds: float, jobs: int = 1) -> str:
    """Return an amount of disk and of time in words, as in ``about 2.4 GB and 28 minutes``."""
    text = f"about {filesize.decimal(size)} and {time_text(seconds / jobs)}"
    return text + (f" with {jobs} processes on as many cores" if jobs > 1 else "")


def time_text(seconds: float) -> str:
    """Return a duration as people read it."""
    if seconds >= 2 * 3600:
        return f"{seconds / 3600:.1f} hours"
    return counted(round(seconds / 60), "minute") if seconds >= 90 else counted(round(seconds), "second")
