"""The physical quantities in which the original's models differ from our models of the same id."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import mujoco

from imujoco_minari.envs.differences import Difference, differing, model_differences
from imujoco_minari.envs.external_mjcf import canonical_external_mjcf
from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf
from imujoco_minari.errors import ImujocoError
from imujoco_minari.importing.archive import Archive
from imujoco_minari.storage import file_format, minari_root
from imujoco_minari.variants import Variant, catalogue
from imujoco_minari.variants.original import ORIGINAL, OriginalVariant


@dataclass(frozen=True)
class Departure:
    """How one of the original's models compares with ours.

    Attributes:
        variant: the id in the archive.
        against: our variant it is compared with: the one of the same id, else the base robot.
        differences: quantities that differ, ours before the original's.
        error: why the model could not be compared; empty when it could.
    """

    variant: str
    against: str
    differences: tuple[Difference, ...] = ()
    error: str = ""

    @property
    def same_id(self) -> bool:
        """Whether our grammar has a variant of this id."""
        return self.variant == self.against


@dataclass(frozen=True)
class Coverage:
    """Which ids the two catalogues share."""

    both: tuple[str, ...]
    only_original: tuple[str, ...]
    only_ours: tuple[str, ...]


def departures_of_archive(archive: Archive, variants: Iterable[OriginalVariant]) -> Iterator[Departure]:
    """Compare models of an archive with ours; a model that cannot be read is reported as such."""
    for variant in variants:
        try:
            yield departure(variant, archive.mjcf(variant)[1])
        except ImujocoError as error:
            yield Departure(str(variant), _against(variant), error=str(error))


def departure(variant: OriginalVariant, mjcf: str) -> Departure:
    """Compare the canonical text of an original's model with ours."""
    ours = compile_mjcf(canonical_mjcf(Variant.parse(_against(variant))))
    theirs = compile_mjcf(mjcf)
    try:
        found = model_differences(ours, theirs) + differing(_more_quantities(ours, theirs))
    except KeyError as error:
        return Departure(str(variant), _against(variant), error=f"{variant}: has other names: {error}")
    return Departure(str(variant), _against(variant), tuple(found))


def coverage(variants: Iterable[OriginalVariant], robot: str | None, category: str | None) -> Coverage:
    """Return which ids are in both catalogues, and which are in one of them only."""
    theirs, ours = set(map(str, variants)), set(map(str, catalogue(robot, category)))
    return Coverage(*(tuple(sorted(ids)) for ids in (theirs & ours, theirs - ours, ours - theirs)))


def common_differences(departures: Iterable[Departure]) -> dict[str, dict[Difference, int]]:
    """Return the differences that most variants of a robot share, with the number of these variants.

    Where gym's model of the robot differs from ours, every variant of the robot differs too.
    """
    robots: dict[str, list[Departure]] = {}
    for departure in departures:
        robots.setdefault(departure.variant.partition("-")[0], []).append(departure)
    shared: dict[str, dict[Difference, int]] = {}
    for robot, found in robots.items():
        for difference, count in Counter(each for d in found for each in d.differences).items():
            if count > 2 and 2 * count > len(found):
                shared.setdefault(robot, {})[difference] = count
    return shared


def published_models() -> dict[OriginalVariant, str]:
    """Return the models of the original's datasets that are in the Minari root, by their variants."""
    models: dict[OriginalVariant, str] = {}
    for folder in sorted((minari_root.datasets_root() / ORIGINAL).glob("*-v0")):
        try:
            with h5py.File(file_format.main_file(folder / "data"), "r") as file:
                variant = OriginalVariant.parse(str(file.attrs["variant"]))
                # A dataset in the root may come from anywhere, for example by `imujoco pull`.
                text = canonical_external_mjcf(str(file.attrs["mjcf"]), variant.robot, folder.name)
        except (OSError, KeyError, ImujocoError):
            continue
        models.setdefault(variant, text)
    return models


def _against(variant: OriginalVariant) -> str:
    return str(variant.ours or variant.base)


def _more_quantities(ours: mujoco.MjModel, theirs: mujoco.MjModel) -> Iterator[tuple[str, float, float, str]]:
    """Yield the quantities that no category of ours changes, so ``show`` does not list them."""
    anchors = _anchors(ours), _anchors(theirs)
    # The original's model has been checked to have our joints and actuators, in our order.
    for i in range(ours.njnt):
        name = ours.joint(i).name
        yield f"stiffness of {name}", ours.jnt_stiffness[i], theirs.jnt_stiffness[i], "N m/rad"
        for axis, number in (("x", 0), ("z", 2)):
            first, second = (places[i][number] for places in anchors)
            yield f"{axis} of {name} in the rest pose", first, second, "m"
    yield "timestep", ours.opt.timestep, theirs.opt.timestep, "s"


def _anchors(model: mujoco.MjModel) -> Any:
    """Return where the joints are in the rest pose, ``(joints, 3)`` in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xanchor.copy()
