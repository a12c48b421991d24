"""Recipes: all that decides what a dataset holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imujoco_minari.errors import DatasetError
from imujoco_minari.policies import Policy
from imujoco_minari.policies.tiers import TierPart, parts
from imujoco_minari.storage import file_format
from imujoco_minari.variants import EXPERT, Variant


@dataclass(frozen=True)
class Recipe:
    """All that decides the content of a dataset, beside the versions of the software.

    Attributes:
        variant: whose environment is stepped.
        tier: which policy makes the data; part of the dataset's id.
        episodes: how many.
        seed: base seed of all that is random.
        policy: a policy file to use instead of the shipped one.
        stochastic: sample the actions instead of taking the policy's mode.
    """

    variant: Variant
    tier: str = EXPERT
    episodes: int = 100
    seed: int = 0
    policy: Path | None = None
    stochastic: bool = False

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise DatasetError(f"a dataset has at least one episode, not {self.episodes}")
        if self.seed < 0:
            raise DatasetError(f"a seed is not negative, as {self.seed} is")

    @property
    def dataset_id(self) -> str:
        """The id under which the dataset is published."""
        return self.variant.dataset_id(self.tier)

    @property
    def attributes(self) -> dict[str, Any]:
        """What the dataset's root and each of its episodes carry."""
        return file_format.attributes(self.variant, self.tier)

    @property
    def episode_attributes(self) -> dict[str, Any]:
        """What each episode carries: whence it came too, which a collection of it then says."""
        return self.attributes | {"source": self.dataset_id}

    def parts(self) -> list[TierPart]:
        """Return the policies that make the dataset, and how many episodes each."""
        return parts(self.variant, self.tier, self.episodes, path=self.policy, stochastic=self.stochastic)

    def stated(self) -> dict[str, Any]:
        """Return the metadata by which a dataset of this recipe is told from others of the same id."""
        policies = [part.policy for part in self.parts()]
        return {
            "total_episodes": self.episodes,
            "seed": self.seed,
            "policy_sha256": ",".join(policy.sha256 for policy in policies),
            "policy_deterministic": all(policy.deterministic for policy in policies),
        }


def algorithms(policies: Sequence[Policy]) -> str:
    """Return the names of the policies' algorithms, as a dataset's metadata states them."""
    return ", ".join(dict.fromkeys(policy.algorithm for policy in policies))


def description(recipe: Recipe, made_by: Sequence[TierPart]) -> str:
    """Return the description in a dataset's metadata: one or two sentences."""
    variant, policies = recipe.variant, [part.policy for part in made_by]
    change = (
        "unchanged"
        if not variant.body
        else f"with the {variant.category} of {', '.join(variant.mjcf_names)} "
        f"changed by {variant.percent:+d} %"
    )
    return (
        f"iMuJoCo, rebuilt: the robot {variant.robot} of Gymnasium's v5 environments, {change}. "
        f"{recipe.episodes} episodes of the tier {recipe.tier}, by {len(policies)} "
        f"{'policy' if len(policies) == 1 else 'policies'} ({algorithms(policies)}) acting "
        f"{'deterministically' if all(policy.deterministic for policy in policies) else 'stochastically'}."
    )
