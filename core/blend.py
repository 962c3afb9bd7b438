"""Weighted multiband blending of warped photos (Zhao 2020, 3.4; Bu 2016, Map2DFusion).

The finest bands come from whichever photo weighs most at their own resolution, the lowest one is a weighted
average of all photos. Instead of Laplacians the difference to the photo's own Gaussian level is carried down
the pyramid: `blended = photo + up(blended_coarser − photo_coarser)`, which is the same sum. Levels halve by
2 × 2 means and double by bilinear interpolation between pixel centres.

Level l of a lattice has `cell_px >> l` pixels a cell; at the last level a pixel is a cell. Colours between
the levels are float32 grey levels: every sum runs over a pixel's few neighbours in one order, so that its
rounding does not depend on the window.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.warp import INSIDE, Int16, Int32, Rgb

Labels = NDArray[np.int16]
Fine = NDArray[np.float32]
Flat = NDArray[np.float32]
Flat8 = NDArray[np.uint8]
Row = NDArray[np.float32]

NOBODY = -1
OTHER_GROUND = 0.03
"""How much a difference of mean tone says, beside one of detail, that photos do not show the same."""


class Layer(NamedTuple):
    """One warped photo, whose top-left corner is a cell of the lattice.

    `levels`: its Gaussian levels, finest first, (h >> l, w >> l, 3) uint8.
    """

    label: int
    row: int
    col: int
    levels: list[Rgb]


def gaussian_levels(warped: Rgb, bands: int) -> list[Rgb]:
    """The photo and its 2 × 2 means, `bands` times over; sides are multiples of 2^bands."""
    levels = [warped]
    for _ in range(bands):
        height, width = levels[-1].shape[0] // 2, levels[-1].shape[1] // 2
        # INTER_AREA by exactly 2 is integer: (a + b + c + d + 2) >> 2.
        levels.append(
            np.asarray(cv2.resize(levels[-1], (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        )
    return levels


def label_level(
    knot_labels: Labels, weights: Int32, pixels_per_cell: int, places: Int32 | None, sizes: Int32
) -> Labels:
    """Which photo weighs most at each pixel of one level: (rows · n, cols · n) int16, or `NOBODY`.

    `knot_labels`: (rows, cols); `weights`: (photos, rows, cols). With `places` (photos, rows, cols, 2), 1/256
    px, only photos whose `sizes` (photos, 2) hold the pixel count, so that the mosaic ends where photos end.
    """
    rows, cols = knot_labels.shape
    out = np.empty((rows * pixels_per_cell, cols * pixels_per_cell), np.int16)
    strict = places is not None
    no_places = np.empty((1, 1, 1, 2), np.int32)
    _label(knot_labels, weights, pixels_per_cell, strict, no_places if places is None else places, sizes, out)
    return out


def blend_level(
    coarse: Fine, coarse_labels: Labels, layers: list[Layer], level: int, labels: Labels, cell_px: int
) -> Fine:
    """The blended colours of `level`, (H, W, 3) float32, from those of the next coarser one."""
    out = np.zeros((*labels.shape, 3), np.float32)
    for layer in layers:
        change = _changes(coarse, coarse_labels, layer, level + 1, cell_px)
        _apply(change, _rows(layer, level), layer.label, labels, *_corner(layer, level, cell_px), out)
    return out


def blend_finest(
    coarse: Fine, coarse_labels: Labels, layers: list[Layer], labels: Labels, cell_px: int
) -> NDArray[np.uint8]:
    """Level 0 as RGBA (H, W, 4) uint8; transparent black where `labels` says nobody."""
    out = np.zeros(labels.shape, "<u4")
    for layer in layers:
        change = _changes(coarse, coarse_labels, layer, 1, cell_px)
        _paint(change, _rows(layer, 0), layer.label, labels, *_corner(layer, 0, cell_px), out)
    return out.view(np.uint8).reshape(*labels.shape, 4)


def _rows(layer: Layer, level: int) -> Flat8:
    """A layer's level as flat rows, three numbers a pixel."""
    return layer.levels[level].reshape(len(layer.levels[level]), -1)


def _corner(layer: Layer, level: int, cell_px: int) -> tuple[int, int]:
    """The row and column of a layer's first pixel among all pixels of the level."""
    return layer.row * (cell_px >> level), layer.col * (cell_px >> level)


def _changes(coarse: Fine, coarse_labels: Labels, layer: Layer, level: int, cell_px: int) -> Flat:
    """How the blended colours differ from one photo's own, as flat rows."""
    photo = _rows(layer, level)
    out = np.empty(photo.shape, np.float32)
    flat = coarse.reshape(len(coarse), -1)
    _difference(flat, coarse_labels, photo, *_corner(layer, level, cell_px), out)
    return out


class Tones(NamedTuple):
    """Local mean colours of all photos at all knots, (photos, rows, cols, 3) int16 in 1/16 grey levels.

    `own`: as they will be drawn; `even`: as they should be drawn, without the lens's falloff; `detail`: how
    they depart from a much coarser mean.
    """

    own: Int16
    even: Int16
    detail: Int16


def retone(labels: Labels, weights: Int32, tones: Tones, tolerance: float) -> Fine:
    """What each knot's winner lacks to the mean tone of all photos there: (rows, cols, 3) float32.

    `weights`: (photos, rows, cols). Photos count the less, the more their detail differs from the winner's,
    in units of `tolerance` grey levels. Exposure and vignetting differ over whole photos and leave no detail;
    but where a tree leans over a road in one photo, its darkness must not haunt the road in another.
    """
    out = np.zeros((*labels.shape, 3), np.float32)
    _retone(labels, weights, *tones, (16 * tolerance) ** 2, out)
    return out


@compiled
def _retone(
    labels: Labels, weights: Int32, own: Int16, even: Int16, detail: Int16, scale: float, out: Fine
) -> None:
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            winner = labels[y, x]
            if winner < 0:
                continue
            total, red, green, blue = 0.0, 0.0, 0.0, 0.0
            here = even[winner, y, x]
            for k in range(weights.shape[0]):
                if weights[k, y, x] > 0:
                    r = detail[k, y, x, 0] - detail[winner, y, x, 0]
                    g = detail[k, y, x, 1] - detail[winner, y, x, 1]
                    b = detail[k, y, x, 2] - detail[winner, y, x, 2]
                    apart = (r * r + g * g + b * b) / 3
                    r, g, b = (
                        even[k, y, x, 0] - here[0],
                        even[k, y, x, 1] - here[1],
                        even[k, y, x, 2] - here[2],
                    )
                    apart += (r * r + g * g + b * b) / 3 * OTHER_GROUND
                    say = weights[k, y, x] * scale / (scale + apart)
                    total += say
                    red += say * (even[k, y, x, 0] - here[0])
                    green += say * (even[k, y, x, 1] - here[1])
                    blue += say * (even[k, y, x, 2] - here[2])
            lack = (red / total, green / total, blue / total)
            for c in range(3):
                out[y, x, c] = (here[c] - own[winner, y, x, c] + lack[c]) / 16


@compiled
def _contenders(
    knot_labels: Labels, weights: Int32, j: int, i: int, found: NDArray[np.int64]
) -> tuple[int, bool]:
    """The winners at a patch's four knots, ascending, in `found`; whether all lie inside of their photos."""
    count, inside = 0, True
    for corner in range(4):
        y, x = j + corner // 2, i + corner % 2
        label = knot_labels[y, x]
        if label < 0:
            inside = False
            continue
        inside = inside and weights[label, y, x] >= INSIDE
        known = False
        for q in range(count):
            known = known or found[q] == label
        if not known:
            found[count] = label
            count += 1
    found[:count].sort()
    return count, inside


@compiled
def _contest(f: int, left: int, right: int, best: NDArray[np.int64], chosen: Labels) -> None:
    """Let photo f compete for one row of a patch by its weight at the row's ends."""
    n = len(best)
    for x in range(n):
        w = left * (2 * n - 2 * x - 1) + right * (2 * x + 1)
        if w > best[x]:
            best[x] = w
            chosen[x] = f


@compiled
def _contest_held(
    f: int, ends: NDArray[np.int64], bounds: NDArray[np.int64], best: NDArray[np.int64], chosen: Labels
) -> None:
    """Like `_contest`, only for the pixels that photo f truly holds.

    `ends` (3, 2): weight, x and y at the row's left and right end; `bounds`: the largest x and y that count.
    """
    n = len(best)
    for x in range(n):
        near, far = 2 * n - 2 * x - 1, 2 * x + 1
        w = ends[0, 0] * near + ends[0, 1] * far
        a = ends[1, 0] * near + ends[1, 1] * far
        b = ends[2, 0] * near + ends[2, 1] * far
        held = a >= 0 and b >= 0 and a <= bounds[0] and b <= bounds[1]
        if held and w > best[x]:
            best[x] = w
            chosen[x] = f


@compiled
def _label(
    knot_labels: Labels, weights: Int32, n: int, strict: bool, places: Int32, sizes: Int32, out: Labels
) -> None:
    """Patch by patch between knots, in whole numbers: bilinear weights, scaled by (2n)²."""
    best, chosen = np.empty(n, np.int64), np.empty(n, np.int16)
    found, ends, bounds = np.empty(4, np.int64), np.zeros((3, 2), np.int64), np.zeros(2, np.int64)
    for y in range(len(out)):
        out[y] = NOBODY
    for j in range(knot_labels.shape[0] - 1):
        for i in range(knot_labels.shape[1] - 1):
            y0, x0 = j * n + n // 2, i * n + n // 2
            count, inside = _contenders(knot_labels, weights, j, i, found)
            if count == 1 and (inside or not strict):
                out[y0 : y0 + n, x0 : x0 + n] = np.int16(found[0])
                continue
            exact = strict and not inside
            for y in range(n if count else 0):
                best[:] = -1
                chosen[:] = NOBODY
                upper, lower = 2 * n - 2 * y - 1, 2 * y + 1
                for q in range(count):
                    f = found[q]
                    for side in range(2):
                        ends[0, side] = weights[f, j, i + side] * upper + weights[f, j + 1, i + side] * lower
                        for axis in range(2 if exact else 0):
                            above, below = places[f, j, i + side, axis], places[f, j + 1, i + side, axis]
                            ends[1 + axis, side] = above * upper + below * lower
                            bounds[axis] = (sizes[f, axis] - 1) * 1024 * n * n
                    if exact:
                        _contest_held(f, ends, bounds, best, chosen)
                    else:
                        _contest(f, ends[0, 0], ends[0, 1], best, chosen)
                out[y0 + y, x0 : x0 + n] = chosen


@compiled
def _difference(coarse: Flat, labels: Labels, photo: Flat8, top: int, left: int, out: Flat) -> None:
    # Whole arrays and offsets, not slices: these stay contiguous: one compiled version, and vector code.
    for y in range(photo.shape[0]):
        here, own, change = coarse[top + y, 3 * left : 3 * left + photo.shape[1]], photo[y], out[y]
        for i in range(len(own)):
            change[i] = here[i] - np.float32(own[i])
        # Where nobody is, nothing pulls: or the mosaic's border would fade into black.
        for x in range(photo.shape[1] // 3):
            if labels[top + y, left + x] < 0:
                change[3 * x : 3 * x + 3] = np.float32(0)


@compiled
def _blended_row(change: Flat, photo: Flat8, y: int, start: int, stop: int, scratch: Flat, line: Row) -> None:
    """Row y of photo + change doubled in size, for pixels start … stop − 1, both even, into `line`.

    Rows are flat, three numbers a pixel; plain loops over equal slices, which compile to vector code.
    """
    three, sixteenth = np.float32(3), np.float32(1 / 16)
    height, width = change.shape
    other = min(max(y // 2 + (y % 2) * 2 - 1, 0), height - 1)
    first, last = 3 * (start // 2), 3 * (stop // 2)
    low, high = max(first - 3, 0), min(last + 3, width)
    near, far, mix = change[y // 2, low:high], change[other, low:high], scratch[0, low + 3 : high + 3]
    for i in range(len(mix)):
        mix[i] = three * near[i] + far[i]
    if first == 0:
        scratch[0, 0:3] = scratch[0, 3:6]
    if last == width:
        scratch[0, width + 3 : width + 6] = scratch[0, width : width + 3]
    left, here, right = (
        scratch[0, first:last],
        scratch[0, first + 3 : last + 3],
        scratch[0, first + 6 : last + 6],
    )
    even, odd = scratch[1, first:last], scratch[2, first:last]
    for i in range(len(here)):
        even[i] = (three * here[i] + left[i]) * sixteenth
        odd[i] = (three * here[i] + right[i]) * sixteenth
    out, own = line[2 * first : 2 * last], photo[y, 2 * first : 2 * last]
    for x in range(len(even) // 3):
        for c in range(3):
            out[6 * x + c] = even[3 * x + c]
            out[6 * x + 3 + c] = odd[3 * x + c]
    for i in range(len(out)):
        out[i] += np.float32(own[i])


@compiled
def _span(names: NDArray[np.int16], label: int) -> tuple[int, int]:
    """The even first and last pixel between which a row holds the label; (0, 0) when it does not."""
    start, stop = 0, len(names)
    while start < stop and names[start] != label:
        start += 1
    while stop > start and names[stop - 1] != label:
        stop -= 1
    return (0, 0) if start == stop else (start - start % 2, stop + stop % 2)


@compiled
def _apply(change: Flat, photo: Flat8, label: int, labels: Labels, top: int, left: int, out: Fine) -> None:
    scratch, line = np.empty((3, change.shape[1] + 6), np.float32), np.empty(photo.shape[1], np.float32)
    for y in range(photo.shape[0]):
        start, stop = _span(labels[top + y, left : left + photo.shape[1] // 3], label)
        if start == stop:
            continue
        _blended_row(change, photo, y, start, stop, scratch, line)
        for x in range(start, stop):
            if labels[top + y, left + x] == label:
                for c in range(3):
                    out[top + y, left + x, c] = line[3 * x + c]


@compiled
def _paint(
    change: Flat,
    photo: Flat8,
    label: int,
    labels: Labels,
    top: int,
    left: int,
    out: NDArray[np.uint32],
) -> None:
    """Like `_apply`, but rounded and packed as R, G, B and full alpha into little-endian words."""
    half, dark, bright = np.float32(0.5), np.float32(0), np.float32(255)
    scratch, line = np.empty((3, change.shape[1] + 6), np.float32), np.empty(photo.shape[1], np.float32)
    bytes_ = np.empty(photo.shape[1], np.uint8)
    for y in range(photo.shape[0]):
        start, stop = _span(labels[top + y, left : left + photo.shape[1] // 3], label)
        if start == stop:
            continue
        _blended_row(change, photo, y, start, stop, scratch, line)
        values, rounded = line[3 * start : 3 * stop], bytes_[3 * start : 3 * stop]
        for i in range(len(values)):
            rounded[i] = np.uint8(np.int32(min(max(values[i], dark), bright) + half))
        first, last = left + start, left + stop
        names, words = labels[top + y, first:last], out[top + y, first:last]
        for x in range(len(names)):
            if names[x] == label:
                words[x] = (
                    np.uint32(rounded[3 * x])
                    | np.uint32(rounded[3 * x + 1]) << np.uint32(8)
                    | np.uint32(rounded[3 * x + 2]) << np.uint32(16)
                    | np.uint32(0xFF000000)
                )
