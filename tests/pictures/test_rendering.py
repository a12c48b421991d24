"""Pictures: what is drawn, where the camera stands, and, where there is an OpenGL, the pixels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image, ImageDraw

from imujoco_minari import combine_datasets, publish
from imujoco_minari.cli.app import run
from imujoco_minari.envs import gl
from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.errors import (
    DatasetError,
    DatasetNotFoundError,
    DependencyError,
    RenderingError,
    StorageError,
    VariantError,
)
from imujoco_minari.pictures import rendering
from imujoco_minari.pictures.gallery.clips import stance
from imujoco_minari.pictures.rendering import frame_steps, render_motions
from imujoco_minari.pictures.rendering.files import write_picture, write_video
from imujoco_minari.pictures.rendering.film import (
    caption_height,
    captioned,
    contact_sheet,
    grid,
    sheet_steps,
    stride,
)
from imujoco_minari.pictures.rendering.framing import (
    FIELD_OF_VIEW,
    FILL,
    Camera,
    Capsules,
    axes,
    capsules,
    follow,
)
from imujoco_minari.pictures.rendering.motion import Motion, of_dataset, of_variant, perform, replay
from imujoco_minari.pictures.rendering.scene import COLOURS, NEAR, scene_model
from imujoco_minari.policies import RandomPolicy
from imujoco_minari.variants import ROBOTS, Variant, bases, catalogue, specification

HOPPER = Variant.parse("hopper-massdec_25_leggeom")
ONE_A_KIND = [
    next(variant for variant in catalogue(robot, category))
    for robot in ROBOTS
    for category in ("mass", "joint", "length", "friction")
]


@pytest.fixture(scope="module")
def opengl() -> Iterator[str]:
    """The backend, or a skip where this machine has none."""
    with pytest.MonkeyPatch.context() as patch:
        # Set first, so that what the choice writes does not outlive these tests.
        patch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""))
        try:
            yield gl.backend()
        except RenderingError as error:
            pytest.skip(str(error))


def moved(variant: Variant, seconds: float | None = None) -> Motion:
    return perform(variant, RandomPolicy(specification(variant.robot).action_size), seed=3, seconds=seconds)


# What moves


def test_a_performance_is_the_episode_of_its_seed() -> None:
    first, again = moved(HOPPER), moved(HOPPER)
    assert np.array_equal(first.positions, again.positions)
    assert first.terminated
    assert first.positions.shape == (len(first.rewards) + 1, 6)
    assert first.duration == pytest.approx(len(first.rewards) * 0.008)


def test_a_performance_ends_after_the_seconds_asked_for() -> None:
    motion = moved(Variant.parse("halfcheetah-base"), seconds=2.0)
    assert len(motion.rewards) == 40
    assert not motion.terminated


def test_a_motion_is_cut_without_changing_what_is_left() -> None:
    whole = moved(HOPPER)
    part = whole.until(0.04)
    assert len(part.rewards) == 5
    assert np.array_equal(part.positions, whole.positions[:6])
    assert not part.terminated
    assert whole.until(1e6) is whole


def test_a_recorded_episode_is_replayed_not_played_anew() -> None:
    published = publish(HOPPER, tier="random", episodes=3, seed=5)
    with h5py.File(published.path / "data" / "main_data.hdf5") as file:
        recorded = [
            (file[f"episode_{k}/observations"][()], file[f"episode_{k}/rewards"][()]) for k in range(3)
        ]
    for episode, (observations, rewards) in enumerate(recorded):
        motion = replay(published.dataset_id, episode)
        # A Hopper's observation begins with all its positions but the distance run.
        assert np.array_equal(motion.positions[:, 1:], observations[:, :5])
        assert np.array_equal(motion.rewards, rewards)
        assert motion.divergence == 0.0
    assert not np.array_equal(recorded[0][0][0], recorded[1][0][0])


def test_a_replay_that_does_not_follow_its_record_says_so() -> None:
    published = publish(HOPPER, tier="random", episodes=1)
    with h5py.File(published.path / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/observations"][2, 0] += 0.25
    assert replay(published.dataset_id).divergence == pytest.approx(0.25)


def test_an_episode_of_a_collection_is_its_variants() -> None:
    other = Variant.parse("hopper-lengthinc_50_footgeom")
    ids = [publish(variant, tier="random", episodes=2).dataset_id for variant in (HOPPER, other)]
    combine_datasets(ids, "imujoco/hopper-mine-v0")
    motion = replay("imujoco/hopper-mine-v0", 3)
    assert motion.variant == other
    assert motion.divergence == 0.0
    assert np.array_equal(motion.positions, replay(ids[1], 1).positions)


@pytest.mark.parametrize("name", ["hopper-massdec_25_leggeom", "halfcheetah-base", "walker2d-base"])
def test_an_episode_without_a_seed_is_shown_as_observed(name: str) -> None:
    published = publish(name, tier="random", episodes=1)
    replayed = replay(published.dataset_id)
    with h5py.File(published.path / "data" / "main_data.hdf5", "a") as file:
        file["episode_0"].attrs["replayable"] = False
        del file["episode_0"].attrs["seed"]
    observed = replay(published.dataset_id)
    assert observed.title == "random, episode 0, as observed"
    assert observed.timestep == replayed.timestep
    assert np.array_equal(observed.positions[:, 1:], replayed.positions[:, 1:])
    assert np.array_equal(observed.rewards, replayed.rewards)
    # The distance run, from the velocity at each step's end, is near enough to follow with a camera.
    start, end = replayed.positions[[0, -1], 0]
    assert observed.positions[-1, 0] == pytest.approx(end - start, abs=0.25 + 0.1 * abs(end - start))


def test_an_episode_that_does_not_say_how_it_was_made_is_named() -> None:
    published = publish(HOPPER, tier="random", episodes=1)
    with h5py.File(published.path / "data" / "main_data.hdf5", "a") as file:
        del file["episode_0"].attrs["seed"]
    with pytest.raises(DatasetError, match=r"episode 0 cannot be read: .*seed"):
        replay(published.dataset_id)
    with h5py.File(published.path / "data" / "main_data.hdf5", "a") as file:
        file["episode_0"].attrs["catalogue"] = "imujoco-original"
    with pytest.raises(DatasetError, match=r"episode 0 cannot be read: .*seed"):
        replay(published.dataset_id)
    with h5py.File(published.path / "data" / "main_data.hdf5", "a") as file:
        file["episode_0"].attrs["seed"] = 0
    with pytest.raises(VariantError, match="needs the text of its model"):
        replay(published.dataset_id)


def test_an_episode_of_a_damaged_file_is_named() -> None:
    published = publish(HOPPER, tier="random", episodes=1)
    path = published.path / "data" / "main_data.hdf5"
    # The signature of a group's nodes. HDF5 fails with a RuntimeError.
    path.write_bytes(path.read_bytes().replace(b"SNOD", b"SNOB"))
    with pytest.raises(DatasetError, match="random-v0: episode 0 cannot be read"):
        replay(published.dataset_id)


def test_replaying_what_is_not_there_names_it_and_the_valid_episodes() -> None:
    with pytest.raises(DatasetNotFoundError, match="imujoco/hopper-base-v0 is not in the Minari root"):
        replay("imujoco/hopper-base-v0")
    published = publish(HOPPER, tier="random", episodes=2)
    with pytest.raises(DatasetNotFoundError, match="no episode 2; valid: 0 to 1"):
        replay(published.dataset_id, 2)


def test_beside_a_dataset_stands_the_base_robots_episode_of_that_number() -> None:
    published = publish(HOPPER, tier="random", episodes=2)
    base = publish(HOPPER.base, tier="random", episodes=2, seed=9)
    left, right = of_dataset(published.dataset_id, 1, beside_base=True)
    assert np.array_equal(left.positions, replay(base.dataset_id, 1).positions)
    assert np.array_equal(right.positions, replay(published.dataset_id, 1).positions)
    assert [left.variant, right.variant] == [HOPPER.base, HOPPER]


def test_without_a_dataset_of_the_base_robot_its_policy_of_the_tier_moves_it() -> None:
    published = publish(HOPPER, tier="random", episodes=1)
    left, right = of_dataset(published.dataset_id, 0, beside_base=True)
    assert (left.variant, left.title) == (HOPPER.base, "random policy")
    assert right.variant == HOPPER


def test_beside_a_base_robot_stands_nothing() -> None:
    assert len(of_variant(HOPPER.base, "random", None, beside_base=True)) == 1
    assert len(of_variant(HOPPER, "random", None, beside_base=True)) == 2


# Where the camera stands


def project(camera: Camera, points: Any, aspect: float) -> Any:
    """Return where ``points`` (frames, n, 3) lie in the picture: (frames, n, 2), each within -1 to 1."""
    right, up, forward = axes()
    relative = points - camera.lookat[:, None, :]
    depth = camera.distance + relative @ forward
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2)
    x, y = relative @ right / (depth * tangent * aspect), relative @ up / (depth * tangent)
    return np.stack([x, y], axis=-1)


@pytest.mark.parametrize("variant", [*bases(), *ONE_A_KIND], ids=str)
def test_the_whole_robot_is_in_every_picture(variant: Variant) -> None:
    motion = moved(variant, seconds=2.0)
    seen = capsules(compile_mjcf(canonical_mjcf(variant)), motion.positions)
    right, up, _ = axes()
    for aspect in (4 / 3, 0.6, 2.5):
        (camera,) = follow([seen], aspect, motion.timestep)
        reach = 0.0
        for direction in (right, -right, up, -up):
            rim = seen.ends + seen.radii[:, None] * direction
            reach = max(reach, float(np.abs(project(camera, rim, aspect)).max()))
        assert reach <= FILL + 1e-9
        # And it is no speck: the robot fills a good part of the picture's shorter way.
        assert reach > 0.6


def test_the_camera_follows_a_runner_and_stands_at_one_height() -> None:
    way = np.linspace(0.0, 50.0, 101)
    ends = np.stack(
        [np.stack([way + dx, 0 * way, 0 * way + z], axis=-1) for dx, z in ((-0.3, 0.1), (0.3, 0.9))], 1
    )
    (camera,) = follow([Capsules(ends, np.array([0.05, 0.05]), 0 * way)], 1.0, 0.05)
    assert camera.lookat[:, 0] == pytest.approx(way)
    assert np.ptp(camera.lookat[:, 2]) == 0.0


def test_robots_side_by_side_are_seen_from_one_distance() -> None:
    small, large = (
        capsules(compile_mjcf(canonical_mjcf(Variant.parse(name))), moved(Variant.parse(name)).positions)
        for name in ("hopper-base", "hopper-lengthinc_200_torsogeom")
    )
    alone = follow([small], 1.0, 0.008)[0]
    together = follow([small, large], 1.0, 0.008)
    assert together[0].distance == together[1].distance > alone.distance


def test_the_camera_model_is_mujocos(opengl: str) -> None:
    """A bright ball's pixels lie where the projection says."""
    from imujoco_minari.pictures.rendering.studio import Studio

    variant = Variant.parse("hopper-massinc_50_footgeom")
    motion = moved(variant)
    with Studio(320, 240, fine=False) as studio:
        seen = capsules(studio.model(variant), motion.positions)
        (camera,) = follow([seen], studio.aspect, motion.timestep)
        picture = np.asarray(next(studio.shoot(variant, motion.positions[:1], camera))).astype(float)
    # The foot's capsule is the last geom; its colour is orange, and nothing else is.
    rows, columns = np.nonzero(picture[:, :, 0] - picture[:, :, 2] > 60)
    ends = project(camera, seen.ends, 4 / 3)[0][[3, 7]].mean(axis=0)
    assert columns.mean() == pytest.approx((ends[0] + 1) * 160, abs=6)
    assert rows.mean() == pytest.approx((1 - ends[1]) * 120, abs=6)


# How it looks


@pytest.mark.parametrize("variant", [*bases(), *ONE_A_KIND], ids=str)
def test_the_scene_has_the_variants_geometry_and_colours_what_changes(variant: Variant) -> None:
    scene = scene_model(variant, width=320, height=240)
    plain = compile_mjcf(canonical_mjcf(variant))
    robot = slice(1, None)
    assert np.array_equal(scene.geom_size[robot], plain.geom_size[robot])
    assert np.array_equal(scene.body_pos, plain.body_pos)
    assert np.array_equal(scene.geom_pos, plain.geom_pos)
    colour = COLOURS.get(variant.category)
    coloured = {
        scene.geom(i).name
        for i in range(1, scene.ngeom)
        if colour and np.allclose(scene.geom_rgba[i][:3], colour)
    }
    if variant.category == "joint":
        assert scene.nsite == 1
        assert np.allclose(scene.site_rgba[0][:3], colour)
    else:
        assert coloured == set(variant.mjcf_names)
        assert scene.nsite == 0


def test_the_colours_differ_from_each_other_and_from_the_robot() -> None:
    colours = [*COLOURS.values(), NEAR]
    for number, first in enumerate(colours):
        for second in colours[number + 1 :]:
            assert np.abs(np.subtract(first, second)).max() > 0.15


@pytest.mark.parametrize(
    ("size", "text"),
    # A picture of 64 pixels asks for text of less than 6 pixels.
    [((640, 480), [18.36, 21.6]), ((64, 64), [2.448, 2.88]), ((64, 480), [5.1, 6.0])],
)
def test_the_text_of_a_caption_shrinks_but_stays_readable(
    size: tuple[int, int], text: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[float] = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda *given, **_: drawn.append(given[4].size))
    captioned(Image.new("RGB", size), HOPPER, "a title", "a state")
    assert sorted(set(drawn)) == pytest.approx(text)


# Frames


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_video_runs_as_fast_as_the_simulation(robot: str) -> None:
    motion = moved(Variant(robot), seconds=1.0)
    assert 15 <= 1 / (stride([motion]) * motion.timestep) <= 35


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_the_rate_of_a_file_is_that_of_its_frames(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[float] = []
    monkeypatch.setattr(rendering, "Studio", lambda *size: nullcontext())
    monkeypatch.setattr(rendering, "frames", lambda *given, **named: iter(()))
    monkeypatch.setattr(rendering, "write_video", lambda path, pictures, rate: told.append(rate))
    motion, path = moved(HOPPER), tmp_path / f"a.{ending}"
    render_motions([motion], path)
    first, second, *_ = frame_steps([motion], path)
    assert told == [pytest.approx(1 / ((second - first) * motion.timestep))]


def test_frames_of_a_video_a_picture_and_a_sheet() -> None:
    motion = moved(Variant.parse("halfcheetah-base"), seconds=5.0)
    assert frame_steps([motion], Path("a.mp4")) == list(range(101))
    assert len(frame_steps([motion], Path("a.gif"))) == 51
    assert frame_steps([motion], Path("a.png")) == [50]
    steps = frame_steps([motion], Path("a.png"), sheet=True)
    assert (len(steps), steps[0], steps[-1]) == (12, 0, 100)
    assert sheet_steps(3) == [0, 1, 2]


def test_a_sheet_loses_no_picture() -> None:
    pictures = [Image.new("RGB", (20, 10), (number, 0, 0)) for number in range(7)]
    whole = grid(pictures, 4)
    assert {whole.getpixel((x, y))[0] for y in (5, 23) for x in (10, 38, 66, 94)} == {*range(7), 255}
    assert contact_sheet([Image.new("RGB", (50, 10))] * 3).width < 3 * 50


# Files


def pictures(count: int) -> list[Image.Image]:
    return [Image.new("RGB", (65, 49), (20 * number, 80, 200 - 20 * number)) for number in range(count)]


def test_a_video_has_its_frames_and_its_rate(tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    target = tmp_path / "new" / "clip.mp4"
    write_video(target, pictures(10), 20.0)
    with Path(target).open("rb") as file:
        assert b"ftyp" in file.read(12)
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(target))
    assert (count, seconds) == (10, pytest.approx(0.5, abs=0.06))
    assert [item.name for item in target.parent.iterdir()] == ["clip.mp4"]


def test_a_gif_has_its_frames_and_its_rate(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.gif", pictures(6), 12.5)
    with Image.open(tmp_path / "clip.gif") as clip:
        assert (clip.n_frames, clip.info["duration"], clip.size) == (6, 80, (65, 49))


def test_an_interrupted_video_leaves_the_old_one(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    target = tmp_path / "clip.mp4"
    target.write_text("the old one")

    def broken() -> object:
        yield from pictures(3)
        raise RuntimeError("the power is out")

    with pytest.raises(RuntimeError, match="power"):
        write_video(target, broken(), 20.0)  # type: ignore[arg-type]
    assert target.read_text() == "the old one"
    assert [item.name for item in tmp_path.iterdir()] == ["clip.mp4"]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file/a.png"):
        write_picture(tmp_path / "file" / "a.png", pictures(1)[0])


@pytest.mark.parametrize("name", ["a.avi", "a", "mp4"])
def test_a_format_that_is_not_written_is_refused(name: str) -> None:
    with pytest.raises(RenderingError, match=r"valid endings: \.mp4, \.gif, \.png"):
        frame_steps([moved(HOPPER)], Path(name))


def test_a_missing_video_writer_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(DependencyError, match=r'pip install "imujoco-minari\[render\]"'):
        frame_steps([moved(HOPPER)], Path("a.mp4"))


# OpenGL


@pytest.fixture
def untried(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """The choice of a backend as a new process makes it."""
    gl.backend.cache_clear()
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        # Set first, so that what the choice writes is undone as well.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "platform", "linux")
    yield monkeypatch
    gl.backend.cache_clear()


def test_egl_is_preferred_and_osmesa_comes_next(untried: pytest.MonkeyPatch) -> None:
    untried.setattr(gl, "_works", lambda candidate: True)
    assert gl.backend() == "egl"
    gl.backend.cache_clear()
    untried.delenv("MUJOCO_GL")
    untried.setattr(gl, "_works", lambda candidate: candidate == "osmesa")
    assert gl.backend() == "osmesa"


def test_without_any_opengl_the_packages_to_install_are_named(untried: pytest.MonkeyPatch) -> None:
    untried.setattr(gl, "_works", lambda candidate: False)
    with pytest.raises(RenderingError, match=r"libegl1 libgl1-mesa-dri.*libosmesa6"):
        gl.backend()


def test_the_users_choice_decides(untried: pytest.MonkeyPatch) -> None:
    tried = []
    untried.setattr(gl, "_works", lambda candidate: bool(tried.append(candidate)))
    untried.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(RenderingError, match="tried osmesa"):
        gl.backend()
    assert tried == ["osmesa"]
    untried.setenv("MUJOCO_GL", "glfw")
    assert gl.backend() == "native"


def test_a_library_that_is_not_there_does_not_work() -> None:
    gl.LIBRARIES["nothing"] = "libnothing-at-all.so.1"
    try:
        assert not gl._works("nothing")
    finally:
        del gl.LIBRARIES["nothing"]


def test_the_backend_is_found_after_mujoco_was_imported(opengl: str, tmp_path: Path) -> None:
    """What MuJoCo settled on at its import does not matter; nor does a display that is not there."""
    code = (
        "import sys, mujoco, imujoco_minari.envs.robots\n"
        "from imujoco_minari.cli.app import run\n"
        "import imujoco_minari.cli\n"
        "sys.exit(run('render hopper-base --tier random --size 64x64 --output'.split() + sys.argv[1:]))"
    )
    environment = {
        key: value
        for key, value in os.environ.items()
        if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
    }
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "a.png")],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "a.png").exists()


# The pixels


def test_the_picture_shows_robot_floor_and_sky(opengl: str, tmp_path: Path) -> None:
    motions = [moved(variant) for variant in (HOPPER.base, HOPPER)]
    seen = []
    render_motions(motions, tmp_path / "a.png", (320, 240), on_frame=lambda: seen.append(1))
    picture = np.asarray(Image.open(tmp_path / "a.png")).astype(int)
    strip = caption_height(240)
    assert picture.shape == (240 + strip, 2 * 320 + 4, 3)
    assert seen == [1]
    left, right = picture[strip:, :320], picture[strip:, 324:]
    orange = [int(((part[:, :, 0] - part[:, :, 2]) > 60).sum()) for part in (left, right)]
    assert orange[0] == 0
    assert orange[1] > 100
    # Tiles, not one grey: light and dark ones on the lowest rows.
    assert np.ptp(left[-30:].mean(axis=2)) > 15
    # The captions hold ink.
    assert picture[:strip, :320].min() < 100
    assert picture[:strip, 324:].min() < 100
    # Nothing of the robot touches the frame: its colours stay inside.
    for edge in (right[0], right[-1], right[:, 0], right[:, -1]):
        assert (edge[:, 0] - edge[:, 2]).max() < 60


def test_frames_of_a_video_differ(opengl: str, tmp_path: Path) -> None:
    render_motions([moved(HOPPER)], tmp_path / "a.gif", (96, 96))
    with Image.open(tmp_path / "a.gif") as clip:
        assert clip.n_frames > 1
        first = np.asarray(clip.convert("RGB")).astype(int)
        clip.seek(clip.n_frames - 1)
        last = np.asarray(clip.convert("RGB")).astype(int)
    assert np.abs(first - last).max() > 60


def test_a_motion_that_is_over_stands_still_beside_one_that_goes_on(opengl: str) -> None:
    from imujoco_minari.pictures.rendering.film import frames
    from imujoco_minari.pictures.rendering.studio import Studio

    whole = moved(HOPPER)
    last = len(whole.rewards)
    steps = [0, last // 2, last, last + 5, last + 10]
    shots: list[int] = []
    with Studio(96, 96, fine=False) as studio:
        pictures = list(frames([whole.until(0.05), whole], studio, steps, on_frame=lambda: shots.append(1)))
    assert len(pictures) == len(shots) == 5
    left = [np.asarray(picture)[:, :96] for picture in pictures]
    right = [np.asarray(picture)[:, 100:] for picture in pictures]
    assert not np.array_equal(left[0], left[1])
    assert all(np.array_equal(left[1], picture) for picture in left[2:])
    assert not np.array_equal(right[1], right[2])
    assert np.array_equal(right[2], right[4])
    # The end of an episode is drawn paler than its way there.
    assert right[2].mean() > right[1].mean() + 5


def test_the_command_renders_a_recorded_episode(
    opengl: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    published = publish(HOPPER, tier="random", episodes=2)
    target = tmp_path / "sheet.png"
    command = ["render", published.dataset_id, "--sheet", "--size", "96x80", "-o", str(target)]
    assert run([*command, "-e", "1", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["path"] == str(target)
    assert told["motions"][0]["moved_by"] == "random, episode 1"
    assert told["motions"][0]["divergence"] == 0.0
    before = target.read_bytes()
    assert run(command) == 1
    assert f"{target} is already there; it was left alone" in capsys.readouterr().err
    assert target.read_bytes() == before
    assert run([*command, "--force"]) == 0
    assert target.read_bytes() != before


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["hopper-massdec_25_legeom"], 2, "did you mean"),
        (["hopper-base", "--tier", "mine", "--output", "a.png"], 2, "policy makes the tier 'mine'"),
        (["hopper-base", "--tier", "random", "--output", "a.avi"], 2, "valid endings"),
        (["hopper-base", "--tier", "random", "--sheet", "--output", "a.gif"], 1, "give --output a .png"),
        (["hopper-base", "--tier", "random", "--output", "a.png", "--size", "big"], 1, "WIDTHxHEIGHT"),
        (["hopper-base", "--tier", "random", "--output", "a.png", "--size", "1x1"], 1, "64 to 4096"),
        (["imujoco/hopper-base-v0", "--output", "a.png"], 2, "is not in the Minari root"),
        (["imujoco/hopper-base-v0", "-t", "expert", "-o", "a.png"], 1, "leave out --tier and --policy"),
        (["imujoco/hopper-base-v0", "--policy", "p.zip", "-o", "a.png"], 1, "leave out --tier and"),
    ],
)
def test_the_command_names_what_is_wrong(
    arguments: list[str],
    code: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["render", *arguments]) == code
    assert words in capsys.readouterr().err
    assert list(tmp_path.glob("*.*")) == []


# Portraits


@pytest.mark.parametrize("variant", [*bases(), *ONE_A_KIND], ids=str)
def test_a_stance_stands_on_the_floor_within_the_joints_ranges(variant: Variant) -> None:
    model = compile_mjcf(canonical_mjcf(variant))
    position = stance(variant)
    seen = capsules(model, position[None])
    assert (seen.ends[0, :, 2] - seen.radii).min() == pytest.approx(0.0, abs=1e-9)
    for joint in range(3, model.njnt):
        low, high = model.jnt_range[joint]
        assert low - 1e-12 <= position[model.jnt_qposadr[joint]] <= high + 1e-12


def test_the_readmes_picture_is_there() -> None:
    readme = Path(__file__).parents[2] / "README.md"
    assert "(docs/images/variants.png)" in readme.read_text("utf-8")
    with Image.open(readme.parent / "docs" / "images" / "variants.png") as picture:
        assert picture.width > 1000
