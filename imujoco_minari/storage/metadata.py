"""The file ``metadata.json`` of a dataset: how it is read and completed, and the record of how it was made.

Every operation reads the file once and passes the result on.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from imujoco_minari.storage import file_format

METADATA_FILE = "metadata.json"
MAX_METADATA_BYTES = 2**24

# The packages whose versions decide what is in a dataset, bit for bit or nearly so.
_PACKAGES = ("imujoco-minari", "mujoco", "gymnasium", "minari", "numpy")
_AUTHORS = frozenset({"imujoco_minari"})


def read_metadata(data: Path) -> dict[str, Any]:
    """Return the content of a dataset's ``metadata.json``; empty if it is no JSON object of sane size.

    Args:
        data: the dataset's ``data`` folder.
    """
    path = data / METADATA_FILE
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            return {}
        metadata = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return metadata if isinstance(metadata, dict) else {}


def provenance(
    *, authors: Iterable[str] = _AUTHORS, code: str | None = None, algorithm: str, description: str
) -> dict[str, Any]:
    """Return the metadata that say who made a dataset, how, and with which versions.

    Args:
        authors: names of the authors.
        code: where the code is that made the episodes; None for this package.
        algorithm: name of the algorithm that trained the policy.
        description: one or two sentences about the dataset.
    """
    return {
        "algorithm_name": algorithm,
        "author": sorted(authors),
        "code_permalink": code or f"imujoco-minari=={version('imujoco-minari')}",
        "description": description,
        "minari_version": version("minari"),
        "requirements": [f"{name}=={version(name)}" for name in ("mujoco", "gymnasium")],
        "versions": {name: version(name) for name in _PACKAGES},
        "machine": platform.machine(),
        # BLAS and the C library round the last bit differently with and without these instructions.
        "simd": np.show_config(mode="dicts")["SIMD Extensions"]["found"],
    }


def complete_metadata(data: Path, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Add to a dataset's ``metadata.json``, with the digests of both files, and return the whole.

    This is the last act before a dataset is committed.

    Args:
        data: the dataset's ``data`` folder.
        metadata: what to add; values as JSON holds them.
    """
    path, main_file = data / METADATA_FILE, file_format.main_file(data)
    whole: dict[str, Any] = json.loads(path.read_text("utf-8")) | dict(metadata)
    whole["dataset_size"] = round(main_file.stat().st_size / 1e6, 1)
    whole[file_format.FILE_DIGEST] = file_format.file_sha256(main_file)
    whole[file_format.METADATA_DIGEST] = file_format.metadata_sha256(whole)
    path.write_text(json.dumps(whole), "utf-8")
    return whole
