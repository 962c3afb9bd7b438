"""Weighted multiband blending of warped photos (Zhao 2020, 3.4; Bu 2016, Map2DFusion), in integers.

The finest bands come from whichever photo weighs most at their own resolution, the lowest one is a weighted
average of all photos. Instead of Laplacians the difference to the photo's own Gaussian level is carried down
the pyramid: `blended = photo + up(blended_coarser − photo_coarser)`, which is the same sum. Levels halve by
2 × 2 means and double by bilinear interpolation between pixel centres.

Level l of a lattice has `cell_px >> l` pixels a cell; at the last level a pixel is a cell. Colours between
the levels are int16 in 1/16 grey levels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from core.warp import INSIDE, Int32, Rgb, compiled

Labels = NDArray[np.int16]
Fine = NDArray[np.int16]

NOBODY = -1


class Layer(NamedTuple):
    """One warped photo, whose top-left corner is a cell of the lattice.

    `levels`: its Gaussian levels, finest first, (h >> l, w >> l, 3) uint8. `gain`: (3,) int32, 4096 = 1.
    """

    label: int
    row: int
    col: int
    levels: list[Rgb]
    gain: Int32


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
    out = np.full((rows * pixels_per_cell, cols * pixels_per_cell), NOBODY, np.int16)
    strict = places is not None
    no_places = np.empty((1, 1, 1, 2), np.int32)
    _label(knot_labels, weights, pixels_per_cell, strict, no_places if places is None else places, sizes, out)
    return out


def blend_level(
    coarse: Fine, coarse_labels: Labels, layers: list[Layer], level: int, labels: Labels, cell_px: int
) -> Fine:
    """The blended colours of `level`, (H, W, 3) int16, from those of the next coarser one."""
    out = np.zeros((*labels.shape, 3), np.int16)
    n = cell_px >> level
    for layer in layers:
        change = _changes(coarse, coarse_labels, layer, level + 1, n // 2)
        _apply(
            change, layer.levels[level], layer.gain, layer.label, labels, layer.row * n, layer.col * n, out
        )
    return out


def blend_finest(
    coarse: Fine, coarse_labels: Labels, layers: list[Layer], labels: Labels, cell_px: int
) -> NDArray[np.uint8]:
    """Level 0 as RGBA (H, W, 4) uint8; transparent black where `labels` says nobody."""
    out = np.zeros((*labels.shape, 4), np.uint8)
    for layer in layers:
        change = _changes(coarse, coarse_labels, layer, 1, cell_px // 2)
        _paint(
            change,
            layer.levels[0],
            layer.gain,
            layer.label,
            labels,
            layer.row * cell_px,
            layer.col * cell_px,
            out,
        )
    return out


def _changes(coarse: Fine, coarse_labels: Labels, layer: Layer, level: int, pixels_per_cell: int) -> Fine:
    photo = layer.levels[level]
    top, left = layer.row * pixels_per_cell, layer.col * pixels_per_cell
    out = np.empty(photo.shape, np.int16)
    area = np.s_[top : top + photo.shape[0], left : left + photo.shape[1]]
    _difference(coarse[area], coarse_labels[area], photo, layer.gain, out)
    return out


class Tones(NamedTuple):
    """Local mean colours of all photos at all knots, (photos, rows, cols, 3) int32 in 1/16 grey levels.

    `own`: as they will be drawn; `even`: as they should be drawn, without the lens's falloff; `detail`: how
    they depart from a much coarser mean.
    """

    own: Int32
    even: Int32
    detail: Int32


def retone(labels: Labels, weights: Int32, tones: Tones, tolerance: float) -> Fine:
    """What each knot's winner lacks to the mean tone of all photos there: (rows, cols, 3) int16.

    `weights`: (photos, rows, cols). Photos count the less, the more their detail differs from the winner's,
    in units of `tolerance` grey levels. Exposure and vignetting differ over whole photos and leave no detail;
    but where a tree leans over a road in one photo, its darkness must not haunt the road in another.
    """
    out = np.zeros((*labels.shape, 3), np.int16)
    _retone(labels, weights, *tones, (16 * tolerance) ** 2, out)
    return out


@compiled
def _retone(
    labels: Labels, weights: Int32, own: Int32, even: Int32, detail: Int32, scale: float, out: Fine
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
                    say = weights[k, y, x] * scale / (scale + (r * r + g * g + b * b) / 3)
                    total += say
                    red += say * (even[k, y, x, 0] - here[0])
                    green += say * (even[k, y, x, 1] - here[1])
                    blue += say * (even[k, y, x, 2] - here[2])
            lack = (red / total, green / total, blue / total)
            for c in range(3):
                out[y, x, c] = here[c] - own[winner, y, x, c] + math.floor(lack[c] + 0.5)


@compiled
def _label(
    knot_labels: Labels,
    weights: Int32,
    n: int,
    strict: bool,
    places: Int32,
    sizes: Int32,
    out: Labels,
) -> None:
    rows, cols = knot_labels.shape
    best, chosen = np.empty(n, np.int64), np.empty(n, np.int16)
    found = np.empty(4, np.int64)
    for j in range(rows - 1):
        for i in range(cols - 1):
            y0, x0 = j * n + n // 2, i * n + n // 2
            count, pure = 0, True
            for corner in range(4):
                label = knot_labels[j + corner // 2, i + corner % 2]
                if label < 0:
                    pure = False
                    continue
                pure = pure and (weights[label, j + corner // 2, i + corner % 2] >= INSIDE or not strict)
                known = False
                for q in range(count):
                    known = known or found[q] == label
                if not known:
                    found[count] = label
                    count += 1
            if count == 0:
                continue
            if count == 1 and pure:
                out[y0 : y0 + n, x0 : x0 + n] = np.int16(found[0])
                continue
            found[:count].sort()
            for y in range(n):
                best[:] = 0
                chosen[:] = NOBODY
                part = 2 * y + 1
                for q in range(count):
                    f = found[q]
                    w_left = weights[f, j, i] * (2 * n - part) + weights[f, j + 1, i] * part
                    w_right = weights[f, j, i + 1] * (2 * n - part) + weights[f, j + 1, i + 1] * part
                    if strict and not pure:
                        p, r = places[f, j : j + 2, i : i + 2], sizes[f]
                        a_left = p[0, 0, 0] * (2 * n - part) + p[1, 0, 0] * part
                        a_right = p[0, 1, 0] * (2 * n - part) + p[1, 1, 0] * part
                        b_left = p[0, 0, 1] * (2 * n - part) + p[1, 0, 1] * part
                        b_right = p[0, 1, 1] * (2 * n - part) + p[1, 1, 1] * part
                        last_a = (r[0] - 1) * 1024 * n * n
                        last_b = (r[1] - 1) * 1024 * n * n
                        for x in range(n):
                            along = 2 * x + 1
                            a = a_left * (2 * n - along) + a_right * along
                            b = b_left * (2 * n - along) + b_right * along
                            w = w_left * (2 * n - along) + w_right * along
                            if (
                                a >= 0
                                and b >= 0
                                and a <= last_a
                                and b <= last_b
                                and (chosen[x] < 0 or w > best[x])
                            ):
                                best[x] = w
                                chosen[x] = f
                    else:
                        for x in range(n):
                            w = w_left * (2 * n - 2 * x - 1) + w_right * (2 * x + 1)
                            if w > best[x]:
                                best[x] = w
                                chosen[x] = f
                out[y0 + y, x0 : x0 + n] = chosen


@compiled
def _difference(coarse: Fine, labels: Labels, photo: Rgb, gain: Int32, out: Fine) -> None:
    for y in range(photo.shape[0]):
        for x in range(photo.shape[1]):
            for c in range(3):
                own = (photo[y, x, c] * gain[c] + 128) >> 8
                # Where nobody is, nothing pulls: or the mosaic's border would fade into black.
                out[y, x, c] = coarse[y, x, c] - own if labels[y, x] >= 0 else 0


@compiled
def _doubled_row(change: Fine, y: int, start: int, stop: int, line: Fine) -> None:
    """Row y of the change at twice its size (flat colours), for coarse columns start … stop − 1."""
    height, width = change.shape[0], change.shape[1]
    near = y // 2
    far = min(max(near + (y % 2) * 2 - 1, 0), height - 1)
    for x in range(start, stop):
        before, after = max(x - 1, 0), min(x + 1, width - 1)
        for c in range(3):
            here = 3 * change[near, x, c] + change[far, x, c]
            left = 3 * change[near, before, c] + change[far, before, c]
            right = 3 * change[near, after, c] + change[far, after, c]
            line[6 * x + c] = (3 * here + left + 8) >> 4
            line[6 * x + 3 + c] = (3 * here + right + 8) >> 4


@compiled
def _apply(
    change: Fine, photo: Rgb, gain: Int32, label: int, labels: Labels, top: int, left: int, out: Fine
) -> None:
    line = np.empty(3 * photo.shape[1], np.int16)
    for y in range(photo.shape[0]):
        names = labels[top + y, left : left + photo.shape[1]]
        start, stop = 0, photo.shape[1]
        while start < stop and names[start] != label:
            start += 1
        while stop > start and names[stop - 1] != label:
            stop -= 1
        if start == stop:
            continue
        _doubled_row(change, y, start // 2, (stop + 1) // 2, line)
        for x in range(start, stop):
            if names[x] == label:
                for c in range(3):
                    out[top + y, left + x, c] = ((photo[y, x, c] * gain[c] + 128) >> 8) + line[3 * x + c]


@compiled
def _paint(
    change: Fine,
    photo: Rgb,
    gain: Int32,
    label: int,
    labels: Labels,
    top: int,
    left: int,
    out: NDArray[np.uint8],
) -> None:
    line = np.empty(3 * photo.shape[1], np.int16)
    for y in range(photo.shape[0]):
        names = labels[top + y, left : left + photo.shape[1]]
        start, stop = 0, photo.shape[1]
        while start < stop and names[start] != label:
            start += 1
        while stop > start and names[stop - 1] != label:
            stop -= 1
        if start == stop:
            continue
        _doubled_row(change, y, start // 2, (stop + 1) // 2, line)
        for x in range(start, stop):
            if names[x] == label:
                for c in range(3):
                    value = (((photo[y, x, c] * gain[c] + 128) >> 8) + line[3 * x + c] + 8) >> 4
                    out[top + y, left + x, c] = min(max(value, 0), 255)
                out[top + y, left + x, 3] = 255
