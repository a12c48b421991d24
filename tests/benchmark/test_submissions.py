"""Lines of others are checked before they stand beside the published ones. They are untrusted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from imujoco_minari.benchmark import few_shot, offline
from imujoco_minari.benchmark.lines import read_lines
from imujoco_minari.benchmark.page import read_results, results_page, sections
from imujoco_minari.benchmark.submissions import MAX_BYTES, MAX_LINE, MAX_LINES, check_submission
from imujoco_minari.cli.app import run
from imujoco_minari.errors import BenchmarkError

RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.fixture(scope="module")
def whole() -> list[dict[str, Any]]:
    """The lines of one published method on one split: a whole submission."""
    lines = read_lines(RESULTS / few_shot.FILE)
    return [
        dict(x)
        for x in lines
        if (x["method"], x["split"], x["tier"]) == ("maml", "hopper-random-v1", "expert")
    ]


def written(folder: Path, lines: list[Any], name: str = few_shot.FILE) -> Path:
    (folder / name).write_text("".join(json.dumps(line) + "\n" for line in lines), "utf-8")
    return folder


def test_whole_lines_have_no_fault(whole: list[dict[str, Any]], tmp_path: Path) -> None:
    assert len(whole) == 175
    assert check_submission(written(tmp_path, whole)) == []
    off = [x for x in read_lines(RESULTS / offline.FILE) if x["method"] == "iql"]
    written(tmp_path, off, offline.FILE)
    assert check_submission(tmp_path) == ["a folder has one method, but these lines are of 2"]
    (tmp_path / few_shot.FILE).unlink()
    assert check_submission(tmp_path) == []
    written(tmp_path, off[1:], offline.FILE)
    assert "lacks seed 0 (2 of 3 cells)" in check_submission(tmp_path)[0]


def test_an_offline_algorithm_may_stop_early(tmp_path: Path) -> None:
    lines = [dict(x) for x in read_lines(RESULTS / offline.FILE) if x["method"] == "iql"]
    for line in lines:
        line["checkpoints"] = line["checkpoints"][:2]
        steps = list(map(str, line["checkpoints"]))
        line["results"] = {
            variant: {number: by_updates[number] for number in steps}
            for variant, by_updates in line["results"].items()
        }
    assert check_submission(written(tmp_path, lines, offline.FILE)) == []
    for checkpoints in ([], [50_000]):
        changed = [line | {"checkpoints": checkpoints} for line in lines]
        assert any(
            f"checkpoints is list; the published results have {[25_000]}" in fault
            for fault in check_submission(written(tmp_path, changed, offline.FILE))
        )


def test_missing_and_repeated_cells_are_named(whole: list[dict[str, Any]], tmp_path: Path) -> None:
    (fault,) = check_submission(written(tmp_path, whole[2:]))
    assert "lacks 'hopper-massinc_50_torsogeom', '1x100', seed 0 and 1 more (173 of 175 cells)" in fault
    (fault,) = check_submission(written(tmp_path, [*whole, whole[0]]))
    assert "repeats 'hopper-massinc_50_torsogeom', '1x100', seed 0 (175" in fault
    (fault,) = check_submission(written(tmp_path, [*whole, whole[0] | {"seed": 7}]))
    assert "the protocol lacks: 'hopper-massinc_50_torsogeom', '1x100', seed 7" in fault


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"protocol": "few-shot-v2"}, "the protocol is 'few-shot-v2', not few-shot-v1"),
        ({"split": "mine"}, "in the split 'mine' with the tier 'expert'"),
        ({"variant": "hopper-base"}, "published results do not have 'hopper-base'"),
        ({"data_sha256": "0"}, "data_sha256 is '0'; the published results have"),
        ({"train_sha256": "0"}, "train_sha256 is '0'; the published results have"),
        ({"policies_sha256": "0"}, "policies_sha256 is '0'; the published"),
        ({"references": [0.0, 1.0]}, "references is list; the published results have ["),
        ({"episodes": 1}, "episodes is 1; the published results have 10"),
        ({"settings": {}}, "its settings are not stated"),
        ({"settings": {"a": {}}}, "its settings are not stated"),
        ({"settings": {"a": 1}}, "the lines have 2 different settings"),
        ({"versions": {"mujoco": "3.0.0\n"}}, r"mujoco is '3.0.0\n'; the published results have"),
        ({"seed": True}, "seed is missing or not int"),
        ({"budget": None}, "budget is missing or not str"),
        ({"results": {}}, "it has no results"),
        ({"results": {"-1": {}}}, "'-1' is not a number of gradient steps"),
        ({"results": {"0": 3}}, "returns are not 10 finite numbers"),
        ({"results": {"0": {"returns": [float("nan")] * 10, "error": 0.1}}}, "returns are not 10 finite"),
        ({"results": {"0": {"returns": [10**999] * 10, "error": 0.1}}}, "returns are not 10 finite"),
        ({"results": {"0": {"returns": [True] * 10, "error": 0.1}}}, "returns are not 10 finite"),
        ({"results": {"0": {"returns": [1.0] * 10}}}, "the error of the actions is not a finite number"),
        ({"results": {"7": {"returns": [1.0] * 10, "error": 0.1}}}, "differ in their gradient steps"),
    ],
)
def test_each_fault_is_named(
    whole: list[dict[str, Any]], tmp_path: Path, change: dict[str, Any], fault: str
) -> None:
    found = check_submission(written(tmp_path, [whole[0] | change, *whole[1:]]))
    assert any(fault in each for each in found), found
    assert all(each.isprintable() for each in found)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"[]",
        b"3",
        b"\xff\xfe",
        b"null",
        b"[" * 100_000,
        b'{"a":' * 9_000,
        b"1" * 5_000,
        b"\0",
        b'{"seed": "\\ud800"}',
    ],
)
def test_malformed_lines_are_faults(tmp_path: Path, text: bytes) -> None:
    for name in (few_shot.FILE, offline.FILE):
        (tmp_path / name).write_bytes(text + b"\n")
    assert len(check_submission(tmp_path)) >= 2


def test_reading_is_bounded(whole: list[dict[str, Any]], tmp_path: Path) -> None:
    file = written(tmp_path, whole) / few_shot.FILE
    with file.open("ab") as opened:
        opened.write(b" " * (MAX_LINE + 1))
    assert "line 176 is longer than 128 KiB" in check_submission(tmp_path)[0]
    with file.open("ab") as opened:
        opened.truncate(MAX_BYTES + 1)
    assert "larger than 8 MiB: not read" in check_submission(tmp_path)[0]
    file.write_bytes(b"\n" * (MAX_LINES + 1))
    assert "more than 100,000 lines: not read further" in check_submission(tmp_path)[0]
    written(tmp_path, [whole[0] | {"versions": {"mujoco": str(number)}} for number in range(500)])
    assert len(check_submission(tmp_path)) < 60


def test_a_folder_without_lines_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=r"has neither few-shot.jsonl nor offline.jsonl"):
        check_submission(tmp_path)


def test_the_command_prints_the_faults(
    whole: list[dict[str, Any]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(["benchmark", "check", str(written(tmp_path, whole))]) == 0
    assert "whole, and of the published data" in capsys.readouterr().out
    written(tmp_path, whole[1:])
    assert run(["benchmark", "check", str(tmp_path)]) == 1
    assert capsys.readouterr().out.count("\n") == 1
    assert run(["benchmark", "check", str(tmp_path), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert (answer["whole"], len(answer["faults"])) == (False, 1)


def test_the_page_marks_lines_of_others_and_refuses_faulty_ones(
    whole: list[dict[str, Any]], tmp_path: Path
) -> None:
    written(tmp_path, whole)
    own = tmp_path / "others" / "mine"
    own.mkdir(parents=True)
    written(own, whole)
    results = read_results(tmp_path)
    page = results_page(results, sections(results))
    assert "| mine † | 2000 |" in page
    assert "† a method of others" in page
    written(own, whole[1:])
    with pytest.raises(BenchmarkError, match=r"mine: few-shot.jsonl: hopper-random-v1, expert: lacks"):
        read_results(tmp_path)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"split": "hopper-random-v1/../../../x"}, r"line 1: .*: split is 'hopper-random-v1/\.\./"),
        ({"method": "<script>x</script>|\n# H"}, r"line 1: .*: method is '<script>"),
        ({"tier": None}, "line 1: .*: tier is None"),
    ],
)
def test_a_name_that_would_leave_the_folder_or_change_the_page_is_refused(
    whole: list[dict[str, Any]], tmp_path: Path, change: dict[str, Any], fault: str
) -> None:
    with pytest.raises(BenchmarkError, match=fault):
        read_results(written(tmp_path, [whole[0] | change]))


@pytest.mark.parametrize(
    "key", ["variant", "seed", "references", "data_sha256", "train_sha256", "policies_sha256", "versions"]
)
def test_a_line_that_lacks_an_entry_is_named(whole: list[dict[str, Any]], tmp_path: Path, key: str) -> None:
    facts = {"name": "f", "facts": {}}
    line = {name: value for name, value in whole[0].items() if name != key}
    with pytest.raises(BenchmarkError, match=f"line 3: not a result of the benchmark: it has no {key}"):
        read_results(written(tmp_path, [facts, whole[1], line]))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"references": [7.0, 7.0]}, "both of its references are 7.0"),
        ({"references": ["a", "b"]}, "."),
        ({"references": [1.0]}, "not enough values"),
        ({"seed": "0"}, "its seed is not a whole number"),
        ({"versions": "1"}, "."),
        ({"protocol": "offline-v1"}, "its protocol is not few-shot-v1"),
        ({"results": {"x": {"returns": [1.0], "error": 0.0}}}, "invalid literal for int"),
        ({"results": {"0": {"returns": [], "error": 0.0}}}, "not finite"),
        ({"results": {"0": {"returns": [float("nan")], "error": 0.0}}}, "not finite"),
        ({"results": {"0": {"returns": "12", "error": 0.0}}}, "."),
        ({"results": {"0": {"returns": [1.0]}}}, "it has no error"),
        ({"results": {"0": [1.0]}}, "."),
    ],
)
def test_a_line_that_cannot_be_scored_is_named(
    whole: list[dict[str, Any]], tmp_path: Path, change: dict[str, Any], fault: str
) -> None:
    with pytest.raises(BenchmarkError, match=f"line 1: not a result of the benchmark: .*{fault}"):
        read_results(written(tmp_path, [whole[0] | change]))


@pytest.mark.parametrize("start", [b"\xef\xbb\xbf", b'{"a":"\xed\xa0\x80"}\n'])
def test_the_check_refuses_the_bytes_that_the_page_cannot_read(
    whole: list[dict[str, Any]], tmp_path: Path, start: bytes
) -> None:
    file = written(tmp_path, whole) / few_shot.FILE
    file.write_bytes(start + file.read_bytes())
    assert any("line 1: not a JSON object" in fault for fault in check_submission(tmp_path))


def test_an_incomplete_last_line_is_a_fault(whole: list[dict[str, Any]], tmp_path: Path) -> None:
    file = written(tmp_path, whole) / few_shot.FILE
    file.write_bytes(file.read_bytes().rstrip())
    assert "line 175: it has no line break at its end" in check_submission(tmp_path)[0]
