"""Every Python block of the README and of the documentation runs, or says why not."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from actor_datasets import publish_actors
from doc_blocks import REPOSITORY, pages, read_page, run_page

from imujoco_minari.variants import EXPERT, parse_dataset_id

PAGES = {str(path.relative_to(REPOSITORY)): path for path in pages()}


@pytest.fixture(scope="session")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari root that gets the datasets that pages ask for."""
    return tmp_path_factory.mktemp("published")


@pytest.mark.parametrize("name", PAGES)
def test_the_page_runs(
    name: str, published: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = read_page(PAGES[name])
    for dataset_id in page.has:
        publish_actors([dataset_id], published)
        shutil.copytree(published / dataset_id, root / dataset_id)
    if page.has:
        shutil.copy(published / "imujoco" / "namespace_metadata.json", root / "imujoco")
    monkeypatch.chdir(tmp_path)
    ran = run_page(page)
    needed = [block.needs for block in page.blocks if block.needs]
    assert needed or len(ran) == sum(not block.not_run for block in page.blocks)


@pytest.mark.parametrize("name", [name for name, path in PAGES.items() if read_page(path).has])
def test_a_page_says_how_to_publish_the_datasets_that_it_reads(name: str) -> None:
    commands = re.findall(r"imujoco publish ([^`\n]*)", PAGES[name].read_text("utf-8"))
    published = {word for command in commands for word in command.split()}
    read = [parse_dataset_id(dataset_id) for dataset_id in read_page(PAGES[name]).has]
    assert {str(variant) for variant, _ in read} <= published
    assert {tier for _, tier in read} <= published | {EXPERT}


def page_of(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "page.md"
    path.write_text(text, "utf-8")
    return path


def test_blocks_share_their_names_and_run_in_order(tmp_path: Path) -> None:
    text = "```python\nx = [1]\n```\ntext\n\n  ```python\n  x.append(2)\n  ```\n```console\n$ x\n```\n"
    page = read_page(page_of(tmp_path, text + "```python\nassert x == [1, 2]\n```\n"))
    assert len(run_page(page)) == 3


def test_a_failing_block_fails_at_its_line(tmp_path: Path) -> None:
    page = read_page(page_of(tmp_path, "# Title\n\n```python\nx = 1\nassert x == 2\n```\n"))
    with pytest.raises(AssertionError) as failure:
        run_page(page)
    assert failure.traceback[-1].lineno == 4


def test_an_excused_block_does_not_run(tmp_path: Path) -> None:
    text = "<!-- not run: it fails -->\n\n```python\nassert False\n```\n```python\nx = 1\n```\n"
    assert len(run_page(read_page(page_of(tmp_path, text)))) == 1


def test_what_needs_a_missing_module_ends_the_run(tmp_path: Path) -> None:
    text = "```python\nx = 1\n```\n<!-- needs: no_such_module -->\n```python\nassert False\n```\n"
    text += "```python\nunknown\n```\n"
    assert len(run_page(read_page(page_of(tmp_path, text)))) == 1
    present = text.replace("no_such_module", "json")
    with pytest.raises(AssertionError):
        run_page(read_page(page_of(tmp_path, present)))


def test_the_datasets_of_a_page_are_collected(tmp_path: Path) -> None:
    text = "<!-- has: a/b-v0 a/c-v0 -->\n\ntext\n\n<!-- has: a/d-v0 -->\n"
    assert read_page(page_of(tmp_path, text)).has == ("a/b-v0", "a/c-v0", "a/d-v0")


@pytest.mark.parametrize(
    "text",
    [
        "<!-- not run: reason -->\ntext\n\n```python\nx = 1\n```\n",
        "<!-- needs: json -->\n```console\n$ x\n```\n",
        "<!-- not run: -->\n```python\nx = 1\n```\n",
    ],
)
def test_an_excuse_for_nothing_or_of_nothing_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match=r"no Python block follows|not run what"):
        read_page(page_of(tmp_path, text))
