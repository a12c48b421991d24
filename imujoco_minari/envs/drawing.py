"""Environments that draw a variant at each reset and report it at every step.

:class:`DrawingEnv` is what they share. :class:`CollectionEnv` draws from a list of variants; it is also the
environment of a combined dataset. :class:`RandomisedEnv` draws parameters from ranges.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from imujoco_minari.envs.registration import environment_spec
from imujoco_minari.envs.robots import Array, VariantEnv
from imujoco_minari.errors import ArgumentError, DrawingError, VariantError, clipped, suggestion, unknown
from imujoco_minari.variants import Variant, adopt_page
from imujoco_minari.variants.changes import plain_number
from imujoco_minari.variants.context import changed_parameters, check_parameters, context
from imujoco_minari.variants.original import OriginalVariant
from imujoco_minari.variants.ranges import UNIFORM, Ranges, drawing_ranges
from imujoco_minari.variants.robots import forget_on_error


class DrawingEnv(gym.Env[Any, Any]):
    """A robot whose variant is drawn at each reset.

    The info of ``reset`` and of every ``step`` has the id of the variant (``variant``) and its context
    (``context``, float64, shape ``(len(parameters),)``): the change of each parameter relative to the base
    value, percent / 100.

    Attributes:
        parameters: names of the entries of a context, in order.
        observe_context: whether the context is appended to the observation.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]
    }

    parameters: tuple[str, ...]
    observe_context: bool

    _current: VariantEnv
    _name: str
    _context: NDArray[np.float64]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.parameters)} parameters, now {self._name})"

    @property
    def variant(self) -> Variant:
        """The variant of the present episode."""
        return self._current.variant

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the present robot: ``model``, ``data``, ``dt``, ``set_state`` and others."""
        # A copy that is being made has no robot yet.
        if name.startswith("_") or "_current" not in vars(self):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._current, name)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, of ``options["variant"]`` if given, else of a variant that ``seed`` draws.

        The episode equals an episode of the variant's own environment with the same seed.

        Raises:
            VariantError: if this environment has no such variant.
            ArgumentError: if ``options`` has another key than ``variant``.
        """
        name = _asked_for(options)
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(np.iinfo(np.int64).max))
        self._show(self._choose(name, seed))
        observation, info = self._current.reset(seed=seed)
        return self._observed(observation), info | self._report()

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Step the present variant."""
        observation, reward, terminated, truncated, info = self._current.step(action)
        return self._observed(observation), reward, terminated, truncated, info | self._report()

    def render(self) -> Any:
        """Render the present variant."""
        return self._current.render()

    @abstractmethod
    def _choose(self, name: str | None, seed: int) -> VariantEnv:
        """Return the environment of the named variant, or without a name of one that ``seed`` draws.

        ``np_random`` is seeded with it where the caller of ``reset`` gave it.
        """

    def _begin_with(self, environment: VariantEnv, parameters: Sequence[str], observe_context: bool) -> None:
        """Set the spaces and the parameters, and show a first variant's environment."""
        self.parameters, self.observe_context = tuple(parameters), observe_context
        self.metadata, self.render_mode = environment.metadata, environment.render_mode
        self.action_space = environment.action_space
        space = environment.observation_space
        assert isinstance(space, gym.spaces.Box)
        if observe_context:
            # Nothing is left of a parameter at -1.
            low = np.append(space.low, np.full(len(self.parameters), -1.0))
            high = np.append(space.high, np.full(len(self.parameters), np.inf))
            space = gym.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = space
        self._show(environment)

    def _show(self, environment: VariantEnv) -> None:
        """Make an environment the present one."""
        self._current = environment
        self._name = str(environment.variant)
        self._context = context(environment.variant, self.parameters)

    def _report(self) -> dict[str, Any]:
        # A copy, because users may keep and change what they get.
        return {"variant": self._name, "context": self._context.copy()}

    def _observed(self, observation: Array) -> Array:
        if self.observe_context:
            return np.concatenate((observation, self._context))
        return observation


class CollectionEnv(DrawingEnv, EzPickle):
    """One robot in many variants, one variant for each episode.

    ``reset(options={"variant": id})`` chooses the variant. Without the option, the seed draws it.

    Args:
        variants: ids of variants of one robot.
        models: id -> MJCF text in place of ``variants``, for variants of the original archive.
        weights: id -> weight of a variant in the draw, at least 0. Other variants have weight 1.
        parameters: names of the parameters in the context; None for those that the variants change.
        observe_context: append the context to the observation.
        page: the texts of the robot's page, for a robot of the user.
        **kwargs: passed to each variant's environment.

    Attributes:
        variants: the ids.

    Raises:
        VariantError: if the ids are not of variants of one robot, or a weight or ``parameters`` do not fit
            the variants.
        DrawingError: if a weight is negative or infinite, or no weight is above 0.

    Example:
        >>> env = gym.make("imujoco/hopper-mass-v0", observe_context=True)
        >>> env.observation_space.shape
        (15,)
    """

    @forget_on_error()
    def __init__(
        self,
        variants: Sequence[str] = (),
        models: Mapping[str, str] | None = None,
        weights: Mapping[str, float] | None = None,
        parameters: Sequence[str] | None = None,
        observe_context: bool = False,
        page: Mapping[str, str] | None = None,
        **kwargs: Any,
    ) -> None:
        EzPickle.__init__(self, variants, models, weights, parameters, observe_context, page, **kwargs)
        if page is not None and variants:
            adopt_page(variants[0].partition("-")[0], page)
        self._models = dict(models or {})
        kind = OriginalVariant if self._models else Variant
        parsed = [kind.parse(variant) for variant in self._models or variants]
        robots = sorted({variant.robot for variant in parsed})
        if len(robots) != 1:
            raise VariantError(
                f"a collection holds variants of one robot, not of {', '.join(robots) or 'none'}"
            )
        self.variants = tuple(str(variant) for variant in parsed)
        if parameters is None:
            parameters = changed_parameters(parsed)
        else:
            parameters = check_parameters(robots[0], parameters)
            for variant in parsed:
                context(variant, parameters)
        self._probabilities = None if weights is None else self._normalised(weights)
        self._kwargs = kwargs
        self._environments: dict[str, VariantEnv] = {}
        self._begin_with(self._environment(self.variants[0]), parameters, observe_context)

    def close(self) -> None:
        """Close every variant's environment."""
        for environment in self._environments.values():
            environment.close()  # type: ignore[no-untyped-call]

    def _choose(self, name: Variant | str | None, seed: int) -> VariantEnv:
        if name is None and self._probabilities is None:
            name = self.variants[self.np_random.integers(len(self.variants))]
        elif name is None:
            name = self.variants[self.np_random.choice(len(self.variants), p=self._probabilities)]
        self._check(name)
        return self._environment(str(name))

    def _check(self, name: Variant | str) -> None:
        if str(name) not in self.variants:
            raise VariantError(
                f"variant {name!r} is not in this collection{suggestion(str(name)[:80], self.variants)}; "
                f"it has {len(self.variants)}, from {self.variants[0]} to {self.variants[-1]}"
            )

    def _normalised(self, weights: Mapping[Any, float]) -> Array:
        """Return the probability of each variant."""
        weights = {str(variant): weight for variant, weight in weights.items()}
        for name, weight in weights.items():
            self._check(name)
            if not (isinstance(plain_number(weight), int | float) and 0 <= weight < float("inf")):
                raise DrawingError(f"the weight of {name} is {weight!r}; valid: a number, at least 0")
        values = np.array([weights.get(name, 1.0) for name in self.variants], dtype=np.float64)
        if not values.any():
            raise DrawingError("every variant has weight 0; at least one weight must be above 0")
        return np.asarray(values / values.sum())

    def _environment(self, name: str) -> VariantEnv:
        if name not in self._environments:
            self._environments[name] = variant_environment(name, self._models.get(name), self._kwargs)
        return self._environments[name]


class RandomisedEnv(DrawingEnv, EzPickle):
    """One robot whose parameters are drawn from ranges, anew for each episode.

    The seed of a reset draws all parameters, as percents with two decimals, and the model is compiled with
    them. ``info["variant"]`` names them, and ``info["context"]`` holds them as numbers.
    ``reset(options={"variant": id})`` chooses the variant, inside the ranges or not.

    Args:
        robot: the robot, as in ``hopper``.
        ranges: parameter -> lowest and highest percent of change; None for those of the catalogue.
        distribution: ``uniform`` or ``log-uniform``.
        parameters: names of the parameters in the context; None for those that have a range.
        observe_context: append the context to the observation.
        page: the texts of the robot's page, for a robot of the user.
        **kwargs: passed to each variant's environment.

    Attributes:
        ranges: the :class:`~imujoco_minari.variants.ranges.Ranges`.

    Raises:
        VariantError: if there is no such robot or parameter, a parameter cannot have such a percent, or
            ``parameters`` lacks one that has a range.
        DrawingError: if there is no range, or a range or the distribution is not valid.
    """

    @forget_on_error()
    def __init__(
        self,
        robot: str,
        ranges: Mapping[str, Sequence[float]] | None = None,
        distribution: str = UNIFORM,
        parameters: Sequence[str] | None = None,
        observe_context: bool = False,
        page: Mapping[str, str] | None = None,
        **kwargs: Any,
    ) -> None:
        EzPickle.__init__(self, robot, ranges, distribution, parameters, observe_context, page, **kwargs)
        if page is not None:
            adopt_page(robot, page)
        self.ranges = Ranges(robot, drawing_ranges(robot) if ranges is None else ranges, distribution)
        names = self.ranges.parameters if parameters is None else check_parameters(robot, parameters)
        context(self.ranges.draw(0), names)
        self._kwargs = kwargs
        self._begin_with(variant_environment(str(self.ranges.base), None, kwargs), names, observe_context)

    def close(self) -> None:
        """Close the present variant's environment."""
        self._current.close()  # type: ignore[no-untyped-call]

    def _choose(self, name: str | None, seed: int) -> VariantEnv:
        variant = self.ranges.draw(seed) if name is None else Variant.parse(name)
        if variant.robot != self.ranges.robot:
            raise VariantError(f"{variant} is not a variant of {self.ranges.robot}")
        context(variant, self.parameters)
        self._current.close()  # type: ignore[no-untyped-call]
        return variant_environment(str(variant), None, self._kwargs)


def _asked_for(options: Any) -> Any:
    """Return the variant that the options of a reset ask for, or None."""
    if options is None:
        return None
    if not isinstance(options, Mapping):
        raise ArgumentError(
            f'the options of a reset are a dict, as {{"variant": id}}, not {clipped(repr(options))}'
        )
    for key in options:
        # Minari's collector passes its own options on.
        if key != "variant" and not str(key).startswith("minari_"):
            raise ArgumentError(unknown("unknown option of a reset", key, ["variant"]))
    return options.get("variant")


def variant_environment(name: str, mjcf: str | None, arguments: Mapping[str, Any]) -> VariantEnv:
    """Make a variant's own environment without wrappers."""
    spec = environment_spec(name, mjcf)
    creator = load_env_creator(str(spec.entry_point))
    return cast(VariantEnv, creator(**spec.kwargs, **arguments))
