"""Sparse normal equations as a gtsam factor graph: a key per frame, and a last one that all frames share.

gtsam eliminates the linearised graph front by front (a Bayes tree of dense conditionals), in an order with
little fill-in (nested dissection by METIS) that serves every linearisation of the same pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from core.geometry import Array
from core.pose_graph.residuals import IntArray

# Below this any order costs less than finding a good one.
SMALL = 30


@dataclass(frozen=True, slots=True)
class Border:
    """Unknowns that touch every frame: `cross` (N, d, B), `matrix` (B, B), `rhs` (B,)."""

    cross: Array
    matrix: Array
    rhs: Array


@dataclass(frozen=True, slots=True)
class Structure:
    """The `pairs` of frames that are tied, and the `order` (N,) in which frames are eliminated."""

    pairs: tuple[tuple[int, int], ...]
    order: IntArray

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.order)


@dataclass(frozen=True, slots=True)
class Eliminated:
    """gtsam's `tree` of conditionals, and the `order` of its keys: k for frame k, N for the border."""

    tree: gtsam.GaussianBayesTree
    order: IntArray


def plan(n: int, pairs: IntArray) -> Structure:
    """How to eliminate `n` frames tied by `pairs` (E, 2)."""
    return Structure(tuple((i, j) for i, j in pairs.tolist()), _order(n, pairs))


def gaussian_graph(
    pairs: Sequence[tuple[int, int]], frame: Array, pair: Array, rhs: Array, border: Border | None
) -> gtsam.GaussianFactorGraph:
    """H·x = `rhs` (N, d) in HessianFactors: `frame` (N, d, d), `pair` (E, d, d: row the pair's first frame).

    A pair's factor carries only its block off the diagonal: its share of the diagonal is in `frame` already,
    and elimination sums all factors of a key before it factorises.
    """
    n, d = rhs.shape
    graph = gtsam.GaussianFactorGraph()
    add, factor = graph.push_back, gtsam.HessianFactor
    if border is None:
        for k in range(n):
            add(factor(k, frame[k], rhs[k], 0.0))
    else:
        add(factor(n, border.matrix, border.rhs, 0.0))
        no_border, no_border_rhs = np.zeros_like(border.matrix), np.zeros_like(border.rhs)
        for k in range(n):
            add(factor(k, n, frame[k], border.cross[k], rhs[k], no_border, no_border_rhs, 0.0))
    no_frame, no_rhs = np.zeros((d, d)), np.zeros(d)
    for (i, j), block in zip(pairs, pair, strict=True):
        add(factor(i, j, no_frame, block, no_rhs, no_frame, no_rhs, 0.0))
    return graph


def eliminate(
    structure: Structure, frame: Array, pair: Array, rhs: Array, border: Border | None = None
) -> Eliminated | None:
    """The Bayes tree of `gaussian_graph`, the border last; None where H is not positive definite."""
    order = structure.order if border is None else np.append(structure.order, len(structure))
    ordering = gtsam.Ordering()
    for k in order.tolist():
        ordering.push_back(k)
    graph = gaussian_graph(structure.pairs, frame, pair, rhs, border)
    try:
        return Eliminated(graph.eliminateMultifrontal(ordering), order)
    except RuntimeError:
        return None


def solve_blocks(
    structure: Structure, frame: Array, pair: Array, rhs: Array, border: Border | None = None
) -> tuple[Array, Array] | None:
    """Solution (N, d) and (B,) of H·x = `rhs` (N, d); None where H is not positive definite."""
    done = eliminate(structure, frame, pair, rhs, border)
    if done is None:
        return None
    step = done.tree.optimize()
    x = np.array([step.at(k) for k in range(len(structure))]).reshape(rhs.shape)
    y = np.zeros(0) if border is None else np.asarray(step.at(len(structure)), float)
    return (x, y) if np.isfinite(x).all() and np.isfinite(y).all() else None


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
