"""The original benchmark's variants: their ids, their dataset ids and their environments.

An original variant is named by the archive's grammar, which is ours, but its bodies and percents are
the archive's own and need not be in our catalogue. Its environment is Gymnasium's v5 environment of the
robot around the archive's model; the model's text stands in the environment's spec, so that a dataset
recovers its environment wherever this package is installed, without the archive.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gymnasium.envs.registration import EnvSpec

from imujoco_minari.envs.registration import MAX_EPISODE_STEPS
from imujoco_minari.errors import VariantError
from imujoco_minari.variants import BASE, CATEGORIES, MAX_PERCENT, NAMESPACE, ROBOTS, Variant, specification

ORIGINAL = "imujoco-original"
RECOLLECTED = "recollected"
# The attribute by which an episode says that its variant is not one of ours.
CATALOGUE = "catalogue"

_ID = re.compile(
    rf"(?P<robot>{'|'.join(ROBOTS)})-(?P<category>{'|'.join(CATEGORIES)})(?P<sign>inc|dec)"
    r"_(?P<percent>[0-9]{1,5})_(?P<body>[A-Za-z0-9_]{1,40})",
    re.ASCII,
)
_CLASS = {
    "hopper": "OriginalHopperEnv",
    "halfcheetah": "OriginalHalfCheetahEnv",
    "walker2d": "OriginalWalker2dEnv",
}


@dataclass(frozen=True, order=True)
class OriginalVariant(Variant):
    """A variant of the original's archive; its body is the archive's word, whatever our catalogue lists.

    Raises:
        VariantError: when robot or category is not the benchmark's, or the percent leaves nothing.
    """

    def __post_init__(self) -> None:
        specification(self.robot)
        if self.category == BASE:
            return
        if self.category not in CATEGORIES or not self.body:
            raise VariantError(
                f"{self.robot} has no category {self.category!r}; valid: {', '.join(CATEGORIES)}"
            )
        if not -100 < self.percent <= MAX_PERCENT:
            raise VariantError(
                f"percent {self.percent} is out of range; valid: above -100, up to {MAX_PERCENT}"
            )

    @classmethod
    def parse(cls, text: str) -> OriginalVariant:
        """Return the variant that ``text``, a file's stem in the archive, names.

        Raises:
            VariantError: when it is not ``<robot>-<category><inc|dec>_<percent>_<body>`` or ``<robot>-base``.
        """
        robot, _, rest = text.partition("-")
        if rest == BASE and robot in ROBOTS:
            return cls(robot, BASE, 0, "")
        match = _ID.fullmatch(text)
        if match is None:
            raise VariantError(
                f"{text[:80]!r} is no variant of the original; "
                "valid: <robot>-<category><inc|dec>_<percent>_<body>, as in hopper-massdec_25_leggeom"
            )
        percent = int(match["percent"]) * (1 if match["sign"] == "inc" else -1)
        return cls(match["robot"], match["category"], percent, match["body"])

    def __str__(self) -> str:
        return super().__str__()

    @property
    def ours(self) -> Variant | None:
        """The variant of the same id in our grammar; None where ours has no such body or percent."""
        try:
            return Variant.parse(str(self))
        except VariantError:
            return None

    @property
    def environment_id(self) -> str:
        """The Gymnasium id, ``imujoco-original/<variant>-v0``."""
        return f"{ORIGINAL}/{self}-v0"

    def dataset_id(self, tier: str = "expert") -> str:
        """The Minari id of this variant's data, ``imujoco-original/<variant>[-<tier>]-v0``."""
        suffix = self.base.dataset_id(tier).removeprefix(f"{NAMESPACE}/{self.base}")
        return f"{ORIGINAL}/{self}{suffix}"

    def environment_spec(self, mjcf: str) -> EnvSpec:
        """Return the Gymnasium spec of this variant's environment around the model of ``mjcf``."""
        return EnvSpec(
            id=self.environment_id,
            entry_point=f"imujoco_minari.importing.environments:{_CLASS[self.robot]}",
            max_episode_steps=MAX_EPISODE_STEPS,
            kwargs={"variant": str(self), "mjcf": mjcf},
        )


def originals_spec(name: str, models: Mapping[OriginalVariant, str]) -> EnvSpec:
    """Return the Gymnasium spec of one original variant, or of a collection ``name`` of several.

    Args:
        name: of the collection, without namespace and version.
        models: variant -> MJCF text.
    """
    if len(models) == 1:
        ((variant, mjcf),) = models.items()
        return variant.environment_spec(mjcf)
    return EnvSpec(
        id=f"{ORIGINAL}/{name}-v0",
        entry_point="imujoco_minari.importing.environments:OriginalCollectionEnv",
        max_episode_steps=MAX_EPISODE_STEPS,
        kwargs={"models": {str(variant): mjcf for variant, mjcf in models.items()}},
    )


def models_of(arguments: Any) -> dict[OriginalVariant, str]:
    """Return the models in the arguments of a spec that :func:`originals_spec` made; empty for another.

    Raises:
        VariantError: when they name no variant.
    """
    if not isinstance(arguments, Mapping):
        return {}
    models = arguments.get("models", {arguments.get("variant"): arguments.get("mjcf")})
    if not isinstance(models, Mapping):
        return {}
    texts = {str(name): text for name, text in models.items() if isinstance(text, str)}
    return {OriginalVariant.parse(name): text for name, text in texts.items()}


def is_original(attributes: Mapping[str, Any]) -> bool:
    """Return whether the attributes of a dataset or an episode are those of an original variant."""
    return bool(attributes.get(CATALOGUE, "") == ORIGINAL)


def variant_of(attributes: Mapping[str, Any]) -> Variant:
    """Return the variant, ours or an original's, that the attributes of a dataset or an episode name.

    Raises:
        VariantError: when they name none.
        KeyError: when they say nothing of a variant.
    """
    return (OriginalVariant if is_original(attributes) else Variant).parse(str(attributes["variant"]))
