"""Zips and npz files that mean harm, or are broken, are refused in one line and before they do any."""

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

from imujoco_minari.errors import DatasetError, DatasetNotFoundError, ImujocoError
from imujoco_minari.importing import safe_unpack
from imujoco_minari.importing.archive import open_archive
from imujoco_minari.importing.originals import Import, import_archive, recollect
from imujoco_minari.variants.original import OriginalVariant

HOPPER = "hopper-massdec_25_leggeom"


def write_zip(path: Path, name: str, *, mode: int = 0, data: bytes = b"x") -> Path:
    info = zipfile.ZipInfo("placeholder")
    info.filename = name
    info.orig_filename = name
    info.external_attr = mode << 16
    info.create_system = 3
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(info, data)
    return path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("/etc/passwd", "absolute path"),
        ("C:/windows/x.xml", "absolute path"),
        ("\\\\server\\x", "absolute path"),
        ("xml/../../x.xml", "could leave the folder"),
        ("xml\\..\\x.xml", "could leave the folder"),
        ("xml//x.xml", "malformed path"),
        ("xml/./x.xml", "malformed path"),
        ("xml/a\x07.xml", "malformed path"),
        ("xml/" + "a" * 300, "malformed path"),
        ("xml/con.xml", "named as a device"),
        ("NUL", "named as a device"),
    ],
)
def test_entries_that_could_leave_the_folder_are_refused(tmp_path: Path, name: str, message: str) -> None:
    path = write_zip(tmp_path / "a.zip", name)
    with pytest.raises(DatasetError, match=message), safe_unpack.open_zip(path):
        pytest.fail("the zip was opened")


@pytest.mark.parametrize("mode", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFSOCK])
def test_links_and_devices_are_refused(tmp_path: Path, mode: int) -> None:
    path = write_zip(tmp_path / "a.zip", "xml/x.xml", mode=mode | 0o644, data=b"/etc/passwd")
    with pytest.raises(DatasetError, match="link or another special file"), safe_unpack.open_zip(path):
        pytest.fail("the zip was opened")


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
        ("MAX_TOTAL_BYTES", 2999, "would unpack to 3000 bytes; the limit is 2999"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(safe_unpack, name, value)
            with pytest.raises(DatasetError, match=message), safe_unpack.open_zip(path):
                pytest.fail("the zip was opened")


def test_an_entry_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xml/a.xml", b"1")
        archive.writestr("xml/A.xml", b"2")
    with pytest.raises(DatasetError, match="is there twice"), safe_unpack.open_zip(path):
        pytest.fail("the zip was opened")


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
    with pytest.raises(ImujocoError, match="no file at"):
        safe_unpack.read_npz(tmp_path / "none.npz")
