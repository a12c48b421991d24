"""Arrays as the in-memory datasets of other libraries: Tianshou, d3rlpy, TorchRL and imitation.

None of these libraries is a dependency: an adapter imports its library when it is called, and raises a
DependencyError when it is not installed. Each docstring states which data the library cannot hold.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from imujoco_minari.errors import DependencyError
from imujoco_minari.loading import Arrays


def to_tianshou(data: Arrays) -> Any:
    """Return a ``tianshou.data.ReplayBuffer`` of all steps, in order.

    No data is lost. The ``info`` of its batches is empty.
    """
    buffer = _library("tianshou.data", "to_tianshou()").ReplayBuffer.from_data(
        obs=data.observations,
        act=data.actions,
        rew=data.rewards,
        terminated=data.terminations,
        truncated=data.truncations,
        done=data.dones,
        obs_next=data.next_observations,
    )
    # from_data() (2.0.1) leaves this at 0, which marks the first step as the end of an episode.
    buffer.last_index = np.array([len(data) - 1])
    return buffer


def to_d3rlpy(data: Arrays) -> Any:
    """Return a ``d3rlpy.dataset.MDPDataset`` of all episodes.

    d3rlpy does not hold the final observation of an episode. It does not bootstrap at a termination, and it
    omits the last step of a truncated episode from its transitions.
    """
    d3rlpy = _library("d3rlpy", "to_d3rlpy()")
    return d3rlpy.dataset.MDPDataset(
        observations=data.observations,
        actions=data.actions,
        rewards=data.rewards.reshape(-1, 1),
        terminals=data.terminations.astype(np.float32),
        # d3rlpy requires exactly one of the two where an episode is both terminated and truncated.
        timeouts=(data.truncations & ~data.terminations).astype(np.float32),
        action_space=d3rlpy.constants.ActionSpace.CONTINUOUS,
    )


def to_tensordict(data: Arrays) -> Any:
    """Return a ``tensordict.TensorDict`` of the N steps, with TorchRL's keys. It shares the arrays' memory.

    Keys: ``observation``, ``action``, ``episode``, ``variant_index``, and under ``next``:
    ``observation``, ``reward``, ``terminated``, ``truncated``, ``done``. No data is lost.
    """
    tensordict = _library("tensordict", "to_tensordict()")
    tensor = _library("torch", "to_tensordict()").from_numpy
    after = {
        "observation": tensor(data.next_observations),
        "reward": tensor(data.rewards).unsqueeze(-1),
        "terminated": tensor(data.terminations).unsqueeze(-1),
        "truncated": tensor(data.truncations).unsqueeze(-1),
        "done": tensor(data.dones).unsqueeze(-1),
    }
    steps = {
        "observation": tensor(data.observations),
        "action": tensor(data.actions),
        "episode": tensor(np.repeat(np.arange(data.episodes), data.episode_lengths)),
        "variant_index": tensor(data.variant_index),
        "next": tensordict.TensorDict(after, batch_size=[len(data)]),
    }
    return tensordict.TensorDict(steps, batch_size=[len(data)])


def to_torchrl(data: Arrays, *, batch_size: int = 256) -> Any:
    """Return a ``torchrl.data.TensorDictReplayBuffer`` of all steps, in order.

    No data is lost. (TorchRL's own ``MinariExperienceReplay``, 0.14, returns zeros for a local dataset.)
    ``sample()`` returns ``batch_size`` steps.
    """
    torchrl = _library("torchrl.data", "to_torchrl()")
    storage = torchrl.LazyTensorStorage(len(data))
    buffer = torchrl.TensorDictReplayBuffer(storage=storage, batch_size=batch_size)
    buffer.extend(to_tensordict(data))
    return buffer


def to_imitation(data: Arrays) -> list[Any]:
    """Return a list of ``imitation.data.types.TrajectoryWithRew``, one for each episode.

    ``terminal`` states whether the episode was terminated. imitation does not hold whether it was truncated.
    """
    imitation = _library("imitation.data.types", "to_imitation()")
    return [
        imitation.TrajectoryWithRew(
            obs=episode.observations,
            acts=episode.actions,
            infos=None,
            terminal=episode.terminated,
            rews=episode.rewards,
        )
        for episode in data.trajectories()
    ]


def _library(module: str, purpose: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        # Not an extra of this package: some of these libraries pin versions that conflict with its own.
        package = module.partition(".")[0]
        raise DependencyError(
            f"{purpose} needs {package}, which is not installed: run `pip install {package}`"
        ) from None
