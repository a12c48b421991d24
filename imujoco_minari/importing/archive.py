"""The original's archive on disk: its variants, and the three files of each.

The three parts ``xml``, ``policies`` and ``dataset`` are folders or the published zips, in any mix, in the
given folder or in its subfolder ``imujoco``. The files of a zip are unpacked one at a time.
"""

from __future__ import annotations

import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from imujoco_minari.envs.external_mjcf import canonical_external_mjcf
from imujoco_minari.envs.untrusted_mjcf import MAX_BYTES
from imujoco_minari.errors import DatasetError, DatasetNotFoundError, StorageError, VariantError, suggestion
from imujoco_minari.importing.safe_unpack import open_zip, unpack
from imujoco_minari.variants.original import PARTS, OriginalVariant, file_name


@dataclass(frozen=True)
class Member:
    """One file of the archive: a file on disk, or the entry ``entry`` of the zip at ``path``."""

    path: Path
    entry: str = ""

    def __str__(self) -> str:
        return f"{self.path}/{self.entry}" if self.entry else str(self.path)

    @property
    def name(self) -> str:
        """The name of the file, without its folders."""
        return (self.entry or self.path.name).rpartition("/")[2]

    @contextmanager
    def on_disk(self) -> Iterator[Path]:
        """Yield the path of the file; an entry of a zip is a temporary file within the context."""
        if not self.entry:
            if not stat.S_ISREG(self.path.lstat().st_mode):
                raise DatasetError(f"{self.path}: is a link or another special file; valid: a plain file")
            yield self.path
            return
        with tempfile.TemporaryDirectory(prefix="imujoco-") as folder:
            target = Path(folder) / f"entry{Path(self.entry).suffix}"
            with open_zip(self.path) as archive:
                size = archive.getinfo(self.entry).file_size
                if size > shutil.disk_usage(folder).free:
                    raise StorageError(f"{self}: needs {size} bytes in {folder}, which has fewer free")
                unpack(archive, self.entry, target)
            yield target


@dataclass(frozen=True)
class Archive:
    """The files of an archive.

    Attributes:
        place: the folder of the archive.
        files: variant -> part (``xml``, ``policies``, ``dataset``) -> file.
        ignored: the files that are not named after a variant.
    """

    place: Path
    files: Mapping[OriginalVariant, Mapping[str, Member]]
    ignored: tuple[str, ...]

    @property
    def variants(self) -> tuple[OriginalVariant, ...]:
        """The variants that have at least one file in the archive, sorted."""
        return tuple(sorted(self.files))

    def select(self, names: Sequence[str], robot: str | None, category: str | None) -> list[OriginalVariant]:
        """Return the named variants, or all if none is named, of one robot and category or of any.

        Raises:
            VariantError: when the archive has no such variant, or none is left.
        """
        ids = {str(variant): variant for variant in self.variants}
        no_variant = f"the archive at {self.place} has no variant"
        if not ids:
            had = ", ".join(self.ignored[:5]) or "no files"
            raise VariantError(f"{no_variant} of the original's four categories; it has {had}")
        for name in names:
            if name not in ids:
                raise VariantError(f"{no_variant} {name!r}{suggestion(name[:80], ids)}; it has {len(ids)}")
        chosen = of_kind([ids[name] for name in dict.fromkeys(names or ids)], robot, category)
        if not chosen:
            raise VariantError(f"{no_variant} that --robot and --category leave")
        return chosen

    def member(self, variant: OriginalVariant, part: str) -> Member:
        """Return a variant's file of a part.

        Raises:
            DatasetNotFoundError: when the archive has no such file.
        """
        try:
            return self.files[variant][part]
        except KeyError:
            name = file_name(part, variant)
            raise DatasetNotFoundError(f"{variant}: the archive at {self.place} has no {name}") from None

    def mjcf(self, variant: OriginalVariant) -> tuple[str, str]:
        """Return the MJCF text of a variant as it is in the archive, and the canonical text.

        Raises:
            DatasetNotFoundError: when the archive has no model of the variant.
            ModelError: when the model is unsafe, does not compile, or is not a model of the robot.
        """
        member = self.member(variant, "xml")
        with member.on_disk() as path, path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        text = data.decode("utf-8", errors="replace")
        return text, canonical_external_mjcf(text, variant.robot, str(member))


def of_kind(
    variants: Iterable[OriginalVariant], robot: str | None, category: str | None
) -> list[OriginalVariant]:
    """Return the variants of a robot and a category; None means any."""
    return [v for v in variants if robot in (None, v.robot) and category in (None, v.category)]


def open_archive(place: Path) -> Archive:
    """Return the archive in the folder ``place``.

    Raises:
        DatasetNotFoundError: when the folder does not exist, or has none of the three parts.
        DatasetError: when a zip is broken or too large.
    """
    if not place.is_dir():
        raise DatasetNotFoundError(f"no folder at {place}")
    files: dict[OriginalVariant, dict[str, Member]] = {}
    ignored: list[str] = []
    roots = [root for root in (place, place / "imujoco") if root.is_dir()]
    parts = [(part, found) for part in PARTS for root in roots if (found := _part(root, part)) is not None]
    if not parts:
        raise DatasetNotFoundError(
            f"{place} holds no part of the archive; valid: the folders {', '.join(PARTS)}, or their zips"
        )
    for part, members in parts:
        prefix, suffix = PARTS[part]
        for member in members:
            name = member.name
            if name.startswith("._") or name == ".DS_Store":
                continue
            try:
                if not (name.startswith(prefix) and name.endswith(suffix)):
                    raise VariantError(name)
                variant = OriginalVariant.parse(name.removeprefix(prefix).removesuffix(suffix))
            except VariantError:
                ignored.append(f"{part}/{name}")
                continue
            files.setdefault(variant, {}).setdefault(part, member)
    return Archive(place, files, tuple(sorted(ignored)))


def _part(root: Path, part: str) -> list[Member] | None:
    """Return the files of a part, from its folder or else its zip; None when neither exists."""
    folder, zipped = root / part, root / f"{part}.zip"
    if folder.is_dir():
        return [Member(path) for path in sorted(folder.iterdir()) if not path.is_dir()]
    if zipped.is_file():
        with open_zip(zipped) as archive:
            return [Member(zipped, info.filename) for info in archive.infolist() if not info.is_dir()]
    return None
