"""The command line: what people see, what scripts read, and how it fails."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import minari
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

from imujoco_minari.cli.app import run


def test_list_counts_the_catalogue(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["list"]) == 0
    out = capsys.readouterr().out
    assert "154 variants; 154 with an expert, 0 published" in out
    assert "hopper-massdec_25_leggeom" in out
    assert run(["list", "--robot", "hopper", "--with-base"]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[1].startswith("hopper-base ")
    assert "37 variants and 1 base; " in out
    assert run(["list", "--robot", "walker2d", "--category", "length", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 14
    assert {row["robot"] for row in rows} == {"walker2d"}


def test_show_tells_the_change_in_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["show", "hopper-massdec_25_leggeom", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["dataset"] == "imujoco/hopper-massdec_25_leggeom-v0"
    (change,) = shown["changes"]
    assert change["quantity"] == "mass of leg"
    assert change["after"] / change["before"] == pytest.approx(0.75)
    assert run(["show", "halfcheetah-frictiondec_50_feet"]) == 0
    out = capsys.readouterr().out
    assert "friction of ffoot on floor   0.4      0.2" in out


@pytest.mark.parametrize(
    ("variant", "made"),
    [
        (
            "hopper-massdec_25_thighgeom",
            "universal policy told hopper-massinc_50_footgeom, not trained further",
        ),
        ("walker2d-jointdec_50_thighjoint", "walker2d-jointdec_50_thighjoints, not trained further"),
        ("halfcheetah-lengthdec_25_bthigh", "universal policy told a searched context, not trained further"),
        ("halfcheetah-lengthinc_50_fshin", "105,000 steps from halfcheetah-all, seed 0"),
        ("hopper-massinc_100_thighgeom", "the universal policy, told this variant; no own training"),
    ],
)
def test_show_says_what_made_an_expert(variant: str, made: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["show", variant]) == 0
    assert f"expert       CrossQ, {made}\n" in capsys.readouterr().out


def test_publish_verify_combine(capsys: pytest.CaptureFixture[str], root: Path) -> None:
    assert (
        run(["publish", "--robot", "hopper", "--category", "friction", "--tier", "random", "--episodes", "2"])
        == 0
    )
    captured = capsys.readouterr()
    assert captured.out.count("published imujoco/hopper-friction") == 3
    assert captured.err.startswith("3 datasets: about ")
    assert captured.err.endswith("published 3, failed 0\n")
    again = ["publish", "hopper-frictiondec_50_feet", "--tier", "random"]
    assert run([*again, "--episodes", "2"]) == 0
    assert "left alone imujoco/hopper-frictiondec_50_feet-random-v0" in capsys.readouterr().out
    combine = ["combine", "--robot", "hopper", "--tier", "random"]
    assert run([*combine, "--category", "friction"]) == 0
    assert "combined 3 datasets into imujoco/hopper-friction-random-v0: 6 episodes" in capsys.readouterr().out
    assert run([*combine, "--category", "friction"]) == 0
    assert "left alone imujoco/hopper-friction-random-v0" in capsys.readouterr().out
    assert (
        run(["publish", "hopper-frictiondec_50_feet", "-t", "random", "-n", "2", "-s", "1", "--force"]) == 0
    )
    assert run([*combine, "--category", "friction"]) == 1
    assert "is stale: its sources have changed" in capsys.readouterr().err
    assert run([*combine, "--category", "friction", "--force"]) == 0
    capsys.readouterr()
    assert run(["verify", *minari.list_local_datasets()]) == 0
    assert capsys.readouterr().out.count(": sound") == 4


def test_combine_lists_what_is_not_published(capsys: pytest.CaptureFixture[str], root: Path) -> None:
    assert run(["publish", "hopper-frictiondec_50_feet", "--tier", "random", "--episodes", "2"]) == 0
    combine = ["combine", "--robot", "hopper", "--category", "friction", "--tier", "random"]
    capsys.readouterr()
    for more in ([], ["--id", "imujoco/hopper-some-v0"]):
        assert run([*combine, *more]) == 2
        *missing, error = capsys.readouterr().err.splitlines()
        assert [line.strip() for line in missing] == [
            f"imujoco/hopper-friction{change}_feet-random-v0" for change in ("dec_25", "inc_50")
        ]
        assert "2 of 3 datasets are not in the Minari root: make them with `imujoco publish" in error
    assert run([*combine, "--partial"]) == 2
    assert "name the collection with --id" in capsys.readouterr().err
    assert run([*combine, "--partial", "--id", "imujoco/hopper-friction-random-v0"]) == 1
    assert "stands for the tier random of all 3 variants of hopper in friction" in capsys.readouterr().err
    assert run([*combine, "--partial", "--id", "imujoco/hopper-some-v0"]) == 0
    assert "combined 1 dataset into imujoco/hopper-some-v0: 2 episodes" in capsys.readouterr().out
    assert run(["combine", "imujoco/x-v0", "--id", "a/b-v0", "--partial"]) == 2


def test_verify_fails_on_damage(capsys: pytest.CaptureFixture[str], root: Path) -> None:
    import h5py

    assert run(["publish", "hopper-base", "--tier", "random", "--episodes", "2", "--json"]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    with h5py.File(Path(outcome["path"]) / "data" / "main_data.hdf5", "a") as file:
        file["episode_1/rewards"][3] += 1e-12
    assert run(["verify", outcome["dataset_id"], "--json"]) == 1
    findings = json.loads(capsys.readouterr().out)[outcome["dataset_id"]]
    assert any(finding["where"].startswith("episode_1/rewards") for finding in findings)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["show", "hoper-massdec_25_leggeom"], 2, "did you mean 'hopper'"),
        (["list", "--robot", "crab"], 2, "valid: hopper, halfcheetah, walker2d"),
        (["list", "--category", "colour"], 2, "valid: mass, joint, length, friction"),
        (["show", "hopper-massdec_100_leggeom"], 2, "percent -100"),
        (["show", "hopper-jointinc_25_legjoint"], 2, "can only shrink"),
        (["publish"], 2, "name a variant"),
        (["publish", "hopper"], 2, "hopper is a robot: --robot hopper chooses its variants"),
        (["publish", "hopper-base", "--episodes", "0"], 2, "--episodes"),
        (["publish", "hopper-base", "--tier", "No Tier"], 2, "malformed tier"),
        (["publish", "humanoid-base"], 2, "imujoco train humanoid-base"),
        (["publish", "hopper-base", "-t", "mine", "--policy", "no.zip"], 2, "no policy file at no.zip"),
        (["publish", "hopper-base", "--policy", "no.zip"], 2, "--policy needs a --tier"),
        (["verify", "imujoco/nothing-v0"], 2, "not in the Minari root"),
        (["verify", "../../etc-v0"], 2, "malformed dataset id"),
        (["combine", "--robot", "hopper"], 2, "imujoco publish --robot hopper"),
        (["combine", "a/b-v0"], 2, "--id"),
        (["policy", "export", "humanoid-base", "x.zip"], 2, "imujoco train"),
        (["train", "hopper-base", "--max-steps", "0"], 2, "add --universal"),
        (["train", "--universal", "--robot", "hopper", "--jobs", "2"], 2, "--universal has no --jobs"),
        (["plot", "imujoco/hopper-base-v0", "--output", "x.png"], 1, "give --output a folder"),
        (["transfer", "--robot", "hopper", "--output", "x.svg"], 1, "give --output a folder"),
    ],
)
def test_a_mistake_gets_one_clear_line_and_a_code(
    capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, words: str
) -> None:
    assert run(arguments) == code
    captured = capsys.readouterr()
    assert words in " ".join(captured.err.split())
    assert "Traceback" not in captured.err
    if captured.err.startswith("error:"):
        assert captured.err.count("\n") == 1


def test_a_policy_of_another_robot_fails_and_leaves_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, root: Path
) -> None:
    path = tmp_path / "walker.safetensors"
    save_file(dict(random_actor(17, 6).weights), path)
    assert run(["publish", "hopper-base", "--tier", "mine", "--policy", str(path)]) == 1
    assert "it fits halfcheetah and walker2d" in capsys.readouterr().err
    assert minari.list_local_datasets() == {}


def test_a_root_that_cannot_be_written_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(blocked / "minari"))
    assert run(["publish", "hopper-base", "--tier", "random", "--episodes", "1"]) == 1
    err = capsys.readouterr().err
    assert str(blocked) in err
    assert err.count("\n") == 1


def test_the_module_runs_as_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "imujoco_minari", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("imujoco-minari ")


@pytest.mark.parametrize(
    ("command", "code", "words"),
    [
        ("list --robot hopper >&-", 0, ""),
        ("show nothing >&- 2>&-", 2, ""),
        ("delete imujoco/hopper-base-random-v0 <&-", 2, "give --yes in a script"),
    ],
)
def test_a_closed_stream_is_an_empty_one(command: str, code: int, words: str, root: Path) -> None:
    (root / "imujoco" / "hopper-base-random-v0").mkdir(parents=True)
    line = f"exec {sys.executable} -m imujoco_minari {command}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (code, "")
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_log_file_gets_each_line_at_once() -> None:
    """The lines of long work would else wait in a buffer, and be lost when the work is killed."""
    code = (
        "import os, sys; from imujoco_minari.cli.app import main; sys.argv[1:] = ['line']; "
        "main.__globals__['run'] = lambda words: print(*words) or os._exit(0); main()"
    )
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
    done = subprocess.run([sys.executable, "-c", code], env=buffered, capture_output=True, check=True)
    assert done.stdout == b"line\n"
