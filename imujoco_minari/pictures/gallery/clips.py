"""The gallery's pictures: a short clip and a portrait of each variant.

Each picture has a key, the digest of everything that decides it (model, policy, size, seconds). A later run
draws only pictures with a new key. It needs no OpenGL if there are none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from imujoco_minari.envs.mjcf import canonical_mjcf, compile_mjcf, mjcf_sha256
from imujoco_minari.errors import PolicyNotFoundError
from imujoco_minari.pictures.gallery.entries import Clip
from imujoco_minari.pictures.rendering.files import write_picture, write_video
from imujoco_minari.pictures.rendering.film import frames, stride
from imujoco_minari.pictures.rendering.framing import Capsules, capsules, follow
from imujoco_minari.pictures.rendering.motion import Motion, perform
from imujoco_minari.pictures.rendering.portraits import stance
from imujoco_minari.pictures.rendering.studio import Studio
from imujoco_minari.policies import Policy, load_policy
from imujoco_minari.policies.tiers import RANDOM
from imujoco_minari.variants import EXPERT, Variant, catalogue

SIZE = (320, 240)
SECONDS, FRAMES_PER_SECOND, QUALITY = 4.0, 20.0, 30
# An episode that ends at once would flicker in a loop, so its last frame stays for a second.
REST_SECONDS = 1.0
# Increase this number when the look of the pictures changes.
STYLE = 2


class ClipMaker:
    """Draws clips and portraits into the folder of a site. It is a context manager.

    Args:
        folder: the site's folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._studio: Studio | None = None

    def __enter__(self) -> ClipMaker:
        return self

    def __exit__(self, *raised: object) -> None:
        if self._studio is not None:
            self._studio.close()

    def draw(self, variant: Variant, known: Mapping[str, Any]) -> tuple[Clip, str, bool]:
        """Draw a variant's clip and portrait, unless an earlier run has drawn the same.

        Args:
            variant: the variant.
            known: ``key`` and ``clip`` of an earlier run, or empty.

        Returns:
            The content of the clip, its key, and whether it was drawn now.

        Raises:
            RenderingError: if no OpenGL works.
            StorageError: if a file cannot be written.
            PolicyError: if the variant's policy cannot be read.
        """
        policy, tier = choose_policy(variant)
        key = clip_key(variant, policy)
        clip_path, portrait_path = clip_file(self._folder, variant), portrait_file(self._folder, variant)
        if known.get("key") == key and clip_path.is_file() and portrait_path.is_file():
            return Clip(**known["clip"]), key, False
        motion = perform(variant, policy, seconds=SECONDS)
        self._write_clip(motion, clip_path)
        self._write_portrait(variant, portrait_path)
        return Clip(tier, motion.duration, motion.total, motion.terminated), key, True

    @property
    def studio(self) -> Studio:
        """The renderer. It is made at the first use."""
        if self._studio is None:
            self._studio = Studio(*SIZE, fine=False)
        return self._studio

    def _write_clip(self, motion: Motion, path: Path) -> None:
        every = stride([motion], FRAMES_PER_SECOND)
        last = len(motion.rewards)
        rest = round(REST_SECONDS / motion.timestep) if motion.terminated else 0
        steps = range(0, last + rest + 1, every)
        write_video(
            path,
            frames([motion], self.studio, steps, captions=False),
            1.0 / (every * motion.timestep),
            quality=QUALITY,
        )

    def _write_portrait(self, variant: Variant, path: Path) -> None:
        # The variants of other lengths are framed too, so all portraits of a robot have the same distance.
        seen = [
            _stance_capsules(variant),
            *(_stance_capsules(each) for each in catalogue(variant.robot, "length")),
        ]
        camera = follow(seen, self.studio.aspect, 1.0)[0]
        shot = next(self.studio.shoot(variant, [stance(variant)], camera))
        write_picture(path, Image.fromarray(np.ascontiguousarray(shot)))


@cache
def _stance_capsules(variant: Variant) -> Capsules:
    """Return the capsules of a variant in its stance."""
    return capsules(compile_mjcf(canonical_mjcf(variant)), stance(variant)[None])


def choose_policy(variant: Variant) -> tuple[Policy, str]:
    """Return the policy of a variant's clip and its tier: the expert, or random if there is none."""
    try:
        return load_policy(variant), EXPERT
    except PolicyNotFoundError:
        return load_policy(variant, tier=RANDOM), RANDOM


def clip_key(variant: Variant, policy: Policy) -> str:
    """Return the digest of everything that decides a variant's pictures."""
    parts = (
        STYLE,
        SIZE,
        SECONDS,
        FRAMES_PER_SECOND,
        QUALITY,
        REST_SECONDS,
        mjcf_sha256(canonical_mjcf(variant)),
        policy.sha256,
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def clip_file(folder: Path, variant: Variant) -> Path:
    """Return the path of a variant's clip in the site."""
    return folder / "clips" / f"{variant}.mp4"


def portrait_file(folder: Path, variant: Variant) -> Path:
    """Return the path of a variant's portrait in the site."""
    return folder / "portraits" / f"{variant}.webp"
