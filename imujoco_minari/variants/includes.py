"""Reads a user's files: a page, and an MJCF file as one text with the files that it includes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from imujoco_minari.errors import CatalogueError, PageNotFoundError

# A model of more than 48 KiB is refused later. Comments may make its files longer.
_MAX_BYTES, _MAX_INCLUDES = 2**20, 100


def read_file(path: Path, most: int) -> str:
    """Return the text of a user's file of at most ``most`` bytes; raise a CatalogueError if there is none."""
    if not path.exists():
        raise PageNotFoundError(f"{path}: cannot be read: no such file or folder")
    # A pipe, for example, would wait without end.
    if not path.is_file():
        raise CatalogueError(f"{path}: cannot be read: it is no file")
    try:
        if path.stat().st_size > most:
            raise CatalogueError(f"{path}: the file has more than {most} bytes")
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CatalogueError(f"{path}: cannot be read: {error}") from None


def read_model(path: Path) -> str:
    """Return the MJCF text of a file, with each ``<include file="..."/>`` replaced by that file's content.

    A dataset stores the model as one text, so the model may name no other files.

    Raises:
        CatalogueError: when a file cannot be read, is not XML, or an include names a file outside the folder
            of ``path``; or there are too many includes.
    """
    root = _read(path)
    _insert_includes(root, path, path.parent.resolve(), (path.resolve(),), [])
    try:
        return ET.tostring(root, encoding="unicode")
    except RecursionError:
        raise CatalogueError(f"{path}: elements are nested too deep") from None


def _insert_includes(
    root: ET.Element, path: Path, folder: Path, open_files: tuple[Path, ...], included: list[Path]
) -> None:
    places = [(parent, child) for parent in root.iter() for child in parent if child.tag == "include"]
    for parent, child in places:
        named = child.get("file", "")
        file = (folder / named).resolve()
        if not file.is_relative_to(folder):
            raise CatalogueError(
                f"{path}: includes the file {named!r}, which is outside its folder; valid: a file in {folder}"
            )
        if file in open_files:
            raise CatalogueError(f"{path}: includes the file {named!r}, which includes itself")
        included.append(file)
        # Files that include each other several times would grow without end.
        if len(included) > _MAX_INCLUDES:
            raise CatalogueError(f"{path}: has more than {_MAX_INCLUDES} includes")
        part = _read(file)
        _insert_includes(part, path, folder, (*open_files, file), included)
        place = list(parent).index(child)
        parent[place : place + 1] = list(part)


def _read(path: Path) -> ET.Element:
    text = read_file(path, _MAX_BYTES)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CatalogueError(f"{path}: a model with a DOCTYPE or entities is refused")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise CatalogueError(f"{path}: not XML: {error}") from None
