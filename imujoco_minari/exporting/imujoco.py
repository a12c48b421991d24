"""The layout of the original's archive: datasets, policies and models of many variants in one folder.

``dataset/sac-<variant>.npz`` is a table that also has the terminations, so an import makes the same datasets
again. Programs for the original read its first columns and the last one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

from imujoco_minari.envs.mjcf import canonical_mjcf, mjcf_sha256
from imujoco_minari.errors import DatasetError, VariantError
from imujoco_minari.exporting.flat import ARCHIVE_TABLE, write_table
from imujoco_minari.loading import arrays
from imujoco_minari.policies import Actor, load_policy
from imujoco_minari.policies.sb3 import export_zip
from imujoco_minari.storage import minari_root
from imujoco_minari.storage.metadata import read_metadata
from imujoco_minari.storage.missing import making, not_in_root
from imujoco_minari.variants import Variant, parse_dataset_id
from imujoco_minari.variants.original import PARTS, REBUILT, file_name

README = f"""\
{REBUILT}. These are not the files of 2023 (Zenodo record 7971395): the models, policies and episodes
are new. imujoco-minari {{version}} wrote them in the layout of the original.

dataset/sac-<variant>.npz   array "data", float64, one row a step. Columns: observation, action, reward,
                            next observation, terminated, done. Done is 1 in an episode's last row.
policies/sac-<variant>.zip  the policy that made the episodes, for stable_baselines3.SAC.load. Only its actor
                            is trained.
xml/<variant>.xml           the model, for MuJoCo, and for xml_file= of Gymnasium's v5 environments.
"""


def write(dataset_ids: Sequence[str], target: Path, on_dataset: Callable[[], None]) -> tuple[int, int]:
    """Write datasets, their policies and models to the folder ``target``; return the episodes and steps.

    All datasets are checked before the first is written. :func:`~imujoco_minari.exporting.export_archive`
    lists the errors.
    """
    chosen: dict[Variant, str] = {}
    actors: list[Actor] = []
    for dataset_id in dict.fromkeys(dataset_ids):
        try:
            variant, tier = parse_dataset_id(dataset_id)
        except VariantError as error:
            raise VariantError(f"the format imujoco takes datasets of one variant each: {error}") from None
        if chosen.setdefault(variant, dataset_id) != dataset_id:
            raise DatasetError(
                f"{chosen[variant]} and {dataset_id} are of one variant; the archive has one dataset of each"
            )
        actors.append(_maker(dataset_id, variant, tier))
    for part in PARTS:
        (target / part).mkdir(parents=True)
    (target / "README.txt").write_text(README.format(version=version("imujoco-minari")), "utf-8")
    episodes = steps = 0
    for (variant, dataset_id), actor in zip(chosen.items(), actors, strict=True):
        data = arrays(dataset_id)
        write_table(data, target / file_name("dataset", variant), ARCHIVE_TABLE)
        export_zip(variant, target / file_name("policies", variant), actor)
        write_model(variant, target / file_name("xml", variant))
        episodes, steps = episodes + data.episodes, steps + len(data)
        on_dataset()
    return episodes, steps


def write_model(variant: Variant, path: Path) -> None:
    """Write the model of a variant as an MJCF file, with a comment that it is not the original's."""
    # The original's programs use MuJoCo 2, which knows this attribute only under its old name.
    text = canonical_mjcf(variant).replace('type="directional"', 'directional="true"')
    comment = f"<!-- {REBUILT}: {variant} of imujoco-minari {version('imujoco-minari')} -->\n"
    path.write_text(text + comment, "utf-8")


def _maker(dataset_id: str, variant: Variant, tier: str) -> Actor:
    """Return the installed policy of a dataset; check that it and the present model made the dataset."""
    if not minari_root.exists(dataset_id):
        raise not_in_root(dataset_id)
    actor = load_policy(variant, tier=tier)
    if not isinstance(actor, Actor):
        raise DatasetError(
            f"{dataset_id}: the archive has the policy of each dataset, and {tier} has no network"
        )
    stated = read_metadata(minari_root.dataset_folder(dataset_id) / "data")
    mjcf = mjcf_sha256(canonical_mjcf(variant))
    for part, key, digest in (("policy", "policy_sha256", actor.sha256), ("model", "mjcf_sha256", mjcf)):
        if stated.get(key) != digest:
            raise DatasetError(
                f"{dataset_id} was made with another {part} than the installed one; "
                f"`{making(dataset_id)} --force` makes it again"
            )
    return actor
