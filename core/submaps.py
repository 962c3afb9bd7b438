"""Submaps: parts of the flight whose pictures hang together, and the ties that make one map of them.

Zhan 2021, section III. A submap is what one drone's first matches connect. Frames that no match reaches start
a submap of their own instead of being lost; further pairs between submaps are tried where the pictures look
alike by each frame's own standards, and the strongest ties merge the submaps (Kruskal).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array, Camera
from core.matching import PairMatch
from core.neighbours import NeighbourParams, Pair, Sighting, candidates, metres, peculiar
from core.pose_graph.model import GraphFrame

Georeference = Literal["gps", "tie", "none"]
Matched = Callable[[Sequence[Pair]], Sequence[PairMatch] | None]

_SIMILARITY_STEP = 1e-5
_BLOCK = 256


@dataclass(frozen=True, slots=True)
class TieParams:
    """How pairs between submaps are chosen.

    `usual`: the thresholds k and l of a frame without neighbours to learn them from; `range`: what they may
    be learnt to be. `per_frame`: pairs that one frame proposes at most; `per_tie`: pairs tried between two
    submaps at most. `reach_m`: frames whose GPS lie further apart cannot show the same ground.
    """

    usual: float = 0.5
    range: tuple[float, float] = (0.3, 0.95)
    per_frame: int = 6
    per_tie: int = 64
    reach_m: float = 300.0


@dataclass(frozen=True, slots=True)
class Canonical:
    """The pairs that the final map rests on: `first` candidates, `extra` ties tried; the accepted matches."""

    first: tuple[Pair, ...]
    extra: tuple[Pair, ...]
    matches: tuple[PairMatch, ...]


@dataclass(frozen=True, slots=True)
class Submap:
    """What the first matches of one drone connect; 0 is the largest.

    `merged`: the connected map that it became part of, `submap` in poses.json; None: it has no place.
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


def canonical(
    frames: Sequence[Sighting],
    matched: Matched,
    neighbours: NeighbourParams | None = None,
    params: TieParams | None = None,
) -> Canonical | None:
    """All pairs of the final map: a function of the frames and of what their pairs' matching comes to.

    `matched` gives the accepted matches of some pairs, or None as long as some are not matched yet: then the
    answer is None too, and the same question is asked again later.
    """
    first = candidates(frames, neighbours)
    found = matched(first)
    if found is None:
        return None
    extra = ties_to_try(frames, first, found, params)
    more = matched(extra) if extra else ()
    if more is None:
        return None
    ordered = sorted((m for m in (*found, *more) if m.accepted), key=lambda m: (m.low, m.high))
    return Canonical(tuple(first), tuple(extra), tuple(ordered))


def ties_to_try(
    frames: Sequence[Sighting],
    tried: Collection[Pair],
    matches: Iterable[PairMatch],
    params: TieParams | None = None,
) -> list[Pair]:
    """Pairs (low id, high id) between submaps worth matching besides those `tried`, sorted (Zhan, III C).

    A function of the sets. Empty when the accepted `matches` connect all frames.
    """
    params = params or TieParams()
    ordered = [f for _, f in sorted({f.frame_id: f for f in frames}.items())]
    index = {f.frame_id: k for k, f in enumerate(ordered)}
    edges = [
        (index[m.low], index[m.high], max(m.counts.guided, len(m.uv_low)))
        for m in sorted(matches, key=lambda m: (m.low, m.high))
        if m.accepted and m.low in index and m.high in index
    ]
    part = np.array(parts(len(ordered), [(i, j) for i, j, _ in edges]))
    if len(ordered) < 2 or part.max() == 0:
        return []
    done: list[list[int]] = [[] for _ in ordered]
    for i, j in ((index[a], index[b]) for a, b in tried if a in index and b in index):
        done[i].append(j)
        done[j].append(i)
    shared: list[dict[int, int]] = [{} for _ in ordered]
    for i, j, points in edges:
        shared[i][j] = shared[j][i] = points
    proposals: dict[tuple[int, int], tuple[int, int]] = {}
    for rank, score, low, high in _alike(ordered, part, shared, done, params):
        proposals[low, high] = min(proposals.get((low, high), (rank, -score)), (rank, -score))
    return sorted((ordered[i].frame_id, ordered[j].frame_id) for i, j in _firmest(proposals, part, params))


def _alike(
    frames: Sequence[Sighting],
    part: NDArray[np.int64],
    shared: Sequence[Mapping[int, int]],
    done: Sequence[Sequence[int]],
    params: TieParams,
) -> Iterator[tuple[int, int, int, int]]:
    """(rank, similarity, low, high): what each frame outside the largest submap proposes, best first."""
    words = peculiar(np.stack([f.words for f in frames]))
    loud = 1 / np.sqrt(words.shape[1])
    above, below = (words > loud).astype(np.float32), (words < -loud).astype(np.float32)
    at, seekers = _positions(frames), np.flatnonzero(part != 0)
    for rows in (seekers[k : k + _BLOCK] for k in range(0, len(seekers), _BLOCK)):
        # Both whole numbers: the last bits of a product shall not decide.
        common = np.rint(above[rows] @ above.T + below[rows] @ below.T)
        score = np.rint(words[rows] @ words.T / _SIMILARITY_STEP)
        for i, n, s in zip(rows.tolist(), common, score, strict=True):
            open_to = part != part[i]
            open_to[done[i]] = False
            open_to &= ~(np.hypot(*(at - at[i]).T) > params.reach_m)  # nan: who knows
            chosen = _above(open_to, n, s, *thresholds(shared[i], n, s, params))[: params.per_frame]
            for rank, j in enumerate(chosen):
                yield rank, int(s[j]), min(i, j), max(i, j)


def _positions(frames: Sequence[Sighting]) -> Array:
    """(N, 2) metres, nan without GPS."""
    at = np.full((len(frames), 2), np.nan)
    located = [k for k, f in enumerate(frames) if f.gps is not None]
    if located:
        at[located] = metres(frames, located)
    return at


def _above(
    open_to: NDArray[np.bool_], common: NDArray[Any], score: NDArray[Any], of_words: float, of_score: float
) -> list[int]:
    """The frames that look alike by both measures, k and l times the best of each; most alike first."""
    who = np.flatnonzero(open_to)
    who = who[common[who] >= of_words * common[who].max(initial=0)]
    best = score[who].max(initial=0)
    who = who[(score[who] >= of_score * best) & (score[who] > 0)]
    return [int(j) for j in who[np.argsort(-score[who], kind="stable")]]


def thresholds(
    shared: Mapping[int, int], common: NDArray[Any], score: NDArray[Any], params: TieParams | None = None
) -> tuple[float, float]:
    """The k = N1/N0 and l = S1/S0 of one frame (Zhan 2021, III C): how alike half an overlap looks here.

    `shared`: the points it shares with each of its neighbours. 0 is the neighbour that shares most, 1 the
    one that shares nearest to half as much. `common`, `score` (N,): words in common and similarity to all.
    """
    params = params or TieParams()
    if len(shared) < 2:
        return params.usual, params.usual
    adjacent = min(shared, key=lambda j: (-shared[j], j))
    rest = [j for j in sorted(shared) if j != adjacent]
    nearby = min(rest, key=lambda j: (abs(2 * shared[j] - shared[adjacent]), j))
    low, high = params.range

    def ratio(values: NDArray[Any]) -> float:
        if values[adjacent] <= 0:
            return params.usual
        return min(max(float(values[nearby]) / float(values[adjacent]), low), high)

    return ratio(common), ratio(score)


def _firmest(
    proposals: Mapping[tuple[int, int], tuple[int, int]], part: NDArray[np.int64], params: TieParams
) -> Iterator[tuple[int, int]]:
    """Of the pairs between two submaps the most promising: every frame's first choices first."""
    count: dict[tuple[int, int], int] = {}
    for i, j in sorted(proposals, key=lambda pair: (proposals[pair], pair)):
        between = (int(min(part[i], part[j])), int(max(part[i], part[j])))
        count[between] = count.get(between, 0) + 1
        if count[between] <= params.per_tie:
            yield i, j


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


def intersection_angles_deg(match: PairMatch, low: Camera, high: Camera) -> Array:
    """The angle (M,) at which the rays of each common point meet, both cameras taken to look straight down.

    The turn between the pictures is that of the best similarity; no pose is needed.
    """
    a, b = (
        camera.rays(uv.astype(np.float64))[:, :2] @ np.array([1, 1j])
        for camera, uv in ((low, match.uv_low), (high, match.uv_high))
    )
    turn = np.vdot(b - b.mean(), a - a.mean())
    b = b * (turn / abs(turn) if abs(turn) > 0 else 1.0)
    cosine = (1 + (a * b.conj()).real) / np.sqrt((1 + np.abs(a) ** 2) * (1 + np.abs(b) ** 2))
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def submap_graph(
    frames: Sequence[GraphFrame],
    matches: Iterable[PairMatch],
    merged: Mapping[str, int],
    dropped: Collection[Pair] = (),
    extra: Collection[Pair] = (),
) -> SubmapGraph:
    """The submaps of solved frames and their ties, whatever the order of the arguments.

    `merged`: each placed frame's connected map. `dropped`: matches that the pose graph found wrong. `extra`:
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
    found = [_tie(i, j, crossing, camera) for (i, j), crossing in sorted(between.items())]
    number = max(part, default=-1) + 1
    forest = spanning(number, [(t.low, t.high, t.strength) for t in found])
    ties = tuple(
        Tie(t.low, t.high, t.strength, t.frames, t.points, t.angle_deg, (t.low, t.high) in forest)
        for t in found
    )
    return SubmapGraph(tuple(_submaps(ordered, part, forest, merged)), ties, len(later), len(wrong))


def _tie(low: int, high: int, crossing: Sequence[PairMatch], camera: Mapping[str, Camera]) -> Tie:
    frames = len({f for m in crossing for f in (m.low, m.high)})
    points = sum(len(m.uv_low) for m in crossing)
    angles = [intersection_angles_deg(m, camera[m.low], camera[m.high]) for m in crossing]
    angle_deg = float(np.median(np.concatenate(angles))) if points else 0.0
    return Tie(low, high, strength(frames, points, angle_deg), frames, points, angle_deg)


def _submaps(
    ordered: Sequence[GraphFrame],
    part: Sequence[int],
    forest: Collection[tuple[int, int]],
    merged: Mapping[str, int],
) -> Iterator[Submap]:
    members: dict[int, list[GraphFrame]] = {}
    for f, k in zip(ordered, part, strict=True):
        members.setdefault(k, []).append(f)
    located = {k for k, fs in members.items() if any(f.meta.gps is not None for f in fs)}
    together = parts(len(members), forest)
    reached = {together[k] for k in located}
    for k, fs in sorted(members.items()):
        by: Georeference = "gps" if k in located else "tie" if together[k] in reached else "none"
        home = next((merged[f.frame_id] for f in fs if f.frame_id in merged), None)
        yield Submap(k, tuple(f.frame_id for f in fs), fs[0].meta.drone, home, by)


def joins(merged: Mapping[str, int], new_ids: Collection[str], matches: Iterable[PairMatch]) -> bool:
    """Whether the matches of new frames tie frames of different connected maps: then all is solved again."""
    touching = [m for m in matches if m.accepted and (m.low in new_ids or m.high in new_ids)]
    known = {f: merged[f] for m in touching for f in (m.low, m.high) if f in merged}
    nodes: list[int | str] = [*sorted(set(known.values())), *sorted(new_ids)]
    index = {node: k for k, node in enumerate(nodes)}
    ends = [(known.get(m.low, m.low), known.get(m.high, m.high)) for m in touching]
    label = parts(len(nodes), [(index[a], index[b]) for a, b in ends if a in index and b in index])
    maps = len(nodes) - len(new_ids)
    return len(set(label[:maps])) < maps
