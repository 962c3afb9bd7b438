"""Where one photo ends and the next begins: seams run where photos agree.

A car that drives, a tree that leans another way: where photos disagree, a seam would leave half of each. Each
photo starts from the ground that it shows much better than the others and spreads from there over the
contested ground, fast where photos disagree and slowly where they are alike: so whatever they disagree about
falls to one photo as a whole, and the photos meet where it does not show. Seen from a distance this is a
geodesic Voronoi diagram; as it spreads `REACH_CELLS` at most, it is the same in every window.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.warp import FULL, INSIDE, Int16, Int32

Costs = NDArray[np.float32]

REACH_CELLS = 16
"""No knot farther than this changes where a seam runs."""
CONTEST = 0.5
"""Photos may contest ground where w and the others' largest weight m differ by less than this × (w + m)."""
ALIKE = 20.0
"""Grey levels by which photos may differ and are still rather alike."""
STEP = 0.2
LEAST_STEP = 0.001
"""What a step from knot to knot costs where photos are alike, and at least; a contest is 2 wide."""
_FAR = np.float32(1000)


def settle(weights: Int32, spots: Int16) -> Int32:
    """Weights (photos, rows, cols) whose largest one tells whose ground it is, with good seams.

    `weights`, `spots` (photos, rows, cols, 3): as `core.warp.Views` has them. Knots closer than
    `REACH_CELLS` + 1 to the border are not settled yet.
    """
    out = weights.copy()
    cost = np.full(weights.shape, _FAR, np.float32)
    step = np.zeros(weights.shape[1:], np.float32)
    _claim(weights, spots, cost, step)
    # Things end a little beyond the knots that see them.
    step = np.asarray(cv2.erode(step, np.ones((3, 3), np.uint8)), np.float32)
    _spread(cost, step)
    _weigh(cost, out)
    return out


@compiled
def _claim(weights: Int32, spots: Int16, cost: Costs, step: Costs) -> None:
    """Each photo's claim on each knot, −1 (its own) … 1 (nothing to seek there), and how dear a step is."""
    n, rows, cols = weights.shape
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for y in range(rows):
        for x in range(cols):
            first, second, best = 0, 0, -1
            for k in range(n):
                w = weights[k, y, x]
                if w > first:
                    first, second, best = w, first, k
                elif w > second:
                    second = w
            if first < INSIDE:
                continue
            low[:], high[:] = 1 << 20, -(1 << 20)
            for k in range(n):
                w = weights[k, y, x]
                if w < INSIDE:
                    continue
                m = second if k == best else first
                claim = np.float32((m - w) / (m + w))
                if claim <= CONTEST:
                    cost[k, y, x] = claim
                    for c in range(3):
                        low[c] = min(low[c], spots[k, y, x, c])
                        high[c] = max(high[c], spots[k, y, x, c])
            apart = max((high - low).max(), 0) / (16 * ALIKE)
            alike = 1 / (1 + apart * apart * apart * apart)
            step[y, x] = LEAST_STEP + STEP * alike


@compiled
def _spread(cost: Costs, step: Costs) -> None:
    """Claims pass from knot to knot, where the photo may claim at all.

    To the four nearest and to all eight around by turns: so fronts are octagons, and seams no squares.
    """
    for k in range(len(cost)):
        top, bottom, left, right = _contested(cost[k])
        rows, cols = bottom - top, right - left
        if rows <= 0:
            continue
        held, across = np.full((rows + 2, cols), _FAR), np.full((rows + 2, cols), _FAR)
        own = cost[k, top:bottom, left:right].copy()
        dear = step[top:bottom, left:right].copy()
        for y in range(rows):
            for x in range(cols):
                dear[y, x] += _FAR if own[y, x] >= _FAR else np.float32(0)
        for turn in range(REACH_CELLS):
            for y in range(rows):
                line, still, wide = own[y], held[y + 1], across[y + 1]
                still[:] = line
                wide[0], wide[cols - 1] = min(line[0], line[1]), min(line[cols - 2], line[cols - 1])
                for x in range(1, cols - 1):
                    wide[x] = min(min(line[x - 1], line[x]), line[x + 1])
            beside = across if turn % 2 else held
            for y in range(rows):
                line, price, above, level, below = own[y], dear[y], beside[y], across[y + 1], beside[y + 2]
                for x in range(cols):
                    line[x] = min(line[x], min(min(above[x], level[x]), below[x]) + price[x])
        cost[k, top:bottom, left:right] = own


@compiled
def _contested(cost: Costs) -> tuple[int, int, int, int]:
    """From and to which row, from and to which column a photo contests ground, and one knot around."""
    rows, cols = cost.shape
    top, bottom, left, right = rows, 0, cols, 0
    for y in range(rows):
        for x in range(cols):
            if abs(cost[y, x]) <= CONTEST:
                top, bottom, left, right = min(top, y), y + 1, min(left, x), max(right, x + 1)
    return (
        max(top - REACH_CELLS, 0),
        min(bottom + REACH_CELLS, rows),
        max(left - REACH_CELLS, 0),
        min(right + REACH_CELLS, cols),
    )


@compiled
def _weigh(cost: Costs, weights: Int32) -> None:
    """The less a knot costs a photo, the more it weighs there; what lies outside of photos stays as it is."""
    half = np.float32((FULL - INSIDE) // 2)
    for k in range(len(cost)):
        for y in range(cost.shape[1]):
            for x in range(cost.shape[2]):
                if weights[k, y, x] >= INSIDE:
                    claim = min(max(cost[k, y, x], np.float32(-1)), np.float32(1))
                    weights[k, y, x] = INSIDE + np.int32(half * (1 - claim))
