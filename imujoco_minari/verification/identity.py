"""Checks that metadata, file attributes and episodes agree on what the dataset is, and that it is true.

The environment that the metadata names must be one of ours: Minari imports and calls whatever is
named, at ``recover_environment()`` and, if a space is missing, at ``load_dataset()``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from minari import supported_dataset_versions

from imujoco_minari.envs.registration import (
    current_spec,
    dataset_name,
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
from imujoco_minari.verification.content import Content
from imujoco_minari.verification.findings import Finding, differing, differs, plain, same, shown
from imujoco_minari.verification.replay import simulator


def loadable(metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Report metadata with which stock Minari could not load the dataset, or would run what is not ours."""
    yield from differing("metadata.json/", metadata, {"data_format": "hdf5"})
    if metadata.get("minari_version") not in list(supported_dataset_versions):
        version = metadata.get("minari_version")
        yield differs("metadata.json/minari_version", version, "a version that the installed Minari loads")
    for key in ("dataset_id", "algorithm_name", "code_permalink", "description"):
        if not isinstance(metadata.get(key), str):
            yield differs(f"metadata.json/{key}", metadata.get(key), "a text")
    for key in ("author", "requirements", *({"combined_datasets"} & metadata.keys())):
        value = metadata.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(one, str) for one in value):
            yield differs(f"metadata.json/{key}", value, "a list of texts")
    for key in ("observation_space", "action_space"):
        if key not in metadata:
            yield Finding(f"metadata.json/{key}", "is missing: Minari would make the environment")
        elif not _is_box(metadata[key]):
            yield differs(f"metadata.json/{key}", metadata[key], "a Box of floats")
    if metadata.get("env_spec") is not None:
        yield from _env_spec("metadata.json/env_spec", metadata["env_spec"])
    if metadata.get("eval_env_spec") is not None:
        yield Finding("metadata.json/eval_env_spec", "is not written by this package: do not load it")


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
    """Report attributes of an episode that contradict its variant, or its dataset's file or metadata."""
    attrs, name = found.attributes, found.name
    if variant is None:
        yield differs(f"{name}@variant", attrs.get("variant"), "a variant")
        return
    tier = str(attrs.get("tier"))
    yield from differing(f"{name}@", attrs, file_format.attributes(variant, tier))
    try:
        possible = expected.possible_sources(metadata, variant, tier)
    except VariantError as error:
        yield Finding(f"{name}@tier", str(error))
        return
    if "source" in attrs and not any(same(attrs["source"], one) for one in possible):
        yield differs(f"{name}@source", attrs["source"], " or ".join(possible))
    replayed = structure.is_replayed(attrs)
    if file_format.REPLAYABLE in attrs and replayed:
        yield differs(f"{name}@{file_format.REPLAYABLE}", attrs[file_format.REPLAYABLE], "False, or missing")
    seed = expected.seed(metadata, number)
    if replayed and seed is not None:
        yield from differing(f"{name}@", attrs, {"seed": seed}, ", as the base seed gives to this episode")
    if expected.is_randomised(metadata):
        yield from _drawn(name, attrs, variant, root, metadata)
    elif not expected.is_collection(metadata):
        shared = {key: root.get(key) for key in ("variant", "tier", CATALOGUE, file_format.REPLAYABLE)}
        yield from differing(f"{name}@", attrs, shared, ", as in the file's attributes")


def _drawn(
    name: str,
    attrs: Mapping[str, Any],
    variant: Variant,
    root: Mapping[str, Any],
    metadata: Mapping[str, Any],
) -> Iterator[Finding]:
    """Report an episode whose variant is not the one that its seed draws from the dataset's ranges."""
    try:
        drawn = file_format.stated_ranges(metadata).draw(int(attrs["seed"]))
    except (ImujocoError, ValueError, TypeError, AttributeError, KeyError) as error:
        yield Finding("metadata.json/ranges", f"draw no variant for {name}: {shown(str(error))}")
        return
    if drawn != variant:
        yield differs(f"{name}@variant", str(variant), f"{drawn}, which its seed draws")
    yield from differing(f"{name}@", attrs, {"tier": root.get("tier")}, ", as in the file's attributes")


def whole(root: Mapping[str, Any], metadata: Mapping[str, Any], content: Content) -> Iterator[Finding]:
    """Report attributes of root and metadata that contradict each other or the episodes."""
    variants = list(dict.fromkeys(variant for variant, _ in content.identities))
    spaces = {key: json.loads(metadata[key]) for key in ("observation_space", "action_space")}
    yield from differing("metadata.json/", spaces, expected.spaces(variants[0].robot))
    yield from _environment(root, metadata, variants)
    if expected.is_collection(metadata):
        shared = {key: metadata.get(key) for key in file_format.IDENTITY}
        yield from differing("@", root, shared, ", as in the metadata")
    else:
        yield from _root(root, metadata)


def _environment(
    root: Mapping[str, Any], metadata: Mapping[str, Any], variants: Sequence[Variant]
) -> Iterator[Finding]:
    """Report an environment that is not the variant's, or not the collection's of all its variants."""
    if metadata.get("env_spec") is None:
        yield Finding("metadata.json/env_spec", "is missing: no environment can be recovered")
        return
    spec = current_spec(json.loads(metadata["env_spec"]))
    try:
        if expected.is_randomised(metadata):
            made = randomised_spec(file_format.stated_ranges(metadata))
        else:
            models = stored_models(spec["kwargs"])
            if models and "mjcf" in root:
                models = {str(variants[0]): str(root["mjcf"])}
            made = dataset_spec(dataset_name(metadata["dataset_id"]), variants, models)
    except (VariantError, DrawingError) as error:
        yield Finding("metadata.json/env_spec", f"is not the variant's: {error}")
        return
    wanted = json.loads(made.to_json())
    every = {key: wanted.get(key) for key in sorted(wanted.keys() | spec.keys())}
    yield from differing("metadata.json/env_spec/", spec, every, ", as the variant's environment has")


def _root(root: Mapping[str, Any], metadata: Mapping[str, Any]) -> Iterator[Finding]:
    # MuJoCo takes a tenth of a second to import, and the child processes that check parts never come here.
    from imujoco_minari.envs.mjcf import mjcf_sha256, model_text

    tier = str(root.get("tier"))
    try:
        if expected.is_randomised(metadata):
            ranges = file_format.stated_ranges(metadata)
            variant, named = ranges.base, file_format.attributes(ranges, tier)
        else:
            variant = variant_of(root)
            named = file_format.attributes(variant, tier)
        text, digest = str(root["mjcf"]), plain(root["mjcf_sha256"])
    except (ImujocoError, KeyError) as error:
        yield Finding(file_format.MAIN_FILE, f"lacks a true attribute of its variant: {str(error)[:120]}")
        return
    yield from differing("@", root, named)
    shared = {key: root.get(key) for key in (*named, CATALOGUE, file_format.REPLAYABLE, "mjcf_sha256")}
    yield from differing("metadata.json/", metadata, shared, ", as in the file's attributes")
    if mjcf_sha256(text) != digest:
        yield Finding("@mjcf", "does not have the digest that mjcf_sha256 states")
    elif text != model_text(variant, text):
        yield Finding("@mjcf", f"is not the model that {simulator()} makes of the variant")
