"""Where a picture at rising blur differs most from its surroundings (Lowe 2004, 3 and 4); compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled

Floats = NDArray[np.float32]
Rows = tuple[Floats, Floats, Floats]

EDGE_RATIO = 10.0
BORDER = 5
# More than half a pixel, lest an extremum between two pixels is handed to and fro and given up.
STAY = 0.6


@compiled
def _difference(less: Floats, more: Floats, out: Floats) -> None:
    for x in range(len(out)):
        out[x] = more[x] - less[x]


@compiled
def _peaks_of_row(rows: Rows, k: int, least: np.float32, out: NDArray[np.int8]) -> None:
    """Flag in `out` what its six neighbours do not surpass: without branches, so that it is fast.

    `rows`: of all differences (layers + 2, w), the row before, the row itself and the row after.
    """
    up, here, down = rows[0][k], rows[1][k], rows[2][k]
    below, above = rows[1][k - 1], rows[1][k + 1]
    for x in range(1, len(here) - 1):
        v, left, right = here[x], here[x - 1], here[x + 1]
        most = max(max(max(left, right), max(up[x], down[x])), max(max(below[x], above[x]), least))
        fewest = min(min(min(left, right), min(up[x], down[x])), min(min(below[x], above[x]), -least))
        out[x] = 1 if (v >= most) | (v <= fewest) else 0


@compiled
def _is_extremum(rows: Rows, k: int, x: int) -> bool:
    """Whether none of the 26 values around surpasses this one, up or down."""
    sign = np.float32(1 if rows[1][k, x] > 0 else -1)
    v = sign * rows[1][k, x]
    for row in rows:
        for r in range(k - 1, k + 2):
            for c in range(x - 1, x + 2):
                if sign * row[r, c] > v:
                    return False
    return True


@compiled
def _around(stack: Floats, k: int, y: int, x: int, out: Floats) -> None:
    """The 27 differences at and around a place, in `out` (3, 3, 3): layer, row, column."""
    for a in range(3):
        for b in range(3):
            for c in range(3):
                r, q = y + b - 1, x + c - 1
                out[a, b, c] = stack[k + a, r, q] - stack[k + a - 1, r, q]


@compiled
def _refined(stack: Floats, k: int, y: int, x: int, least: float, d: Floats, out: Floats) -> bool:
    """The extremum of a parabola through the surroundings: x, y, layer, contrast into `out`.

    `d` (3, 3, 3): room for the surroundings.
    """
    layers, height, width = len(stack) - 3, stack.shape[1], stack.shape[2]
    for _ in range(5):
        _around(stack, k, y, x, d)
        v = d[1, 1, 1]
        gx, gy = (d[1, 1, 2] - d[1, 1, 0]) / 2, (d[1, 2, 1] - d[1, 0, 1]) / 2
        gs = (d[2, 1, 1] - d[0, 1, 1]) / 2
        xx, yy = d[1, 1, 2] + d[1, 1, 0] - 2 * v, d[1, 2, 1] + d[1, 0, 1] - 2 * v
        ss = d[2, 1, 1] + d[0, 1, 1] - 2 * v
        xy = (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0]) / 4
        xs = (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0]) / 4
        ys = (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1]) / 4
        a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
        determinant = xx * a + xy * b + xs * c
        if determinant == 0:
            return False
        dx = -(a * gx + b * gy + c * gs) / determinant
        dy = -(b * gx + (xx * ss - xs * xs) * gy + (xy * xs - xx * ys) * gs) / determinant
        ds = -(c * gx + (xy * xs - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
        if abs(dx) < STAY and abs(dy) < STAY and abs(ds) < STAY:
            contrast = abs(v + (gx * dx + gy * dy + gs * ds) / 2)
            trace, area = xx + yy, xx * yy - xy * xy
            if contrast < least or area <= 0 or trace * trace * EDGE_RATIO >= (EDGE_RATIO + 1) ** 2 * area:
                return False
            out[0], out[1], out[2], out[3] = x + dx, y + dy, k + ds, contrast
            return True
        if not (abs(dx) < width and abs(dy) < height and abs(ds) < layers):
            return False
        x, y, k = x + int(np.rint(dx)), y + int(np.rint(dy)), k + int(np.rint(ds))
        if not (1 <= k <= layers and BORDER <= x < width - BORDER and BORDER <= y < height - BORDER):
            return False
    return False


@compiled
def extrema(stack: Floats, least: float) -> Floats:
    """(N, 4) x, y, layer, contrast of the extrema of the differences between the layers of `stack`
    (layers + 3, h, w), by row, then layer, then column; `least`: their contrast.
    """
    depth, height, width = stack.shape
    out, n, cube = np.empty((1024, 4), np.float32), 0, np.empty((3, 3, 3), np.float32)
    # Three rows of all differences at a time: they stay in the cache.
    ring = np.empty((3, depth - 1, width), np.float32)
    eights = np.zeros((width + 7) // 8, np.int64)
    flags = eights.view(np.int8)
    for y in range(BORDER - 1, height - BORDER + 1):
        for k in range(depth - 1):
            _difference(stack[k, y], stack[k + 1, y], ring[y % 3, k])
        if y <= BORDER:
            continue
        rows = (ring[(y - 2) % 3], ring[(y - 1) % 3], ring[y % 3])
        for k in range(1, depth - 2):
            _peaks_of_row(rows, k, np.float32(least / 2), flags)
            for eight in range(len(eights)):
                if eights[eight] == 0:
                    continue
                for x in range(max(8 * eight, BORDER), min(8 * eight + 8, width - BORDER)):
                    if flags[x] == 0 or not _is_extremum(rows, k, x):
                        continue
                    if n == len(out):
                        out = np.concatenate((out, np.empty_like(out)))
                    n += _refined(stack, k, y - 1, x, least, cube, out[n])
    return out[:n].copy()
