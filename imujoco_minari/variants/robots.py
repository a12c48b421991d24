"""The robots that are known: those with a page in ``env_specs/``, and those with a page of the user.

A user's page and its MJCF file travel with the robot: in the specs of its environments, and with its variants
to other processes. So a dataset of such a robot works on machines that do not have the page.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

from imujoco_minari.errors import CatalogueError, VariantError, as_path, clipped, unknown
from imujoco_minari.variants.pages import RobotSpecification, parse_specification

_ROBOT = re.compile(r"[a-z][a-z0-9]{0,39}", re.ASCII)
# An HDF5 attribute holds at most 64 KiB.
_MAX_PAGE_CHARACTERS = 48 * 1024


_T = TypeVar("_T")


def specification(robot: str) -> RobotSpecification:
    """Return the page of ``robot``.

    Raises:
        VariantError: when there is no such robot.
    """
    if isinstance(robot, str) and robot in _FAULTS:
        raise CatalogueError(_FAULTS[robot])
    if not isinstance(robot, str) or robot not in _PAGES:
        own = "load_catalogue and --catalogue load the page of another robot"
        raise VariantError(f"{unknown('unknown robot', robot, _PAGES)}; {own}")
    return _PAGES[robot]


def known_robots() -> tuple[str, ...]:
    """Return all known robots: those that the catalogue lists, the smallest first, then the others."""
    return tuple(_PAGES)


def page_files(path: str | Path) -> dict[str, Path]:
    """Return robot -> page for the pages in a folder, or for one page; raise a CatalogueError for none."""
    path = as_path(path)
    files = sorted(path.glob("*.toml")) if path.is_dir() else [path]
    if not files:
        raise CatalogueError(f"{path}: no page of a robot is here; a page is a file <robot>.toml")
    return {file.name.removesuffix(".toml"): file for file in files}


def load_page(robot: str, file: Path) -> None:
    """Make a robot known by its page. The page's ``model`` is an MJCF file beside it, or one of Gymnasium's.

    Raises:
        CatalogueError: when the page or its model cannot be read, the page is wrong, or another page of the
            robot is loaded.
    """
    # Only pages of users need an XML parser, which takes time to import.
    from imujoco_minari.variants.includes import read_file, read_model

    page = {"toml": read_file(file, 4 * _MAX_PAGE_CHARACTERS)}
    model = file.with_name(_parse(robot, page, str(file)).model)
    if model.is_file():
        page["mjcf"] = read_model(model)
    adopt_page(robot, page, str(file))


def keep_fault(robot: str, fault: str) -> None:
    """Keep the fault of a robot's page. :func:`specification` raises it when that robot is needed."""
    if robot not in _PAGES:
        _FAULTS[robot] = fault


def adopt_page(robot: str, page: Mapping[str, str], name: str = "") -> None:
    """Make a robot known by the texts of its page.

    Args:
        robot: the name of the robot.
        page: what :func:`carried_page` returned: the text of the page (``toml``), and that of the model
            (``mjcf``) unless the model is one of Gymnasium's.
        name: of the page, for messages.

    Raises:
        CatalogueError: when the page is wrong, or another page of the robot is loaded.
    """
    if _CARRIED.get(robot) == page:
        return
    name = name or f"the page of {clipped(robot)}"
    parsed = _parse(robot, page, name)
    if robot in _PAGES:
        raise CatalogueError(
            f"{name}: another page of the robot {robot} is loaded; give the robot another name, or load the "
            "changed page in a new process"
        )
    _PAGES[robot] = parsed
    _FAULTS.pop(robot, None)
    _CARRIED[robot] = MappingProxyType(dict(page))


def forget_page(robot: str) -> None:
    """Make a robot unknown that :func:`adopt_page` made known, and clear the caches that use its page."""
    if _CARRIED.pop(robot, None) is not None:
        del _PAGES[robot]
        for function in _FOLLOWING:
            function.cache_clear()


@contextmanager
def forget_on_error() -> Iterator[None]:
    """If the block fails, make the robots unknown again that became known in it."""
    before = known_robots()
    try:
        yield
    except BaseException:
        for robot in set(known_robots()) - set(before):
            forget_page(robot)
        raise


def follows_page(function: _T) -> _T:
    """Mark a cached function that uses pages: :func:`forget_page` clears its cache."""
    _FOLLOWING.append(function)
    return function


def carried_page(robot: str) -> Mapping[str, str] | None:
    """Return the texts that :func:`adopt_page` takes; None for a robot that the package ships.

    The MJCF text may come from anywhere: :mod:`imujoco_minari.envs` checks it before it compiles it.
    """
    return _CARRIED.get(robot)


def carrying(
    robot: str, make: Callable[..., _T], *arguments: object
) -> tuple[Callable[..., _T], tuple[Any, ...]]:
    """Return the ``__reduce__`` of an object of a robot. The page of a user's robot travels along."""
    page = carried_page(robot)
    return _make_with_page, (page and dict(page), robot, make, arguments)


def _make_with_page(
    page: Mapping[str, str] | None, robot: str, make: Callable[..., _T], arguments: tuple[object, ...]
) -> _T:
    if page is not None:
        adopt_page(robot, page)
    return make(*arguments)


def _parse(robot: str, page: Mapping[str, str], name: str) -> RobotSpecification:
    if not _ROBOT.fullmatch(robot):
        raise CatalogueError(
            f"{name}: {clipped(robot)!r} is not the name of a robot; valid: lower-case letters and digits"
        )
    if not set(page) <= {"toml", "mjcf"} or not all(isinstance(text, str) for text in page.values()):
        raise CatalogueError(f"{name}: a page has the texts toml and mjcf")
    text = page.get("toml", "")
    if len(text) > _MAX_PAGE_CHARACTERS:
        raise CatalogueError(f"{name}: the page has {len(text)} characters; limit {_MAX_PAGE_CHARACTERS}")
    return parse_specification(text, name)


def pages_folder() -> Path:
    """Return the folder of the shipped pages."""
    return Path(__file__).parents[1] / "env_specs"


def _shipped_pages() -> dict[str, RobotSpecification]:
    """Return the robots of the package, the listed ones first, the smallest first among both."""
    pages = {
        page.stem: parse_specification(page.read_text("utf-8"), page.name)
        for page in pages_folder().glob("*.toml")
    }
    order = sorted(pages, key=lambda robot: (not pages[robot].listed, pages[robot].observation_size, robot))
    return {robot: pages[robot] for robot in order}


_PAGES = _shipped_pages()
# Robot -> the texts of its page, for robots that the package does not ship.
_CARRIED: dict[str, Mapping[str, str]] = {}
# Robot -> the fault of its page, for robots whose pages could not be loaded.
_FAULTS: dict[str, str] = {}
# The functions whose caches are cleared when a page is forgotten.
_FOLLOWING: list[Any] = []
# The robots that the catalogue lists. Their variants are the 154.
ROBOTS = tuple(robot for robot, page in _PAGES.items() if page.listed)
