"""Dataset cards: the Markdown page of a dataset or a namespace on a remote.

The front matter is the YAML that Hugging Face reads. All numbers come from the dataset itself: its metadata,
the attributes of its episodes, and the compiled models of its environments.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from imujoco_minari.envs.differences import differences
from imujoco_minari.errors import VariantError
from imujoco_minari.policies.tiers import EXPERT_STOCHASTIC, LARGE_TIERS, MEDIUM_REPLAY, RANDOM, REPLAY, TIERS
from imujoco_minari.storage.file_format import LINKED, MAIN_FILE, REPLAYABLE
from imujoco_minari.storage.metadata import AUTHOR, read_metadata, sources, texts
from imujoco_minari.storage.missing import making
from imujoco_minari.variants import parse_dataset_id

ORIGINAL = "https://zenodo.org/records/7971395"
PAPER = "https://arxiv.org/abs/2306.13554"
CITATION = """@inproceedings{patacchiola2023comparing,
  title     = {Comparing the Efficacy of Fine-Tuning and Meta-Learning for Few-Shot Policy Imitation},
  author    = {Patacchiola, Massimiliano and Sun, Mingfei and Hofmann, Katja and Turner, Richard E.},
  booktitle = {Conference on Lifelong Learning Agents},
  year      = {2023},
  note      = {The original iMuJoCo; data at https://zenodo.org/records/7971395}
}"""

_POWERS = ("1K", "10K", "100K", "1M", "10M", "100M", "1B")
_TAGS = ("minari", "gymnasium", "mujoco", "imitation-learning", "offline-reinforcement-learning", "imujoco")


def front_matter(title: str, license_: str, steps: int, tags: Sequence[str] = ()) -> str:
    """Return the YAML block at the start of a card. ``license_`` is the Hub's name of a licence."""
    lines = ["---", f"license: {license_}", f"pretty_name: {json.dumps(title)}"]
    # The Hub would read HDF5 as a table and show an error in place of the card.
    lines += ["viewer: false", "size_categories:", f"- {size_category(steps)}"]
    lines += ["task_categories:", "- reinforcement-learning", "- robotics", "tags:"]
    lines += [f"- {json.dumps(tag)}" for tag in dict.fromkeys((*_TAGS, *tags))]
    return "\n".join([*lines, "---", ""])


def size_category(rows: int) -> str:
    """Return the Hub's size category of a dataset with this number of rows."""
    if rows < 10**3 or rows >= 10**9:
        return "n<1K" if rows < 10**3 else "n>1B"
    power = len(str(rows)) - 4
    return f"{_POWERS[power]}<n<{_POWERS[power + 1]}"


def dataset_card(data: Path, remote: str) -> str:
    """Return the card of the dataset with the folder ``data``, for the remote at this address."""
    metadata = read_metadata(data)
    dataset_id = metadata["dataset_id"]
    with h5py.File(data / MAIN_FILE, "r") as file:
        episodes = [file[name].attrs for name in file]
        returns = np.array([float(attrs["rewards_sum"]) for attrs in episodes])
        lengths = np.array([int(attrs["total_steps"]) for attrs in episodes])
        # The metadata of a collection do not state this.
        replayable = all(bool(attrs.get(REPLAYABLE, True)) for attrs in episodes)
    tags = [str(metadata[key]) for key in ("robot", "category", "tier") if metadata.get(key)]
    parts = [
        front_matter(dataset_id, _license_name(metadata), int(metadata["total_steps"]), tags),
        f"# {dataset_id}\n\n{metadata.get('description', '')}\n",
        *_change_section(dataset_id),
        "## Numbers\n\n" + _markdown_table(("", ""), _number_rows(metadata, returns, lengths)),
        "## How to load it\n\n" + _loading_instructions(dataset_id, remote),
        "## How it was made\n\n" + _provenance_section(metadata, replayable=replayable),
        _origin_section([metadata]),
    ]
    return "\n".join(parts)


def namespace_card(namespace: str, remote: str, datasets: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the card of a namespace such as ``imujoco``, with a table of its datasets: id -> metadata."""
    steps, rows = 0, []
    for dataset_id, metadata in sorted(datasets.items()):
        stated = metadata.get("total_steps")
        own = stated if isinstance(stated, int) else 0
        steps += own
        episodes, policy = metadata.get("total_episodes", ""), metadata.get("algorithm_name", "")
        rows.append((f"`{dataset_id}`", str(episodes), f"{own:,}", str(policy)))
    licenses = {_license_name(metadata) for metadata in datasets.values()}
    license_ = licenses.pop() if len(licenses) == 1 else "other"
    example = min(datasets, default=f"{namespace}/hopper-base-v0")
    parts = [
        front_matter(f"iMuJoCo, rebuilt ({namespace})", license_, steps),
        f"# {namespace}\n\nDatasets of MuJoCo robots, each with one physical parameter changed, in "
        "[Minari](https://minari.farama.org)'s format, made with the Python package `imujoco-minari`.\n",
        "## How to load them\n\n" + _loading_instructions(example, remote),
        f"## The datasets\n\n{len(datasets)} datasets, {steps:,} steps.\n\n"
        + _markdown_table(("dataset", "episodes", "steps", "policy"), rows),
        _origin_section(list(datasets.values())),
    ]
    return "\n".join(parts)


def _change_section(dataset_id: str) -> list[str]:
    try:
        variant, _ = parse_dataset_id(dataset_id)
    except VariantError:
        return []
    rows = [(d.quantity, f"{d.before:.6g}", f"{d.after:.6g}", d.unit) for d in differences(variant)]
    if not rows:
        return []
    return [
        "## What changes\n\n" + _markdown_table(("quantity", str(variant.base), str(variant), "unit"), rows)
    ]


def _number_rows(metadata: Mapping[str, Any], returns: Any, lengths: Any) -> list[tuple[str, str]]:
    spread = f"{returns.min():.1f} to {returns.max():.1f}"
    rows = [
        ("episodes", f"{len(returns)}"),
        ("steps", f"{lengths.sum():,}"),
        ("return", f"{returns.mean():.1f} ± {returns.std():.1f} ({spread})"),
        ("episode length", f"{lengths.mean():.0f} steps ({lengths.min()} to {lengths.max()})"),
        ("policy", str(metadata.get("algorithm_name", "unknown"))),
    ]
    if "policy_deterministic" in metadata:
        rows.append(("actions", "the policy's mode" if metadata["policy_deterministic"] else "sampled"))
    references = {"ref_min_score": "return of a random policy", "ref_max_score": "return of the expert"}
    for key, name in references.items():
        if isinstance(metadata.get(key), int | float):
            rows.append((name, f"{metadata[key]:.1f}"))
    if combined := sources(metadata):
        rows.append(("combined from", f"{len(combined)} datasets"))
    return rows


def _loading_instructions(dataset_id: str, remote: str) -> str:
    return (
        f'```console\n$ pip install "minari[hdf5,{"hf" if remote.startswith("hf:") else "gcs"}]"\n'
        f"$ export MINARI_REMOTE={remote}\n```\n\n"
        f'```python\nimport minari\n\ndataset = minari.load_dataset("{dataset_id}", download=True)\n```\n\n'
        "With `imujoco-minari` installed, `dataset.recover_environment()` returns its environment,\n"
        f"and `imujoco pull {dataset_id} --remote {remote}` checks every digest of the download.\n"
    )


def _provenance_section(metadata: Mapping[str, Any], *, replayable: bool) -> str:
    rows = [("package", str(metadata.get("code_permalink", "unknown")))]
    for name, number in sorted(metadata.get("versions", {}).items()):
        rows.append((f"version of {name}", str(number)))
    policy = ("policy_sha256", "universal_sha256", "policy_told")
    named = ("machine", "seed", *policy, "mjcf_sha256", "content_sha256")
    rows += [(key.replace("_", " "), f"`{metadata[key]}`") for key in named if key in metadata]
    command = _reproducing_command(metadata)
    block = f"```console\n$ {command}\n```\n\n" if command else ""
    replay = (
        "Every episode has its own recorded seed, so seeds and actions replay the whole dataset. "
        "`imujoco verify` replays it and compares every bit.\n"
    )
    return block + _markdown_table(("", ""), rows) + (replay if replayable else "")


def _reproducing_command(metadata: Mapping[str, Any]) -> str:
    """Return the command that makes the dataset again; empty if no single command does."""
    dataset_id = str(metadata["dataset_id"])
    try:
        _, tier = parse_dataset_id(dataset_id)
    except VariantError:
        combined, link = sources(metadata), " --link" if LINKED in metadata else ""
        return f"imujoco combine {' '.join(combined)} --id {dataset_id}{link}" if combined else ""
    if metadata.get("author") != [AUTHOR] or tier not in (*TIERS, *LARGE_TIERS):
        return ""
    command = making(dataset_id)
    if tier == REPLAY:
        return command
    if tier != MEDIUM_REPLAY:
        command += f" --episodes {metadata['total_episodes']}"
    command += f" --seed {metadata.get('seed', 0)}"
    sampled = tier in (EXPERT_STOCHASTIC, MEDIUM_REPLAY, RANDOM)
    if not sampled and not metadata.get("policy_deterministic", True):
        command += " --stochastic"
    return command


def _origin_section(datasets: Sequence[Mapping[str, Any]]) -> str:
    """Return the section that names the authors of the episodes and cites the original."""
    others = sorted({author for each in datasets for author in texts(each, "author")} - {AUTHOR})
    authors = "These episodes are new. They are not from its archive."
    if others:
        authors = f"Episodes or policies are by {', '.join(others)}."
    return (
        "## Where it comes from\n\n"
        f"The idea, the names of the variants and their counts are from iMuJoCo ([paper]({PAPER}), "
        f"[data]({ORIGINAL})). {authors} Please cite the original:\n\n```bibtex\n{CITATION}\n```\n"
    )


def _license_name(metadata: Mapping[str, Any]) -> str:
    """Return the Hub's name of a dataset's licence; ``unknown`` for external data that states none."""
    if isinstance(metadata.get("license"), str):
        return str(metadata["license"]).lower()
    return "apache-2.0" if metadata.get("author") == [AUTHOR] else "unknown"


def _markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]) + "\n"
