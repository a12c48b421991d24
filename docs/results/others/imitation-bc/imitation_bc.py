"""Behaviour cloning of the library `imitation`, in few-shot imitation."""

from copy import deepcopy

import numpy as np
import torch
from gymnasium.spaces import Box
from imitation.algorithms import bc
from imitation.data import rollout
from imitation.util import logger

from imujoco_minari.exporting import to_imitation


class Cloning:
    """`imitation.algorithms.bc.BC` with its default network and loss, on the demonstrations alone."""

    def __init__(self, seed, rate=1e-3, batch=32):
        self.seed, self.rate, self.batch = seed, rate, batch
        self.library = "imitation 1.0.1"
        self.algorithm = "BC: FeedForward32Policy, entropy 1e-3, Adam"
        self.steps = (25, 200, 2000)

    def adapt(self, demonstrations):
        """Return the policies after 25, 200 and 2,000 gradient steps."""
        torch.manual_seed(self.seed)
        torch.set_num_threads(1)
        seen, actions = demonstrations.observations, demonstrations.actions
        flat = rollout.flatten_trajectories_with_rew(to_imitation(demonstrations))
        cloning = bc.BC(
            observation_space=Box(-np.inf, np.inf, seen.shape[1:], np.float32),
            action_space=Box(-1.0, 1.0, actions.shape[1:], np.float32),
            rng=np.random.default_rng(self.seed),
            demonstrations=flat,
            batch_size=self.batch,
            optimizer_kwargs={"lr": self.rate},
            custom_logger=logger.configure(format_strs=[]),
        )
        policies, before = {}, 0
        for steps in self.steps:
            cloning.train(n_batches=steps - before, progress_bar=False, log_interval=10**9)
            before = steps
            # The distribution of the last batch cannot be copied.
            cloning.policy.action_dist.distribution = None
            policies[steps] = deepcopy(cloning.policy)
        return policies
