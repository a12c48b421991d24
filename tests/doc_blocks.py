"""The Python blocks of Markdown pages, and how a page is run.

A page's blocks run in order and share their names. Comments steer it, each on a line of its own:

- ``<!-- has: imujoco/hopper-base-v0 ... -->`` anywhere: datasets that are in the Minari root beforehand;
- ``<!-- needs: d3rlpy -->`` above a block: it and all that follow run where that module is installed;
- ``<!-- not run: reason -->`` above a block: it never runs.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]

_COMMENT = re.compile(r"<!-- (has|needs|not run): *(.*?) *-->")
_FENCE = re.compile(r"(?P<indent> *)```(?P<language>[^`]*)")


@dataclass(frozen=True)
class Block:
    """One Python block: its code, the line it begins at (from 1), and what was said above it."""

    code: str
    line: int
    needs: str = ""
    not_run: str = ""


@dataclass(frozen=True)
class Page:
    """One Markdown file: its datasets and its Python blocks."""

    path: Path
    has: tuple[str, ...]
    blocks: tuple[Block, ...]


def pages() -> Iterator[Path]:
    """Yield the README and every page of the documentation, as it is written."""
    yield REPOSITORY / "README.md"
    for path in sorted((REPOSITORY / "docs").rglob("*.md")):
        if "_build" not in path.parts:
            yield path


def read_page(path: Path) -> Page:
    """Return the blocks of a page.

    Raises:
        ValueError: when a comment is above no Python block, or gives no reason.
    """
    has: list[str] = []
    blocks: list[Block] = []
    said: dict[str, str] = {}
    lines = path.read_text("utf-8").splitlines()
    number = 0
    while number < len(lines):
        line = lines[number]
        number += 1
        if fence := _FENCE.match(line):
            start = number
            indent, language = fence["indent"], fence["language"].strip()
            while lines[number].strip() != "```":
                number += 1
            code = "\n".join(row.removeprefix(indent) for row in lines[start:number])
            number += 1
            if language == "python":
                blocks.append(Block(code, start + 1, said.pop("needs", ""), said.pop("not run", "")))
        elif comment := _COMMENT.fullmatch(line.strip()):
            if not comment[2]:
                raise ValueError(f"{path.name}, line {number}: {comment[1]} what?")
            if comment[1] == "has":
                has += comment[2].split()
            else:
                said[comment[1]] = comment[2]
            continue
        elif not line.strip():
            continue
        if said:
            raise ValueError(f"{path.name}, line {number}: no Python block follows {said}")
    return Page(path, tuple(has), tuple(blocks))


def run_page(page: Page) -> list[Block]:
    """Run a page's blocks and return those that ran; a traceback shows the page's own lines."""
    ran = []
    names: dict[str, object] = {"__name__": "__main__"}
    for block in page.blocks:
        if block.needs and not find_spec(block.needs):
            break
        if not block.not_run:
            exec(compile("\n" * (block.line - 1) + block.code, str(page.path), "exec"), names)
            ran.append(block)
    return ran
