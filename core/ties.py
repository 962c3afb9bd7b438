"""Which pairs the final map rests on: neighbours first, then what may tie the submaps that are left.

Zhan 2021, section III C: pairs between submaps are tried where the pictures look alike by each frame's own
measure, learnt from how alike its neighbours in its own submap look.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.gallery import Gallery, apart
from core.geometry import Array
from core.matching import PairMatch
from core.neighbours import NeighbourParams, Pair, Sighting, candidates, metres, peculiar
from core.submaps import parts

Matched = Callable[[Sequence[Pair]], Sequence[PairMatch] | None]

_SIMILARITY_STEP = 1e-5
_BLOCK = 256


@dataclass(frozen=True, slots=True)
class TieParams:
    """How pairs between submaps are chosen.

    `usual`: the thresholds k and l of a frame without neighbours to learn them from; `range`: what they may
    be learnt to be. `per_frame`: pairs that one frame proposes at most; `per_tie`: pairs tried between two
    submaps at most. `rounds`: how often what has been merged looks for the rest. `reach_m`: frames whose GPS
    lie further apart cannot show the same ground.
    """

    usual: float = 0.5
    range: tuple[float, float] = (0.3, 0.95)
    per_frame: int = 6
    per_tie: int = 64
    rounds: int = 4
    reach_m: float = 300.0


LIVE = TieParams(per_frame=2, per_tie=8)
"""While drones fly, every photo looks at the other maps a little; the final solve looks again, and harder."""


@dataclass(frozen=True, slots=True)
class Canonical:
    """The pairs that the final map rests on: `first` candidates, `extra` ties tried; the accepted matches."""

    first: tuple[Pair, ...]
    extra: tuple[Pair, ...]
    matches: tuple[PairMatch, ...]


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
    params, extra, good = params or TieParams(), list[Pair](), list(found)
    for _ in range(params.rounds):
        tries = ties_to_try(frames, (*first, *extra), good, params)
        if not tries:
            break
        more = matched(tries)
        if more is None:
            return None
        extra += tries
        good += more
    ordered = sorted((m for m in good if m.accepted), key=lambda m: (m.low, m.high))
    return Canonical(tuple(first), tuple(sorted(extra)), tuple(ordered))


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
    ordered, index = _indexed(frames)
    edges = [
        (index[m.low], index[m.high], max(m.counts.guided, len(m.uv_low)))
        for m in sorted(matches, key=lambda m: (m.low, m.high))
        if m.accepted and m.low in index and m.high in index
    ]
    part = np.array(parts(len(ordered), [(i, j) for i, j, _ in edges]))
    if len(ordered) < 2 or part.max() == 0:
        return []
    shared: list[dict[int, int]] = [{} for _ in ordered]
    for i, j, points in edges:
        shared[i][j] = shared[j][i] = points
    seekers = np.flatnonzero(part != 0)
    words = peculiar(np.stack([f.words for f in ordered]))
    proposals = _alike(ordered, words, part, shared, _tried(tried, index), seekers, params)
    return _chosen(ordered, proposals, part, params)


def live_ties(
    seekers: Collection[str],
    gallery: Gallery,
    homes: Mapping[str, Hashable],
    tried: Collection[Pair],
    params: TieParams | None = None,
) -> list[Pair]:
    """Pairs (low id, high id) of `seekers` with frames of other maps, worth matching besides those `tried`.

    While the mission grows: `homes` says which map each frame is part of, and each frame's thresholds are
    the usual ones. Only what lies near is looked at closely. Sorted.
    """
    params = params or LIVE
    seeking = {k for k in seekers if k in homes and k in gallery.row_of}
    own = {homes[k] for k in seeking}
    others = (k for k in gallery.within(seeking, params.reach_m) if k in homes)
    near = seeking | {k for k in others if len(own) > 1 or homes[k] not in own}
    label = {home: k for k, home in enumerate(sorted({homes[k] for k in near}, key=str))}
    if len(label) < 2:
        return []
    ordered, index = _indexed(gallery.sighting(k) for k in near)
    part = np.array([label[homes[f.frame_id]] for f in ordered], np.int64)
    rows = np.array(sorted(index[k] for k in seeking), np.int64)
    words = apart(gallery.words(f.frame_id for f in ordered), gallery.average)
    nobody: list[dict[int, int]] = [{} for _ in ordered]
    proposals = _alike(ordered, words, part, nobody, _tried(tried, index), rows, params)
    return _chosen(ordered, proposals, part, params)


def _indexed(frames: Iterable[Sighting]) -> tuple[list[Sighting], dict[str, int]]:
    ordered = [f for _, f in sorted({f.frame_id: f for f in frames}.items())]
    return ordered, {f.frame_id: k for k, f in enumerate(ordered)}


def _tried(tried: Iterable[Pair], index: Mapping[str, int]) -> list[list[int]]:
    """Whom each frame was matched with."""
    done: list[list[int]] = [[] for _ in index]
    for i, j in ((index[a], index[b]) for a, b in tried if a in index and b in index):
        done[i].append(j)
        done[j].append(i)
    return done


def _chosen(
    ordered: Sequence[Sighting],
    proposed: Iterable[tuple[int, int, int, int]],
    part: NDArray[np.int64],
    params: TieParams,
) -> list[Pair]:
    proposals: dict[tuple[int, int], tuple[int, int]] = {}
    for rank, score, low, high in proposed:
        proposals[low, high] = min(proposals.get((low, high), (rank, -score)), (rank, -score))
    return sorted((ordered[i].frame_id, ordered[j].frame_id) for i, j in _firmest(proposals, part, params))


def _alike(
    frames: Sequence[Sighting],
    words: NDArray[np.float32],
    part: NDArray[np.int64],
    shared: Sequence[Mapping[int, int]],
    done: Sequence[Sequence[int]],
    seekers: NDArray[np.int64],
    params: TieParams,
) -> Iterator[tuple[int, int, int, int]]:
    """(rank, similarity, low, high): what each of the `seekers` proposes, best first. `words`: peculiar."""
    loud = 1 / np.sqrt(words.shape[1])
    above, below = (words > loud).astype(np.float32), (words < -loud).astype(np.float32)
    at = _positions(frames)
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
