"""How sharp a photo is, place by place, so that a blurred one gives way to its neighbours.

How much the finest detail bends over that of coarser detail: the light, the ground and the haze change both
alike, blur only the former.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.warp import INSIDE, Int32

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

_BEND = np.array([[-0.5, 1.0, -0.5]], np.float32)
LEAST_CONTRAST = 1.5
"""Grey levels of coarser detail below which nothing can be said: water is not blurred."""
CLEARLY = 0.5
"""A photo gives way where it is less than this times as sharp as another one that sees the place well."""
WELL = 8
"""Seeing a place well: a weight not smaller by more than this factor."""


def sharpness(grey: Bytes, size: tuple[int, int]) -> Bytes:
    """1 … 255, the sharper the more, or 0 where it cannot be told; (h, w) uint8.

    `grey`: (H, W) uint8, all photos shrunk alike; `size`: (w, h).
    """
    whole = grey.astype(np.float32)
    # A hand or a gimbal that moves blurs along one direction only: the blurrier one tells.
    bent = [np.asarray(cv2.filter2D(whole, -1, bend), np.float32) for bend in (_BEND, _BEND.T)]
    # At half the size wide blurs cost a third; what halving blurs, 0.25 px², is taken off their variance.
    half = cv2.resize(whole, tuple(max(1, n // 2) for n in whole.shape[::-1]), interpolation=cv2.INTER_AREA)
    fine, broad = (cv2.GaussianBlur(half, (0, 0), np.sqrt((s**2 - 0.25) / 4)) for s in (2.0, 5.0))
    coarse = _energy(np.asarray(fine - broad, np.float32), size)
    ratio = np.sqrt(np.minimum(*(_energy(band, size) for band in bent)) / np.maximum(coarse, 1e-6))
    told = np.clip(np.rint(64 * ratio), 1, 255)
    return np.where(coarse > LEAST_CONTRAST**2, told, 0).astype(np.uint8)


def _energy(band: Floats, size: tuple[int, int]) -> Floats:
    return np.asarray(
        cv2.blur(cv2.resize(band * band, size, interpolation=cv2.INTER_AREA), (9, 9)), np.float32
    )


@compiled
def give_way(weights: Int32, sharp: Bytes) -> None:
    """Lessens, in place, the weights (photos, rows, cols) of photos that are blurred where others are sharp.

    `sharp`: the `sharpness` of each photo at the same knots.
    """
    n, rows, cols = weights.shape
    top, best = np.empty(cols, np.int32), np.empty(cols, np.int32)
    for y in range(rows):
        top[:], best[:] = 0, 1
        for k in range(n):
            line = weights[k, y]
            for x in range(cols):
                top[x] = max(top[x], line[x])
        for k in range(n):
            line, told = weights[k, y], sharp[k, y]
            for x in range(cols):
                if line[x] >= INSIDE and WELL * line[x] >= top[x]:
                    best[x] = max(best[x], told[x])
        for k in range(n):
            line, told = weights[k, y], sharp[k, y]
            for x in range(cols):
                w, s = line[x], told[x] / (CLEARLY * best[x])
                if w >= INSIDE and 0 < s < 1:
                    line[x] = INSIDE + np.int32((w - INSIDE) * s * s * s * s)
