"""Recipes: everything that decides the content of a dataset, beside software versions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError, PolicyError, VariantError, whole_number
from imujoco_minari.policies import Policy
from imujoco_minari.policies.experts import is_folded
from imujoco_minari.policies.tiers import MEDIUM_REPLAY, TierPart, parts, range_parts
from imujoco_minari.policies.universal import UniversalPolicy
from imujoco_minari.storage import file_format
from imujoco_minari.variants import EXPERT, Ranges, Variant

# The attributes that a policy needs to make a dataset.
_STATED = ("act", "algorithm", "sha256", "deterministic")
# A thousand times more than any dataset of these robots that is known; a mistyped number is larger.
MAX_EPISODES = 10**6


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the content of a dataset, beside software versions.

    Attributes:
        variant: the variant to step, or the ranges from which each episode draws one. The tiers of ranges
            name the policies of the unchanged robot.
        tier: the tier, which names the policy and is part of the dataset's id.
        episodes: number of episodes.
        seed: base seed of all random numbers.
        policy: a policy, or the file of one, to use instead of the tier's.
        stochastic: sample the actions of a file's or a tier's policy instead of taking their mode.

    Raises:
        VariantError: if the tier is malformed.
        PolicyError: if the policy does not fit the robot, or does not state what a dataset states of it.
        ArgumentError: if another attribute is not valid.
        DatasetError: if the tier ``medium-replay`` gets more than a seed.

    Example:
        >>> Recipe(Variant.parse("hopper-base"), tier="random").dataset_id
        'imujoco/hopper-base-random-v0'
    """

    variant: Variant | Ranges
    tier: str = EXPERT
    episodes: int = 100
    seed: int = 0
    policy: Path | Policy | None = None
    stochastic: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.variant, Variant | Ranges):
            raise VariantError(f"a recipe needs a Variant or Ranges, not {type(self.variant).__name__}")
        if whole_number(self.episodes, "episodes", least=1) > MAX_EPISODES:
            raise DatasetError(f"a dataset has 1 to {MAX_EPISODES} episodes, not {self.episodes}")
        whole_number(self.seed, "seed", least=0)
        _ = self.dataset_id
        if self.policy is not None and not isinstance(self.policy, Path):
            _check_policy(self.policy, self.nominal.robot)
        if self.tier == MEDIUM_REPLAY and isinstance(self.variant, Ranges):
            raise DatasetError(f"the tier {MEDIUM_REPLAY} is a training run on one variant, not on ranges")
        if self.tier == MEDIUM_REPLAY and (self.episodes, self.policy, self.stochastic) != (100, None, False):
            raise DatasetError(
                f"the tier {MEDIUM_REPLAY} is a training run: it takes a seed, but no number of episodes, "
                "no policy and no --stochastic"
            )

    @property
    def dataset_id(self) -> str:
        """The id of the dataset."""
        return self.variant.dataset_id(self.tier)

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the file. If they name one variant, each episode has them too."""
        return file_format.attributes(self.variant, self.tier)

    def episode_attributes(self, seed: int) -> dict[str, Any]:
        """Return the attributes of the episode with a seed: its variant, and the dataset as ``source``."""
        variant = self.variant.draw(seed) if isinstance(self.variant, Ranges) else self.variant
        return file_format.attributes(variant, self.tier) | {"source": self.dataset_id}

    @property
    def nominal(self) -> Variant:
        """The variant; for ranges the unchanged robot, whose policies act and whose model the file holds."""
        return self.variant.base if isinstance(self.variant, Ranges) else self.variant

    def parts(self) -> list[TierPart]:
        """Return the parts of the dataset, each of one policy, in the order of the episodes."""
        if self.policy is not None and not isinstance(self.policy, Path):
            return [TierPart(self.policy, self.episodes)]
        how: Any = {"path": self.policy, "stochastic": self.stochastic}
        if isinstance(self.variant, Ranges):
            return range_parts(self.variant.robot, self.tier, self.episodes, **how)
        return parts(self.variant, self.tier, self.episodes, **how)

    def stated(self, made_by: Sequence[TierPart]) -> dict[str, Any]:
        """Return the metadata that distinguish a dataset of this recipe from others with the same id."""
        policies = [part.policy for part in made_by]
        return {
            **{key: value for key, value in self.attributes.items() if key in file_format.RANGES},
            "total_episodes": self.episodes,
            "seed": self.seed,
            "policy_sha256": ",".join(policy.sha256 for policy in policies),
            "policy_deterministic": all(policy.deterministic for policy in policies),
        }

    def told(self, made_by: Sequence[TierPart]) -> dict[str, Any]:
        """Return the metadata of a folded expert: the universal policy, and what it was told in percent.

        They are empty if another policy makes the episodes.
        """
        for part in made_by:
            record = getattr(part.policy, "record", {})
            if is_folded(record):
                return {"universal_sha256": record["universal_sha256"], "policy_told": record["told"]}
        return {}


def _check_policy(policy: Any, robot: str) -> None:
    """Raise a PolicyError unless a policy states what its dataset's metadata state, and fits the robot."""
    if isinstance(policy, type) or not all(hasattr(policy, name) for name in _STATED):
        kind = policy.__name__ if isinstance(policy, type) else type(policy).__name__
        raise PolicyError(
            f"a dataset states the algorithm and the digest of its policy, which {kind} does not have: "
            "give a file (a Stable-Baselines3 .zip, as model.save() writes it, or an actor's .safetensors), "
            "or a policy of load_policy() or read_actor()"
        )
    if hasattr(policy, "check"):
        policy.check(robot)


def algorithms(policies: Sequence[Policy | UniversalPolicy]) -> str:
    """Return the names of the policies' algorithms as text for the metadata."""
    return ", ".join(dict.fromkeys(policy.algorithm for policy in policies))


def description(recipe: Recipe, made_by: Sequence[TierPart]) -> str:
    """Return the description of a dataset for its metadata, in one or two sentences."""
    variant, policies = recipe.variant, [part.policy for part in made_by]
    if isinstance(variant, Ranges):
        drawn = (f"{name} ({low:+g} to {high:+g} %)" for name, (low, high) in variant.ranges.items())
        change = f"with parameters drawn for each episode ({variant.distribution}): {', '.join(drawn)}"
    else:
        change = " and ".join(
            f"with the {one.category} of {', '.join(one.mjcf_names(variant.robot))} "
            f"changed by {one.percent:+g} %"
            for one in variant.changes
        )
        change = change or "unchanged"
    folded = "the universal policy, told the variant: " if recipe.told(made_by) else ""
    return (
        f"iMuJoCo, rebuilt: the robot {variant.robot} of Gymnasium's v5 environments, {change}. "
        f"{recipe.episodes} episodes of the tier {recipe.tier}, by {len(policies)} "
        f"{'policy' if len(policies) == 1 else 'policies'} ({folded}{algorithms(policies)}) acting "
        f"{'deterministically' if all(policy.deterministic for policy in policies) else 'stochastically'}."
    )
