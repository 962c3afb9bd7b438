"""SIFT (Lowe 2004) in two halves, so that a grid may choose between them: where keypoints lie, how they look.

OpenCV's builds the scale space twice when only some of the found keypoints are to be described, and looks
at every pixel around each of them; here it is built once, and a keypoint's surroundings are read at a grid
of places that keeps the descriptor. Compiled; one thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.blurring import blur
from core.extrema import BORDER, extrema
from core.gradients import SIGMA, directions, histograms

Floats = NDArray[np.float32]

CAMERA_BLUR = 0.5


@dataclass(frozen=True, slots=True)
class ScaleSpace:
    """A picture at rising blur. `octaves`: each (layers + 3, h, w), the first one twice the picture."""

    octaves: tuple[Floats, ...]
    layers: int


@dataclass(frozen=True, slots=True)
class Spots:
    """Extrema of the scale space, (N,) each: `octave`, `layer` int64; `at` (N, 3) float32: x, y in pixels of
    the octave and the layer, all to a fraction; `response`: contrast in grey levels. In the order of octave,
    row, layer, column.
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
    """Octaves of a picture (H, W), down to about ten pixels; `layers`: 3 at least."""
    size = (2 * gray.shape[1], 2 * gray.shape[0])
    first = np.asarray(cv2.resize(gray.astype(np.float32), size), np.float32)
    variance = SIGMA**2 * 4 ** (np.arange(layers + 3) / layers)
    rise = np.sqrt(np.diff(variance))
    octaves: list[Floats] = []
    shape = first.shape
    while min(shape) > 2 * BORDER + 2:
        stack = np.empty((layers + 3, *shape), np.float32)
        if octaves:
            stack[0] = octaves[-1][layers, ::2, ::2]
        else:
            blur(first, math.sqrt(variance[0] - (2 * CAMERA_BLUR) ** 2), stack[0])
        for k, sigma in enumerate(rise):
            blur(stack[k], sigma, stack[k + 1])
        octaves.append(stack)
        shape = ((shape[0] + 1) // 2, (shape[1] + 1) // 2)
    return ScaleSpace(tuple(octaves), layers)


def find_spots(space: ScaleSpace, contrast: float) -> Spots:
    """Extrema whose contrast (share of the full range) suffices and that are no edges."""
    least = contrast * 255 / space.layers
    found, octave = [], []
    for k, stack in enumerate(space.octaves):
        spots = extrema(stack, least)
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
        which, turn = directions(space.octaves[k], spots.at[mine], space.layers)
        row, angle = np.concatenate((row, mine[which])), np.concatenate((angle, turn))
    order = np.argsort(row, kind="stable")[:most]
    chosen, angle = spots.take(row[order]), angle[order]
    looks = np.zeros((len(order), 128), np.float32)
    for k in np.unique(chosen.octave):
        mine = np.flatnonzero(chosen.octave == k)
        looks[mine] = histograms(space.octaves[k], chosen.at[mine], angle[mine], space.layers)
    size = SIGMA * np.exp2(chosen.at[:, 2] / space.layers + chosen.octave)
    return Described(chosen.xy(), angle, size.astype(np.float32), looks)
