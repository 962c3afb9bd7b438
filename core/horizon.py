"""Whether a photo shows the sky: nothing else tells a horizon shot that carries no gimbal angle."""

from __future__ import annotations

import numpy as np

from core.decode import Pixels

STRIP = 0.25
"""Share of the picture, from one side inwards, that a sky would fill at least."""
EVEN, BRIGHTER = 12.0, 60.0
"""Grey levels: how little a sky varies, and how much brighter than the ground opposite it is."""


def shows_sky(thumb: Pixels) -> bool:
    """Whether one side of a thumbnail (h, w, 3) uint8 RGB is an even brightness far above the other half's.

    All four sides are tried, for cameras are mounted any way round. Ground is seldom so: a field as even as a
    sky has no half that is so much darker.
    """
    grey = np.asarray(thumb[..., :3], np.float32).mean(2)
    for turned in (grey, grey[::-1], grey.T, grey.T[::-1]):
        strip, opposite = turned[: max(1, int(STRIP * len(turned)))], turned[len(turned) // 2 :]
        if strip.std() < EVEN and strip.mean() - opposite.mean() > BRIGHTER:
            return True
    return False
