"""Changes: a category of physical parameter, a signed percent of the base value, and a body."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from imujoco_minari.errors import VariantError, clipped, unknown
from imujoco_minari.variants.pages import Listing
from imujoco_minari.variants.robots import specification

# Beyond this a model still compiles but means nothing; it also bounds hostile ids.
MAX_PERCENT = 10_000
# Decimals of a percent. An id must stay short and exact.
MAX_DECIMALS = 2

CHANGE_ID = re.compile(
    r"(?P<category>[a-z]+?)(?P<sign>inc|dec)_(?P<percent>[0-9]+(?:p[0-9]+)?)_(?P<body>[a-z0-9]+)", re.ASCII
)
GRAMMAR = (
    "valid: <robot>-<category><inc|dec>_<percent>_<body>, as in hopper-massdec_25_leggeom, "
    "several such changes joined by -, or <robot>-base"
)


@dataclass(frozen=True, order=True)
class Change:
    """One physical parameter of a robot, changed.

    Attributes:
        category: one of ``CATEGORIES``.
        percent: signed change in percent of the base value, with at most two decimals.
        body: the MJCF name without underscores, or a group that the robot's page names.
    """

    category: str
    percent: float
    body: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "percent", plain_number(self.percent))
        if (
            isinstance(self.percent, bool)
            or not isinstance(self.percent, int | float)
            or not abs(self.percent) < float("inf")
            or round(self.percent, MAX_DECIMALS) != self.percent
        ):
            raise VariantError(f"percent must be a number with at most two decimals, not {self.percent!r}")
        # 50 and 50.0 are one change, with one id.
        if isinstance(self.percent, float) and self.percent.is_integer():
            object.__setattr__(self, "percent", int(self.percent))

    def __str__(self) -> str:
        number = f"{abs(self.percent):.{MAX_DECIMALS}f}".rstrip("0").rstrip(".").replace(".", "p")
        return f"{self.category}{'inc' if self.percent >= 0 else 'dec'}_{number}_{self.body}"

    @classmethod
    def parse(cls, text: str) -> Change:
        """Return the change that ``text``, a part of a variant id, names.

        Raises:
            VariantError: when it is malformed.
        """
        match = CHANGE_ID.fullmatch(text)
        if match is None:
            raise VariantError(f"malformed change {clipped(text)!r}; {GRAMMAR}")
        size = float(match["percent"].replace("p", "."))
        if size > MAX_PERCENT:
            raise VariantError(f"the percent is too large; valid: at most {MAX_PERCENT}")
        change = cls(match["category"], size if match["sign"] == "inc" else -size, match["body"])
        if str(change) != text:
            raise VariantError(f"write {clipped(text)!r} as {str(change)!r}")
        return change

    @property
    def factor(self) -> float:
        """The factor on the base value, ``1 + percent / 100``."""
        return (100 + self.percent) / 100

    def mjcf_names(self, robot: str) -> tuple[str, ...]:
        """Return the names of the model's parts that are changed on a robot.

        Raises:
            VariantError: when the robot has no such category or body.
        """
        listing = listing_of(robot, self.category)
        names = listing.names(self.body)
        if not names:
            known = (*listing.bodies, *listing.groups)
            raise VariantError(unknown(f"the {self.category} of {robot} has no body", self.body, known))
        return names

    def check(self, robot: str) -> None:
        """Check that a robot can be changed so.

        Raises:
            VariantError: when it cannot.
        """
        names = self.mjcf_names(robot)
        if self.percent <= -100:
            raise VariantError(
                f"percent {self.percent} leaves nothing of the {self.category}; valid: above -100"
            )
        if self.percent > MAX_PERCENT:
            raise VariantError(f"percent {self.percent} is too large; valid: at most {MAX_PERCENT}")
        fixed = [name for name in names if name not in listing_of(robot, self.category).widen]
        if self.category == "joint" and self.percent > 0 and fixed:
            raise VariantError(
                f"the range of {fixed[0]} can only shrink, not grow by {self.percent} %; valid: -99 to 0"
            )


def plain_number(number: float) -> float:
    """Return a number of NumPy as Python's, and any other value as it is."""
    return number.item() if isinstance(number, np.generic) else number


def listing_of(robot: str, category: str) -> Listing:
    """Return a category of a robot's page; raise a VariantError when the robot has no such category."""
    categories = specification(robot).categories
    if category not in categories:
        raise VariantError(unknown(f"{robot} has no category", category, categories))
    return categories[category]
