"""What is kept of one picture for matching: keypoints, RootSIFT descriptors, appearance, a thumbnail.

Zhao 2020 section 3.2: about a thousand keypoints on a small preview are enough. They are chosen strongest
first within each cell of a grid, so that one leafy corner does not take them all, and only the chosen ones
are described.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.sharpness import sharpness
from core.sift import Spots, describe, find_spots, scale_space
from core.vocabulary import appearance

Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]

DESCRIPTOR_SCALE = 512.0
_MAGIC = b"OSF1"
_HEAD = struct.Struct("<4sIIHH")


@dataclass(frozen=True, slots=True)
class FeatureParams:
    """How keypoints are found.

    `side_px`: long side of the copy they are found on. `keypoints`: how many are kept at most. `cells`: the
    grid has cells × cells cells. `contrast`: SIFT's threshold; low, because fields and sand have little.
    `octave_layers`: SIFT's scales per octave. `thumb_px`: long side of the thumbnail.
    """

    side_px: int = 512
    keypoints: int = 1000
    cells: int = 8
    contrast: float = 0.01
    octave_layers: int = 3
    thumb_px: int = 128


FEATURE_SIDE_PX = FeatureParams().side_px
"""Keypoints are found on a copy of this size, so nothing larger is decoded for them."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The features of one photo; equal only to themselves.

    `keypoints` (K, 2) float32, pixels of the ORIGINAL photo; `angle_rad` (K,) float32, clockwise as seen;
    `scale_px` (K,) float32, diameter in pixels of the original; `descriptors` (K, 128) uint8, RootSIFT × 512;
    `words` (W,) float32 of length 1 (or all zero without keypoints): compare two by their dot product;
    `thumb` (h, w, 4) uint8 RGB, area-averaged, and `core.sharpness`.
    """

    keypoints: Floats
    angle_rad: Floats
    scale_px: Floats
    descriptors: Bytes
    words: Floats
    thumb: Bytes

    def to_bytes(self) -> bytes:
        """All of it, little-endian; the same features give the same bytes."""
        head = _HEAD.pack(_MAGIC, len(self.keypoints), len(self.words), *self.thumb.shape[:2])
        floats = (self.keypoints, self.angle_rad, self.scale_px, self.words)
        body = [np.ascontiguousarray(a, "<f4").tobytes() for a in floats]
        return b"".join((head, *body, self.descriptors.tobytes(), self.thumb.tobytes()))

    @classmethod
    def from_bytes(cls, data: bytes) -> Features:
        """The inverse of `to_bytes`. Raises ValueError when the bytes are not whole features."""
        if len(data) < _HEAD.size or data[:4] != _MAGIC:
            raise ValueError("not the features of a photo")
        _, k, w, th, tw = _HEAD.unpack_from(data)
        n_floats = 4 * k + w
        left = len(data) - _HEAD.size - 4 * n_floats - 128 * k
        if left not in (3 * th * tw, 4 * th * tw):  # three: from before photos were asked how sharp they are
            raise ValueError("the features of this photo are cut off")
        floats = np.frombuffer(data, "<f4", n_floats, _HEAD.size).astype(np.float32)
        rest = np.frombuffer(data, np.uint8, offset=_HEAD.size + 4 * n_floats)
        return cls(
            keypoints=floats[: 2 * k].reshape(k, 2),
            angle_rad=floats[2 * k : 3 * k],
            scale_px=floats[3 * k : 4 * k],
            descriptors=rest[: 128 * k].reshape(k, 128),
            words=floats[4 * k :],
            thumb=rest[128 * k :].reshape(th, tw, -1),
        )


def extract(
    rgb: NDArray[np.uint8], original_size: tuple[int, int], params: FeatureParams | None = None
) -> Features:
    """Finds and describes the keypoints of a photo (Zhao 2020, 3.2).

    `rgb`: uint8 (H, W, 3), the photo at any resolution; `original_size`: (width, height) of the photo itself,
    in whose pixels the keypoints come back. About 15 ms on one core.
    """
    params = params or FeatureParams()
    copy = _shrunk(rgb, params.side_px)
    gray = np.asarray(cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY), np.uint8)
    space = scale_space(gray, params.octave_layers)
    spots = find_spots(space, params.contrast)
    found = describe(space, spots.take(_chosen(spots, gray.shape, params)), params.keypoints)
    descriptors = _root_sift(found.histograms)
    height, width = gray.shape
    to_original = np.array((original_size[0] / width, original_size[1] / height))
    return Features(
        keypoints=((found.xy + 0.5) * to_original - 0.5).astype(np.float32),
        angle_rad=found.angle_rad,
        scale_px=(found.size_px * np.sqrt(to_original.prod())).astype(np.float32),
        descriptors=descriptors,
        words=appearance(descriptors),
        thumb=thumbnail(copy, params.thumb_px),
    )


def thumbnail(rgb: NDArray[np.uint8], side_px: int = 128) -> Bytes:
    """A small copy (h, w, 4) uint8 of a picture (H, W, 3): RGB, and how sharp the picture is."""
    small = _shrunk(rgb, side_px)
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    return np.dstack((small, sharpness(grey, (small.shape[1], small.shape[0]))))


def _shrunk(rgb: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """Area-averaged so that the long side is `side_px`; smaller pictures stay as they are."""
    height, width = rgb.shape[:2]
    scale = side_px / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(rgb)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _chosen(spots: Spots, shape: tuple[int, ...], params: FeatureParams) -> NDArray[np.intp]:
    """Rows of the strongest spots of every grid cell, all cells' strongest first."""
    # Response alone may tie; the order in which spots are found makes the choice unique.
    ranked = np.argsort(-spots.response, kind="stable")
    place = spots.xy()[ranked] / (shape[1], shape[0]) * params.cells
    column, row = place.clip(0, params.cells - 1).astype(int).T
    # Rank by rank through the cells: a cell with few keypoints leaves its places to the others.
    turns = np.argsort(rank_in_cell(row * params.cells + column), kind="stable")
    return np.asarray(ranked[turns[: params.keypoints]])


def rank_in_cell(cell: NDArray[np.int_]) -> NDArray[np.int_]:
    """For each item (N,) how many items before it lie in the same cell."""
    order = np.argsort(cell, kind="stable")
    inside = cell[order]
    rank = np.empty(len(cell), np.int_)
    rank[order] = np.arange(len(cell)) - np.searchsorted(inside, inside)
    return rank


def _root_sift(histograms: Floats) -> Bytes:
    """SIFT (K, 128) → RootSIFT × 512 as uint8 (K, 128): Euclidean distance becomes Hellinger's."""
    share = histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9)
    return np.asarray(np.minimum(np.sqrt(share) * DESCRIPTOR_SCALE + 0.5, 255), np.uint8)
