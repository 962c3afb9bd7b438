"""Which pairs of frames are worth matching: near in space, near in time, or alike (Zhao 2020, 3.2).

Three independent reasons, because each fails somewhere: GPS may be 60 m off or missing, capture times may be
wrong, and meadows all look alike. The answer is a function of the set of frames, whatever their order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.frame import GpsFix

Pair = tuple[str, str]
Floats = NDArray[np.float64]

METRES_PER_DEGREE = 111_320.0
SIMILARITY_STEP = 1e-5


@dataclass(frozen=True, slots=True)
class Sighting:
    """What is known of a frame when its partners are sought. `words`: `Features.words`, any one length W."""

    frame_id: str
    captured_s: float | None
    name: str
    drone: str
    gps: GpsFix | None
    words: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class NeighbourParams:
    """How many partners each reason proposes.

    `nearest`: nearest positions; `sectors`: the nearest position in each of so many directions besides, so
    that a dense flight line does not hide the next line. `before_and_after`: frames of the same drone on
    either side in capture order. `alike`: most similar pictures, `alike_without_gps` for frames without GPS.
    """

    nearest: int = 10
    sectors: int = 8
    before_and_after: int = 2
    alike: int = 4
    alike_without_gps: int = 8


def candidates(frames: Sequence[Sighting], params: NeighbourParams | None = None) -> list[Pair]:
    """All pairs (low id, high id) worth matching, sorted; the order of `frames` does not matter."""
    params = params or NeighbourParams()
    ordered = _ordered(frames)
    return _pairs(ordered, ((i, j) for i, js in _partners(ordered, params) for j in js))


class CaptureOrder(NamedTuple):
    """Where a frame stands among all: by capture time, those without one last."""

    captured_s: float
    name: str
    frame_id: str


def capture_order(frame: Sighting) -> CaptureOrder:
    """What frames are sorted by."""
    return CaptureOrder(np.inf if frame.captured_s is None else frame.captured_s, frame.name, frame.frame_id)


def _ordered(frames: Iterable[Sighting]) -> list[Sighting]:
    """Capture order, each frame once."""
    return sorted({f.frame_id: f for f in frames}.values(), key=capture_order)


def _pairs(ordered: Sequence[Sighting], indices: Iterable[tuple[int, int]]) -> list[Pair]:
    ids = [f.frame_id for f in ordered]
    return sorted({(min(ids[i], ids[j]), max(ids[i], ids[j])) for i, j in indices if i != j})


def _partners(ordered: Sequence[Sighting], params: NeighbourParams) -> Iterable[tuple[int, list[int]]]:
    """For each frame's index the indices of its partners, reason after reason."""
    yield from _in_time(ordered, params)
    yield from _in_space(ordered, params)
    yield from _in_appearance(ordered, params)


def _in_time(ordered: Sequence[Sighting], params: NeighbourParams) -> Iterable[tuple[int, list[int]]]:
    by_drone = sorted(range(len(ordered)), key=lambda i: (ordered[i].drone, i))
    reach = params.before_and_after
    for _, group in groupby(by_drone, key=lambda i: ordered[i].drone):
        line = list(group)
        for place, i in enumerate(line):
            yield i, line[max(0, place - reach) : place + reach + 1]


def _in_space(ordered: Sequence[Sighting], params: NeighbourParams) -> Iterable[tuple[int, list[int]]]:
    located = [i for i, f in enumerate(ordered) if f.gps is not None]
    if len(located) < 2:
        return
    xy, position_of = np.unique(metres(ordered, located), axis=0, return_inverse=True)
    position_of = position_of.ravel()
    at: list[list[int]] = [[] for _ in xy]
    for i, p in zip(located, position_of, strict=True):
        at[p].append(i)
    tree = cKDTree(xy)
    reach = min(len(xy), 8 * max(params.nearest, params.sectors) + 1)
    for i, p in zip(located, position_of, strict=True):
        _, near = tree.query(xy[p], k=reach)
        yield i, one_each(i, at, spread(xy, int(p), np.atleast_1d(near), params))


def metres(ordered: Sequence[Sighting], located: Sequence[int]) -> Floats:
    """East and north (N, 2) of frames that have GPS, from a middle of theirs; longitude's scale may be rough.

    Rounded to centimetres: a repeated fix is one position.
    """
    fixes = [ordered[i].gps for i in located]
    lat_lon = np.array([(g.lat_deg, g.lon_deg) for g in fixes if g is not None])
    lon = lat_lon[:, 1] - np.median(lat_lon[:, 1])
    east = ((lon + 180) % 360 - 180) * np.cos(np.radians(np.median(lat_lon[:, 0])))
    return np.round(np.column_stack((east, lat_lon[:, 0])) * METRES_PER_DEGREE, 2)


def spread(xy: Floats, p: int, near: NDArray[np.intp], params: NeighbourParams) -> list[int]:
    """Of the near positions, nearest first, the nearest few and the nearest in each direction; p leads."""
    near = near[near != p]
    offset = xy[near] - xy[p]
    turn = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) % 1
    _, first_in_sector = np.unique((turn * params.sectors).astype(int), return_index=True)
    chosen = {int(q) for q in near[: params.nearest]} | {int(q) for q in near[first_in_sector]}
    return [p, *sorted(chosen)]


def one_each(i: int, at: Sequence[Sequence[int]], positions: Sequence[int]) -> list[int]:
    """One frame per position, the next in capture order; of i's own position one before and one after."""
    here = at[positions[0]]
    place = here.index(i)
    there = [min(at[q], key=lambda j: abs(j - i)) for q in positions[1:]]
    return [*here[max(0, place - 1) : place + 2], *there]


def _in_appearance(ordered: Sequence[Sighting], params: NeighbourParams) -> Iterable[tuple[int, list[int]]]:
    if len(ordered) < 2:
        return
    apart = peculiar(np.stack([f.words for f in ordered]))
    for start in range(0, len(ordered), 256):
        # Rounded, so that the last bits of a product do not decide between twins: the earlier one wins.
        similarity = np.round(apart[start : start + 256] @ apart.T / SIMILARITY_STEP)
        for i, row in enumerate(similarity, start):
            row[i] = -np.inf
            count = params.alike if ordered[i].gps is not None else params.alike_without_gps
            yield i, highest(row, min(count, len(ordered) - 1))


def highest(row: NDArray[np.float32], count: int) -> list[int]:
    """The places of the `count` highest values (N,), the earlier place first among equals."""
    if count == 0:
        return []
    enough = np.flatnonzero(row >= np.partition(row, -count)[-count])
    return [int(j) for j in enough[np.argsort(-row[enough], kind="stable")][:count]]


def peculiar(words: NDArray[np.float32]) -> NDArray[np.float32]:
    """What sets each picture of the mission apart from the mission's average: (N, W), rows of length 1.

    One field fills all pictures of many a flight; without this, its common look drowns the differences.
    """
    apart = words - words.mean(0, dtype=np.float64).astype(np.float32)
    length = np.linalg.norm(apart, axis=1, keepdims=True)
    return np.asarray(apart / np.maximum(length, 1e-9), np.float32)
