"""The loops of matching, compiled: whose descriptors are nearest, in all the picture and in windows of it.

Everything here is exact: no order of summation and no number of threads decides anything.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

NEAR = 3
"""How many keypoints of a window are compared: the nearest ones."""


class Keypoints(NamedTuple):
    """One photo's keypoints, strongest first: `xy` (K, 2) undistorted pixels, centred on the axis.

    `turn` (K,) radians, `size` (K,) pixels, `looks` (K, 128) descriptors and `length` (K,) theirs.
    """

    xy: Floats
    turn: Floats
    size: Floats
    looks: Bytes
    length: Floats


class Cells(NamedTuple):
    """Points by square cells: the corner (2,), a cell's side, columns, rows, `order` (N,) cell by cell.

    `first` (columns · rows + 1,): where each cell begins in `order`.
    """

    low: Doubles
    side: float
    columns: int
    rows: int
    first: Indices
    order: Indices


class Limits(NamedTuple):
    """Of a guided match, in pixels: the window's radius, the distance from its plane and from its line.

    `cosine`: the least of its descriptors.
    """

    window: float
    plane: float
    line: float
    cosine: float


@compiled
def mutual(similarity: Floats, ratio: float) -> Indices:
    """(P, 2) indices of unit vectors that are each other's nearest and clearly nearer than the second.

    `similarity`: (N, M) float32 dot products, C-contiguous, every row's highest positive. `ratio`: of the
    best distance to the second best.
    """
    n, m = similarity.shape
    # Positive floats are in the order of their bits, and whole numbers are compared many at a time.
    bits = similarity.view(np.int32)
    lowest = np.int32(-(2**31))
    highest = np.full(m, lowest, np.int32)
    best, top = np.empty(n, np.int64), np.empty(n, np.int32)
    for i in range(n):
        peak, place = lowest, m
        for j in range(m):
            peak = max(peak, bits[i, j])
            highest[j] = max(highest[j], bits[i, j])
        for j in range(m):
            place = min(place, j if bits[i, j] == peak else m)
        best[i], top[i] = place, peak
    found, count = np.empty((n, 2), np.int64), 0
    for i in range(n):
        k = best[i]
        if top[i] != highest[k]:
            continue
        second = lowest
        for j in range(m):
            second = max(second, lowest if j == k else bits[i, j])
        other = np.array([second]).view(np.float32)[0]
        # For unit vectors d² = 2 − 2s.
        if 1 - similarity[i, k] < ratio * ratio * (1 - other):
            found[count, 0], found[count, 1] = i, k
            count += 1
    return found[:count]


@compiled
def agreeing(pairs: Indices, a: Keypoints, b: Keypoints, bins: int) -> Mask:
    """Which of the pairs (P, 2) agree with most on the turn and the zoom between two pictures: a mask (P,).

    Two of the `bins` to the full circle on either side of the peak agree; a zoom may depart from the median
    by 2 to the power of 0.8.
    """
    n = len(pairs)
    turn, zoom, agree = np.empty(n), np.empty(n), np.zeros(n, np.bool_)
    histogram = np.zeros(bins, np.int64)
    for p in range(n):
        i, j = pairs[p]
        turn[p] = (b.turn[j] - a.turn[i]) / (2 * np.pi) % 1
        zoom[p] = np.log2(b.size[j] / a.size[i])
        histogram[min(int(turn[p] * bins), bins - 1)] += 1
    most, peak = -1, 0.0
    for k in range(bins):
        smooth = histogram[k - 1] + histogram[k] + histogram[(k + 1) % bins]
        if smooth > most:
            most, peak = smooth, (k + 0.5) / bins
    for p in range(n):
        agree[p] = abs((turn[p] - peak + 0.5) % 1 - 0.5) < 2.0 / bins
    if agree.any():
        usual = np.median(zoom[agree])
        for p in range(n):
            agree[p] &= abs(zoom[p] - usual) < 0.8
    return agree


@compiled
def _cells(xy: Floats, side: float) -> Cells:
    """Points (N, 2) by cells of about this side; no more than 256 to the picture's."""
    low = np.array([np.float64(xy[:, 0].min()), np.float64(xy[:, 1].min())])
    wide, high = xy[:, 0].max() - low[0], xy[:, 1].max() - low[1]
    side = max(side, max(wide, high) / 256)
    columns, rows = int(wide / side) + 1, int(high / side) + 1
    first, home = np.zeros(columns * rows + 1, np.int64), np.empty(len(xy), np.int64)
    for k in range(len(xy)):
        home[k] = int((xy[k, 1] - low[1]) / side) * columns + int((xy[k, 0] - low[0]) / side)
        first[home[k] + 1] += 1
    first = np.cumsum(first)
    order, filled = np.empty(len(xy), np.int64), first.copy()
    for k in range(len(xy)):
        order[filled[home[k]]] = k
        filled[home[k]] += 1
    return Cells(low, side, columns, rows, first, order)


@compiled
def _window(x: float, y: float, cells: Cells) -> tuple[int, int, int, int]:
    """Rows from, to and columns from, to of the cells within one cell's side of a point; nan has none."""
    column, row = np.floor((x - cells.low[0]) / cells.side), np.floor((y - cells.low[1]) / cells.side)
    if not (-1 <= column <= cells.columns and -1 <= row <= cells.rows):
        return 0, 0, 0, 0
    c, r = int(column), int(row)
    return max(0, r - 1), min(cells.rows, r + 2), max(0, c - 1), min(cells.columns, c + 2)


@compiled
def _moved(h: Doubles, x: float, y: float) -> tuple[float, float]:
    """Where the homography (3, 3) puts a point."""
    depth = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    return (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / depth, (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / depth


@compiled
def _cosine(a: Keypoints, i: int, b: Keypoints, j: int) -> float:
    """Of two descriptors."""
    total, one, other = np.int32(0), a.looks[i], b.looks[j]
    for k in range(len(one)):
        total += np.int32(one[k]) * np.int32(other[k])
    return float(total / (a.length[i] * b.length[j]))


@compiled
def _off_line(lines: Doubles, p: Floats, q: Floats) -> float:
    """How far q lies from the epipolar line of p, pixels; `lines` (3, 3), all zero when there are none."""
    u = lines[0, 0] * p[0] + lines[0, 1] * p[1] + lines[0, 2]
    v = lines[1, 0] * p[0] + lines[1, 1] * p[1] + lines[1, 2]
    w = lines[2, 0] * p[0] + lines[2, 1] * p[1] + lines[2, 2]
    return float(abs(u * q[0] + v * q[1] + w) / max(np.sqrt(u * u + v * v), 1e-12))


@compiled
def around(h: Doubles, reach: float, ratio: float, turn: float, a: Keypoints, b: Keypoints) -> Indices:
    """(P, 2) indices of keypoints that look alike, no further than `reach` from where h (3, 3) says.

    Clearly more alike than any other there (`ratio` as in `mutual`), and turned by `turn` radians, or
    nearly.
    """
    cells = _cells(b.xy, reach)
    owner, score = np.full(len(b.xy), -1), np.zeros(len(b.xy))
    for i in range(len(a.xy)):
        x, y = _moved(h, a.xy[i, 0], a.xy[i, 1])
        top, second, pick = 0.0, 0.0, -1
        r0, r1, c0, c1 = _window(x, y, cells)
        for r in range(r0, r1):
            begin, end = r * cells.columns + c0, r * cells.columns + c1
            for k in cells.order[cells.first[begin] : cells.first[end]]:
                if (b.xy[k, 0] - x) ** 2 + (b.xy[k, 1] - y) ** 2 > reach * reach:
                    continue
                alike = _cosine(a, i, b, k)
                if alike > top:
                    top, second, pick = alike, top, k
                elif alike > second:
                    second = alike
        if pick < 0 or 1 - top >= ratio * ratio * (1 - second) or top <= score[pick]:
            continue
        if abs((b.turn[pick] - a.turn[i] - turn + np.pi) % (2 * np.pi) - np.pi) < np.pi / 9:
            owner[pick], score[pick] = i, top
    chosen = np.flatnonzero(owner >= 0)
    return np.column_stack((owner[chosen], chosen))


@compiled
def _nearest(
    x: float, y: float, reach: float, xy: Floats, cells: Cells, near: Indices, apart: Doubles
) -> None:
    """Writes the points nearest to (x, y) within `reach` into `near` (−1: none), d² into `apart`."""
    near[:], apart[:] = -1, np.inf
    r0, r1, c0, c1 = _window(x, y, cells)
    for r in range(r0, r1):
        for k in cells.order[cells.first[r * cells.columns + c0] : cells.first[r * cells.columns + c1]]:
            d = (xy[k, 0] - x) ** 2 + (xy[k, 1] - y) ** 2
            if d > reach * reach or d >= apart[-1]:
                continue
            slot = len(near) - 1
            while slot > 0 and (d < apart[slot - 1] or (d == apart[slot - 1] and k < near[slot - 1])):
                near[slot], apart[slot] = near[slot - 1], apart[slot - 1]
                slot -= 1
            near[slot], apart[slot] = k, d


@compiled
def in_windows(planes: Doubles, lines: Doubles, a: Keypoints, b: Keypoints, limits: Limits) -> Indices:
    """(M, 2) indices of keypoints that match where one of the homographies `planes` (H, 3, 3) says.

    `lines`: the fundamental matrix (3, 3), or zeros. Each keypoint matches once, by the earliest plane. The
    matches come plane by plane, a's strongest keypoints first.
    """
    cells = _cells(b.xy, limits.window)
    a_free, b_free = np.ones(len(a.xy), np.bool_), np.ones(len(b.xy), np.bool_)
    found, count = np.empty((min(len(a.xy), len(b.xy)), 2), np.int64), 0
    near, apart = np.empty(NEAR, np.int64), np.empty(NEAR)
    for h in planes:
        owner, score = np.full(len(b.xy), -1), np.zeros(len(b.xy))
        for i in range(len(a.xy)):
            if not a_free[i]:
                continue
            x, y = _moved(h, a.xy[i, 0], a.xy[i, 1])
            _nearest(x, y, limits.window, b.xy, cells, near, apart)
            top, pick, far = limits.cosine, -1, 0.0
            for slot in range(NEAR):
                k = near[slot]
                if k >= 0 and b_free[k]:
                    alike = _cosine(a, i, b, k)
                    if alike > top:
                        top, pick, far = alike, k, apart[slot]
            if pick < 0 or far >= limits.plane**2 or top <= score[pick]:
                continue
            if _off_line(lines, a.xy[i], b.xy[pick]) < limits.line:
                owner[pick], score[pick] = i, top
        chosen = np.flatnonzero(owner >= 0)
        for k in chosen[np.argsort(owner[chosen])]:
            found[count] = owner[k], k
            a_free[owner[k]] = b_free[k] = False
            count += 1
    return found[:count]


@compiled
def supporting(
    pairs: Indices, planes: Doubles, lines: Doubles, a: Keypoints, b: Keypoints, limits: Limits
) -> tuple[int, int]:
    """How many of the pairs (P, 2) lie on their epipolar lines; how many of those on one of the planes."""
    on_lines = on_planes = 0
    for i, j in pairs:
        if _off_line(lines, a.xy[i], b.xy[j]) >= limits.line:
            continue
        on_lines += 1
        for h in planes:
            x, y = _moved(h, a.xy[i, 0], a.xy[i, 1])
            if (b.xy[j, 0] - x) ** 2 + (b.xy[j, 1] - y) ** 2 < limits.plane**2:
                on_planes += 1
                break
    return on_lines, on_planes


@compiled
def _within(h: Doubles, xy: Floats, frame: Floats) -> Mask:
    """Which of the points (N, 2) the homography h puts into the bounding box of the points of a frame."""
    west, east, north, south = frame[:, 0].min(), frame[:, 0].max(), frame[:, 1].min(), frame[:, 1].max()
    inside = np.empty(len(xy), np.bool_)
    for i in range(len(xy)):
        x, y = _moved(h, xy[i, 0], xy[i, 1])
        inside[i] = west <= x <= east and north <= y <= south
    return inside


@compiled
def in_common(h: Doubles, back: Doubles, a: Keypoints, b: Keypoints, pairs: Indices) -> tuple[int, int]:
    """How many of the pairs (P, 2), and at most of either picture's keypoints, both pictures can show.

    By a homography (3, 3) and its inverse.
    """
    seen_by_b, seen_by_a = _within(h, a.xy, b.xy), _within(back, b.xy, a.xy)
    both = 0
    for i, j in pairs:
        both += seen_by_b[i] and seen_by_a[j]
    return both, min(seen_by_b.sum(), seen_by_a.sum())
