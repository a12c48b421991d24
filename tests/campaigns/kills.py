"""Commands killed or interrupted at random moments, and run again: run by scripts/test-kills.

Each trial starts the real command line in a session and a folder of its own, sends the signal, looks
at what others see then, and runs the command again, which must end where an undisturbed one does. An
interrupted command must also end with 130 and say no traceback; neither may leave a process.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from imujoco_minari.policies import expert_actor, expert_record, policies_folder
from imujoco_minari.storage import transactions
from imujoco_minari.variants import Variant

sys.path.insert(0, str(Path(__file__).parents[1]))
from campaigns.crash import visible
from original_archive import write_archive
from processes import running

A, B = "imujoco/hopper-base-random-v0", "imujoco/hopper-massdec_25_leggeom-random-v0"
ALL = "imujoco/hopper-both-random-v0"
ARCHIVED = ("hopper-massdec_25_leggeom", "walker2d-jointdec_50_footjoint")
# The command line on a run of seconds: four intervals, one of them without updates.
TRAIN = """
import sys
from imujoco_minari.cli import main
sys.argv = ["imujoco", *sys.argv[1:]]
main()
"""
SETTINGS = (
    "exploration_steps=1000",
    "evaluate_every=1000",
    "max_steps=4000",
    "batch_size=16",
    "ranking_episodes=2",
    "choosing_episodes=2",
    "deciding_episodes=3",
    "confirming_episodes=4",
)
CLI = ("-m", "imujoco_minari")
# Hidden files that belong to a namespace and to an export that is a folder.
MARKS = (".namespace", ".imujoco-export.json")
# In the traceback of an interrupt that came before the command line had begun.
BEGINNING = (
    "init_import_site",
    "imujoco_minari/__init__.py",
    "from imujoco_minari.cli import main",
    'File "<string>", line 3, in <module>',
)
EXPORT = (*CLI, "export", A, B, "-f")


def datasets(place: Path) -> dict[str, str]:
    """Return what stock Minari lists, each checked to be whole and sound, with its digest."""
    os.environ["MINARI_DATASETS_PATH"] = str(place / "root")
    return visible(place / "root")


def files(place: Path) -> dict[str, str]:
    """Return the digest of every file that an export has made."""
    made = [path for pattern in ("out*", "out*/**/*") for path in place.glob(pattern) if path.is_file()]
    return {str(path.relative_to(place)): hashlib.sha256(path.read_bytes()).hexdigest() for path in made}


def policies(place: Path) -> dict[str, str]:
    """Return the digest of the policy of every record, which must be that of the weights beside it."""
    os.environ["IMUJOCO_HOME"] = str(place / "imujoco")
    found = {}
    for path in policies_folder().glob("*-*.json"):
        variant = Variant.parse(path.stem)
        found[path.stem] = str(expert_record(variant)["weights_sha256"])
        assert expert_actor(variant).sha256 == found[path.stem], (
            f"the weights of {variant} are not its record's"
        )
    return found


@dataclass(frozen=True)
class Command:
    """What is run, what ran before it, how to see what it made, and whether a second run refuses to."""

    words: tuple[str, ...]
    look: Callable[[Path], dict[str, str]] = datasets
    before: tuple[tuple[str, ...], ...] = ()
    archive: bool = False
    refuses_again: bool = False


def publishing(variant: str, *options: str) -> tuple[str, ...]:
    return (*CLI, "publish", variant, "-t", "random", "-n", "4", *options)


SOURCES = (publishing("hopper-base"), publishing("hopper-massdec_25_leggeom"))
COMMANDS = {
    "publish": Command(publishing("hopper-base", "-n", "40")),
    "publish --jobs 2": Command(publishing("hopper-base", "-n", "80", "-j", "2")),
    "publish --force": Command(publishing("hopper-base", "-s", "1", "-n", "40", "--force"), before=SOURCES),
    "publish many": Command((*CLI, "publish", "-r", "hopper", "-c", "friction", "-t", "random", "-n", "2")),
    "combine": Command((*CLI, "combine", A, B, "--id", ALL), before=SOURCES),
    "import-archive": Command((*CLI, "import-archive", "archive"), archive=True),
    "export npz": Command((*EXPORT, "npz", "-o", "out.npz"), files, SOURCES, refuses_again=True),
    "export d4rl --force": Command(
        (*EXPORT, "d4rl", "-o", "out.hdf5", "--force"), files,
        (*SOURCES, (*CLI, "export", A, "-f", "d4rl", "-o", "out.hdf5")),
    ),
    "export rlds": Command((*EXPORT, "rlds", "-o", "out"), files, SOURCES, refuses_again=True),
    "train": Command(
        ("-c", TRAIN, "train", "swimmer-massinc_50_mid", "--scratch", "--state", "state",
         *(word for setting in SETTINGS for word in ("--set", setting))), policies,
    ),
}  # fmt: skip


@dataclass
class Tally:
    """What the trials came to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


class Trials:
    """A command, its undisturbed outcome, and a folder for its trials."""

    def __init__(self, name: str, scratch: Path, archive: Path) -> None:
        self.name, self.command, self.place = name, COMMANDS[name], scratch / "place"
        self._pristine = scratch / f"pristine-{len(list(scratch.iterdir()))}"
        self._pristine.mkdir()
        if self.command.archive:
            (self._pristine / "archive").symlink_to(archive)
        self._reset(None)
        for words in self.command.before:
            self._run(words).check_returncode()
        self._save()
        self.before = self.command.look(self.place)
        start = time.monotonic()
        self._run(self.command.words).check_returncode()
        self.seconds = time.monotonic() - start
        self.after = self.command.look(self.place)
        assert self.after != self.before, "the command changes nothing"

    def trial(self, number: signal.Signals, delay: float, tally: Tally) -> None:
        """Stop the command once and check what is there, before and after another run."""
        self._reset(self._pristine)
        process = subprocess.Popen(
            [sys.executable, *self.command.words], env=self._environment(), cwd=self.place,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
            # What runs in the background of a script ignores interrupts, and so would its children.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        stopped = True
        _wait_for_start(process)
        try:
            _, errors = process.communicate(timeout=delay)
            stopped = False
        except subprocess.TimeoutExpired:
            if number is signal.SIGINT:
                # As a terminal does it: to the whole session.
                os.killpg(process.pid, number)
            else:
                process.send_signal(number)
            errors = _last_words(process)
        # As docs/promises.md has it, an interrupt that comes while Python imports the package shows it.
        beginning = any(mark in errors for mark in BEGINNING)
        end = "stopped as it began" if beginning else "stopped" if stopped else "was done"
        tally.outcomes[f"{number.name}, {self.name}: {end}"] += 1
        if number is signal.SIGINT and stopped and process.returncode != 0 and not beginning:
            # Within Python's own beginning and end it is the signal itself, which a shell calls 130 too.
            assert process.returncode in (130, -signal.SIGINT), f"ended with {process.returncode}: {errors}"
            assert "Traceback" not in errors, errors
        now = self.command.look(self.place)
        assert set(self.before) <= set(now), f"lost {set(self.before) - set(now)}"
        wrong = [
            key for key, value in now.items() if value not in (self.before.get(key), self.after.get(key))
        ]
        assert not wrong, f"neither the old nor the new: {wrong}"
        self._gone(process.pid)
        again = self._run(self.command.words)
        refused = now == self.after and self.command.refuses_again
        assert again.returncode == (1 if refused else 0), again.stderr
        assert self.command.look(self.place) == self.after, "the next run made something else"
        left = [path for path in self.place.rglob(".*") if path.name not in MARKS]
        if left and refused:
            os.environ["MINARI_DATASETS_PATH"] = str(self.place / "root")
            transactions.tidy()
            left = [path for path in left if path.exists()]
        assert not left, f"left behind: {left}"

    def _gone(self, session: int) -> None:
        """Wait for the workers of a command that is gone; they have seconds."""
        end = time.monotonic() + 10
        while running(session):
            assert time.monotonic() < end, f"{len(running(session))} processes outlived their command"
            time.sleep(0.02)

    def _run(self, words: tuple[str, ...]) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *words], env=self._environment(), cwd=self.place,
            check=False, capture_output=True, text=True,
        )  # fmt: skip

    def _environment(self) -> dict[str, str]:
        os.environ["MINARI_DATASETS_PATH"] = str(self.place / "root")
        return os.environ | {"IMUJOCO_HOME": str(self.place / "imujoco"), "OMP_NUM_THREADS": "1"}

    def _reset(self, source: Path | None) -> None:
        # What JAX has compiled stays.
        compiled = self.place.parent / "compiled"
        if (self.place / "imujoco" / "compiled").is_dir() and not compiled.exists():
            (self.place / "imujoco" / "compiled").rename(compiled)
        shutil.rmtree(self.place, ignore_errors=True)
        shutil.copytree(source or self._pristine, self.place, symlinks=True)
        (self.place / "root").mkdir(exist_ok=True)
        if compiled.exists():
            (self.place / "imujoco").mkdir(exist_ok=True)
            (self.place / "imujoco" / "compiled").symlink_to(compiled)

    def _save(self) -> None:
        shutil.rmtree(self._pristine)
        shutil.copytree(self.place, self._pristine, symlinks=True, ignore=shutil.ignore_patterns("compiled"))


def _last_words(process: subprocess.Popen[str]) -> str:
    """Return what a stopped command said, when it and all that it started have closed their ears."""
    try:
        return process.communicate(timeout=60)[1]
    except subprocess.TimeoutExpired:
        there = running(process.pid)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        raise AssertionError(f"still there a minute later: {there}") from None


def _wait_for_start(process: subprocess.Popen[str]) -> None:
    """Wait until Python has begun, which says what it likes of an earlier interrupt: NumPy is there."""
    while process.poll() is None:
        with contextlib.suppress(OSError):
            if "_multiarray_umath" in Path(f"/proc/{process.pid}/maps").read_text():
                return
        time.sleep(0.01)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="for each command and signal")
    parser.add_argument("--only", choices=COMMANDS, help="one command")
    parser.add_argument("--signal", choices=["SIGKILL", "SIGINT"], help="one signal")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    tally, rng, start = Tally(), random.Random(options.seed), time.monotonic()
    signals = [signal.Signals[options.signal]] if options.signal else [signal.SIGKILL, signal.SIGINT]
    with tempfile.TemporaryDirectory() as folder:
        archive = write_archive(Path(folder, "archive"), ARCHIVED)
        scratch = Path(folder, "scratch")
        scratch.mkdir()
        for name in COMMANDS if options.only is None else [options.only]:
            trials = Trials(name, scratch, archive)
            print(f"{name}: {trials.seconds:.1f} s undisturbed", flush=True)
            for number in signals:
                for _ in range(options.trials):
                    delay = rng.uniform(0, trials.seconds)
                    try:
                        trials.trial(number, delay, tally)
                    except Exception as error:
                        said = f"{name}, {number.name} after {delay:.2f} s: {type(error).__name__}: {error}"
                        tally.failures.append(said)
                        print("FAILED", said, flush=True)
    for key, value in sorted(tally.outcomes.items()):
        print(f"{key}: {value}")
    print(
        f"{tally.outcomes.total()} trials in {time.monotonic() - start:.0f} s, {len(tally.failures)} failed"
    )
    sys.exit(bool(tally.failures))


if __name__ == "__main__":
    main()
