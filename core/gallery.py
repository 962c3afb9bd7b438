"""What all pictures of a growing mission look like, where and when they were taken; it grows by what is new.

Whom a new frame is worth being matched with, for the same three reasons as in `core.neighbours`, is worked
out from what is kept: nothing is sorted, copied or looked at one by one, however many frames there are.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from core.neighbours import (
    METRES_PER_DEGREE,
    SIMILARITY_STEP,
    CaptureOrder,
    NeighbourParams,
    Pair,
    Sighting,
    capture_order,
    highest,
    one_each,
    spread,
)

Floats = NDArray[np.float64]
Words = NDArray[np.float32]

_FIRST = 64
_NO_WORDS: Words = np.zeros(0, np.float32)


def apart(words: Words, average: Words) -> Words:
    """`core.neighbours.peculiar` of some pictures (N, W) when the average (W,) is known; rows of length 1."""
    rest = words - average
    return np.asarray(rest / np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), 1e-9), np.float32)


class Gallery:
    """Sightings by frame id, with their average picture; those near one or alike are found among all at once.

    Words are (W,), for all of the same length.
    """

    def __init__(self) -> None:
        """Starts empty."""
        self.row_of: dict[str, int] = {}
        self._frames: list[Sighting] = []
        self._lines: dict[str, list[CaptureOrder]] = {}
        self._lat_lon = np.full((_FIRST, 2), np.nan)
        self._words: Words = np.zeros((_FIRST, 0), np.float32)
        self._length2: Words = np.zeros(_FIRST, np.float32)
        self._total: Floats = np.zeros(0)

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
        return self._words[[self.row_of[k] for k in frame_ids]]

    def within(self, frame_ids: Collection[str], reach_m: float) -> set[str]:
        """All that lie no further than that from any of these; without GPS a frame is near everybody."""
        near = np.zeros(len(self._frames), bool)
        for k in frame_ids:
            near |= ~(np.hypot(*self._offsets_m(k).T) > reach_m)
        return {self._frames[row].frame_id for row in np.flatnonzero(near).tolist()}

    def sighting(self, frame_id: str) -> Sighting:
        """As it was added; its words are empty, for `words` has them."""
        return self._frames[self.row_of[frame_id]]

    def partners(self, frame_id: str, params: NeighbourParams | None = None) -> list[Pair]:
        """The pairs (low id, high id) of one of the frames with others that are worth matching, sorted."""
        params, frame = params or NeighbourParams(), self.sighting(frame_id)
        near = self._near(frame, params) if frame.gps is not None else ()
        count = params.alike if frame.gps is not None else params.alike_without_gps
        found = {*self._next_to(frame, params), *near, *self._alike(frame_id, count)} - {frame_id}
        return sorted((min(frame_id, k), max(frame_id, k)) for k in found)

    def _next_to(self, frame: Sighting, params: NeighbourParams) -> Iterator[str]:
        line, reach = self._lines[frame.drone], params.before_and_after
        place = bisect_left(line, capture_order(frame))
        return (at.frame_id for at in line[max(0, place - reach) : place + reach + 1])

    def _near(self, frame: Sighting, params: NeighbourParams) -> Iterator[str]:
        reach = 8 * max(params.nearest, params.sectors) + 1
        rows, xy, position_of = self._nearest(frame.frame_id, reach)
        ordered = sorted(
            zip((capture_order(self._frames[k]) for k in rows), position_of.tolist(), strict=True)
        )
        at: list[list[int]] = [[] for _ in xy]
        for place, (_, position) in enumerate(ordered):
            at[position].append(place)
        mine = next(k for k, (order, _) in enumerate(ordered) if order.frame_id == frame.frame_id)
        near = np.argsort(np.hypot(*xy.T), kind="stable")[:reach]
        positions = spread(xy, ordered[mine][1], near, params)
        return (ordered[k][0].frame_id for k in one_each(mine, at, positions))

    def _nearest(self, frame_id: str, reach: int) -> tuple[NDArray[np.intp], Floats, NDArray[np.intp]]:
        """Rows of frames that stand at the nearest positions, more than `reach` where there are as many; the
        positions (P, 2) from this frame, metres; and which of them each frame is at.
        """
        offset_m = np.round(self._offsets_m(frame_id), 2)  # a repeated fix is one position
        away_m = np.hypot(*offset_m.T)
        located = int(np.isfinite(away_m).sum())
        count = min(2 * reach, located)
        while True:
            rows = np.argpartition(away_m, count - 1)[:count]  # nan, without GPS, counts as farthest
            xy, position_of = np.unique(offset_m[rows], axis=0, return_inverse=True)
            if len(xy) > reach or count == located:
                return rows, xy, position_of.ravel()
            count = min(4 * count, located)

    def _offsets_m(self, frame_id: str) -> Floats:
        """East and north (N, 2) of all frames from this one; nan where either has no GPS."""
        here = self._lat_lon[self.row_of[frame_id]]
        north, east = (self._lat_lon[: len(self._frames)] - here).T
        east = ((east + 180) % 360 - 180) * np.cos(np.radians(here[0]))
        return np.column_stack((east, north)) * METRES_PER_DEGREE

    def _alike(self, frame_id: str, count: int) -> Iterator[str]:
        """As the products of `core.neighbours.peculiar` words would say, without a copy of all words."""
        n, row, mean = len(self._frames), self.row_of[frame_id], self.average
        mine = self._words[row] - mean
        to_mine, to_mean = (self._words[:n] @ np.column_stack((mine, mean))).T
        length2 = self._length2[:n] - 2 * to_mean + mean @ mean
        lengths = np.sqrt(np.maximum(length2, 1e-12) * max(float(mine @ mine), 1e-12))
        similarity = np.round((to_mine - mean @ mine) / lengths / SIMILARITY_STEP)
        similarity[row] = -np.inf
        return (self._frames[k].frame_id for k in highest(similarity, min(count, n - 1)))

    def _append(self, sighting: Sighting) -> None:
        row, words = len(self._frames), sighting.words
        if row == 0:
            self._words, self._total = np.zeros((_FIRST, len(words)), np.float32), np.zeros(len(words))
        elif row == len(self._words):
            self._words = np.concatenate((self._words, np.zeros_like(self._words)))
            self._length2 = np.concatenate((self._length2, np.zeros_like(self._length2)))
            self._lat_lon = np.concatenate((self._lat_lon, np.full_like(self._lat_lon, np.nan)))
        self._words[row] = words
        if (fix := sighting.gps) is not None:
            self._lat_lon[row] = fix.lat_deg, fix.lon_deg
        self._length2[row] = words @ words
        self._total += words
        self.row_of[sighting.frame_id] = row
        insort(self._lines.setdefault(sighting.drone, []), capture_order(sighting))
        self._frames.append(replace(sighting, words=_NO_WORDS))
