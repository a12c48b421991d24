"""Files joined by moving their bytes hold what HDF5 would have copied, and only harmless files are joined."""

from __future__ import annotations

import errno
import hashlib
import io
import itertools
import random
import shutil
from pathlib import Path

import h5py
import numpy as np
import pyfive
import pytest

from imujoco_minari.errors import DatasetError
from imujoco_minari.publishing.combiner import combine_datasets
from imujoco_minari.publishing.joining import Joiner, NotPlainError
from imujoco_minari.publishing.publisher import combiner, publish
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.storage.quiet_file import writing
from imujoco_minari.storage.writer import write_episode
from imujoco_minari.verification import verify

IDS = [f"imujoco/{name}-random-v0" for name in ("hopper-base", "hopper-massdec_25_leggeom")]
EPISODES = 5


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    root = tmp_path_factory.mktemp("published")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        for number, name in enumerate(IDS):
            publish(name.split("/")[1].removesuffix("-random-v0"), tier="random", episodes=EPISODES + number)
    return root


@pytest.fixture
def sources(published, root):
    shutil.copytree(published, root)
    return [data_file(name) for name in IDS]


def data_file(dataset_id):
    return file_format.main_file(minari_root.dataset_folder(dataset_id) / "data")


def whole(file):
    """Return all that a file says: names, attributes in their order, dtypes, shapes and numbers."""
    said = [("/", list(file.attrs.items()))]

    def look(name, found):
        said.append((name, list(found.attrs.items())))
        if isinstance(found, h5py.Dataset):
            said.append((found.dtype, found.shape, found.maxshape, found.chunks, found[()].tobytes()))

    file.visititems(look)
    return said


def joined(target, *paths):
    """Join files and return the layouts."""
    with Joiner(target, [path.stat().st_size for path in paths], _episodes(paths)) as joiner:
        layouts = [joiner.add(path) for path in paths]
        joiner.finish({})
    return layouts


def _episodes(paths):
    count = 0
    for path in paths:
        with h5py.File(path, "r") as file:
            count += len(file)
    return count


def test_what_is_joined_is_what_hdf5_copies(sources, monkeypatch):
    said, metadata = [], []
    for way in ("moved", "copied"):
        with monkeypatch.context() as patch:
            if way == "copied":
                patch.setattr(combiner, "_join", lambda *_: None)
            collection = combine_datasets(IDS, "imujoco/both-v0", force=True)
        assert verify("imujoco/both-v0") == []
        path = file_format.main_file(collection.storage.data_path)
        with h5py.File(path, "r") as file:
            assert len(file) == 2 * EPISODES + 1
            said.append(whole(file))
        metadata.append(collection.storage.metadata)
        assert metadata[-1]["file_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert said[0] == said[1]
    differ = {key for key in metadata[0] | metadata[1] if metadata[0].get(key) != metadata[1].get(key)}
    assert differ <= {"file_sha256", "metadata_sha256", "dataset_size"}


def test_another_reader_of_the_format_reads_it(sources, tmp_path):
    target = tmp_path / "joined.hdf5"
    joined(target, *sources)
    number = 0
    with pyfive.File(target) as ours:
        for path in sources:
            with h5py.File(path, "r") as source:
                for place in range(len(source)):
                    theirs, group = source[f"episode_{place}"], ours[f"episode_{number}"]
                    assert sorted(group) == sorted(theirs)
                    for key, array in theirs.items():
                        assert group[key][:].tobytes() == array[()].tobytes()
                        assert group[key].attrs["sha256"].decode() == array.attrs["sha256"]
                    said = {k: v.decode() if isinstance(v, bytes) else v for k, v in group.attrs.items()}
                    assert said == dict(theirs.attrs) | {"id": number}
                    number += 1
        assert len(list(ours)) == number == 2 * EPISODES + 1


@pytest.mark.parametrize("episodes", [1, 9, 70, 300, 1100])
def test_any_number_of_episodes_of_any_length(tmp_path, episodes):
    # Tables of names fill up, split and get trees of several levels; odd lengths leave nothing aligned.
    paths = [tmp_path / "a.hdf5", tmp_path / "b.hdf5"]
    rng = np.random.default_rng(episodes)
    lengths = {}
    for path, count in zip(paths, (episodes, 3), strict=True):
        path.touch()
        lengths[path] = rng.integers(0, 6, count)
        with writing(path) as file:
            for number, length in enumerate(lengths[path].tolist()):
                arrays = {
                    "observations": rng.normal(size=(length + 1, 3)),
                    "rewards": rng.normal(size=length).astype(np.float32),
                    "terminations": rng.random(length) < 0.5,
                    "infos": rng.integers(-9, 9, (length, 2)),
                }
                attributes = {"id": number, "total_steps": length, "source": "é" * (number % 7)}
                write_episode(file, f"episode_{number}", arrays, attributes)
    target = tmp_path / "joined.hdf5"
    layouts = joined(target, *paths, paths[0])
    assert [layout.steps for layout in layouts] == [int(lengths[p].sum()) for p in (*paths, paths[0])]
    with h5py.File(target, "r") as ours:
        number = 0
        for path in (*paths, paths[0]):
            with h5py.File(path, "r") as source:
                for place in range(len(source)):
                    group, theirs = ours[f"episode_{number}"], source[f"episode_{place}"]
                    assert whole_without_id(group) == whole_without_id(theirs)
                    assert group.attrs["id"] == number
                    number += 1
        assert number == len(ours)


def whole_without_id(group):
    (_, attributes), *rest = whole(group)
    return [item for item in attributes if item[0] != "id"], rest


def test_what_was_joined_can_be_joined_again_and_written_to(sources, tmp_path):
    once, twice = tmp_path / "once.hdf5", tmp_path / "twice.hdf5"
    joined(once, *sources)
    joined(twice, once, sources[0])
    with h5py.File(twice, "r") as file:
        before = {name: whole_without_id(group) for name, group in file.items()}
    assert len(before) == 3 * EPISODES + 1
    with h5py.File(twice, "r+") as file:
        file.copy("episode_0", "episode_99")
        del file["episode_1"]
        file["episode_2"].attrs["new"] = "a text"
        file["episode_3"].create_dataset("more", data=np.arange(1000))
    with h5py.File(twice, "r") as file:
        after = {name: whole_without_id(group) for name, group in file.items()}
        assert file["episode_2"].attrs["new"] == "a text"
        assert file["episode_3/more"][-1] == 999
    assert after.pop("episode_99") == before["episode_0"]
    changed = {"episode_1", "episode_2", "episode_3"}
    assert {name for name in before if after.get(name) != before[name]} == changed


def test_shares_of_jobs_and_tiers_are_joined_too(root, tmp_path, monkeypatch):
    publish("hopper-base", tier="medium-expert", episodes=4, jobs=2)
    combine_datasets(["imujoco/hopper-base-medium-expert-v0"], "imujoco/by-bytes-v0")
    joined(
        tmp_path / "joined.hdf5",
        data_file("imujoco/hopper-base-medium-expert-v0"),
        data_file("imujoco/by-bytes-v0"),
    )


def test_hdf5_copies_what_is_not_plain(sources, monkeypatch):
    used = []
    copy = combiner._copy
    monkeypatch.setattr(combiner, "_copy", lambda *given: used.append(1) or copy(*given))
    combine_datasets(IDS, "imujoco/plain-v0")
    assert used == []
    with h5py.File(sources[1], "r+") as file:
        file["episode_0"].create_dataset("infos", data=np.arange(100), chunks=(10,))
    collection = combine_datasets(IDS, "imujoco/mixed-v0")
    assert used == [1]
    with h5py.File(file_format.main_file(collection.storage.data_path), "r") as file:
        assert file[f"episode_{EPISODES}/infos"].chunks == (10,)
        assert len(file) == 2 * EPISODES + 1


def test_attributes_that_do_not_fit_are_left_to_hdf5(sources, monkeypatch):
    monkeypatch.setattr("imujoco_minari.publishing.joining.root._ROOM", 0)
    assert combine_datasets(IDS, "imujoco/tight-v0").total_episodes == 2 * EPISODES + 1
    assert verify("imujoco/tight-v0") == []


def test_a_file_system_that_maps_nothing_is_left_to_hdf5(sources, monkeypatch):
    def refuse(*given, **named):
        raise OSError(errno.ENODEV, "No such device")

    monkeypatch.setattr("imujoco_minari.publishing.joining.layout.mmap.mmap", refuse)
    assert combine_datasets(IDS, "imujoco/unmapped-v0").total_episodes == 2 * EPISODES + 1


def test_a_full_disk_is_an_error_that_names_the_file(sources, monkeypatch):
    class Full(io.FileIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", lambda path, mode, buffering: Full(path, mode))
    with (
        pytest.raises(OSError, match=r"No space left on device: .*joined\.hdf5"),
        Joiner(sources[0].with_name("joined.hdf5"), [8], 1) as joiner,
    ):
        joiner._output.sha256()


CHANGES = []


def change(function):
    """Count a function among those that make a file one that this package would not write."""
    CHANGES.append(function)
    return function


@change
def chunked(file):
    file["episode_1"].create_dataset("x", data=np.arange(9), chunks=(3,))


@change
def compressed(file):
    file["episode_1"].create_dataset("x", data=np.arange(9), compression="gzip")


@change
def compact(file):
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_layout(h5py.h5d.COMPACT)
    h5py.h5d.create(file["episode_1"].id, b"x", h5py.h5t.NATIVE_INT8, h5py.h5s.create(h5py.h5s.SCALAR), plist)


@change
def texts(file):
    file["episode_1"].create_dataset("x", data=["a", "b"])


@change
def text_attributes(file):
    file["episode_1"].attrs["x"] = ["a", "b"]


@change
def record(file):
    file["episode_1"].create_dataset("x", data=np.zeros(3, [("a", "i4"), ("b", "f4")]))


@change
def named_type(file):
    file["episode_1/x"] = np.dtype("f8")


@change
def type_elsewhere(file):
    file["episode_0/type"] = np.dtype("f8")
    file["episode_1"].create_dataset("x", data=np.zeros(3), dtype=file["episode_0/type"])


@change
def soft_link(file):
    file["episode_1/x"] = h5py.SoftLink("/episode_0")


@change
def external_link(file):
    file["episode_1/x"] = h5py.ExternalLink("/etc/passwd", "/")


@change
def hard_link(file):
    file["episode_1/x"] = file["episode_0/rewards"]


@change
def circle(file):
    file["episode_1/x"] = file["episode_1"]


@change
def other_name(file):
    file["other"] = np.arange(3)


@change
def missing(file):
    del file["episode_1"]


@change
def no_digest(file):
    del file["episode_1"].attrs["sha256"]


@change
def no_source(file):
    del file["episode_1"].attrs["source"]


@change
def id_of_another_type(file):
    file["episode_1"].attrs["id"] = 1.0


@change
def ids(file):
    file["episode_1"].attrs["id"] = [1, 2]


@change
def fill_value(file):
    file["episode_1"].create_dataset("x", shape=(3,), dtype="f8", fillvalue=7.0)


@change
def big_endian(file):
    file["episode_1"].create_dataset("x", data=np.arange(3, dtype=">f8"))


@change
def reference(file):
    file["episode_1"].attrs["x"] = file["episode_0"].ref


@change
def elsewhere(file):
    file["episode_1"].create_dataset("x", shape=(4,), dtype="u1", external=[("/etc/passwd", 0, 4)])


@change
def many_attributes(file):
    for number in range(300):
        file["episode_1"].attrs[f"a{number}"] = number


@pytest.mark.parametrize("made", CHANGES)
def test_what_this_package_does_not_write_is_left_to_hdf5(sources, tmp_path, made):
    with h5py.File(sources[0], "r+") as file:
        made(file)
    with pytest.raises(NotPlainError):
        joined(tmp_path / "joined.hdf5", sources[0])


@pytest.mark.parametrize("version", ["v108", "v110", "latest"])
def test_files_of_other_versions_are_left_to_hdf5(sources, tmp_path, version):
    other = tmp_path / "other.hdf5"
    with h5py.File(sources[0], "r") as old, h5py.File(other, "w", libver=(version, "latest")) as new:
        for name in old:
            old.copy(name, new)
    with pytest.raises(NotPlainError):
        joined(tmp_path / "joined.hdf5", other)


@pytest.mark.parametrize("size", [0, 1, 95, 96, 1000, -1, -8, -100])
def test_a_file_that_is_cut_is_left_to_hdf5(sources, tmp_path, size):
    cut = tmp_path / "cut.hdf5"
    cut.write_bytes(sources[0].read_bytes()[:size])
    with (
        pytest.raises(NotPlainError),
        Joiner(tmp_path / "joined.hdf5", [cut.stat().st_size], EPISODES) as joiner,
    ):
        joiner.add(cut)


def test_a_file_that_grows_or_shrinks_meanwhile_is_named(sources, tmp_path):
    size = sources[0].stat().st_size
    for wrong in (size + 8, size - 8):
        with (
            pytest.raises(DatasetError, match="was changed while it was read: nothing was combined"),
            Joiner(tmp_path / "joined.hdf5", [wrong], EPISODES) as joiner,
        ):
            joiner.add(sources[0])


def test_damage_is_refused_or_does_not_matter(sources, tmp_path):
    # A thousand times as many in the campaign, scripts/test-fuzz.
    sound, rng = sources[0].read_bytes(), random.Random(0)
    structure = np.ones(len(sound), bool)
    with h5py.File(sources[0], "r") as file:
        arrays = [array for group in file.values() for _, array in file_format.arrays(group)]
        for array in arrays:
            structure[array.id.get_offset() :][: array.id.get_storage_size()] = False
    places = np.flatnonzero(structure).tolist()
    ends = {"refused": 0, "joined": 0}
    damaged, target = tmp_path / "damaged.hdf5", tmp_path / "joined.hdf5"
    for place, value in itertools.islice(((rng.choice(places), rng.randrange(256)) for _ in places), 300):
        raw = bytearray(sound)
        raw[place] = value
        damaged.write_bytes(raw)
        try:
            with Joiner(target, [len(raw)], EPISODES) as joiner:
                joiner.add(damaged)
                joiner.finish({})
        except NotPlainError:
            ends["refused"] += 1
            continue
        with h5py.File(target, "r") as file:
            whole(file)
        ends["joined"] += 1
    assert min(ends.values()) > 30, ends
