"""The colours of land from the air: how each use of a parcel looks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from core.landscape import Colour


@dataclass(frozen=True, slots=True)
class Style:
    """How one parcel looks. Two RGB colours drift into each other; rows are `row_m` apart.

    `row_depth`, `tram` (wheel tracks): relative darkening; `rough`: fine texture 0–1; `life`: 0 = strictly
    periodic and even, 1 = natural.
    """

    colour: Colour
    other: Colour
    row_m: float = 1.0
    row_depth: float = 0.0
    tram: float = 0.0
    rough: float = 0.8
    life: float = 1.0

    @staticmethod
    def bare() -> Style:
        """What lies beyond the planned land."""
        return Style((120, 132, 84), (136, 138, 96))

    def of(self, seed: int, index: int, monotone: bool) -> Style:
        """This style as it fell out on parcel `index`."""
        rng = np.random.default_rng((seed, 6, index))
        light = rng.uniform(0.86, 1.12)
        warm = rng.normal(0, 5)
        first, second = (_tinted(c, light, warm) for c in (self.colour, self.other))
        changed = replace(self, colour=first, other=second, row_m=self.row_m * rng.uniform(0.85, 1.25))
        if monotone:
            return replace(changed, life=0.0, rough=0.12, row_depth=self.row_depth * 0.8)
        return changed


def _tinted(colour: Colour, light: float, warm: float) -> Colour:
    r, g, b = colour
    return (_level(r * light + warm), _level(g * light), _level(b * light - warm))


def _level(value: float) -> int:
    return int(min(max(value, 0), 255))


STYLES: dict[str, Style] = {
    "wheat": Style((196, 170, 112), (176, 156, 98), 1.6, 0.06, 0.14, 0.55),
    "barley": Style((152, 164, 92), (178, 172, 106), 2.0, 0.06, 0.16, 0.6),
    "maize": Style((92, 124, 58), (74, 106, 50), 0.75, 0.2, 0.0, 0.95),
    "rape": Style((204, 192, 74), (174, 176, 72), 2.2, 0.05, 0.14, 0.65),
    "plough": Style((134, 106, 80), (112, 88, 68), 0.9, 0.14, 0.0, 0.9),
    "stubble": Style((190, 168, 124), (168, 146, 106), 3.0, 0.1, 0.12, 0.7),
    "meadow": Style((112, 136, 74), (132, 144, 84), 4.2, 0.05, 0.0, 0.8),
    "pasture": Style((122, 142, 82), (150, 150, 96), 1.0, 0.0, 0.0, 1.0),
    "beet": Style((98, 132, 66), (120, 112, 76), 1.0, 0.16, 0.12, 0.85),
    "forest": Style((62, 74, 42), (80, 78, 50), 1.0, 0.0, 0.0, 1.0),
    "orchard": Style((124, 140, 80), (146, 144, 96), 5.5, 0.08, 0.0, 0.9),
    "lots": Style((122, 138, 86), (142, 140, 100), 1.0, 0.0, 0.0, 0.9),
    "pitch": Style((108, 134, 72), (122, 138, 80), 1.0, 0.0, 0.0, 0.8),
}

LEAVES = np.array(
    [[62, 88, 44], [78, 104, 52], [96, 114, 56], [70, 92, 58], [112, 116, 64], [126, 104, 60]], float
)


def tree_colour(tone: float) -> Colour:
    """The leaves' colour for a tree's tone, 0–1; the autumnal end is rare."""
    at = tone**1.6 * (len(LEAVES) - 1.001)
    low = int(at)
    r, g, b = LEAVES[low] * (1 - (at - low)) + LEAVES[low + 1] * (at - low)
    return (int(r), int(g), int(b))
