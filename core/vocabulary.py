"""The shipped visual vocabulary: many descriptors in, one vector of a picture's appearance out.

VLAD (Jégou 2010) over descriptors reduced by PCA. The vocabulary lies beside this file as `vocabulary.npz`
(float16, 10 KB). `train` made it, with seed 0, 32 words and 32 dimensions, from 20,000 descriptors of each
of four openly licensed flights (park and shore, near-infrared fields, suburb, dirt road) and as many of
simulated ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

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
        member = (word == np.arange(len(self.centres))[:, None]).astype(np.float32)
        residual = member @ reduced - member.sum(1, keepdims=True) * self.centres
        # Each word counts alike (intra-normalisation): a meadow's thousand blades are one kind of thing.
        residual /= np.maximum(np.linalg.norm(residual, axis=1, keepdims=True), 1e-9)
        flat = residual.ravel()
        return np.asarray(flat / max(float(np.linalg.norm(flat)), 1e-9), np.float32)

    def to_bytes(self) -> bytes:
        """The file that `from_bytes` reads."""
        file = BytesIO()
        parts = {"mean": self.mean, "axes": self.axes, "centres": self.centres}
        np.savez_compressed(file, allow_pickle=False, **{k: v.astype(np.float16) for k, v in parts.items()})
        return file.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Vocabulary:
        """A vocabulary rounded to half precision."""
        with np.load(BytesIO(data), allow_pickle=False) as stored:
            return cls(*(stored[k].astype(np.float32) for k in ("mean", "axes", "centres")))


def train(descriptors: NDArray[np.uint8], words: int = 32, dimensions: int = 32, seed: int = 0) -> Vocabulary:
    """A vocabulary from descriptors (N, 128) uint8 of many different flights."""
    mean = descriptors.mean(0, dtype=np.float64)
    centred = descriptors - mean
    _, axes = np.linalg.eigh(centred.T @ centred)
    strongest = axes[:, ::-1][:, :dimensions]
    centres, _ = kmeans2(centred @ strongest, words, iter=40, minit="++", rng=np.random.default_rng(seed))
    return Vocabulary(mean.astype(np.float32), strongest.astype(np.float32), centres.astype(np.float32))


@cache
def shipped() -> Vocabulary:
    """The vocabulary that comes with the package."""
    return Vocabulary.from_bytes((files("core") / "vocabulary.npz").read_bytes())


LOOKS = 512
"""So many numbers are a picture's looks."""


def looks(words: Floats) -> NDArray[np.float16]:
    """The more telling half of an appearance vector (1024,): (`LOOKS`,), each word's stronger dimensions.

    Found by it, the most similar picture shows the same ground about as often as by all of it; what all
    photos of a mission look like takes half the memory and half the time.
    """
    return words.reshape(32, 32)[:, : LOOKS // 32].ravel().astype(np.float16)


def appearance(descriptors: NDArray[np.uint8]) -> Floats:
    """The appearance vector of a picture with these descriptors (N, 128) uint8, in the shipped vocabulary."""
    return shipped().appearance(descriptors)
