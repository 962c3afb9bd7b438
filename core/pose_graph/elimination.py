"""In which order, and in which dense fronts, the unknowns of a pose graph are eliminated.

gtsam finds an order with little fill-in (nested dissection by METIS); frames with nearly the same neighbours
are eliminated together, so that almost all arithmetic happens in dense matrices (multifrontal elimination,
Duff and Reid 1983, as in gtsam's Bayes tree). One plan serves every linearisation of the same pairs. The
numbers are in `core.pose_graph.factor`.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from core.pose_graph.residuals import IntArray

# Below this a graph is one dense matrix: any order costs less than finding a good one.
SMALL = 30
# Frames join a front when that stores at most this many blocks of zeros, or this share of the front.
SLACK_BLOCKS = 24
SLACK_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Front:
    """A dense step of the elimination: the first `pivots` of `nodes` go, the rest is handed to `parent`.

    `nodes`: frames in order of elimination. `parent`: index of a later front, −1 for a last one. `at`: where
    the nodes that stay lie in the parent's `nodes`. `pairs`: rows (edge, row, column, flipped) of the blocks
    below the diagonal that enter here; `flipped`: 1 when the pair's block is to be transposed.
    """

    nodes: IntArray
    pivots: int
    parent: int
    at: IntArray
    pairs: IntArray


def plan(n: int, pairs: IntArray) -> tuple[Front, ...]:
    """Fronts, children before parents, for `n` frames tied by `pairs` (E, 2)."""
    order = _order(n, pairs)
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    ranked = rank[pairs].reshape(-1, 2)
    eliminated, stays = _grouped(_structure(n, ranked))
    home = np.zeros(n, np.int64)
    for k, group in enumerate(eliminated):
        home[group] = k
    # a block enters where the earlier of its two frames goes
    flipped = ranked[:, 0] < ranked[:, 1]
    entry = np.column_stack((np.arange(len(pairs)), ranked.max(1), ranked.min(1), flipped)).astype(np.int64)
    at_front = home[entry[:, 2]]
    by_front = np.argsort(at_front, kind="stable")
    cuts = np.searchsorted(at_front[by_front], np.arange(len(eliminated) + 1))
    own = [np.array(g + s, np.int64) for g, s in zip(eliminated, stays, strict=True)]
    fronts = []
    for k, (group, rest) in enumerate(zip(eliminated, stays, strict=True)):
        mine = entry[by_front[cuts[k] : cuts[k + 1]]]
        mine[:, 1:3] = np.searchsorted(own[k], mine[:, 1:3])
        parent = int(home[rest[0]]) if rest else -1
        at = np.searchsorted(own[parent], rest).astype(np.int64)
        fronts.append(Front(order[own[k]], len(group), parent, at, np.ascontiguousarray(mine)))
    return tuple(fronts)


def _order(n: int, pairs: IntArray) -> IntArray:
    """Frames in the order in which they are eliminated."""
    if n <= SMALL or not len(pairs):
        return np.arange(n)
    ones = np.ones(len(pairs), np.int8)
    _, part = connected_components(coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (n, n)), directed=False)
    by_part = np.argsort(part, kind="stable")
    members = np.split(by_part, np.flatnonzero(np.diff(part[by_part])) + 1)
    own, of_pair = np.empty(n, np.int64), part[pairs[:, 0]]
    ordered = []
    for mine in members:
        own[mine] = np.arange(len(mine))
        inside = own[pairs[of_pair == part[mine[0]]]] if len(mine) > SMALL else pairs[:0]
        ordered.append(mine[_dissected(len(mine), inside)])
    return np.concatenate(ordered)


def _dissected(n: int, pairs: IntArray) -> IntArray:
    """The order by METIS, which wants a connected graph: it crashes on a node without neighbours."""
    if n <= SMALL:
        return np.arange(n)
    graph = gtsam.SymbolicFactorGraph()
    for i, j in pairs.tolist():
        graph.push_factor(i, j)
    found = gtsam.Ordering.MetisSymbolicFactorGraph(graph)
    return np.array([found.at(k) for k in range(n)], np.int64)


def _structure(n: int, ranked: IntArray) -> list[set[int]]:
    """Per position of the order, the later positions that its elimination ties together."""
    if n <= SMALL:
        return [set(range(k + 1, n)) for k in range(n)]
    later: list[set[int]] = [set() for _ in range(n)]
    for i, j in zip(ranked.min(1).tolist(), ranked.max(1).tolist(), strict=True):
        later[i].add(j)
    for mine in later:
        if mine:
            parent = min(mine)
            later[parent] |= mine
            later[parent].discard(parent)
    return later


def _grouped(later: list[set[int]]) -> tuple[list[list[int]], list[list[int]]]:
    """Positions eliminated together, and those that stay: fronts in order, both lists ascending."""
    n = len(later)
    groups: list[list[int]] = [[k] for k in range(n)]
    children: list[list[int]] = [[] for _ in range(n)]
    wasted = [0] * n
    for k, mine in enumerate(later):
        # largest children first: those are nearest to what stays here
        for child in sorted(children[k], key=lambda c: (-len(later[c]), c)):
            joined, size = groups[child] + groups[k], 1 + len(mine)
            zeros = len(groups[child]) * (size + len(groups[k]) - 1 - len(later[child]))
            zeros += wasted[child] + wasted[k]
            if zeros <= max(SLACK_BLOCKS, SLACK_SHARE * len(joined) * (len(joined) + size)):
                groups[k], groups[child], wasted[k] = joined, [], zeros
        if mine:
            children[min(mine)].append(k)
    tops = [k for k in range(n) if groups[k]]
    return [sorted(groups[k]) for k in tops], [sorted(later[k]) for k in tops]
