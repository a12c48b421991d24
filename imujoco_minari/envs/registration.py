"""From variants to Gymnasium specs, and the registry: every catalogue id, and any other id on demand.

A spec holds strings only: an entry point, ids, and for variants of the original archive the MJCF texts of
their models. So a spec that a dataset stores works on any machine that has this package.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, registry

from imujoco_minari.errors import ArgumentError, CatalogueWarning, ImujocoError, VariantError
from imujoco_minari.variants import (
    BASE,
    NAMESPACE,
    Variant,
    carried_page,
    catalogue,
    held_out_names,
    known_robots,
    specification,
)
from imujoco_minari.variants.original import ORIGINAL, OriginalVariant
from imujoco_minari.variants.ranges import RANDOMISED, UNIFORM, Ranges, drawing_ranges
from imujoco_minari.variants.robots import forget_on_error, keep_fault, load_page, page_files

MAX_EPISODE_STEPS = 1000

_MODULE = "imujoco_minari.envs"
_COLLECTION = f"{_MODULE}:CollectionEnv"
_RANDOMISED = f"{_MODULE}:RandomisedEnv"
# Datasets that were published before VariantEnv took a text store these.
_EARLIER = re.compile(r"imujoco_minari\.importing\.environments:Original(\w+)Env", re.ASCII)


def max_episode_steps(robot: str) -> int | None:
    """Return the number of steps after which an episode of a robot is truncated; None if no number does.

    The robot's page states it, or else it is that of Gymnasium's environment.
    """
    page = specification(robot)
    stock = registry.get(page.environment)
    return page.max_episode_steps or (None if stock is None else stock.max_episode_steps)


def environment_spec(variant: Variant | str, mjcf: str | None = None) -> EnvSpec:
    """Return the Gymnasium spec of a variant's environment.

    Args:
        variant: a variant or its id.
        mjcf: the text of the model, for a variant of the original archive only: its model does not follow
            from its id. An id with a text names a variant of the archive.

    Raises:
        VariantError: when ``variant`` is not a variant id, a variant of the archive has no text, or another
            variant has one.
    """
    if not isinstance(variant, Variant):
        variant = (Variant if mjcf is None else OriginalVariant).parse(variant)
    if isinstance(variant, OriginalVariant) and mjcf is None:
        raise VariantError(f"{variant} is a variant of the original archive and needs the text of its model")
    if not isinstance(variant, OriginalVariant) and mjcf is not None:
        raise VariantError(f"the model of {variant} follows from its id, so it takes no text of a model")
    kwargs = {"variant": str(variant)} | ({} if mjcf is None else {"mjcf": mjcf}) | _page(variant.robot)
    return _spec(variant.environment_id, _entry_point(variant.robot), variant.robot, kwargs)


def collection_spec(
    name: str, variants: Iterable[Variant | str], models: Mapping[str, str] | None = None
) -> EnvSpec:
    """Return the Gymnasium spec of the environment of a collection.

    Args:
        name: of the collection, without namespace and version.
        variants: of one robot, or their ids.
        models: id -> MJCF text for each of them, where they are of the original archive.

    Raises:
        ArgumentError: when ``variants`` is one text or empty.
    """
    ids = [] if isinstance(variants, str) else [str(variant) for variant in variants]
    if not ids:
        raise ArgumentError(f"{variants!r} is no list of variants; valid: ids or variants of one robot")
    robot = next(iter(ids), "").partition("-")[0]
    if models:
        kwargs: dict[str, Any] = {"models": {variant: models[variant] for variant in ids}}
    else:
        kwargs = {"variants": ids, **_page(robot)}
    return _spec(f"{ORIGINAL if models else NAMESPACE}/{name}-v0", _COLLECTION, robot, kwargs)


def randomised_spec(ranges: Ranges | str) -> EnvSpec:
    """Return the Gymnasium spec of the environment that draws variants from ranges.

    Args:
        ranges: the ranges, or a robot for those of the catalogue.
    """
    robot, arguments = str(ranges), {}
    if isinstance(ranges, Ranges):
        bounds = {name: list(pair) for name, pair in ranges.ranges.items()}
        robot, arguments = ranges.robot, {"ranges": bounds, "distribution": ranges.distribution}
    kwargs = {"robot": robot, **arguments, **_page(robot)}
    return _spec(f"{NAMESPACE}/{robot}-{RANDOMISED}-v0", _RANDOMISED, robot, kwargs)


def dataset_spec(name: str, variants: Sequence[Variant | str], models: Mapping[str, str]) -> EnvSpec:
    """Return the Gymnasium spec of a dataset with episodes of ``variants``: of the one, or of a collection.

    ``name`` is that of the collection, and ``models`` is what :func:`stored_models` returns.

    Raises:
        VariantError: when a variant of the original archive has no model, or another variant has one.
    """
    specs = [environment_spec(variant, models.get(str(variant))) for variant in variants]
    if len(specs) == 1:
        return specs[0]
    if len({"mjcf" in spec.kwargs for spec in specs}) > 1:
        raise VariantError("variants of the original archive and of our catalogue share no environment")
    return collection_spec(name, variants, models)


def dataset_name(dataset_id: str) -> str:
    """Return the name in a dataset id, without namespace and version."""
    return dataset_id.rpartition("/")[2].rpartition("-v")[0]


def stored_models(arguments: Any) -> dict[str, str]:
    """Return variant id -> MJCF text for the models in the ``kwargs`` of a dataset's ``env_spec``.

    It is empty for variants whose models follow from their ids.
    """
    if not isinstance(arguments, Mapping):
        return {}
    models = arguments.get("models", {arguments.get("variant"): arguments.get("mjcf")})
    if not isinstance(models, Mapping):
        return {}
    return {str(name): text for name, text in models.items() if isinstance(text, str)}


def current_spec(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a stored spec, with today's entry point where it has an earlier version's."""
    earlier = _EARLIER.fullmatch(str(stored.get("entry_point")))
    if earlier is None:
        return dict(stored)
    name = "CollectionEnv" if earlier[1] == "Collection" else f"{earlier[1]}VariantEnv"
    return {**stored, "entry_point": f"{_MODULE}:{name}"}


def is_entry_point(entry_point: Any) -> bool:
    """Return whether a value is today's entry point of one of this package's environments."""
    return entry_point in (_COLLECTION, _RANDOMISED, *map(_entry_point, known_robots()))


def make(variant: Variant | str, mjcf: str | None = None, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make the environment of any variant of the grammar, in the catalogue or not.

    Args:
        variant: a variant or its id, as in ``hopper-massinc_37_torsogeom``.
        mjcf: the text of the model, for a variant of the original archive.
        **kwargs: what ``gymnasium.make`` takes, ``render_mode`` among them.

    Raises:
        VariantError: when ``variant`` is not a variant id.
        ModelError: when the text is refused.

    Example:
        >>> make("hopper-massinc_37_torsogeom").observation_space.shape
        (11,)
    """
    return gym.make(environment_spec(variant, mjcf), **kwargs)


def randomised(
    robot: str,
    ranges: Mapping[str, Sequence[float]] | None = None,
    distribution: str = UNIFORM,
    **kwargs: Any,
) -> gym.Env[Any, Any]:
    """Make an environment that draws parameters of a robot at each reset.

    It is registered as ``imujoco/<robot>-randomised-v0``, which takes the same arguments.

    Args:
        robot: the robot, as in ``hopper``.
        ranges: parameter -> lowest and highest percent of change; None for those of the catalogue: every
            parameter from its lowest to its highest listed percent.
        distribution: ``uniform`` draws the percent uniformly; ``log-uniform`` draws the logarithm of the
            factor 1 + percent / 100 uniformly.
        **kwargs: what ``gymnasium.make`` takes, and ``parameters`` and ``observe_context`` of
            :class:`~imujoco_minari.envs.drawing.RandomisedEnv`.

    Raises:
        VariantError: if there is no such robot or parameter, or a parameter cannot have such a percent.
        DrawingError: if a range or the distribution is not valid.

    Example:
        >>> env = randomised("hopper", {"mass/torsogeom": (-50, 100), "friction/feet": (-50, 50)})
        >>> env.reset(seed=0)[1]["variant"]
        'hopper-massinc_91p44_torsogeom-frictiondec_18p37_feet'
    """
    bounds = drawing_ranges(robot) if ranges is None else ranges
    return gym.make(randomised_spec(Ranges(robot, bounds, distribution)), **kwargs)


def register(variant: Variant | str) -> str:
    """Register a variant outside the catalogue with Gymnasium and return its environment id.

    Raises:
        VariantError: when ``variant`` is not a variant id.
    """
    spec = environment_spec(variant)
    registry.setdefault(spec.id, spec)
    return spec.id


def register_catalogue() -> None:
    """Register the variants of the known robots' pages, the bases, and each robot's collections."""
    for robot in known_robots():
        _register_robot(robot)


def load_catalogue(path: str | Path) -> tuple[str, ...]:
    """Make robots of the user known: register the variants of their pages, as those of the package are.

    A page is a file ``<robot>.toml``, and its MJCF file lies beside it. A dataset of such a robot stores
    both, so its environment can be recovered on machines that have neither. A page with a fault does not
    stop the others of its folder: its robot is left out with a :class:`CatalogueWarning`.

    Args:
        path: a folder with pages, or a page.

    Returns:
        The names of the robots.

    Raises:
        CatalogueError: when there is no page, or each page or its model cannot be read, is wrong, or
            another page of the robot is loaded.
        ModelError: when each model is refused or does not compile.

    Example:
        >>> load_catalogue("my-robots")  # doctest: +SKIP
        ('tallhopper',)
    """
    from imujoco_minari.envs.mjcf import check_robot

    names: list[str] = []
    faults: dict[str, ImujocoError] = {}
    with forget_on_error():
        for robot, file in page_files(path).items():
            try:
                with forget_on_error():
                    load_page(robot, file)
                    check_robot(robot)
                    # This checks the splits of the page.
                    held_out_names(robot)
                    make(f"{robot}-{BASE}").close()
                names.append(robot)
            except ImujocoError as fault:
                faults[robot] = fault
        if not names:
            raise next(iter(faults.values()))
    for robot, reason in faults.items():
        keep_fault(robot, str(reason))
        warnings.warn(f"the robot {robot} is left out: {reason}", CatalogueWarning, stacklevel=2)
    for robot in names:
        _register_robot(robot)
    return tuple(names)


def _register_robot(robot: str) -> None:
    # Straight into the registry: gym.register() compares versions over the whole registry at each
    # call, and 172 calls would take a third of a second of every import.
    specs = [environment_spec(variant) for variant in (*catalogue(robot), Variant(robot))]
    listed = [(category, catalogue(robot, category)) for category in (None, *specification(robot).categories)]
    specs += [collection_spec(f"{robot}-{name or 'all'}", variants) for name, variants in listed if variants]
    for spec in (*specs, randomised_spec(robot)):
        registry.setdefault(spec.id, spec)


def _spec(name: str, entry_point: str, robot: str, kwargs: dict[str, Any]) -> EnvSpec:
    return EnvSpec(name, entry_point, max_episode_steps=max_episode_steps(robot), kwargs=kwargs)


def _page(robot: str) -> dict[str, Any]:
    """Return the argument ``page`` of environments; empty for a robot that the package ships."""
    page = carried_page(robot)
    return {} if page is None else {"page": dict(page)}


def _entry_point(robot: str) -> str:
    return f"{_MODULE}:{specification(robot).title}VariantEnv"
