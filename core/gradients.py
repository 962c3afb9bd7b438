"""How the surroundings of keypoints look: their directions and histograms (Lowe 2004, 5 and 6); compiled.

The samples of a keypoint are worked on side by side, as vector code: where they lie, how strong and which way
the picture rises there. Only what they are added to is one after the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled_loosely

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

SIGMA = 1.6
TURN_BINS = 36
SECOND_PEAK = 0.8
MOST_DIRECTIONS = 3
# Three sigmas, of half as much again as a keypoint's own, of the largest there is with one layer.
WIDEST_PX = 24


def _disc(reach: int) -> tuple[Ints, Ints]:
    """The pixels of a disc, from the middle outwards: (N,) x and (N,) y."""
    y, x = np.indices((2 * reach + 1, 2 * reach + 1), np.int32) - np.int32(reach)
    order = np.argsort((x * x + y * y).ravel(), kind="stable")
    order = order[: int((x * x + y * y <= reach * reach).sum())]
    return np.ascontiguousarray(x.ravel()[order]), np.ascontiguousarray(y.ravel()[order])


def _samples(side: int) -> tuple[Floats, Floats]:
    """Where the samples of a histogram lie along one side, in cells from the middle, and the weights of all.

    Five cells wide, since a cell reaches half a cell further.
    """
    line = (np.arange(side) + 0.5) * 5 / side - 2.5
    near = np.exp(-(line**2 + line[:, None] ** 2) / 8)
    return line.astype(np.float32), near.ravel().astype(np.float32)


DISC_X, DISC_Y = _disc(WIDEST_PX)
DISC_FAR = (DISC_X**2 + DISC_Y**2).astype(np.float32)
LINE, NEAR = _samples(12)
CELL = np.floor(LINE + 2.5).astype(np.int64)
PART = LINE + np.float32(2.5) - CELL.astype(np.float32)


@compiled_loosely
def _rises(picture: Floats, place: Ints, count: int, gx: Floats, gy: Floats) -> None:
    """Differences across the first `count` places of the flattened `picture`, 0 where a place is −1."""
    flat, width = picture.ravel(), picture.shape[1]
    for i in range(count):
        p = place[i]
        if p < 0:
            gx[i], gy[i] = 0, 0
        else:
            gx[i], gy[i] = flat[p + 1] - flat[p - 1], flat[p + width] - flat[p - width]


@compiled_loosely
def _polar(weight: Floats, gx: Floats, gy: Floats) -> None:
    """`gx` becomes the strength of (gx, gy) times `weight`, `gy` its angle to a ten-thousandth, −π … π."""
    c1, c3, c5 = np.float32(-0.327622764), np.float32(0.15931422), np.float32(-0.0464964749)
    for i in range(len(weight)):
        x, y = gx[i], gy[i]
        gx[i] = weight[i] * np.sqrt(x * x + y * y)
        ax, ay = abs(x), abs(y)
        a = min(ax, ay) / (max(ax, ay) + np.float32(1e-20))
        q = a * a
        r = ((c5 * q + c3) * q + c1) * q * a + a
        r = np.float32(np.pi / 2) - r if ay > ax else r
        r = np.float32(np.pi) - r if x < 0 else r
        gy[i] = -r if y < 0 else r


@compiled_loosely
def _around(shape: tuple[int, int], x0: int, y0: int, sigma: float, place: Ints, weight: Floats) -> int:
    """Where the pixels of a disc lie in a flattened picture, −1 outside, and their Gaussian weights to a
    thousandth; how many there are.
    """
    height, width = np.int32(shape[0]), np.int32(shape[1])
    share = np.float32(1 / (16 * sigma * sigma))
    count = np.searchsorted(DISC_FAR, 9 * sigma * sigma, "right")
    for i in range(count):
        u, v = DISC_X[i], DISC_Y[i]
        x, y = np.int32(x0) + u, np.int32(y0) + v
        inside = (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1)
        place[i] = y * width + x if inside else np.int32(-1)
        z = DISC_FAR[i] * share
        # Taylor's series for an eighth of the exponent
        e = np.float32(1 / 6) - z * np.float32(1 / 24)
        e = np.float32(1) - z * (np.float32(1) - z * (np.float32(0.5) - z * e))
        e *= e
        e *= e
        weight[i] = e * e
    return int(count)


@compiled_loosely
def _turns(strength: Floats, turn: Floats, raw: Floats, out: Floats) -> None:
    """The histogram of turns, smoothed, from −π on, in `out` (36,). `raw` (2, 37): room.

    Two histograms, since neighbours are alike and would wait for each other; −π and π are the same.
    """
    per_turn, half = np.float32(TURN_BINS / (2 * np.pi)), np.float32(TURN_BINS / 2 + 0.5)
    raw[:] = 0
    for i in range(len(strength)):
        raw[i & 1, np.int32(turn[i] * per_turn + half)] += strength[i]
    one = raw[0]
    for b in range(TURN_BINS + 1):
        one[b] += raw[1, b]
    one[0] += one[TURN_BINS]
    for b in range(TURN_BINS):
        beside = one[(b - 1) % TURN_BINS] + one[(b + 1) % TURN_BINS]
        beyond = one[(b - 2) % TURN_BINS] + one[(b + 2) % TURN_BINS]
        out[b] = (beyond + 4 * beside + 6 * one[b]) / 16


@compiled_loosely
def _peak(smooth: Floats, taken: NDArray[np.bool_]) -> int:
    """The highest peak not yet taken of at least `SECOND_PEAK` times the highest, or −1."""
    best, least = -1, np.float32(SECOND_PEAK) * smooth.max()
    for b in range(TURN_BINS):
        peak = smooth[b] > smooth[b - 1] and smooth[b] >= smooth[(b + 1) % TURN_BINS] and not taken[b]
        if peak and smooth[b] >= least and (best < 0 or smooth[b] > smooth[best]):
            best = b
    return best


@compiled_loosely
def directions(stack: Floats, at: Floats, layers: int) -> tuple[NDArray[np.int64], Floats]:
    """Which spot and its angle, for every clear peak of its histogram of gradients."""
    most = MOST_DIRECTIONS * len(at)
    which, angle, n = np.empty(most, np.int64), np.empty(most, np.float32), 0
    gx, gy = np.empty(len(DISC_X), np.float32), np.empty(len(DISC_X), np.float32)
    weight, place = np.empty_like(gx), np.empty(len(DISC_X), np.int32)
    raw, smooth = np.empty((2, TURN_BINS + 1), np.float32), np.empty(TURN_BINS, np.float32)
    for m in range(len(at)):
        picture = stack[min(max(int(np.rint(at[m, 2])), 1), layers)]
        sigma = 1.5 * SIGMA * 2 ** (at[m, 2] / layers)
        count = _around(picture.shape, int(np.rint(at[m, 0])), int(np.rint(at[m, 1])), sigma, place, weight)
        _rises(picture, place, count, gx, gy)
        _polar(weight[:count], gx, gy)
        _turns(gx[:count], gy, raw, smooth)
        taken = np.zeros(TURN_BINS, np.bool_)
        for _ in range(MOST_DIRECTIONS):
            best = _peak(smooth, taken)
            if best < 0:
                break
            taken[best] = True
            before, after = smooth[best - 1], smooth[(best + 1) % TURN_BINS]
            aside = 0.5 * (before - after) / (before - 2 * smooth[best] + after)
            which[n], angle[n] = m, ((best + aside) * (2 * np.pi / TURN_BINS) + np.pi) % (2 * np.pi)
            n += 1
    return which[:n].copy(), angle[:n].copy()


@compiled_loosely
def _grid(shape: tuple[int, int], at: Floats, cell_px: np.float32, angle: np.float32, place: Ints) -> None:
    """Where the samples of a grid turned by `angle` lie in a flattened picture, −1 outside."""
    height, width, side = np.int32(shape[0]), np.int32(shape[1]), len(LINE)
    c, s = cell_px * np.cos(angle), cell_px * np.sin(angle)
    # half a pixel more, so that cutting off rounds
    x0, y0 = at[0] + np.float32(0.5), at[1] + np.float32(0.5)
    for i in range(side):
        left, top = x0 - s * LINE[i], y0 + c * LINE[i]
        for j in range(side):
            x, y = np.int32(left + c * LINE[j]), np.int32(top + s * LINE[j])
            inside = (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1)
            place[i * side + j] = y * width + x if inside else np.int32(-1)


@compiled_loosely
def _binned(angle: np.float32, turn: Floats, strength: Floats, bin8: Ints) -> None:
    """The direction of each sample, 0 … 7, in `bin8`; `turn` becomes how much of it belongs to the next."""
    per_turn = np.float32(8 / (2 * np.pi))
    for i in range(len(turn)):
        t = (angle - turn[i]) * per_turn
        t = t + np.float32(8) if t < 0 else t
        t = t - np.float32(8) if t >= 8 else t
        bin8[i] = min(np.int32(t), np.int32(7))
        turn[i] = strength[i] * (t - np.float32(bin8[i]))


@compiled_loosely
def _shared(strength: Floats, later: Floats, bin8: Ints, cells: Floats) -> None:
    """Adds every sample to its eight neighbours in `cells` (6·6·9,): row, column, direction.

    Directions 0 and 8 are the same; places beyond the 4 × 4 take what falls beside them.
    """
    cells[:] = 0
    n = 0
    for i in range(len(CELL)):
        low = PART[i]
        for j in range(len(CELL)):
            right = PART[j]
            k = 54 * CELL[i] + 9 * CELL[j] + bin8[n]
            a, b = strength[n] - later[n], later[n]
            n += 1
            c, d = a * right, b * right
            a, b = a - c, b - d
            cells[k] += a - a * low
            cells[k + 1] += b - b * low
            cells[k + 9] += c - c * low
            cells[k + 10] += d - d * low
            cells[k + 54] += a * low
            cells[k + 55] += b * low
            cells[k + 63] += c * low
            cells[k + 64] += d * low


@compiled_loosely
def _clipped(cells: Floats, out: Floats) -> None:
    """The inner 4 × 4 × 8 of `cells`, no value above a fifth of the length (Lowe 2004, 6.1)."""
    total = np.float32(0)
    for k in range(16):
        p = 54 * (k // 4 + 1) + 9 * (k % 4 + 1)
        cells[p] += cells[p + 8]
        for t in range(8):
            out[8 * k + t] = cells[p + t]
            total += cells[p + t] * cells[p + t]
    most = np.float32(0.2) * np.sqrt(total)
    for k in range(128):
        out[k] = min(out[k], most)


@compiled_loosely
def histograms(stack: Floats, at: Floats, angle: Floats, layers: int) -> Floats:
    """(K, 128) SIFT: 4 × 4 places of 8 directions, from a grid of samples turned with each keypoint."""
    out, cells = np.empty((len(at), 128), np.float32), np.empty(324, np.float32)
    gx, gy = np.empty(len(NEAR), np.float32), np.empty(len(NEAR), np.float32)
    place, bin8 = np.empty(len(NEAR), np.int32), np.empty(len(NEAR), np.int32)
    for n in range(len(at)):
        picture = stack[min(max(int(np.rint(at[n, 2])), 1), layers)]
        wide = 3 * SIGMA * 2 ** (at[n, 2] / layers)
        _grid(picture.shape, at[n], np.float32(wide), angle[n], place)
        _rises(picture, place, len(place), gx, gy)
        _polar(NEAR, gx, gy)
        _binned(angle[n], gy, gx, bin8)
        _shared(gx, gy, bin8, cells)
        _clipped(cells, out[n])
    return out
