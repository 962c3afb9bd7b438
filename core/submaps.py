"""Submaps: parts of the flight whose pictures hang together, and the ties that make one map of them.

Zhan 2021, section III. A submap is what one drone's first matches connect. Frames that no match reaches start
a submap of their own instead of being lost; `core.ties` looks for more, and the strongest ties merge the
submaps (Kruskal).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from core.geometry import Array, Camera, Pose
from core.matching import PairMatch
from core.neighbours import Pair
from core.pose_graph.model import GraphFrame

Georeference = Literal["gps", "tie", "none"]


@dataclass(frozen=True, slots=True)
class Submap:
    """What the first matches of one drone connect; 0 is the largest.

    `merged`: the connected map that it became part of, `submap` in poses.json; None: it has no pose.
    `georeferenced_by`: its own GPS, a tie to a submap with GPS, or nothing.
    """

    index: int
    frame_ids: tuple[str, ...]
    drone: str
    merged: int | None
    georeferenced_by: Georeference


@dataclass(frozen=True, slots=True)
class Tie:
    """How firmly two submaps hang together (Zhan 2021, equation 3); `accepted`: it is in the forest.

    `frames` F that take part; `points` M that both see; `angle_deg`: θ, the median angle at which rays to
    the same point meet.
    """

    low: int
    high: int
    strength: float
    frames: int
    points: int
    angle_deg: float
    accepted: bool = False


@dataclass(frozen=True, slots=True)
class SubmapGraph:
    """A mission's submaps by index and the ties between them; `tried`: extra pairs, `dropped`: wrong ones."""

    submaps: tuple[Submap, ...]
    ties: tuple[Tie, ...]
    tried: int = 0
    dropped: int = 0

    def to_json(self) -> dict[str, Any]:
        """What the API and the report show: frames are counted, not listed."""
        submaps = [
            {
                "index": s.index,
                "submap": s.merged,
                "frames": len(s.frame_ids),
                "drone": s.drone,
                "georeferenced_by": s.georeferenced_by,
            }
            for s in self.submaps
        ]
        ties = [
            {
                "low": t.low,
                "high": t.high,
                "strength": round(t.strength, 3),
                "frames": t.frames,
                "points": t.points,
                "angle_deg": round(t.angle_deg, 3),
                "accepted": t.accepted,
            }
            for t in self.ties
        ]
        return {"submaps": submaps, "ties": ties, "tried_pairs": self.tried, "dropped_pairs": self.dropped}


def parts(n: int, pairs: Iterable[tuple[int, int]]) -> list[int]:
    """The connected part (n,) of each node: 0 is the largest, equals by their first node."""
    union = _Union(n)
    for i, j in pairs:
        union.join(i, j)
    members: dict[int, list[int]] = {}
    for k in range(n):
        members.setdefault(union.root(k), []).append(k)
    label = [0] * n
    for number, group in enumerate(sorted(members.values(), key=lambda g: (-len(g), g[0]))):
        for k in group:
            label[k] = number
    return label


class _Union:
    """Disjoint sets of 0 … n − 1."""

    def __init__(self, n: int) -> None:
        self._up = list(range(n))

    def root(self, k: int) -> int:
        while self._up[k] != k:
            self._up[k] = self._up[self._up[k]]
            k = self._up[k]
        return k

    def join(self, i: int, j: int) -> bool:
        """Whether they were apart."""
        i, j = self.root(i), self.root(j)
        self._up[max(i, j)] = min(i, j)
        return i != j


def strength(frames: int, points: int, angle_deg: float) -> float:
    """C = F + 0.1 M + 0.1 θ², θ in degrees and at most 45 (Zhan 2021, equation 3)."""
    return frames + 0.1 * points + 0.1 * min(angle_deg, 45.0) ** 2


def spanning(n: int, ties: Iterable[tuple[int, int, float]]) -> set[tuple[int, int]]:
    """The strongest forest that spans n submaps: Kruskal on −C, equals by their indices (Zhan, III E)."""
    union = _Union(n)
    ordered = sorted((-c, min(i, j), max(i, j)) for i, j, c in ties)
    return {(i, j) for _, i, j in ordered if union.join(i, j)}


def intersection_angles_deg(match: PairMatch, low: Camera, high: Camera, turn: Array | None = None) -> Array:
    """The angle (M,) at which the rays to each common point meet.

    `turn`: low_R_high (3, 3); without it both cameras are taken to look straight down, and the turn is that
    of the best similarity between the pictures.
    """
    a, b = low.rays(match.uv_low.astype(np.float64)), high.rays(match.uv_high.astype(np.float64))
    rays = b @ (_flat_turn(a, b) if turn is None else turn).T
    cosine = (a * rays).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(rays, axis=1))
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _flat_turn(a: Array, b: Array) -> Array:
    p, q = (rays[:, :2] @ np.array([1, 1j]) for rays in (a, b))
    angle = float(np.angle(np.vdot(q - q.mean(), p - p.mean())))
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def submap_graph(
    frames: Sequence[GraphFrame],
    matches: Iterable[PairMatch],
    poses: Mapping[str, Pose],
    dropped: Collection[Pair] = (),
    extra: Collection[Pair] = (),
) -> SubmapGraph:
    """The submaps of solved frames and their ties, whatever the order of the arguments.

    `poses`: of the frames that have a place. `dropped`: matches that the pose graph found wrong. `extra`:
    pairs that were tried in order to tie submaps.
    """
    ordered = sorted(frames, key=lambda f: (f.name, f.frame_id))
    index = {f.frame_id: k for k, f in enumerate(ordered)}
    wrong, later = set(dropped), set(extra)
    good = sorted(
        (m for m in matches if m.accepted and (m.low, m.high) not in wrong), key=lambda m: (m.low, m.high)
    )
    good = [m for m in good if m.low in index and m.high in index]
    own = [
        (i, j)
        for m in good
        if ordered[i := index[m.low]].meta.drone == ordered[j := index[m.high]].meta.drone
        and (m.low, m.high) not in later
    ]
    part = parts(len(ordered), own)
    between: dict[tuple[int, int], list[PairMatch]] = {}
    for m in good:
        i, j = sorted((part[index[m.low]], part[index[m.high]]))
        if i != j:
            between.setdefault((i, j), []).append(m)
    camera = {f.frame_id: f.meta.camera() for f in ordered}
    found = [_tie(i, j, crossing, camera, poses) for (i, j), crossing in sorted(between.items())]
    number = max(part, default=-1) + 1
    forest = spanning(number, [(t.low, t.high, t.strength) for t in found])
    ties = tuple(
        Tie(t.low, t.high, t.strength, t.frames, t.points, t.angle_deg, (t.low, t.high) in forest)
        for t in found
    )
    return SubmapGraph(tuple(_submaps(ordered, part, forest, poses)), ties, len(later), len(wrong))


def _tie(
    low: int,
    high: int,
    crossing: Sequence[PairMatch],
    camera: Mapping[str, Camera],
    poses: Mapping[str, Pose],
) -> Tie:
    frames = len({f for m in crossing for f in (m.low, m.high)})
    points = sum(len(m.uv_low) for m in crossing)
    angles = [
        intersection_angles_deg(m, camera[m.low], camera[m.high], _turn(poses.get(m.low), poses.get(m.high)))
        for m in crossing
    ]
    angle_deg = float(np.median(np.concatenate(angles))) if points else 0.0
    return Tie(low, high, strength(frames, points, angle_deg), frames, points, angle_deg)


def _turn(low: Pose | None, high: Pose | None) -> Array | None:
    if low is None or high is None or "gnss" in (low.source, high.source):
        return None
    return np.asarray(low.world_R_cam.T @ high.world_R_cam)


def _submaps(
    ordered: Sequence[GraphFrame],
    part: Sequence[int],
    forest: Collection[tuple[int, int]],
    poses: Mapping[str, Pose],
) -> Iterator[Submap]:
    members: dict[int, list[GraphFrame]] = {}
    for f, k in zip(ordered, part, strict=True):
        members.setdefault(k, []).append(f)
    located = {k for k, fs in members.items() if any(f.meta.gps is not None for f in fs)}
    together = parts(len(members), forest)
    reached = {together[k] for k in located}
    for k, fs in sorted(members.items()):
        by: Georeference = "gps" if k in located else "tie" if together[k] in reached else "none"
        home = next((poses[f.frame_id].submap for f in fs if f.frame_id in poses), None)
        yield Submap(k, tuple(f.frame_id for f in fs), fs[0].meta.drone, home, by)


def joins(merged: Mapping[str, int | str], new_ids: Collection[str], matches: Iterable[PairMatch]) -> bool:
    """Whether the matches of new frames tie frames of different connected maps: then all is solved again.

    `merged`: which map each known frame is part of.
    """
    touching = [m for m in matches if m.accepted and (m.low in new_ids or m.high in new_ids)]
    known = {f: merged[f] for m in touching for f in (m.low, m.high) if f in merged}
    nodes: list[int | str] = [*sorted(set(known.values()), key=str), *sorted(new_ids)]
    index = {node: k for k, node in enumerate(nodes)}
    ends = [(known.get(m.low, m.low), known.get(m.high, m.high)) for m in touching]
    label = parts(len(nodes), [(index[a], index[b]) for a, b in ends if a in index and b in index])
    maps = len(nodes) - len(new_ids)
    return len(set(label[:maps])) < maps
