"""What all pictures of a growing mission look like and where they were taken; it grows by what is new."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from core.frame import GpsFix
from core.neighbours import Sighting

Floats = NDArray[np.float64]
Words = NDArray[np.float32]

_METRES_PER_DEGREE = 111_320.0
_FIRST = 64
_NO_WORDS: Words = np.zeros(0, np.float32)


def apart(words: Words, average: Words) -> Words:
    """`core.neighbours.peculiar` of some pictures (N, W) when the average (W,) is known; rows of length 1."""
    rest = words - average
    return np.asarray(rest / np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), 1e-9), np.float32)


class Gallery:
    """Sightings by frame id, with their average picture; those near some others are found among all at once.

    Words (W,) are kept in half precision: what the live map is built from, not the final one.
    """

    def __init__(self) -> None:
        """Starts empty."""
        self.row_of: dict[str, int] = {}
        self._frames: list[Sighting] = []
        self._at = np.full((_FIRST, 2), np.nan)
        self._words = np.zeros((_FIRST, 0), np.float16)
        self._total: Floats = np.zeros(0)
        self._origin: GpsFix | None = None

    def add(self, sightings: Iterable[Sighting]) -> None:
        """Frames that are there already stay as they are."""
        for sighting in sightings:
            if sighting.frame_id not in self.row_of:
                self._append(sighting)

    @property
    def average(self) -> Words:
        """(W,) the mean of all words."""
        return np.asarray(self._total / max(len(self._frames), 1), np.float32)

    def words(self, frame_ids: Iterable[str]) -> Words:
        """(N, W) in the order of the ids."""
        return self._words[[self.row_of[k] for k in frame_ids]].astype(np.float32)

    def within(self, frame_ids: Collection[str], reach_m: float) -> set[str]:
        """All that lie no further than that from any of these; without GPS a frame is near everybody."""
        n = len(self._frames)
        near = np.zeros(n, bool)
        for k in frame_ids:
            near |= ~(np.hypot(*(self._at[:n] - self._at[self.row_of[k]]).T) > reach_m)
        return {self._frames[row].frame_id for row in np.flatnonzero(near).tolist()}

    def sighting(self, frame_id: str) -> Sighting:
        """As it was added; its words are empty, for `words` has them."""
        return self._frames[self.row_of[frame_id]]

    def _append(self, sighting: Sighting) -> None:
        row, words = len(self._frames), sighting.words
        if row == 0:
            self._words, self._total = np.zeros((_FIRST, len(words)), np.float16), np.zeros(len(words))
        elif row == len(self._words):
            self._words = np.concatenate((self._words, np.zeros_like(self._words)))
            self._at = np.concatenate((self._at, np.full_like(self._at, np.nan)))
        self._words[row], self._at[row] = words, self._place(sighting.gps)
        self._total += words
        self.row_of[sighting.frame_id] = row
        self._frames.append(replace(sighting, words=_NO_WORDS))

    def _place(self, fix: GpsFix | None) -> tuple[float, float]:
        """Metres east and north of the first fix."""
        if fix is None:
            return np.nan, np.nan
        self._origin = origin = self._origin or fix
        east = ((fix.lon_deg - origin.lon_deg + 180) % 360 - 180) * np.cos(np.radians(origin.lat_deg))
        return east * _METRES_PER_DEGREE, (fix.lat_deg - origin.lat_deg) * _METRES_PER_DEGREE
