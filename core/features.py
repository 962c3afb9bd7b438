"""What is kept of one picture for matching: keypoints, RootSIFT descriptors, appearance, a thumbnail.

Zhao 2020 section 3.2: about a thousand keypoints on a small preview are enough. They are chosen strongest
first within each cell of a grid, so that one leafy corner does not take them all, and only the chosen ones
are described.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

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

    side_px: int = 544
    keypoints: int = 1000
    cells: int = 8
    contrast: float = 0.01
    octave_layers: int = 3
    thumb_px: int = 128


FEATURE_SIDE_PX = FeatureParams().side_px
"""Keypoints are found on a copy of this size, so nothing larger is decoded for them."""


@dataclass(frozen=True, slots=True)
class Features:
    """The features of one photo.

    `keypoints` (K, 2) float32, pixels of the ORIGINAL photo; `angle_rad` (K,) float32, clockwise as seen;
    `scale_px` (K,) float32, diameter in pixels of the original; `descriptors` (K, 128) uint8, RootSIFT × 512;
    `words` (W,) float32 of length 1 (or all zero without keypoints): compare two by their dot product;
    `thumb` (h, w, 3) uint8 RGB, area-averaged.
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
        if len(data) != _HEAD.size + 4 * n_floats + 128 * k + 3 * th * tw:
            raise ValueError("the features of this photo are cut off")
        floats = np.frombuffer(data, "<f4", n_floats, _HEAD.size).astype(np.float32)
        rest = np.frombuffer(data, np.uint8, offset=_HEAD.size + 4 * n_floats)
        return cls(
            keypoints=floats[: 2 * k].reshape(k, 2),
            angle_rad=floats[2 * k : 3 * k],
            scale_px=floats[3 * k : 4 * k],
            descriptors=rest[: 128 * k].reshape(k, 128),
            words=floats[4 * k :],
            thumb=rest[128 * k :].reshape(th, tw, 3),
        )


def extract(
    rgb: NDArray[np.uint8], original_size: tuple[int, int], params: FeatureParams | None = None
) -> Features:
    """Finds and describes the keypoints of a photo (Zhao 2020, 3.2).

    `rgb`: uint8 (H, W, 3), the photo at any resolution; `original_size`: (width, height) of the photo itself,
    in whose pixels the keypoints come back. About 75 ms on one core.
    """
    params = params or FeatureParams()
    copy = _shrunk(rgb, params.side_px)
    gray = cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY)
    found = _detect(gray, params)
    chosen, sift_descriptors = _sift(params).compute(gray, found) if found else ((), None)
    descriptors = _root_sift(sift_descriptors)
    height, width = gray.shape
    to_original = np.array((original_size[0] / width, original_size[1] / height))
    xy = np.array([k.pt for k in chosen]).reshape(-1, 2)
    return Features(
        keypoints=((xy + 0.5) * to_original - 0.5).astype(np.float32),
        angle_rad=np.radians([k.angle for k in chosen]).astype(np.float32),
        scale_px=(np.array([k.size for k in chosen]) * np.sqrt(to_original.prod())).astype(np.float32),
        descriptors=descriptors,
        words=appearance(descriptors),
        thumb=_shrunk(copy, params.thumb_px),
    )


def _shrunk(rgb: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """Area-averaged so that the long side is `side_px`; smaller pictures stay as they are."""
    height, width = rgb.shape[:2]
    scale = side_px / max(height, width)
    if scale >= 1:
        return np.ascontiguousarray(rgb)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)


def _detect(gray: NDArray[Any], params: FeatureParams) -> list[cv2.KeyPoint]:
    """The strongest keypoints of every grid cell, the strongest of all cells first."""
    found = _sift(params).detect(gray)
    # Response alone may tie; position and angle make the order, and so the choice, unique.
    facts = np.array([(k.response, *k.pt, k.angle, k.size) for k in found]).reshape(-1, 5)
    ranked = np.lexsort((facts[:, 4], facts[:, 3], facts[:, 1], facts[:, 2], -facts[:, 0]))
    height, width = gray.shape
    column, row = (
        (facts[ranked, 1:3] / (width, height) * params.cells).clip(0, params.cells - 1).astype(int).T
    )
    rank = rank_in_cell(row * params.cells + column)
    # Rank by rank through the cells: a cell with few keypoints leaves its places to the others.
    chosen = np.argsort(rank, kind="stable")[: params.keypoints]
    return [found[i] for i in ranked[np.sort(chosen)]]


def _sift(params: FeatureParams) -> cv2.SIFT:
    # Precise upscaling: without it OpenCV's keypoints sit a quarter of a pixel off.
    return cv2.SIFT.create(0, params.octave_layers, params.contrast, 10, 1.6, enable_precise_upscale=True)


def rank_in_cell(cell: NDArray[np.int_]) -> NDArray[np.int_]:
    """For each item (N,) how many items before it lie in the same cell."""
    order = np.argsort(cell, kind="stable")
    inside = cell[order]
    rank = np.empty(len(cell), np.int_)
    rank[order] = np.arange(len(cell)) - np.searchsorted(inside, inside)
    return rank


def _root_sift(descriptors: NDArray[Any] | None) -> Bytes:
    """SIFT (K, 128) → RootSIFT × 512 as uint8 (K, 128): Euclidean distance becomes Hellinger's."""
    if descriptors is None or not len(descriptors):
        return np.zeros((0, 128), np.uint8)
    share = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return np.asarray(np.minimum(np.sqrt(share) * DESCRIPTOR_SCALE + 0.5, 255), np.uint8)
