"""Gaussian blur of pictures that are blurred already, in nine taps however wide it is; compiled.

A picture blurred by two pixels and more has nothing finer left than what every second or third pixel tells:
taps that far apart see as much of it as taps side by side (à trous, Holschneider 1989).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled_loosely

Floats = NDArray[np.float32]

TAPS = 4


def blur(picture: Floats, sigma: float, out: Floats) -> None:
    """Blurs a `picture` (H, W) into `out`, another one; mirrored at the border.

    From 1.34 px on, `sigma` is at most 0.8 of what the picture is blurred by already. Raises ValueError where
    a picture is smaller than the blur reaches, some four sigmas.
    """
    # The fourth tap lies three sigmas away or more.
    step = math.ceil(3 * sigma / TAPS)
    if TAPS * step >= min(picture.shape):
        raise ValueError(f"a picture of {picture.shape} is too small for a blur of {sigma} px")
    taps = np.exp(-0.5 * (np.arange(TAPS + 1) * step / sigma) ** 2)
    _blur(picture, (taps / (2 * taps.sum() - taps[0])).astype(np.float32), step, out)


@compiled_loosely
def _mix(
    k: Floats, a4: Floats, a3: Floats, a2: Floats, a1: Floats, c: Floats,
    b1: Floats, b2: Floats, b3: Floats, b4: Floats, out: Floats,
) -> None:  # fmt: skip
    """Nine rows weighted by `k` (5,), from the middle one outwards."""
    k0, k1, k2, k3, k4 = k[0], k[1], k[2], k[3], k[4]
    for x in range(len(out)):
        near = k0 * c[x] + k1 * (a1[x] + b1[x]) + k2 * (a2[x] + b2[x])
        out[x] = near + k3 * (a3[x] + b3[x]) + k4 * (a4[x] + b4[x])


@compiled_loosely
def _down(picture: Floats, y: int, k: Floats, d: int, out: Floats) -> None:
    """Row `y` of a picture blurred across its rows."""
    last = len(picture) - 1
    _mix(
        k, picture[abs(y - 4 * d)], picture[abs(y - 3 * d)], picture[abs(y - 2 * d)], picture[abs(y - d)],
        picture[y], picture[last - abs(last - y - d)], picture[last - abs(last - y - 2 * d)],
        picture[last - abs(last - y - 3 * d)], picture[last - abs(last - y - 4 * d)], out,
    )  # fmt: skip


@compiled_loosely
def _across(line: Floats, k: Floats, d: int, out: Floats) -> None:
    """The middle of `line` blurred along itself; its ends become mirrors."""
    rim, w = TAPS * d, len(out)
    for i in range(1, rim + 1):
        line[rim - i], line[rim + w - 1 + i] = line[rim + i], line[rim + w - 1 - i]
    _mix(
        k, line[:w], line[d : d + w], line[2 * d : 2 * d + w], line[3 * d : 3 * d + w],
        line[rim : rim + w], line[5 * d : 5 * d + w], line[6 * d : 6 * d + w],
        line[7 * d : 7 * d + w], line[8 * d : 8 * d + w], out,
    )  # fmt: skip


@compiled_loosely
def _blur(picture: Floats, k: Floats, d: int, out: Floats) -> None:
    height, width = picture.shape
    rim = TAPS * d
    line = np.empty(width + 2 * rim, np.float32)
    for y in range(height):
        _down(picture, y, k, d, line[rim : rim + width])
        _across(line, k, d, out[y])
