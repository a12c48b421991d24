"""Result files: what lines share is stored once, and every line reads as it was written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from imujoco_minari.benchmark.lines import Line, append_lines, identity, parsed, read_lines


def line(method: str, variant: str, seed: int, **more: Any) -> Line:
    measured = {"results": {"0": {"returns": [1.0]}}, "seconds": [0.1]}
    data = {"variant": variant, "data_sha256": "d" * 64, "references": [0.0, 1.0]}
    return (
        {"protocol": "p", "method": method, "settings": {"rate": 0.1}, **data, "seed": seed} | measured | more
    )


LINES = [line(method, variant, seed) for method in "ab" for variant in "vw" for seed in range(3)]


def test_lines_read_as_they_were_written_and_share_their_facts(tmp_path: Path) -> None:
    path, stated = tmp_path / "lines.jsonl", set[str]()
    for each in LINES:
        append_lines(path, [each], stated)
    assert read_lines(path) == LINES
    entries = [json.loads(text) for text in path.read_text("utf-8").splitlines()]
    # Two methods and two datasets.
    assert sum("name" in entry for entry in entries) == 4
    assert all(
        entry.keys() == {"facts", "seed", "results", "seconds"} for entry in entries if "name" not in entry
    )


def test_a_line_without_shared_facts_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    path.write_text("".join(json.dumps(each) + "\n" for each in LINES), "utf-8")
    append_lines(path, LINES[:1])
    assert read_lines(path) == [*LINES, LINES[0]]


def test_a_file_that_was_cut_in_its_facts_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    append_lines(path, LINES[:1])
    path.write_text(path.read_text("utf-8")[:40], "utf-8")
    append_lines(path, LINES[:1])
    assert read_lines(path) == LINES[:1]


def test_the_order_of_settings_does_not_change_the_identity() -> None:
    first, second = (
        line("a", "v", 0, settings=dict(x)) for x in ([("p", 1), ("q", 2)], [("q", 2), ("p", 1)])
    )
    assert identity(first) == identity(second) != identity(line("a", "v", 0))


@pytest.mark.parametrize(
    ("entry", "fault"),
    [
        ([], "not a JSON object"),
        ({"facts": ["c"]}, "not stated before it"),
        ({"facts": [["a"]]}, "not stated before it"),
        ({"facts": ["a", "a", "a"]}, "malformed"),
        ({"facts": {}}, "malformed"),
        ({"facts": "a"}, "malformed"),
        ({"name": 3, "facts": {}}, "malformed"),
        ({"name": "x", "facts": {str(number): 0 for number in range(21)}}, "malformed"),
    ],
)
def test_malformed_entries_are_refused(entry: Any, fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        parsed(json.dumps(entry).encode(), {"a": {"method": "m"}})
