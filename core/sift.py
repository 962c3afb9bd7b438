"""SIFT (Lowe 2004) in two halves, so that a grid may choose between them: where keypoints lie, how they look.

OpenCV's builds the scale space twice when only some of the found keypoints are to be described, and looks
at every pixel around each of them; here it is built once, and a keypoint's surroundings are read at a grid
of places that keeps the descriptor. Compiled; one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

SIGMA = 1.6
CAMERA_BLUR = 0.5
EDGE_RATIO = 10.0
BORDER = 5
# More than half a pixel, lest an extremum between two pixels is handed to and fro and given up.
STAY = 0.6
TURN_BINS = 36
SECOND_PEAK = 0.8
MOST_DIRECTIONS = 3
_compile: Callable[[Any], Any] = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class ScaleSpace:
    """A picture at rising blur. `octaves`: each (layers + 3, h, w), the first one twice the picture."""

    octaves: tuple[Floats, ...]
    layers: int


@dataclass(frozen=True, slots=True)
class Spots:
    """Extrema of the scale space, (N,) each: `octave`, `layer` int64; `at` (N, 3) float32: x, y in pixels of
    the octave and the layer, all to a fraction; `response`: contrast in grey levels. In the order of octave,
    layer, row, column.
    """

    octave: NDArray[np.int64]
    at: Floats
    response: Floats

    def xy(self) -> NDArray[np.float64]:
        """(N, 2) pixels of the picture, integers at pixel centres."""
        return (self.at[:, :2].astype(np.float64) * np.exp2(self.octave)[:, None] + 0.5) / 2 - 0.5

    def take(self, rows: NDArray[np.intp]) -> Spots:
        """Some of them."""
        return Spots(self.octave[rows], self.at[rows], self.response[rows])


@dataclass(frozen=True, slots=True)
class Described:
    """Keypoints: `xy` (K, 2) pixels of the picture, `angle_rad` (K,) clockwise as seen, `size_px` (K,)
    diameter, `histograms` (K, 128) of gradients, not normalised.
    """

    xy: NDArray[np.float64]
    angle_rad: Floats
    size_px: Floats
    histograms: Floats


def scale_space(gray: NDArray[np.uint8], layers: int) -> ScaleSpace:
    """Octaves of a picture (H, W), down to about ten pixels."""
    size = (2 * gray.shape[1], 2 * gray.shape[0])
    big = cv2.resize(gray.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    sharp = np.asarray(big, np.float32)
    step = 2 ** (1 / layers)
    rise = [SIGMA * step ** (k - 1) * float(np.sqrt(step**2 - 1)) for k in range(1, layers + 3)]
    octaves: list[Floats] = []
    shape = sharp.shape
    while min(shape) > 2 * BORDER + 2:
        stack = np.empty((layers + 3, *shape), np.float32)
        if octaves:
            stack[0] = octaves[-1][layers, ::2, ::2]
        else:
            _blurred(sharp, float(np.sqrt(SIGMA**2 - (2 * CAMERA_BLUR) ** 2)), stack[0])
        for k, sigma in enumerate(rise):
            _blurred(stack[k], sigma, stack[k + 1])
        octaves.append(stack)
        shape = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    return ScaleSpace(tuple(octaves), layers)


def _blurred(picture: Floats, sigma: float, out: Floats) -> None:
    # Beyond three sigmas lies a quarter of a percent.
    side = 2 * int(np.ceil(3 * sigma)) + 1
    cv2.GaussianBlur(picture, (side, side), sigma, dst=out)


def find_spots(space: ScaleSpace, contrast: float) -> Spots:
    """Extrema whose contrast (share of the full range) suffices and that are no edges."""
    least = contrast * 255 / space.layers
    found, octave = [], []
    for k, stack in enumerate(space.octaves):
        spots = _extrema(np.subtract(stack[1:], stack[:-1]), least)
        found.append(spots)
        octave.append(np.full(len(spots), k))
    every = np.concatenate(found) if found else np.zeros((0, 4), np.float32)
    which = np.concatenate(octave) if octave else np.zeros(0)
    return Spots(which.astype(np.int64), every[:, :3], every[:, 3])


def describe(space: ScaleSpace, spots: Spots, most: int) -> Described:
    """One entry for every clear direction of every spot, in the order of the spots, `most` at most."""
    row, angle = np.zeros(0, np.intp), np.zeros(0, np.float32)
    for k in np.unique(spots.octave):
        mine = np.flatnonzero(spots.octave == k)
        which, turn = _directions(space.octaves[k], spots.at[mine], space.layers)
        row, angle = np.concatenate((row, mine[which])), np.concatenate((angle, turn))
    order = np.argsort(row, kind="stable")[:most]
    chosen, angle = spots.take(row[order]), angle[order]
    histograms = np.zeros((len(order), 128), np.float32)
    for k in np.unique(chosen.octave):
        mine = np.flatnonzero(chosen.octave == k)
        histograms[mine] = _histograms(
            space.octaves[k], chosen.at[mine], angle[mine], space.layers, *_SAMPLES
        )
    size = SIGMA * np.exp2(chosen.at[:, 2] / space.layers + chosen.octave)
    return Described(chosen.xy(), angle, size.astype(np.float32), histograms)


def _is_extremum(below: Floats, same: Floats, above: Floats, y: int, x: int, sign: float) -> bool:
    """Whether none of the 26 values around surpasses this one, in the direction of `sign`."""
    v = sign * same[y, x]
    for r in range(y - 1, y + 2):
        for c in range(x - 1, x + 2):
            if sign * same[r, c] > v or sign * below[r, c] > v or sign * above[r, c] > v:
                return False
    return True


def _refined(d: Floats, k: int, y: int, x: int, least: float, out: Floats) -> bool:
    """The extremum of a parabola through the surroundings: x, y, layer, contrast into `out`."""
    layers, height, width = d.shape
    for _ in range(5):
        v = d[k, y, x]
        gx, gy = (d[k, y, x + 1] - d[k, y, x - 1]) / 2, (d[k, y + 1, x] - d[k, y - 1, x]) / 2
        gs = (d[k + 1, y, x] - d[k - 1, y, x]) / 2
        xx, yy = d[k, y, x + 1] + d[k, y, x - 1] - 2 * v, d[k, y + 1, x] + d[k, y - 1, x] - 2 * v
        ss = d[k + 1, y, x] + d[k - 1, y, x] - 2 * v
        xy = (d[k, y + 1, x + 1] - d[k, y + 1, x - 1] - d[k, y - 1, x + 1] + d[k, y - 1, x - 1]) / 4
        xs = (d[k + 1, y, x + 1] - d[k + 1, y, x - 1] - d[k - 1, y, x + 1] + d[k - 1, y, x - 1]) / 4
        ys = (d[k + 1, y + 1, x] - d[k + 1, y - 1, x] - d[k - 1, y + 1, x] + d[k - 1, y - 1, x]) / 4
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
        if k < 1 or k > layers - 2 or not (BORDER <= x < width - BORDER and BORDER <= y < height - BORDER):
            return False
    return False


def _peaks_of_rows(up: Floats, here: Floats, down: Floats, least: np.float32, out: NDArray[np.int8]) -> None:
    """Flag in `out` (w − 2,) what surpasses its four neighbours: without branches, so that it is fast."""
    left, middle, right = here[:-2], here[1:-1], here[2:]
    up, down = up[1:-1], down[1:-1]
    for x in range(len(out)):
        v = middle[x]
        high = (v >= left[x]) & (v >= right[x]) & (v >= up[x]) & (v >= down[x]) & (v > least)
        low = (v <= left[x]) & (v <= right[x]) & (v <= up[x]) & (v <= down[x]) & (v < -least)
        out[x] = high - np.int8(low)


def _extrema(d: Floats, least: float) -> Floats:
    """(N, 4) x, y, layer, contrast of the extrema of differences `d` (layers + 2, h, w)."""
    layers, height, width = d.shape
    out, n, one = np.empty((1024, 4), np.float32), 0, np.empty(4, np.float32)
    flags = np.empty(width - 2, np.int8)
    for k in range(1, layers - 1):
        below, same, above = d[k - 1], d[k], d[k + 1]
        for y in range(BORDER, height - BORDER):
            _peaks_of_rows(same[y - 1], same[y], same[y + 1], np.float32(least / 2), flags)
            for x in range(BORDER, width - BORDER):
                if flags[x - 1] == 0 or not _is_extremum(below, same, above, y, x, flags[x - 1]):
                    continue
                if _refined(d, k, y, x, least, one):
                    if n == len(out):
                        out = np.concatenate((out, np.empty_like(out)))
                    out[n] = one
                    n += 1
    return out[:n].copy()


def _angle(y: np.float32, x: np.float32) -> np.float32:
    """atan2 to a ten-thousandth."""
    ax, ay = abs(x), abs(y)
    a = min(ax, ay) / (max(ax, ay) + np.float32(1e-20))
    q = a * a
    r = ((np.float32(-0.0464964749) * q + np.float32(0.15931422)) * q - np.float32(0.327622764)) * q * a + a
    if ay > ax:
        r = np.float32(np.pi / 2) - r
    if x < 0:
        r = np.float32(np.pi) - r
    return np.float32(-r if y < 0 else r)


def _directions(stack: Floats, at: Floats, layers: int) -> tuple[NDArray[np.int64], Floats]:
    """Which spot and its angle, for every clear peak of its histogram of gradients."""
    height, width = stack.shape[1:]
    most = MOST_DIRECTIONS * len(at)
    which, angle, n = np.empty(most, np.int64), np.empty(most, np.float32), 0
    raw, smooth, taken = np.zeros(TURN_BINS), np.zeros(TURN_BINS), np.zeros(TURN_BINS, np.bool_)
    for m in range(len(at)):
        layer = min(max(int(np.rint(at[m, 2])), 1), layers)
        x0, y0 = int(np.rint(at[m, 0])), int(np.rint(at[m, 1]))
        sigma = 1.5 * SIGMA * 2 ** (at[m, 2] / layers)
        reach = int(np.rint(3 * sigma))
        raw[:] = 0
        for y in range(max(y0 - reach, 1), min(y0 + reach + 1, height - 1)):
            for x in range(max(x0 - reach, 1), min(x0 + reach + 1, width - 1)):
                far = ((x - x0) ** 2 + (y - y0) ** 2) / (2 * sigma * sigma)
                if far > 4.5:
                    continue
                gx, gy = (
                    stack[layer, y, x + 1] - stack[layer, y, x - 1],
                    stack[layer, y + 1, x] - stack[layer, y - 1, x],
                )
                turn = int(np.rint(_angle(gy, gx) * (TURN_BINS / (2 * np.pi))))
                raw[turn % TURN_BINS] += np.exp(-far) * np.sqrt(gx * gx + gy * gy)
        for b in range(TURN_BINS):
            smooth[b] = (
                raw[b - 2]
                + raw[(b + 2) % TURN_BINS]
                + 4 * (raw[b - 1] + raw[(b + 1) % TURN_BINS])
                + 6 * raw[b]
            ) / 16
        least, taken[:] = SECOND_PEAK * smooth.max(), False
        for _ in range(MOST_DIRECTIONS):
            best = -1
            for b in range(TURN_BINS):
                peak = smooth[b] > smooth[b - 1] and smooth[b] >= smooth[(b + 1) % TURN_BINS] and not taken[b]
                if peak and smooth[b] >= least and (best < 0 or smooth[b] > smooth[best]):
                    best = b
            if best < 0:
                break
            taken[best] = True
            before, after = smooth[best - 1], smooth[(best + 1) % TURN_BINS]
            aside = 0.5 * (before - after) / (before - 2 * smooth[best] + after)
            which[n], angle[n] = m, (best + aside) * (2 * np.pi / TURN_BINS) % (2 * np.pi)
            n += 1
    return which[:n].copy(), angle[:n].copy()


def _histograms(stack: Floats, at: Floats, angle: Floats, layers: int, line: Floats, near: Floats) -> Floats:
    """(K, 128) SIFT: 4 × 4 places of 8 directions, from a grid of samples turned with each keypoint.

    `line` (S,): where they are along one side, in cells from the middle; `near` (S, S): their weights.
    """
    height, width = stack.shape[1:]
    bins = np.float32(8 / (2 * np.pi))
    out = np.empty((len(at), 128), np.float32)
    # Directions 0 and 8 are the same; places beyond the 4 × 4 take what falls beside them.
    row, cells = np.empty((6, 9), np.float32), np.empty((6, 6, 9), np.float32)
    for n in range(len(at)):
        picture = stack[min(max(int(np.rint(at[n, 2])), 1), layers)]
        wide = 3 * SIGMA * 2 ** (at[n, 2] / layers)
        c, s = np.float32(wide * np.cos(angle[n])), np.float32(wide * np.sin(angle[n]))
        turned = angle[n] * bins
        cells[:] = 0
        for i in range(len(line)):
            v = line[i]
            # half a pixel more, so that cutting off rounds
            x0, y0 = at[n, 0] + np.float32(0.5) - s * v, at[n, 1] + np.float32(0.5) + c * v
            row[:] = 0
            for j in range(len(line)):
                u = line[j]
                x, y = int(x0 + c * u), int(y0 + s * u)
                if x < 1 or y < 1 or x >= width - 1 or y >= height - 1:
                    continue
                gx, gy = picture[y, x + 1] - picture[y, x - 1], picture[y + 1, x] - picture[y - 1, x]
                strength = near[i, j] * np.sqrt(gx * gx + gy * gy)
                turn = turned - _angle(gy, gx) * bins
                if turn < 0:
                    turn += np.float32(8)
                elif turn >= 8:
                    turn -= np.float32(8)
                t = min(int(turn), 7)
                q = int(u + np.float32(2.5))
                right, later = strength * (u + np.float32(2.5) - q), turn - t
                left = strength - right
                row[q, t + 1] += left * later
                row[q, t] += left - left * later
                row[q + 1, t + 1] += right * later
                row[q + 1, t] += right - right * later
            r = int(v + np.float32(2.5))
            low = v + np.float32(2.5) - r
            for q in range(6):
                for t in range(9):
                    cells[r, q, t] += (np.float32(1) - low) * row[q, t]
                    cells[r + 1, q, t] += low * row[q, t]
        _clipped(cells, out[n])
    return out


def _clipped(cells: Floats, out: Floats) -> None:
    """The inner 4 × 4 × 8 of `cells`, no value above a fifth of the length (Lowe 2004, 6.1)."""
    total = np.float32(0)
    for k in range(128):
        place, t = cells[k // 32 + 1, k // 8 % 4 + 1], k % 8
        out[k] = place[t] + (place[8] if t == 0 else np.float32(0))
        total += out[k] * out[k]
    most = np.float32(0.2) * np.sqrt(total)
    for k in range(128):
        out[k] = min(out[k], most)


def _samples(side: int) -> tuple[Floats, Floats]:
    """`line` and `near` of `_histograms`: five cells wide, since a cell reaches half a cell further."""
    line = (np.arange(side) + 0.5) * 5 / side - 2.5
    near = np.exp(-(line**2 + line[:, None] ** 2) / 8)
    return line.astype(np.float32), near.astype(np.float32)


_SAMPLES = _samples(12)
_is_extremum = _compile(_is_extremum)
_refined = _compile(_refined)
_peaks_of_rows = _compile(_peaks_of_rows)
_extrema = _compile(_extrema)
_angle = _compile(_angle)
_directions = _compile(_directions)
_clipped = _compile(_clipped)
_histograms = _compile(_histograms)
