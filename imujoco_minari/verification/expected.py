"""The metadata that this package would write, compared key by key with what a dataset states.

What follows from the variants, the tiers, the base seed and known policies must be as expected. What
does not follow, because it is not known here, is an exception: the result of the check states it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import numpy as np
from gymnasium.spaces import Box
from minari.serialization import serialize_space

from imujoco_minari.errors import ImujocoError
from imujoco_minari.policies.experts import expert_record
from imujoco_minari.policies.references import reference_scores
from imujoco_minari.policies.rollouts import episode_seed
from imujoco_minari.policies.tiers import RECORDED, TierPart, parts, range_parts
from imujoco_minari.storage import file_format
from imujoco_minari.storage.metadata import PACKAGES, code_address, requirements, sources
from imujoco_minari.variants import NAMESPACE, Variant, specification
from imujoco_minari.variants.original import OriginalVariant, names_variant
from imujoco_minari.verification.content import Content
from imujoco_minari.verification.findings import Finding, differing, differs, plain, shown

_POLICY_DIGESTS = re.compile(r"[0-9a-f]{64}(,[0-9a-f]{64})*", re.ASCII)
_POLICY_ATTRIBUTES = ("part", "policy_return", "rank", "rung")
_REFERENCES = (
    ("ref_min_score", "ref_min_evaluation", "return_mean"),
    ("num_episodes_average_score", "ref_min_evaluation", "episodes"),
    ("ref_max_score", "ref_max_evaluation", "return_mean"),
)


@dataclass(frozen=True)
class Known:
    """What is known here of the policies of a dataset that combines no others. Reading them takes a while.

    Attributes:
        parts: the parts of the dataset; None if one of their policies is not known here.
        references: the reference scores in the record of the variant's expert; empty if there are none.
        by_expert: whether this expert made the dataset, so that the scores are the dataset's too.
    """

    parts: Sequence[TierPart] | None
    references: Mapping[str, Any]
    by_expert: bool


def known(metadata: Mapping[str, Any], content: Content) -> Known | None:
    """Return what is known here of a dataset's policies; None for a collection."""
    if is_collection(metadata):
        return None
    variant, tier = content.identities[0]
    made_by = known_parts(variant, tier, metadata)
    if is_randomised(metadata):
        variant = variant.base
    expert = {} if isinstance(variant, OriginalVariant) else expert_record(variant)
    if "random" not in expert:
        return Known(made_by, {}, False)
    by_expert = str(expert.get("weights_sha256")) in _policies(metadata)
    return Known(made_by, reference_scores(variant), by_expert)


def known_parts(variant: Variant, tier: str, metadata: Mapping[str, Any]) -> list[TierPart] | None:
    """Return the parts of a dataset whose policies are all known here, or None."""
    if is_collection(metadata) or isinstance(variant, OriginalVariant):
        return None
    stochastic, episodes = metadata.get("policy_deterministic") is False, metadata["total_episodes"]
    try:
        if is_randomised(metadata):
            found = range_parts(variant.robot, tier, episodes, path=None, stochastic=stochastic)
        else:
            found = parts(variant, tier, episodes, path=None, stochastic=stochastic)
    except ImujocoError:
        return None
    return found if [part.policy.sha256 for part in found] == _policies(metadata) else None


def is_collection(metadata: Mapping[str, Any]) -> bool:
    """Return whether a dataset's metadata says that it combines others."""
    return bool(metadata.get("combined_datasets"))


def is_recorded(metadata: Mapping[str, Any]) -> bool:
    """Return whether a dataset is the record of a training run, whose seeds are its own."""
    return metadata.get("tier") in RECORDED and "policy_sha256" not in metadata


def is_randomised(metadata: Mapping[str, Any]) -> bool:
    """Return whether a dataset's metadata says that its episodes draw their variants from ranges."""
    return "ranges" in metadata and not is_collection(metadata)


def seed(metadata: Mapping[str, Any], number: int) -> int | None:
    """Return the seed of an episode of a dataset; None where the metadata do not decide it."""
    base = metadata.get("seed")
    if is_collection(metadata) or is_recorded(metadata) or not _is_count(base):
        return None
    return episode_seed(base, number)


def policy_attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of an episode that state which policy of its tier made it."""
    stated = {key: plain(attributes[key]) for key in _POLICY_ATTRIBUTES if key in attributes}
    return {key: one if isinstance(one, str | int | float) else shown(one) for key, one in stated.items()}


def possible_sources(metadata: Mapping[str, Any], variant: Variant, tier: str) -> list[str]:
    """Return the datasets that an episode may name as its source; raise a VariantError for a wrong tier."""
    if is_randomised(metadata):
        return [str(metadata.get("dataset_id"))]
    return list(dict.fromkeys([variant.dataset_id(tier), *sources(metadata)]))


def spaces(robot: str) -> dict[str, Any]:
    """Return the serialised spaces of a robot's environments, as JSON values."""
    page = specification(robot)
    observations = Box(-np.inf, np.inf, (page.observation_size,), np.float64)
    actions = Box(-page.action_bound, page.action_bound, (page.action_size,), np.float32)
    return {
        "observation_space": json.loads(serialize_space(observations)),
        "action_space": json.loads(serialize_space(actions)),
    }


def compare(metadata: Mapping[str, Any], content: Content, here: Known | None) -> Iterator[Finding]:
    """Report metadata that this package would have written otherwise; ``here`` is what is :func:`known`."""
    expected = _identity(metadata, content) | _versions(metadata, content)
    statistics = file_format.return_statistics(content.returns)
    expected |= dict.fromkeys(statistics) if is_collection(metadata) else statistics
    if here is not None:
        yield from _origin(metadata, imported=content.unreplayed > 0)
        expected |= _shape_of_references(metadata)
        if here.parts is not None:
            algorithms = dict.fromkeys(part.policy.algorithm for part in here.parts)
            expected["algorithm_name"] = ", ".join(algorithms)
            expected["policy_deterministic"] = all(part.policy.deterministic for part in here.parts)
            yield from _runs(content.runs, here.parts)
        if is_randomised(metadata):
            expected |= dict.fromkeys(score for score, _, _ in _REFERENCES)
        elif here.by_expert:
            expected |= here.references
    yield from differing("metadata.json/", metadata, expected)


def exceptions(metadata: Mapping[str, Any], content: Content, here: Known | None) -> Iterator[str]:
    """Say what cannot be checked of a dataset, in words that follow "sound, but"."""
    if content.unreplayed == content.episodes:
        yield "not replayed: it was imported without seeds"
    elif content.unreplayed:
        some = f"{content.unreplayed} of {content.episodes} episodes"
        yield f"{some} were not replayed: they were imported without seeds"
    if repeated := content.episodes - len(set(content.digests)):
        yield f"{repeated} of its episodes are equal to earlier ones"
    if any(isinstance(variant, OriginalVariant) for variant, _ in content.identities):
        yield "its models are the ones that it stores: the original archive is not known here"
    if is_collection(metadata) and names_variant(str(metadata.get("dataset_id"))):
        yield "it is a collection under the id of a variant"
    if is_recorded(metadata):
        yield "it records a training run, whose seeds are its own"
    if here is not None:
        if "policy_sha256" in metadata and here.parts is None:
            yield "the policy that made it is not known here"
        as_expected = here.references and not any(differing("", metadata, here.references))
        if not (as_expected or is_randomised(metadata) or here.by_expert):
            yield "its reference scores are not known here"


def _identity(metadata: Mapping[str, Any], content: Content) -> dict[str, Any]:
    """Return what the variants and tiers of the episodes decide; None where they differ."""
    if is_randomised(metadata):
        return _randomised_identity(metadata, content)
    every = [file_format.attributes(variant, tier) for variant, tier in content.identities]
    expected: dict[str, Any] = {
        key: every[0][key] if all(one[key] == every[0][key] for one in every) else None
        for key in file_format.IDENTITY
    }
    if not is_collection(metadata) or names_variant(str(metadata.get("dataset_id"))):
        ids = {variant.dataset_id(tier) for variant, tier in content.identities}
        expected["dataset_id"] = ids.pop() if len(ids) == 1 else "a variant's: its episodes are of several"
    return expected


def _randomised_identity(metadata: Mapping[str, Any], content: Content) -> dict[str, Any]:
    """Return what the ranges and the tier of a dataset decide."""
    tier = content.identities[0][1]
    try:
        ranges = file_format.stated_ranges(metadata)
    except (ImujocoError, ValueError, TypeError, AttributeError):
        return {"ranges": "ranges of parameters of a robot, and their distribution"}
    attributes = file_format.attributes(ranges, tier)
    nothing: dict[str, Any] = dict.fromkeys(file_format.IDENTITY)
    stated = str(metadata.get("dataset_id"))
    name = stated.removeprefix(f"{NAMESPACE}/{ranges.robot}-").removesuffix("-v0").removesuffix(f"-{tier}")
    try:
        dataset_id = replace(ranges, name=name).dataset_id(tier)
    except ImujocoError:
        dataset_id = ranges.dataset_id(tier)
    return nothing | attributes | {"dataset_id": dataset_id}


def _versions(metadata: Mapping[str, Any], content: Content) -> dict[str, Any]:
    """Return what the stated versions decide."""
    versions = metadata.get("versions")
    if not isinstance(versions, dict) or any(not isinstance(versions.get(name), str) for name in PACKAGES):
        return {"versions": f"the versions of {', '.join(PACKAGES)}"}
    expected: dict[str, Any] = {"minari_version": versions["minari"]}
    if not is_collection(metadata):
        expected["requirements"] = requirements(versions)
    if is_collection(metadata) or not isinstance(content.identities[0][0], OriginalVariant):
        expected["code_permalink"] = code_address(versions)
    return expected


def _origin(metadata: Mapping[str, Any], *, imported: bool) -> Iterator[Finding]:
    """Report a dataset that does not state where its episodes come from."""
    seed, policies, deterministic, source = map(
        metadata.get, ("seed", "policy_sha256", "policy_deterministic", "source")
    )
    if imported:
        if not isinstance(source, str):
            yield differs("metadata.json/source", source, "a text, as imported episodes have")
        yield from differing("metadata.json/", metadata, {"seed": None, "policy_sha256": None})
        return
    if not _is_count(seed):
        yield differs("metadata.json/seed", seed, "a base seed")
    if not is_recorded(metadata) and not _policies(metadata):
        yield differs("metadata.json/policy_sha256", policies, "the digest of a policy")
    if not isinstance(deterministic, bool):
        yield differs("metadata.json/policy_deterministic", deterministic, "true or false")


def _policies(metadata: Mapping[str, Any]) -> list[str]:
    """Return the digests of the policies that made a dataset; empty where it states none."""
    stated = metadata.get("policy_sha256")
    return stated.split(",") if isinstance(stated, str) and _POLICY_DIGESTS.fullmatch(stated) else []


def _runs(runs: Sequence[tuple[int, Mapping[str, Any]]], made_by: Sequence[TierPart]) -> Iterator[Finding]:
    """Report episodes that do not state the attributes of the policy that made them."""
    first = 0
    ends = [*(start for start, _ in runs[1:]), float("inf")]
    for part in made_by:
        for (start, attributes), end in zip(runs, ends, strict=True):
            overlap = start < first + part.episodes and end > first
            if overlap and attributes != part.attributes:
                wanted = shown(dict(part.attributes))
                yield Finding(
                    f"{file_format.episode_name(max(start, first))}@",
                    f"states {shown(attributes)}, not {wanted}",
                )
        first += part.episodes


def _shape_of_references(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reference scores that the stated evaluations give."""
    return {
        score: found[field] if isinstance(found, dict) and _is_number(found.get(field)) else None
        for score, key, field in _REFERENCES
        for found in (metadata.get(key),)
    }


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < float("inf")
