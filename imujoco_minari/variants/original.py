"""The variants of the original archive: their ids, and the names of their files.

The archive's grammar of ids is ours, but its bodies and percents are its own and need not be in our
catalogue. The model of such a variant does not follow from its id: the dataset stores its MJCF text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from imujoco_minari.errors import VariantError
from imujoco_minari.variants import BASE, MAX_PERCENT, NAMESPACE, ROBOTS, Change, Variant
from imujoco_minari.variants.ids import split_name

ORIGINAL = "imujoco-original"
RECOLLECTED = "recollected"
ORIGINAL_CATEGORIES = ("mass", "joint", "length", "friction")
# The attribute that marks episodes of variants that are not in our grammar; its value is ORIGINAL.
CATALOGUE = "catalogue"

# A model with these words in a comment is of an archive that this package wrote in the original's layout.
REBUILT = "iMuJoCo, rebuilt"
# The parts of the archive -> the beginning and the end of its file names, around a variant's id.
PARTS: Mapping[str, tuple[str, str]] = {
    "xml": ("", ".xml"),
    "policies": ("sac-", ".zip"),
    "dataset": ("sac-", ".npz"),
}

_ID = re.compile(
    rf"(?P<robot>{'|'.join(ROBOTS)})-(?P<category>{'|'.join(ORIGINAL_CATEGORIES)})(?P<sign>inc|dec)"
    r"_(?P<percent>[0-9]{1,5})_(?P<body>[A-Za-z0-9_]{1,40})",
    re.ASCII,
)


@dataclass(frozen=True, order=True, repr=False)
class OriginalVariant(Variant):
    """A variant of the original archive. Its body is the archive's word, whatever our catalogue lists.

    Raises:
        VariantError: when the percent leaves nothing.
    """

    namespace: ClassVar[str] = ORIGINAL

    def __post_init__(self) -> None:
        if self.changes and not -100 < self.percent <= MAX_PERCENT:
            raise VariantError(
                f"percent {self.percent} is out of range; valid: above -100, up to {MAX_PERCENT}"
            )

    @classmethod
    def parse(cls, text: str | Variant) -> OriginalVariant:
        """Return the variant that ``text``, a file's stem in the archive, names. A variant stays as it is.

        Raises:
            VariantError: when it is not ``<robot>-<category><inc|dec>_<percent>_<body>`` or ``<robot>-base``.
        """
        if isinstance(text, cls):
            return text
        text = str(text)
        robot, _, rest = text.partition("-")
        if rest == BASE and robot in ROBOTS:
            return cls(robot)
        match = _ID.fullmatch(text)
        if match is None:
            raise VariantError(
                f"{text[:80]!r} is not a variant of the original archive; "
                "valid: <robot>-<category><inc|dec>_<percent>_<body>, as in hopper-massdec_25_leggeom"
            )
        percent = int(match["percent"]) * (1 if match["sign"] == "inc" else -1)
        return cls(match["robot"], (Change(match["category"], percent, match["body"]),))

    @property
    def ours(self) -> Variant | None:
        """The variant of the same id in our grammar; None where ours has no such body or percent."""
        try:
            return Variant.parse(str(self))
        except VariantError:
            return None

    @property
    def mjcf_names(self) -> tuple[str, ...]:
        """Names of what our variant of the same id changes; empty where there is none."""
        return self.ours.mjcf_names if self.ours else ()


def file_name(part: str, variant: Variant) -> str:
    """Return the path of a variant's file in the archive.

    Example:
        >>> file_name("dataset", Variant.parse("hopper-massdec_25_leggeom"))
        'dataset/sac-hopper-massdec_25_leggeom.npz'
    """
    return f"{part}/{PARTS[part][0]}{variant}{PARTS[part][1]}"


def names_variant(dataset_id: str) -> bool:
    """Return whether a dataset id is the id of a variant's data of some tier, ours or the archive's."""
    namespace, _, name = dataset_id.partition("/")
    kind = {ORIGINAL: OriginalVariant, NAMESPACE: Variant}.get(namespace)
    try:
        return kind is not None and bool(kind.parse(split_name(name.rpartition("-v")[0])[0]))
    except VariantError:
        return False


def variant_of(attributes: Mapping[str, Any]) -> Variant:
    """Return the variant that the attributes of a dataset or an episode name, ours or the archive's.

    Raises:
        VariantError: when they name none.
        KeyError: when they have no ``variant``.
    """
    kind = OriginalVariant if attributes.get(CATALOGUE, "") == ORIGINAL else Variant
    return kind.parse(str(attributes["variant"]))
