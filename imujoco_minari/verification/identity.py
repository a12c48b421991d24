"""Do metadata, root and episodes say the same of the dataset, and is it true?

The environment that the metadata names must be one of ours: Minari imports and calls whatever stands
there, at ``recover_environment()`` and, where a space is missing, at ``load_dataset()``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from gymnasium.envs.registration import EnvSpec
from minari import supported_dataset_versions

from imujoco_minari.envs.registration import (
    current_spec,
    dataset_spec,
    is_entry_point,
    randomised_spec,
    stored_models,
)
from imujoco_minari.errors import DrawingError, ImujocoError, VariantError
from imujoco_minari.storage import file_format
from imujoco_minari.variants import Variant
from imujoco_minari.variants.original import CATALOGUE, variant_of
from imujoco_minari.verification import expected, structure
from imujoco_minari.verification.bounded_read import Episode
from imujoco_minari.verification.expected import Content
from imujoco_minari.verification.findings import Finding, plain, same, shown
from imujoco_minari.verification.replay import simulator

_SPACES = ("observation_space", "action_space")


def loadable(metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report metadata with which stock Minari could not load the dataset, or would run what is not ours."""
    if metadata.get("data_format") != "hdf5":
        yield Finding("metadata.json/data_format", f"is {shown(metadata.get('data_format'))}, not 'hdf5'")
    for key in ("dataset_id", "minari_version"):
        if not isinstance(metadata.get(key), str):
            yield Finding(f"metadata.json/{key}", f"is {shown(metadata.get(key))}, not a text")
    for key, space in zip(_SPACES, map(metadata.get, _SPACES), strict=True):
        if not _is_box(space):
            yield Finding(
                f"metadata.json/{key}",
                "is no Box of floats" if key in metadata else "is missing: Minari would make the environment",
            )
    if metadata.get("env_spec") is not None:
        yield from _env_spec("metadata.json/env_spec", metadata["env_spec"])
    if metadata.get("eval_env_spec") is not None:
        yield Finding("metadata.json/eval_env_spec", "is not written by this package: do not load it")
    yield from _types(metadata)


def _types(metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report values with which Minari, or a reader of its metadata, fails."""
    if metadata.get("minari_version") not in sorted(supported_dataset_versions):
        version = shown(metadata.get("minari_version"))
        yield Finding(
            "metadata.json/minari_version", f"is {version}, which the installed Minari does not load"
        )
    for key in ("algorithm_name", "code_permalink", "description"):
        if not isinstance(metadata.get(key), str):
            yield Finding(f"metadata.json/{key}", f"is {shown(metadata.get(key))}, not a text")
    combined = ("combined_datasets",) if "combined_datasets" in metadata else ()
    for key in ("author", "requirements", *combined):
        value = metadata.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(one, str) for one in value):
            yield Finding(f"metadata.json/{key}", f"is {shown(value)}, not a list of texts")


def dataset_models(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return variant id -> MJCF text for the models that a dataset stores; empty where ids imply them."""
    try:
        return stored_models(json.loads(metadata["env_spec"])["kwargs"])
    except (ValueError, TypeError, KeyError, RecursionError):
        return {}


def _is_box(text: Any) -> bool:
    try:
        space = json.loads(text)
        (size,) = space["shape"]
        return (
            space["type"] == "Box"
            and space["dtype"] in ("float32", "float64")
            and len(space["low"]) == len(space["high"]) == size
            and all(isinstance(bound, float | int) for bound in (*space["low"], *space["high"]))
        )
    except (ValueError, TypeError, KeyError, RecursionError):
        return False


def _env_spec(where: str, text: Any) -> Iterator[Finding]:
    try:
        spec = current_spec(json.loads(text))
        entry_point, arguments = spec["entry_point"], spec["kwargs"]
        wrappers, vector = spec["additional_wrappers"], spec.get("vector_entry_point")
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        yield Finding(where, "is no environment's specification")
        return
    if not is_entry_point(entry_point):
        yield Finding(
            where,
            f"makes the environment by {shown(entry_point)}, which is not of this package: do not load it",
        )
    if wrappers or vector is not None:
        yield Finding(where, "wraps the environment in what is not of this package: do not load it")
    if not isinstance(arguments, dict):
        yield Finding(where, f"gives the environment the arguments {shown(arguments)}")


def variant(found: Episode) -> Variant | None:
    """Return the variant that an episode's attributes name, or None when they name none."""
    try:
        return variant_of(found.attributes)
    except (ImujocoError, KeyError):
        return None


def episode(
    found: Episode,
    number: int,
    variant: Variant | None,
    root: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> Iterator[Finding]:
    """Report attributes of an episode that contradict its variant or its dataset.

    Args:
        found: the episode.
        number: its place in the dataset.
        variant: the variant that it names, if it names one.
        root: the attributes of its file. Those of a collection may differ from its own.
        metadata: the dataset's metadata.
    """
    attrs, name = found.attributes, found.name
    if variant is None:
        yield Finding(f"{name}@variant", f"is {shown(attrs.get('variant'))}, which is no variant")
        return
    tier = str(attrs.get("tier"))
    for key, value in file_format.attributes(variant, tier).items():
        if not same(attrs.get(key), value):
            yield Finding(f"{name}@{key}", f"is {shown(attrs.get(key))}, not {value!r}")
    try:
        possible = expected.sources(metadata, variant, tier)
    except VariantError as error:
        yield Finding(f"{name}@tier", str(error))
        return
    if "source" in attrs and not any(same(attrs["source"], one) for one in possible):
        yield Finding(f"{name}@source", f"is {shown(attrs['source'])}, not {' or '.join(possible)}")
    if file_format.REPLAYABLE in attrs and structure.is_replayed(attrs):
        stated = shown(attrs[file_format.REPLAYABLE])
        yield Finding(f"{name}@{file_format.REPLAYABLE}", f"is {stated}; valid: False, or nothing")
    seed = expected.seed(metadata, number)
    if structure.is_replayed(attrs) and seed is not None and not same(attrs.get("seed"), seed):
        yield Finding(
            f"{name}@seed", f"is {shown(attrs.get('seed'))}, but the base seed gives {seed} to this episode"
        )
    if expected.is_collection(metadata):
        return
    if expected.is_randomised(metadata):
        yield from _drawn(name, attrs, variant, root, metadata)
        return
    for key in ("variant", "tier", CATALOGUE, file_format.REPLAYABLE):
        if not same(attrs.get(key), plain(root.get(key))):
            yield Finding(
                f"{name}@{key}", f"is {shown(attrs.get(key))}, but the dataset's is {shown(root.get(key))}"
            )


def _drawn(
    name: str,
    attrs: Mapping[str, Any],
    variant: Variant,
    root: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> Iterator[Finding]:
    """Report an episode whose variant is not the one that its seed draws from the dataset's ranges."""
    try:
        ranges = file_format.stated_ranges(metadata)
        drawn = None if ranges is None else ranges.draw(int(attrs["seed"]))
    except (ImujocoError, ValueError, TypeError, AttributeError, KeyError) as error:
        yield Finding("metadata.json/ranges", f"draw no variant for {name}: {shown(str(error))}")
        return
    if drawn != variant:
        yield Finding(f"{name}@variant", f"is {shown(str(variant))}, but its seed draws {drawn}")
    if not same(attrs.get("tier"), plain(root.get("tier"))):
        yield Finding(
            f"{name}@tier", f"is {shown(attrs.get('tier'))}, but the dataset's is {shown(root.get('tier'))}"
        )


def whole(root: Mapping[str, Any], metadata: Mapping[str, Any], content: Content) -> Iterator[Finding]:
    """Report attributes of root and metadata that contradict each other or the episodes."""
    variants = list(dict.fromkeys(variant for variant, _ in content.identities))
    for key, space in expected.spaces(variants[0].robot).items():
        if json.loads(metadata[key]) != space:
            yield Finding(f"metadata.json/{key}", f"is {shown(metadata[key])}, not that of the variant")
    yield from _environment(root, metadata, variants)
    if expected.is_collection(metadata):
        for key in file_format.IDENTITY:
            if not same(metadata.get(key), plain(root.get(key))):
                yield Finding(f"@{key}", f"is {shown(root.get(key))}, but the metadata's is another")
    else:
        yield from _root(root, metadata)


def _environment(
    root: Mapping[str, Any], metadata: Mapping[str, Any], variants: Sequence[Variant]
) -> Iterator[Finding]:
    """Report an environment that is not the variant's, or not the collection's of all its variants."""
    if metadata.get("env_spec") is None:
        yield Finding("metadata.json/env_spec", "is missing: no environment can be recovered")
        return
    spec, models = current_spec(json.loads(metadata["env_spec"])), dataset_models(metadata)
    if models and "mjcf" in root:
        models = {str(variants[0]): str(root["mjcf"])}
    try:
        name = metadata["dataset_id"].rpartition("/")[2].rpartition("-v")[0]
        wanted = json.loads(_spec(name, variants, models, metadata).to_json())
    except (VariantError, DrawingError) as error:
        yield Finding("metadata.json/env_spec", f"is not the variant's: {error}")
        return
    for key in sorted(wanted.keys() | spec.keys()):
        if spec.get(key) != wanted.get(key):
            yield Finding(
                "metadata.json/env_spec", f"has the {key} {shown(spec.get(key))}, which is not the variant's"
            )


def _spec(
    name: str, variants: Sequence[Variant], models: Mapping[str, str], metadata: Mapping[str, Any]
) -> EnvSpec:
    ranges = file_format.stated_ranges(metadata) if expected.is_randomised(metadata) else None
    return dataset_spec(name, variants, models) if ranges is None else randomised_spec(ranges)


def _root(root: Mapping[str, Any], metadata: Mapping[str, Any]) -> Iterator[Finding]:
    # MuJoCo takes a tenth of a second to import, and the child processes that check parts never come here.
    from imujoco_minari.envs.mjcf import mjcf_sha256, model_text

    try:
        ranges = file_format.stated_ranges(metadata) if expected.is_randomised(metadata) else None
        variant = variant_of(root) if ranges is None else ranges.base
        text, digest = str(root["mjcf"]), plain(root["mjcf_sha256"])
    except (ImujocoError, KeyError) as error:
        yield Finding(file_format.MAIN_FILE, f"lacks a true attribute of its variant: {str(error)[:120]}")
        return
    tier = str(root.get("tier"))
    wanted = (
        file_format.attributes(variant, tier)
        if ranges is None
        else file_format.ranges_attributes(ranges, tier)
    )
    for key, value in wanted.items():
        if not same(root.get(key), value):
            yield Finding(f"@{key}", f"is {shown(root.get(key))}, not {value!r}")
    for key in (*wanted, CATALOGUE, file_format.REPLAYABLE):
        if not same(metadata.get(key), plain(root.get(key))):
            yield Finding(
                f"metadata.json/{key}",
                f"is {shown(metadata.get(key))}, but the file's is {shown(root.get(key))}",
            )
    if metadata.get("mjcf_sha256") != digest:
        yield Finding("metadata.json/mjcf_sha256", f"is {shown(metadata.get('mjcf_sha256'))}, not {digest}")
    if mjcf_sha256(text) != digest:
        yield Finding("@mjcf", "does not have the digest that mjcf_sha256 states")
    elif text != model_text(variant, text):
        yield Finding("@mjcf", f"is not the model that {simulator()} makes of the variant")
