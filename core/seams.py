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
    first, second = np.empty(cols, np.int32), np.empty(cols, np.int32)
    low, high = np.empty((cols, 3), np.int32), np.empty((cols, 3), np.int32)
    for y in range(rows):
        first[:], second[:], low[:], high[:] = 0, 0, 1 << 20, -(1 << 20)
        for k in range(n):
            line = weights[k, y]
            for x in range(cols):
                second[x] = max(second[x], min(first[x], line[x]))
                first[x] = max(first[x], line[x])
        for k in range(n):
            for x in range(cols):
                w = weights[k, y, x]
                if w < INSIDE:
                    continue
                m = second[x] if w == first[x] else first[x]
                claim = np.float32((m - w) / (m + w))
                if claim <= CONTEST:
                    cost[k, y, x] = claim
                    for c in range(3):
                        low[x, c] = min(low[x, c], spots[k, y, x, c])
                        high[x, c] = max(high[x, c], spots[k, y, x, c])
        for x in range(cols):
            if first[x] >= INSIDE:
                widest = 0
                for c in range(3):
                    widest = max(widest, high[x, c] - low[x, c])
                apart = widest / (16 * ALIKE)
                alike = 1 / (1 + apart * apart * apart * apart)
                step[y, x] = LEAST_STEP + STEP * alike


@compiled
def _spread(cost: Costs, step: Costs) -> None:
    """Claims pass from knot to knot, where the photo may claim at all.

    To the four nearest and to all eight around by turns: so fronts are octagons, and seams no squares.
    """
    height, width = step.shape
    for k in range(len(cost)):
        top, bottom, left, right = _contested(cost[k])
        rows, cols = bottom - top, right - left
        if rows <= 0:
            continue
        old, dear = np.full((rows + 2, cols + 2), _FAR), np.empty((rows, cols), np.float32)
        for y in range(rows):
            for x in range(cols):
                old[y + 1, x + 1] = own = cost[k, top + y, left + x]
                dear[y, x] = step[top + y, left + x] + (_FAR if own >= _FAR else np.float32(0))
        new = old.copy()
        for turn in range(REACH_CELLS):
            # What is not settled now is too near the border to change what will be.
            first, last = max(turn + 1 - top, 0), min(height - 1 - turn - top, rows)
            start, stop = max(turn + 1 - left, 0), min(width - 1 - turn - left, cols)
            for y in range(first, last):
                above, here, below = old[y, start:], old[y + 1, start:], old[y + 2, start:]
                out, price = new[y + 1, start + 1 :], dear[y, start:]
                for x in range(stop - start):
                    near = min(min(above[x + 1], below[x + 1]), min(here[x], here[x + 2]))
                    if turn % 2:
                        near = min(near, min(min(above[x], above[x + 2]), min(below[x], below[x + 2])))
                    out[x] = min(here[x + 1], near + price[x])
            old, new = new, old
        cost[k, top:bottom, left:right] = old[1:-1, 1:-1]


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


@compiled
def heaviest(weights: Int32, drawn: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Which photo weighs most at each knot that is drawn, the first of equals; elsewhere −1.

    `weights`: (photos, rows, cols); `drawn` and what is returned: (rows, cols).
    """
    n, rows, cols = weights.shape
    found, most = np.empty((rows, cols), np.int16), np.empty(cols, np.int32)
    for y in range(rows):
        found[y], most[:] = 0, weights[0, y]
        for k in range(1, n):
            line, names = weights[k, y], found[y]
            for x in range(cols):
                names[x] = k if line[x] > most[x] else names[x]
                most[x] = max(most[x], line[x])
        for x in range(cols):
            if not drawn[y, x]:
                found[y, x] = -1
    return found
