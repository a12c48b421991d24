"""Every error that a user's mistake or a broken file can cause, and checks of arguments that raise them.

Each is an :class:`ImujocoError` and also the builtin that fits, so that callers may catch either.
A message names the thing, says what is wrong, and lists the valid choices or the nearest match.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from operator import index
from pathlib import Path
from typing import Any, ClassVar


class ImujocoError(Exception):
    """The base of all errors raised by this package.

    Attributes:
        missing: whether the user asked for something that does not exist.
    """

    missing: ClassVar[bool] = False


class NotFoundError(ImujocoError):
    """The user asked for something that does not exist. The command line then exits with 2, not 1."""

    missing = True


class ArgumentError(ImujocoError, ValueError):
    """An argument of a function that has a wrong type or value."""


class VariantError(NotFoundError, ValueError):
    """An id, robot, category, percent or body that does not name a variant."""


class CatalogueError(ImujocoError, ValueError):
    """A catalogue file that is malformed or wrong."""


class PageNotFoundError(NotFoundError, CatalogueError):
    """A page or a folder of pages that does not exist."""


class ModelError(ImujocoError, ValueError):
    """An MJCF model that cannot be built or compiled."""


class DrawingError(ImujocoError, ValueError):
    """Weights, ranges or a distribution from which no variant can be drawn."""


class PolicyError(ImujocoError, ValueError):
    """A policy file that cannot be read, or that does not fit the robot."""


class ImujocoWarning(UserWarning):
    """The base class of the warnings. The command line prints them as notes."""


class CatalogueWarning(ImujocoWarning):
    """A page of a robot that is left out because of a fault in it."""


class PolicyWarning(ImujocoWarning):
    """A policy that falls or scores low, or a policy whose record cannot be read."""


class PolicyNotFoundError(NotFoundError, FileNotFoundError):
    """No policy exists for the variant and the tier, or at the given path."""


class DatasetError(ImujocoError, ValueError):
    """A dataset with wrong content or a wrong identity."""


class DatasetIdError(NotFoundError, DatasetError):
    """A text that is not a dataset id."""


class FormatError(NotFoundError, DatasetError):
    """An export format that does not exist."""


class DatasetExistsError(ImujocoError, FileExistsError):
    """A dataset id that is already taken."""


class DatasetNotFoundError(NotFoundError, FileNotFoundError):
    """A dataset id that names nothing in the Minari root."""


class StorageError(ImujocoError, OSError):
    """The Minari root, or another place to write to, cannot be used."""


class TrainingError(ImujocoError, RuntimeError):
    """Training cannot start, continue or end as asked."""


class TransferError(ImujocoError, RuntimeError):
    """An evaluation of policies across variants that cannot be made or gone on with."""


class BenchmarkError(ImujocoError, ValueError):
    """A benchmark's method, budget or results that cannot be used."""


class BenchmarkChoiceError(NotFoundError, BenchmarkError):
    """A method, setting, budget, robot, tier or held-out variant that a benchmark does not have."""


class RenderingError(ImujocoError, RuntimeError):
    """A picture or a video that cannot be drawn or written."""


class RenderingFormatError(NotFoundError, RenderingError):
    """A file ending that pictures and videos do not have."""


class RemoteError(ImujocoError, ConnectionError):
    """A remote that is malformed, cannot be reached, or refuses."""


class JobError(ImujocoError, RuntimeError):
    """Work that cannot be handed to other processes or machines, or was lost with them."""


class DependencyError(ImujocoError, ImportError):
    """An optional package is needed and not installed."""


def missing_dependency(package: str, extra: str, purpose: str) -> DependencyError:
    """Return the error for an optional ``package`` that ``purpose`` needs, with its remedy."""
    return DependencyError(
        f'{purpose} needs {package}, which is not installed: run `pip install "imujoco-minari[{extra}]"`'
    )


def suggestion(word: str, choices: Iterable[str]) -> str:
    """Return `` (did you mean 'x'?)`` for the choice nearest to ``word``, or an empty string."""
    near = get_close_matches(word, list(choices), n=1, cutoff=0.6)
    return f" (did you mean {near[0]!r}?)" if near else ""


def unknown(what: str, word: object, choices: Iterable[str]) -> str:
    """Return the message for a word that is none of the choices, with the nearest one and all of them.

    It begins with ``what``, as in ``unknown robot``.
    """
    shown, choices = clipped(word), list(choices)
    return f"{what} {shown!r}{suggestion(shown, choices)}; valid: {', '.join(choices)}"


def listed(names: Sequence[str], shown: int = 4) -> str:
    """Return the first names, and the number of the others."""
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(names[:shown]) + more


def clipped(text: object) -> str:
    """Return a text at most 80 characters long, so that a message does not quote a hostile id in full."""
    shown = str(text)
    return shown if len(shown) <= 80 else shown[:77] + "..."


def whole_number(value: Any, name: str, *, least: int) -> int:
    """Return the argument ``name`` as an ``int``.

    Raises:
        ArgumentError: when it is not a whole number, or is smaller than ``least``.
    """
    try:
        number = index(value)
    except TypeError:
        number = least - 1
    if number < least or isinstance(value, bool):
        raise ArgumentError(f"{name} must be a whole number of at least {least}, not {clipped(repr(value))}")
    return number


def as_path(value: Any) -> Path:
    """Return a path.

    Raises:
        ArgumentError: when ``value`` is neither text nor a path.
    """
    try:
        return Path(value)
    except TypeError:
        raise ArgumentError(f"a path is text or a pathlib.Path, not {clipped(repr(value))}") from None


def check_one_robot(datasets: Iterable[tuple[str, str]], purpose: str) -> None:
    """Raise a DatasetError if datasets, pairs of robot and id, are of several robots.

    Robots with equal shapes still mean different things. An unknown robot is an empty text. The message
    begins with ``purpose``, as in ``arrays hold``.
    """
    robots: dict[str, str] = {}
    for robot, dataset_id in datasets:
        robots.setdefault(robot or "unknown", dataset_id)
    if len(robots) > 1:
        listed = ", ".join(f"{robot} ({dataset_id})" for robot, dataset_id in robots.items())
        raise DatasetError(f"{purpose} one robot, but these datasets are of several: {listed}")
