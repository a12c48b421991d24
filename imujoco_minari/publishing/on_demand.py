"""Loads a dataset, and publishes it first where the Minari root does not hold it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from minari import MinariDataset
from rich.console import Console
from rich.progress import Progress

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, VariantError
from imujoco_minari.policies.tiers import RECORDED
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.outcome import Published
from imujoco_minari.publishing.publisher import publish_all, publish_recipe
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.missing import not_in_root
from imujoco_minari.variants import parse_dataset_id
from imujoco_minari.variants.named_collections import NamedCollection


def load_dataset(dataset_id: str, *, jobs: int = 1, quiet: bool = False) -> MinariDataset:
    """Return a dataset of the Minari root. Publish it first if it is missing.

    A missing dataset of a variant is published with 100 episodes of seed 0. For a missing collection, as
    ``imujoco/hopper-all-v0``, every dataset that is missing is published, and all are combined.

    Args:
        dataset_id: the id.
        jobs: number of processes that publish.
        quiet: print nothing on standard error about what is published.

    Raises:
        DatasetIdError: if the id is malformed.
        DatasetNotFoundError: if the dataset is missing and is not one that this function makes. It trains
            nothing: the message names the command that records a training run.
        PolicyNotFoundError: if no policy makes the tier of the variant.
        DatasetError: if a dataset of a collection cannot be published.
        StorageError: if the root cannot be used.

    Example:
        >>> load_dataset("imujoco/hopper-massdec_25_leggeom-v0").total_episodes  # doctest: +SKIP
        100
    """
    folder = minari_root.dataset_folder(dataset_id)
    if not minari_root.exists(dataset_id):
        collection = NamedCollection.parse(dataset_id)
        if collection is not None:
            _publish_missing(collection, jobs, quiet)
            return combine_datasets(collection.sources, dataset_id)
        recipe = _recipe(dataset_id)
        with _progress(dataset_id, "episodes", recipe.episodes, quiet) as advance:
            publish_recipe(recipe, jobs=jobs, on_episode=advance)
    with minari_root.storage_errors():
        return MinariDataset(folder / "data")


def _recipe(dataset_id: str) -> Recipe:
    """Return the recipe of a dataset, or raise a DatasetNotFoundError if it cannot be published."""
    try:
        variant, tier = parse_dataset_id(dataset_id)
    except VariantError:
        raise not_in_root(dataset_id) from None
    if tier in RECORDED:
        raise not_in_root(dataset_id)
    return Recipe(variant, tier)


def _publish_missing(collection: NamedCollection, jobs: int, quiet: bool) -> None:
    """Publish the datasets of a collection that are not in the root; raise the first failure at the end."""
    recipes = [_recipe(source) for source in collection.sources if not minari_root.exists(source)]
    if not recipes:
        return
    failed: list[Published] = []
    with _progress(collection.dataset_id, "datasets", len(recipes), quiet) as advance:
        for outcome in publish_all(recipes, jobs=jobs):
            failed += [outcome] if outcome.error else []
            advance()
    if failed:
        kind = DatasetNotFoundError if failed[0].missing else DatasetError
        raise kind(f"{collection.dataset_id} was not made; {failed[0].dataset_id}: {failed[0].error}")


@contextmanager
def _progress(dataset_id: str, unit: str, total: int, quiet: bool) -> Iterator[Callable[[], None]]:
    """Print what is published, show a bar on a terminal, and yield the function that advances it by one."""
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    if not quiet:
        line = f"{dataset_id} is not in the Minari root: publishing {total} {unit}"
        console.print(line, markup=False)
    with Progress(console=console, disable=quiet or not console.is_terminal) as bar:
        task = bar.add_task(unit, total=total)
        yield lambda: bar.advance(task)
