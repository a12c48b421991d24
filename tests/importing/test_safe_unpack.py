"""Hostile and broken zips and npz files are refused in one line, before they are unpacked."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import original_archive
import pytest

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError, VariantError
from imujoco_minari.importing import safe_unpack
from imujoco_minari.importing.archive import open_archive
from imujoco_minari.importing.originals import Import, import_archive, recollect
from imujoco_minari.variants.original import OriginalVariant

HOPPER = "hopper-massdec_25_leggeom"

pytestmark = pytest.mark.usefixtures("in_process")


@pytest.mark.parametrize("folder", ["", "/etc/", "../../", "dataset/../../../", "dataset\\..\\", "C:\\"])
@pytest.mark.parametrize("mode", [stat.S_IFREG, stat.S_IFLNK, stat.S_IFCHR])
def test_the_name_of_an_entry_does_not_decide_where_it_is_written(
    tmp_path: Path, folder: str, mode: int
) -> None:
    info = zipfile.ZipInfo(f"{folder}sac-{HOPPER}.npz")
    info.external_attr, info.create_system = (mode | 0o644) << 16, 3
    with zipfile.ZipFile(tmp_path / "dataset.zip", "w") as archive:
        archive.writestr(info, b"/etc/passwd")
    for members in open_archive(tmp_path).files.values():
        with members["dataset"].on_disk() as path:
            assert path.name == "entry.npz"
            assert list(path.parent.iterdir()) == [path]
            assert stat.S_ISREG(path.lstat().st_mode)
            assert path.read_bytes() == b"/etc/passwd"


def test_bounds_hold_for_entries_their_number_and_their_sum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(3):
            archive.writestr(f"{number}.xml", b"0" * 1000)
    with safe_unpack.open_zip(path) as archive:
        assert len(archive.infolist()) == 3
    for name, value, message in (
        ("MAX_ENTRIES", 2, "holds 3 entries; the limit is 2"),
        ("MAX_ENTRY_BYTES", 999, "would unpack to 1000 bytes; the limit is 999"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(safe_unpack, name, value)
            with pytest.raises(DatasetError, match=message), safe_unpack.open_zip(path):
                pytest.fail("the zip was opened")
    message = "would unpack to 3000 bytes; the limit is 2999"
    with pytest.raises(DatasetError, match=message), safe_unpack.open_zip(path, max_bytes=2999):
        pytest.fail("the zip was opened")


def test_the_members_of_an_npz_are_bounded_together(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(6):
            archive.writestr(f"{number}.npy", npy("{'descr': '|i1', 'fortran_order': False, 'shape': (1,)}"))
            # As the directory of a zip states them that has a gibibyte of zeros in each.
            archive.getinfo(f"{number}.npy").file_size = 2**30
    with pytest.raises(DatasetError, match=f"would unpack to {6 * 2**30} bytes; the limit is {2**30}"):
        safe_unpack.read_npz(tmp_path / "a.npz")


def test_small_numbers_count_as_the_large_ones_that_they_become(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros(60, np.int8), b=np.zeros(40, np.int8))
    monkeypatch.setattr(safe_unpack, "MAX_NUMBERS", 100)
    assert len(safe_unpack.read_npz(tmp_path / "a.npz")) == 2
    monkeypatch.setattr(safe_unpack, "MAX_NUMBERS", 99)
    with pytest.raises(DatasetError, match="'b' claims 40 numbers; the arrays of one import may have 99"):
        safe_unpack.read_npz(tmp_path / "a.npz")


def npy(header: str, data: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    text = header.encode().ljust(118) + b"\n"
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text + data


def npz(path: Path, content: bytes, name: str = "data.npy") -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (10**12, 16)}"), "not a readable zip"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000, 16)}"), "claims 128000000000 b"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-4, 16)}", b"x" * 64), "claims -512 bytes"),
        (npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"x" * 64), "not of numbers"),
        (npy("{'descr': '<U9', 'fortran_order': False, 'shape': (1,)}", b"x" * 64), "not of numbers"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (4,)}", b"x" * 8), "ends after 8 of 32"),
        (npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1,)}", b"x" * 8, b"\x09\x00"), "version"),
        (npy("__import__('os').system('true')", b"x" * 8), "not a readable zip"),
        (npy("{'descr': ', 3), <f8', 'fortran_order': False, 'shape': (6, 3)}"), "not a readable zip"),
        (b"nothing", "not a readable zip"),
    ],
)
def test_arrays_that_lie_are_refused_unallocated(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        safe_unpack.read_npz(npz(tmp_path / "a.npz", content))


def test_a_pickle_in_an_npz_is_never_loaded(tmp_path: Path) -> None:
    mark = tmp_path / "unpickled"
    bombs = np.array([original_archive.Bomb(mark)], dtype=object)
    np.savez(tmp_path / "a.npz", data=bombs, allow_pickle=True)
    with pytest.raises(DatasetError, match="not of numbers"):
        safe_unpack.read_npz(tmp_path / "a.npz")
    assert not mark.exists()


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_read_as_numpy_wrote_them(tmp_path: Path, order: str) -> None:
    table = np.arange(12.0).reshape(3, 4)
    arrays = {"data": table if order == "C" else np.asfortranarray(table), "flags": np.array([True, False])}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    read = safe_unpack.read_npz(tmp_path / "a.npz")
    assert set(read) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def truncated(content: bytes) -> bytes:
    return content[: len(content) // 2]


def flipped(content: bytes) -> bytes:
    middle = len(content) // 3
    odd = bytes(255 - byte for byte in content[middle : middle + 60])
    return content[:middle] + odd + content[middle + 60 :]


@pytest.mark.parametrize("damage", [truncated, flipped, lambda _: b"", lambda _: b"PK\x03\x04"])
def test_damaged_archives_fail_in_one_line(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    place = original_archive.write_archive(tmp_path / "archive", (HOPPER,))
    for part, suffix in (("dataset", "npz"), ("policies", "zip")):
        path = place / part / f"sac-{HOPPER}.{suffix}"
        path.write_bytes(damage(path.read_bytes()))
    archive = open_archive(place)
    for how in (Import(), Import(recollect=True, episodes=1)):
        (outcome,) = import_archive(archive, archive.variants, how)
        assert outcome.error
        assert "\n" not in outcome.error
        assert HOPPER in outcome.error


def test_a_link_among_the_archives_files_is_refused(tmp_path: Path) -> None:
    place = original_archive.write_archive(tmp_path / "archive", (HOPPER,))
    model = place / "xml" / f"{HOPPER}.xml"
    model.unlink()
    model.symlink_to("/etc/passwd")
    archive = open_archive(place)
    with pytest.raises(DatasetError, match="link or another special file"):
        archive.mjcf(OriginalVariant.parse(HOPPER))


def test_nothing_in_a_policy_zip_is_unpickled(tmp_path: Path) -> None:
    place = original_archive.write_archive(tmp_path / "archive", (HOPPER,))
    mark = tmp_path / "unpickled"
    original_archive.write_sb3_zip(place / "policies" / f"sac-{HOPPER}.zip", "hopper", bomb=mark)
    how = Import(recollect=True, episodes=1)
    published = recollect(open_archive(place), OriginalVariant.parse(HOPPER), how)
    assert published.created
    assert not mark.exists()


def test_a_zip_in_the_archive_that_would_fill_the_disk_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "archive"
    place.mkdir()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"dataset/sac-{HOPPER}.npz", b"0" * 10_000_000)
    (place / "dataset.zip").write_bytes(buffer.getvalue())
    assert buffer.tell() < 50_000
    monkeypatch.setattr(safe_unpack, "MAX_ENTRY_BYTES", 2**20)
    with pytest.raises(DatasetError, match="would unpack to 10000000 bytes"):
        open_archive(place)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetNotFoundError, match="no folder at"):
        open_archive(tmp_path / "none")
    with pytest.raises(DatasetNotFoundError, match="holds no part of the archive; valid: the folders xml"):
        open_archive(tmp_path)
    (tmp_path / "xml").mkdir()
    (tmp_path / "xml" / "hopper-gravityinc_20_world.xml").touch()
    message = "has no variant of the original's four categories; it has xml/hopper-gravityinc_20_world.xml"
    with pytest.raises(VariantError, match=message):
        open_archive(tmp_path).select([], None, None)
    with pytest.raises(ImujocoError, match="no file at"):
        safe_unpack.read_npz(tmp_path / "none.npz")
