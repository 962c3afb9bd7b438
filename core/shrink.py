"""Pictures made smaller by the areas that their pixels cover, four times as fast as OpenCV where it matters.

That is between one and two pixels for one: what is left to do after a JPEG was decoded at a half, a quarter
or an eighth.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

TAPS = 3
"""An interval of at most two pixels touches no more."""


def shrinks_by_area(picture: Bytes, size: tuple[int, int]) -> bool:
    """Whether `shrunk_by_area` can make this (w, h) of the picture (H, W, 3)."""
    sides = tuple(zip(picture.shape[1::-1], size, strict=True))
    return all(n >= TAPS and m <= n <= 2 * m for n, m in sides)


def shrunk_by_area(picture: Bytes, size: tuple[int, int]) -> Bytes:
    """A colour picture (H, W, 3) as (h, w, 3), every pixel the mean of what it covers, rounded.

    `size`: (w, h), neither smaller than a half of the picture's nor larger than it.
    """
    height, width = picture.shape[:2]
    out = np.empty((size[1], size[0], 3), np.uint8)
    picture = np.ascontiguousarray(picture)
    _shrink(picture, *_shares(height, size[1]), *_shares(width, size[0]), out)
    return out


@lru_cache(maxsize=64)
def _shares(n: int, m: int) -> tuple[Indices, Floats]:
    """Of each of `m` pixels that `n` become: the first it is made of (m,), and how much of each (m, TAPS)."""
    start = np.arange(m) * (n / m)
    first = np.minimum(start.astype(np.int64), n - TAPS)
    pixel = first[:, None] + np.arange(TAPS)
    covered = np.minimum(pixel + 1, start[:, None] + n / m) - np.maximum(pixel, start[:, None])
    shares = np.maximum(covered, 0) * (m / n)
    return first, shares.astype(np.float32)


@compiled
def _shrink(picture: Bytes, top: Indices, down: Floats, left: Indices, across: Floats, out: Bytes) -> None:
    height, width = out.shape[:2]
    n = picture.shape[1] * 3
    rows = picture.reshape(picture.shape[0], n)
    line = np.empty(n, np.float32)
    for y in range(height):
        a, b, c = down[y, 0], down[y, 1], down[y, 2]
        first, second, third = rows[top[y]], rows[top[y] + 1], rows[top[y] + 2]
        for i in range(n):
            line[i] = a * np.float32(first[i]) + b * np.float32(second[i]) + c * np.float32(third[i])
        for x in range(width):
            d, e, f = across[x, 0], across[x, 1], across[x, 2]
            at = left[x] * 3
            for channel in range(3):
                i = at + channel
                mean = d * line[i] + e * line[i + 3] + f * line[i + 6]
                out[y, x, channel] = np.uint8(mean + np.float32(0.5))
