"""The file ``metadata.json`` of a dataset: reading it, completing it, and the provenance in it.

Every operation reads the file once and passes the result on.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.errors import CatalogueError
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import adopt_page

METADATA_FILE = "metadata.json"
MAX_METADATA_BYTES = 2**24

# The packages whose versions decide the content of a dataset, to the last bit or nearly.
PACKAGES = ("imujoco-minari", "mujoco", "gymnasium", "minari", "numpy")
# The author that datasets of this package state.
AUTHOR = "imujoco_minari"


def read_metadata(data: Path) -> dict[str, Any]:
    """Return the content of a dataset's ``metadata.json``; empty if it is no JSON object of at most 16 MiB.

    A dataset of a user's robot stores the robot's page. This makes the robot known, unless the page is wrong.
    """
    path = data / METADATA_FILE
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            return {}
        metadata = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(metadata, dict):
        return {}
    _adopt_page(metadata)
    return metadata


def _adopt_page(metadata: Mapping[str, Any]) -> None:
    """Make a user's robot known by the page in the environment's specification."""
    try:
        arguments = json.loads(metadata["env_spec"])["kwargs"]
        page = arguments["page"]
        variant = arguments.get("variant") or arguments["variants"][0]
        adopt_page(str(variant).partition("-")[0], dict(page))
    except (CatalogueError, ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
        # Most datasets have no page. With a wrong one the robot stays unknown, which the next step reports.
        return


def texts(metadata: Mapping[str, Any], key: str) -> list[str]:
    """Return the texts in a list of the metadata; empty if there is no such list."""
    stated = metadata.get(key)
    return [text for text in stated if isinstance(text, str)] if isinstance(stated, list) else []


def sources(metadata: Mapping[str, Any]) -> list[str]:
    """Return the ids of the datasets that a collection combines; empty for other datasets."""
    return texts(metadata, "combined_datasets")


def local_collections() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the id and the metadata of each collection in the Minari root."""
    root = minari_root.datasets_root()
    # The folder of staged datasets begins with a dot.
    for data in sorted(root.glob("[!.]*/**/data")):
        metadata = read_metadata(data)
        if sources(metadata):
            yield data.parent.relative_to(root).as_posix(), metadata


def requirements(versions: Mapping[str, str]) -> list[str]:
    """Return the requirements that the versions of a dataset's packages give."""
    return [f"{name}=={versions[name]}" for name in ("mujoco", "gymnasium")]


def code_address(versions: Mapping[str, str]) -> str:
    """Return the address of the code of this package in a version."""
    return f"imujoco-minari=={versions['imujoco-minari']}"


def provenance(
    *, authors: Iterable[str] = (AUTHOR,), code: str | None = None, algorithm: str, description: str
) -> dict[str, Any]:
    """Return the metadata about the authors, the code and the versions that made a dataset.

    ``code`` is the address of the code that made the episodes; None for this package.
    """
    versions = {name: version(name) for name in PACKAGES}
    return {
        "algorithm_name": algorithm,
        "author": sorted(authors),
        "code_permalink": code or code_address(versions),
        "description": description,
        "minari_version": versions["minari"],
        "requirements": requirements(versions),
        "versions": versions,
        **processor(),
    }


def processor() -> dict[str, Any]:
    """Return the metadata about the processor of this machine."""
    extensions = np.show_config(mode="dicts")["SIMD Extensions"]
    # NumPy states none that a processor has beside those that it needs.
    return {"machine": platform.machine(), "simd": extensions.get("found", [])}


def complete_metadata(data: Path, metadata: Mapping[str, Any]) -> None:
    """Add JSON values and the digests of both files to ``metadata.json``. The next step is a commit."""
    path, main_file = data / METADATA_FILE, file_format.main_file(data)
    whole: dict[str, Any] = json.loads(path.read_text("utf-8")) | dict(metadata)
    whole["dataset_size"] = round(main_file.stat().st_size / 1e6, 1)
    whole[file_format.FILE_DIGEST] = file_format.file_sha256(main_file)
    whole[file_format.METADATA_DIGEST] = file_format.metadata_sha256(whole)
    path.write_text(json.dumps(whole), "utf-8")
