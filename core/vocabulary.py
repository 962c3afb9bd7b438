"""The shipped visual vocabulary: many descriptors in, one short vector of a picture's appearance out.

VLAD (Jégou 2010) over descriptors reduced by PCA. The vocabulary lies beside this file as `vocabulary.npz`;
`train` made it, so it can be made again from any set of descriptors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """`mean` (128,) and `axes` (128, D) of the descriptor PCA; `centres` (K, D) of k-means in that space."""

    mean: Floats
    axes: Floats
    centres: Floats

    def appearance(self, descriptors: NDArray[np.uint8]) -> Floats:
        """Descriptors (N, 128) uint8 → (K·D,) float32 of length 1, or zeros when N is 0."""
        reduced = (descriptors.astype(np.float32) - self.mean) @ self.axes
        word = (reduced @ self.centres.T - 0.5 * (self.centres**2).sum(1)).argmax(1)
        counts = np.bincount(word, minlength=len(self.centres)).astype(np.float32)
        member = (word == np.arange(len(self.centres))[:, None]).astype(np.float32)
        residual = member @ reduced - counts[:, None] * self.centres
        # Each word counts alike (intra-normalisation): a meadow's thousand blades are one kind of thing.
        residual /= np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-9)
        flat = residual.ravel()
        length = np.linalg.norm(flat)
        return np.asarray(flat / length if length > 0 else flat, np.float32)


@cache
def shipped() -> Vocabulary:
    """The vocabulary that comes with the package."""
    with np.load(BytesIO((files("core") / "vocabulary.npz").read_bytes())) as stored:
        return Vocabulary(*(stored[k].astype(np.float32) for k in ("mean", "axes", "centres")))


def appearance(descriptors: NDArray[np.uint8]) -> Floats:
    """The appearance vector of a picture with these descriptors (N, 128) uint8, in the shipped vocabulary."""
    return shipped().appearance(descriptors)
