"""What a photo would look like had it been exposed otherwise.

A camera is taken to show the light L as y = 256 L / (1 + L) (Reinhard et al. 2002, eq. 3): in proportion
where it is dark, compressed towards white. A gain multiplies the light: shadows follow it, white stays white,
nothing is clipped; and the logarithm of L = y / (256 − y) changes by the same amount everywhere.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.geometry import Array

Rgb = NDArray[np.uint8]
Gain = tuple[float, float, float]


def log_light(colour: Array) -> Array:
    """The logarithm of the light that is shown as these grey levels, between 0 and 256; any shape."""
    return np.asarray(np.log(colour / (256 - colour)))


def relit(image: Rgb, gain: Gain) -> Rgb:
    """The picture (h, w, 3 or more) with its first three channels' light multiplied by `gain`."""
    out = image.copy()
    show(image, curves(gain), out)
    return out


@lru_cache(maxsize=1024)
def curves(gain: Gain) -> Rgb:
    """Which grey level each of the 256 turns into when its light is multiplied: (3, 256) uint8."""
    level = np.arange(256) + 0.5
    times = np.array(gain)[:, None]
    return np.asarray(np.floor(256 * times * level / (256 + (times - 1) * level)).clip(0, 255), np.uint8)


@compiled
def show(image: Rgb, table: Rgb, out: Rgb) -> None:
    """Look up the first three channels of `image` (h, w, 3 or more) in `curves`, into `out` of its size."""
    for y in range(image.shape[0]):
        line, to = image[y], out[y]
        for x in range(image.shape[1]):
            to[x, 0] = table[0, line[x, 0]]
            to[x, 1] = table[1, line[x, 1]]
            to[x, 2] = table[2, line[x, 2]]


@compiled
def lit(level: float, gain: float) -> float:
    """What a grey level, 0 … 256, turns into when its light is multiplied by `gain`."""
    return 256 * gain * level / (256 + (gain - 1) * level)
