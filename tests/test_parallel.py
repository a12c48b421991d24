"""Jobs come back once each; a lost worker's are run again, whatever it took with it."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import h5py
import minari
import pytest
from processes import alive, running

from imujoco_minari.errors import DatasetError, DependencyError, JobError
from imujoco_minari.parallel import ATTEMPTS, run_jobs
from imujoco_minari.publishing.publisher import publish, publish_all
from imujoco_minari.publishing.recipes import Recipe
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import Variant
from imujoco_minari.verification import verify

pytestmark = [
    # Joblib's processes are forked or kept beyond the call, and are reaped when the session ends.
    pytest.mark.filterwarnings("ignore:.*worker.*:UserWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    # Joblib's thread may fail on a job that was just given up. Its workers are killed by then.
    pytest.mark.filterwarnings("ignore:.*ExecutorManagerThread:pytest.PytestUnhandledThreadExceptionWarning"),
]


def double(number):
    return 2 * number


def refuse(number):
    if number == 2:
        raise DatasetError("two is refused")
    return number


def die_once(task):
    """Kill the worker the first time that a job marked deadly is worked on."""
    number, folder, deadly = task
    if deadly:
        try:
            (Path(folder) / f"{number}").touch(exist_ok=False)
        except FileExistsError:
            return number
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def die(number):
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def deaf(number):
    """Say whether this process holds interrupts back, as it did from its first instruction on."""
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# Two workers that work for much longer than a test, and one that gets nothing to do.
WORK_ON = """
import os, pathlib, sys, time
from imujoco_minari.parallel import run_jobs

def work(folder):
    pathlib.Path(folder, f"worker-{os.getpid()}").touch()
    time.sleep(600)

if __name__ == "__main__":
    list(run_jobs(work, sys.argv[1:] * 2, jobs=3))
"""


def wait_for(condition):
    for _ in range(600):
        if condition():
            return
        time.sleep(0.1)
    pytest.fail("not so after a minute")


def root_seen(_):
    return str(minari_root.datasets_root())


def test_an_interrupt_is_for_the_parent_alone():
    assert [result for _, result in run_jobs(deaf, range(4), jobs=3)] == [True] * 4
    assert not deaf(0)


def test_one_job_works_here_and_in_order():
    seen = []
    assert list(run_jobs(seen.append, [3, 1, 2])) == [(0, None), (1, None), (2, None)]
    assert seen == [3, 1, 2]


def test_every_job_comes_back_once():
    assert sorted(run_jobs(double, range(20), jobs=2)) == [(number, 2 * number) for number in range(20)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_job_raises_is_raised(jobs):
    with pytest.raises(DatasetError, match="two is refused"):
        list(run_jobs(refuse, range(4), jobs=jobs))


def test_jobs_that_are_given_up_end_in_the_thread_that_started_them():
    with pytest.raises(DatasetError) as raised:
        list(run_jobs(refuse, range(40), jobs=2))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        del raised
        collector = threading.Thread(target=gc.collect)
        collector.start()
        collector.join()
    assert not [str(warning.message) for warning in warned if "joblib" in str(warning.message)]


def test_a_lost_workers_job_is_run_again(tmp_path):
    tasks = [(number, str(tmp_path), number in (1, 4)) for number in range(6)]
    assert sorted(run_jobs(die_once, tasks, jobs=2)) == [(number, number) for number in range(6)]
    assert {path.name for path in tmp_path.iterdir()} >= {"1", "4"}


def test_a_job_that_kills_every_worker_is_given_up_and_the_others_are_done():
    results = dict(run_jobs(die, range(4), jobs=2))
    lost = results.pop(1)
    assert isinstance(lost, JobError)
    assert f"lost with its worker {ATTEMPTS} times" in str(lost)
    assert results == {0: 0, 2: 2, 3: 3}


def test_workers_that_live_on_see_the_present_root(monkeypatch, tmp_path):
    for name in ("one", "two"):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / name))
        assert {result for _, result in run_jobs(root_seen, range(4), jobs=2)} == {str(tmp_path / name)}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "relative")
    assert {result for _, result in run_jobs(root_seen, [0, 1], jobs=2)} == {str(tmp_path / "relative")}


def test_workers_end_with_the_process_that_is_killed(tmp_path):
    script = tmp_path / "owner.py"
    script.write_text(WORK_ON)
    process = subprocess.Popen([sys.executable, str(script), str(tmp_path)], start_new_session=True)
    wait_for(lambda: len(list(tmp_path.glob("worker-*"))) == 2)
    workers = [int(path.name.removeprefix("worker-")) for path in tmp_path.glob("worker-*")]
    assert all(map(alive, workers))
    process.kill()
    process.wait()
    wait_for(lambda: not any(map(alive, workers)))
    wait_for(lambda: not running(process.pid))


def test_an_unknown_back_end_is_named_with_the_valid_ones():
    with pytest.raises(JobError, match=r"no back end 'slurm'; valid: loky, ray$"):
        next(run_jobs(double, [1], backend="slurm"))


def test_ray_that_is_not_installed_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(DependencyError, match=r'run `pip install "imujoco-minari\[ray\]"`$'):
        next(run_jobs(double, [1], backend="ray"))


def test_several_find_what_one_finds(root):
    dataset_id = publish("hopper-base", tier="random", episodes=11).dataset_id
    assert verify(dataset_id, jobs=2) == []
    data = minari_root.dataset_folder(dataset_id) / "data"
    with h5py.File(file_format.main_file(data), "a") as file:
        for number in (3, 9):
            group = file[f"episode_{number}"]
            group["observations"][2, 1] += 1e-9
            file_format.seal_episode(group)
    seen = []
    alone, shared = verify(dataset_id), verify(dataset_id, jobs=2, on_episode=lambda: seen.append(1))
    assert shared == alone
    assert [finding.where for finding in alone if "observations" in finding.where] == [
        "episode_3/observations[2]",
        "episode_9/observations[2]",
    ]
    assert len(seen) == 11


def test_many_are_published_by_several_and_a_failure_is_one_outcome(root):
    recipes = [Recipe(Variant.parse(name), "random", 2) for name in ("hopper-base", "walker2d-base")]
    recipes.append(Recipe(Variant.parse("hopper-base"), "nonsense", 2))
    outcomes = {outcome.dataset_id: outcome for outcome in publish_all(recipes, jobs=2)}
    assert set(outcomes) == {recipe.dataset_id for recipe in recipes}
    assert [outcomes[recipe.dataset_id].created for recipe in recipes] == [True, True, False]
    assert "nonsense" in outcomes[recipes[2].dataset_id].error
    assert sorted(minari.list_local_datasets()) == sorted(recipe.dataset_id for recipe in recipes[:2])
