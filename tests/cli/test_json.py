"""``--json``: one strict JSON document on standard output, from every command, also when it fails."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import original_archive
import pytest
from random_actors import random_actor
from safetensors.numpy import save_file

import imujoco_minari.cli  # noqa: F401
from imujoco_minari.cli.app import command, run
from imujoco_minari.cli.printing import fail, print_json, say
from imujoco_minari.errors import JobError
from imujoco_minari.pictures.gallery import builder
from imujoco_minari.publishing import publisher
from imujoco_minari.remotes import Pulled, Pushed

LEG = "hopper-massdec_25_leggeom"
BASE_ID, LEG_ID = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"
MISSING = "imujoco/hopper-none-v0"

# The work itself is tested elsewhere. Paths are relative to an empty folder.
SUCCESSES: dict[str, Sequence[str]] = {
    "list": ["--robot", "hopper"],
    "show": [LEG],
    "publish": ["hopper-base", "-t", "random", "-n", "1", "--force"],
    "combine": [BASE_ID, LEG_ID, "--id", "imujoco/hopper-two-v0"],
    "verify": [BASE_ID],
    "delete": [BASE_ID, "--yes"],
    "export": [BASE_ID, "--format", "npz"],
    "preferences": [BASE_ID, "-n", "5", "-l", "3"],
    "import-archive": ["archive"],
    "diff-catalogue": ["archive"],
    "import": [BASE_ID, "--variant", "hopper-base", "--tier", "again"],
    "render": ["hopper-base", "--tier", "random", "-o", "a.png"],
    "plot": [LEG_ID],
    "transfer": ["-r", "hopper", "-c", "friction", "-n", "1", "--policy", "mine.safetensors"],
    "gallery": ["site", LEG],
    "push": [BASE_ID, "--remote", "gcp://bucket"],
    "pull": [BASE_ID, "--remote", "gcp://bucket"],
    "train": [LEG],
    "policies": ["--robot", "hopper"],
}
FAILURES: dict[str, Sequence[str]] = {
    "list": ["--robot", "bee"],
    "show": ["hopper-massdec_25_legeom"],
    "publish": ["humanoid-base"],
    "combine": [BASE_ID, MISSING, "--id", "imujoco/hopper-two-v0"],
    "verify": [BASE_ID, MISSING],
    "delete": [MISSING, "--yes"],
    "export": [MISSING, "--format", "npz"],
    "preferences": [MISSING],
    "import-archive": ["nowhere"],
    "diff-catalogue": [],
    "import": ["nowhere", "--variant", "hopper-base", "--tier", "again"],
    "render": [MISSING],
    "plot": [MISSING],
    "transfer": ["-r", "bee"],
    "gallery": ["site", "--robot", "bee"],
    "push": [MISSING],
    "pull": [BASE_ID],
    "train": ["hopper-massdec_25_legeom"],
    "policies": ["--category", "gravity"],
}


def strict(text: str) -> Any:
    """Parse one document of strict JSON."""

    def refuse(constant: str) -> None:
        raise ValueError(f"{constant} is not JSON")

    value = json.loads(text, parse_constant=refuse)
    # A lone surrogate would fail here.
    json.dumps(value, ensure_ascii=False).encode()
    return value


def errors(document: Any) -> list[str]:
    """Return the errors that a document states, of the command or of its items."""
    items = document if isinstance(document, list) else [document]
    return [item["error"] for item in items if isinstance(item, dict) and item.get("error")]


@pytest.fixture
def prepared(small_datasets: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A root with datasets, a folder with an archive and a policy, and no slow or remote work."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    original_archive.write_archive(folder / "archive", (LEG,), 2, ("odd", "done"))
    save_file(dict(random_actor().weights), folder / "mine.safetensors")
    monkeypatch.setattr("imujoco_minari.policies.references.EPISODES", 1)
    monkeypatch.setattr(
        "imujoco_minari.remotes.push_all",
        lambda ids, remote, **_: iter([Pushed(ids[0], remote=remote, uploaded=True)]),
    )
    monkeypatch.setattr(
        "imujoco_minari.remotes.pull_all", lambda ids, remote, **_: iter([Pulled(ids[0], remote=remote)])
    )
    monkeypatch.setattr(builder, "build", lambda folder, *_, **__: builder.Built(folder, 1, 1, {}))
    monkeypatch.setattr(
        "imujoco_minari.pictures.rendering.render_motions", lambda _, target, *__, **___: target.touch()
    )


def commands() -> list[str]:
    """Return the commands that have ``--json``."""
    return [
        name
        for name, each in command().commands.items()
        if any("--json" in parameter.opts for parameter in each.params)
    ]


def test_every_command_is_tried() -> None:
    assert commands() == list(SUCCESSES) == list(FAILURES)


@pytest.mark.parametrize("name", SUCCESSES)
def test_a_success_is_one_document(name: str, prepared: None, capsys: pytest.CaptureFixture[str]) -> None:
    extra = ["--columns", "observation,action,skip,done"] if name == "import-archive" else []
    assert run([name, *SUCCESSES[name], *extra, "--json"]) == 0
    assert errors(strict(capsys.readouterr().out)) == []


@pytest.mark.parametrize("name", FAILURES)
def test_a_failure_is_one_document_that_states_the_error(
    name: str, prepared: None, capsys: pytest.CaptureFixture[str]
) -> None:
    # No remote is named.
    code = 1 if name in ("push", "pull") else 2
    assert run([name, *FAILURES[name], "--json"]) == code
    output = capsys.readouterr()
    (error,) = errors(strict(output.out))
    assert f"error: {error}" in output.err or f": {error}" in output.err


@pytest.mark.parametrize("name", SUCCESSES)
def test_a_wrong_option_is_one_document(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, *SUCCESSES[name], "--no-such-option", "--json"]) == 2
    output = capsys.readouterr()
    (error,) = errors(strict(output.out))
    assert "--no-such-option" in error
    assert f"`imujoco {name} --help`" in error
    assert output.err == f"error: {error}\n"


def test_a_failed_dataset_has_null_for_its_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["publish", "humanoid-base", "--json"]) == 2
    (outcome,) = strict(capsys.readouterr().out)
    assert outcome["return_mean"] is None
    assert outcome["missing"] is True


def test_a_batch_that_stops_keeps_its_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(recipes: Any, **_: Any) -> Iterator[publisher.Published]:
        yield publisher.Published(recipes[0].dataset_id, Path("x"), created=True)
        raise JobError("the cluster is gone")

    monkeypatch.setattr(publisher, "publish_all", stop)
    assert run(["publish", "--robot", "hopper", "--json"]) == 1
    document = strict(capsys.readouterr().out)
    assert document["error"] == "the cluster is gone"
    assert [result["created"] for result in document["results"]] == [True]


def test_verify_keeps_what_it_checked(prepared: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["verify", MISSING, BASE_ID, "--no-replay", "--json"]) == 2
    document = strict(capsys.readouterr().out)
    assert document[BASE_ID] == []
    assert MISSING in document["error"]


@pytest.mark.parametrize("raised", [RuntimeError("a mistake of ours"), KeyboardInterrupt()])
def test_an_unexpected_error_is_one_document_too(
    raised: BaseException, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any) -> None:
        raise raised

    monkeypatch.setattr("imujoco_minari.cli.catalogue.expert_record", fail)
    if isinstance(raised, RuntimeError):
        with pytest.raises(RuntimeError, match="a mistake of ours"):
            run(["show", LEG, "--json"])
    else:
        assert run(["show", LEG, "--json"]) == 130
    (error,) = errors(strict(capsys.readouterr().out))
    assert error in ("RuntimeError: a mistake of ours", "interrupted")


def test_every_value_becomes_strict_json(capsys: pytest.CaptureFixture[str]) -> None:
    print_json(
        {
            "nan": float("nan"),
            "deep": [{"inf": float("inf")}, (1, np.float32("nan"))],
            "array": np.array([[1.0, np.inf]]),
            "number": np.int64(3),
            "path": Path("a/\udcff"),
            1: True,
        }
    )
    assert strict(capsys.readouterr().out) == {
        "nan": None,
        "deep": [{"inf": None}, [1, None]],
        "array": [[1.0, None]],
        "number": 3,
        "path": "a/\\udcff",
        "1": True,
    }


def test_messages_stay_off_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    fail("a failure")
    say("a message")
    assert capsys.readouterr() == ("", "error: a failure\na message\n")
