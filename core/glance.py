"""What solving needs of a photo's picture: so little that those of a whole mission are kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.decode import Pixels
from core.exposure import shrunk
from core.horizon import shows_sky


@dataclass(frozen=True, slots=True, eq=False)
class Glance:
    """`colours`: what `core.exposure` compares, (h, w, 3) uint8 RGB; `sky`: see `core.horizon.shows_sky`.

    Equal only to itself.
    """

    colours: Pixels
    sky: bool


def glance(thumb: Pixels) -> Glance:
    """What a thumbnail (h, w, 3 or more) uint8, RGB first, comes to."""
    return Glance(np.ascontiguousarray(shrunk(thumb)[..., :3]), shows_sky(thumb))
