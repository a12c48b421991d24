"""A name has one meaning, a package says what it owns, no module is long: read from the source, not run."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import imujoco_minari

PACKAGE = Path(imujoco_minari.__file__).parent
MODULES = {str(path.relative_to(PACKAGE)): path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
MAX_LINES = 350

# What is still to be renamed or shortened. An entry that is no longer needed fails the tests: delete it.
SHARED: set[str] = set()
LONG: set[str] = set()


def type_names(source: str) -> Iterator[tuple[str, str]]:
    """Yield the classes and type aliases of a module, each with its definition; a class has none.

    A type alias is an assignment such as ``Positions = NDArray[np.int64]`` at the top of the module.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield node.name, ""
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
            target = node.targets[0]
            if isinstance(target, ast.Name) and target.id[0].isupper() and not target.id.isupper():
                yield target.id, ast.unparse(node.value)


def shared_names(sources: Iterable[str]) -> set[str]:
    """Return the names of several classes, and of a type alias that is defined in several ways."""
    definitions: dict[str, list[str]] = defaultdict(list)
    for source in sources:
        for name, definition in type_names(source):
            definitions[name].append(definition)
    return {name for name, found in definitions.items() if len(set(found)) > 1 or found.count("") > 1}


def long_modules(modules: dict[str, str]) -> set[str]:
    return {name for name, source in modules.items() if len(source.splitlines()) > MAX_LINES}


def undocumented_packages(modules: dict[str, str]) -> set[str]:
    return {
        name
        for name, source in modules.items()
        if name.endswith("__init__.py") and not ast.get_docstring(ast.parse(source))
    }


def test_no_two_types_share_a_name() -> None:
    assert shared_names(MODULES.values()) == SHARED


def test_no_module_is_long() -> None:
    assert long_modules(MODULES) == LONG


def test_every_package_says_what_it_owns() -> None:
    assert sum(name.endswith("__init__.py") for name in MODULES) >= 14
    assert undocumented_packages(MODULES) == set()


def test_shared_names_are_found() -> None:
    assert shared_names(["class A: ...\nclass B: ...", "class A: ...\nclass C: ..."]) == {"A"}
    assert shared_names(["class A: ...\ndef f():\n    class A: ..."]) == {"A"}
    assert shared_names(["Row = tuple[int]", "Row = list[int]", "class Row: ..."]) == {"Row"}
    assert shared_names(["Row = tuple[int]\nrow = a[0]\nROW = a[0]", "Row = tuple[int]"]) == set()


def test_long_modules_and_undocumented_packages_are_found() -> None:
    modules = {
        "long.py": "\n" * 351,
        "short.py": "\n" * 350,
        "a/__init__.py": "x = 1",
        "b/__init__.py": '"B."',
    }
    assert long_modules(modules) == {"long.py"}
    assert undocumented_packages(modules) == {"a/__init__.py"}
