"""The agent that a variant's training starts from: the folded one, or the base's where that scores higher.

The universal policy is told the variant, so its folded actor is the expert that the variant has without
training. Actors that are told another listed variant or a searched context are tried too. The critics are
folded the same way. A robot without a universal policy starts from its base's agent.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.policies import agent_file, own_record, universal_policy
from imujoco_minari.policies.evaluation import evaluate
from imujoco_minari.policies.experts import FOLDED
from imujoco_minari.policies.universal import universal_name
from imujoco_minari.training.agents import actor_of, agent_actor, load_arrays, replace_actor
from imujoco_minari.training.context_search import SEARCHED, best_told, search_contexts
from imujoco_minari.training.critics import fold_critics
from imujoco_minari.training.selection import score
from imujoco_minari.training.task import Start
from imujoco_minari.variants import Variant, catalogue

EPISODES, START_SEED = 20, 1_000_005


def best_start(
    variant: Variant, policies: Path, generations: int, say: Callable[[str], None] = lambda line: None
) -> Start:
    """Return the better start for a variant: the folded agent, or the base's.

    ``generations`` is the length of :func:`search_contexts`. ``say`` is called with a line before it.

    Raises:
        PolicyNotFoundError: if the base's agent does not exist.
    """
    record, path = own_record(variant.base, policies), agent_file(variant.base, policies)
    if not record or path is None:
        raise PolicyNotFoundError(
            f"{variant} starts from the agent of {variant.base}, which does not exist: run "
            f"`imujoco train {variant.base}` first, or train with --scratch"
        )
    base_agent = load_arrays(path)
    starts = [Start(str(variant.base), base_agent, str(record["weights_sha256"]))]
    universal = universal_policy(variant.robot, policies)
    if universal is not None:
        say(f"choosing the start of {variant}, which takes some minutes")
        own = agent_file(universal_name(variant.robot), policies)
        critics = {} if own is None else load_arrays(own)
        others = best_told(universal, variant, [variant.base, *catalogue(variant.robot)])
        contexts = [(str(each), universal.context(each)) for each in dict.fromkeys([variant, *others])]
        found = search_contexts(universal, variant, universal.context(others[0]), generations)
        for told, context in [*contexts, *((SEARCHED, each) for each in found)]:
            folded = fold_critics(variant.robot, context, critics) if critics else {}
            agent = replace_actor(base_agent | folded, universal.fold_context(context).weights)
            starts.append(Start(FOLDED, agent, universal.sha256, told))
    for start in starts:
        actor = actor_of(agent_actor(start.agent), variant.robot)
        start.score = score(evaluate(variant, actor, episodes=EPISODES, seed=START_SEED).asdict())
    return max(starts, key=lambda start: start.score)
