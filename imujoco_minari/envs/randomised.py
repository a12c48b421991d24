"""Environments that draw parameters from ranges at each reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium.utils import EzPickle

from imujoco_minari.envs.drawing import DrawingEnv, variant_environment
from imujoco_minari.envs.robots import VariantEnv
from imujoco_minari.errors import VariantError
from imujoco_minari.variants import Variant, adopt_page
from imujoco_minari.variants.context import check_parameters, context
from imujoco_minari.variants.ranges import UNIFORM, Ranges, drawing_ranges
from imujoco_minari.variants.robots import forget_on_error


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
