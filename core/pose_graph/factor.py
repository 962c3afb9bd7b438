"""Cholesky factor of sparse normal equations, front by front, and the solution that it gives.

Normal equations have a block per frame, one per pair, and a border of unknowns shared by all (lenses, lags).
The border and the right-hand side ride along as the last rows of every front, so that one pass does for both.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cython_blas
from scipy.linalg.blas import dgemv, dsyrk, dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf

from core.compiled import compiled
from core.geometry import Array
from core.pose_graph.elimination import Front
from core.pose_graph.residuals import IntArray


@dataclass(frozen=True, slots=True)
class Border:
    """Unknowns that touch every frame: `cross` (N, d, B), `matrix` (B, B), `rhs` (B,)."""

    cross: Array
    matrix: Array
    rhs: Array


@dataclass(frozen=True, slots=True)
class Factor:
    """H = L·Lᵀ in the order of the `fronts`: `lower` (p, p) and `below` (s + B + 1, p) of each.

    The rows below: the nodes that stay, the border, the right-hand side. `last` (B + 1, B): the same of the
    border. `d` unknowns a frame.
    """

    fronts: tuple[Front, ...]
    lower: tuple[Array, ...]
    below: tuple[Array, ...]
    last: Array
    d: int


@compiled
def _enter(
    panel: Array, nodes: IntArray, pivots: int, pairs: IntArray, frame: Array, pair: Array, tail: Array
) -> None:
    """Add the blocks that enter a front to its first columns (lower triangle), in place."""
    d, at = frame.shape[1], len(nodes) * frame.shape[1]
    for k in range(pivots):
        for b in range(d):
            for a in range(d):
                panel[k * d + a, k * d + b] += frame[nodes[k], a, b]
            for a in range(tail.shape[2]):
                panel[at + a, k * d + b] += tail[nodes[k], b, a]
    for m in range(len(pairs)):
        e, row, col, flipped = pairs[m]
        for b in range(d):
            for a in range(d):
                panel[row * d + a, col * d + b] += pair[e, b, a] if flipped else pair[e, a, b]


@compiled
def _hand_on(panel: Array, rest: Array, child: Array, at: IntArray, d: int) -> None:
    """Add what a `child` leaves (lower triangle) to its parent's first columns and to the `rest`, in place.

    `at`: where the child's nodes lie among the parent's; the rows after them are the last ones of both.
    """
    pivots, size = panel.shape[1], len(child)
    to = np.empty(size, np.int64)
    for q in range(size):
        to[q] = at[q // d] * d + q % d if q // d < len(at) else len(panel) - size + q
    for q in range(size):
        if to[q] < pivots:
            for p in range(q, size):
                panel[to[p], to[q]] += child[p, q]
        else:
            for p in range(q, size):
                rest[to[p] - pivots, to[q] - pivots] += child[p, q]


def _on_one_thread() -> None:
    """Keep scipy's BLAS to one thread: how a sum is shared among threads changes how it rounds, and the same
    photos are to give the same bits anywhere.
    """
    library = ctypes.CDLL(cython_blas.__file__)
    if hasattr(library, "scipy_openblas_set_num_threads"):
        library.scipy_openblas_set_num_threads(1)


_on_one_thread()


def factorise(
    fronts: tuple[Front, ...], frame: Array, pair: Array, rhs: Array, border: Border | None = None
) -> Factor | None:
    """The factor of `frame` (N, d, d), `pair` (E, d, d: row the pair's first frame) and the border, with
    `rhs` (N, d); None where that is not positive definite.
    """
    d, tail = frame.shape[1], rhs[:, :, None]
    last = np.zeros((1, 1), order="F")
    if border is not None:
        tail = np.concatenate((border.cross, tail), axis=2)
        last = np.asfortranarray(np.pad(border.matrix, (0, 1)))
        last[-1, :-1] = border.rhs
    waiting: list[list[tuple[Array, IntArray]]] = [[] for _ in fronts]
    lower, below = [], []
    for k, front in enumerate(fronts):
        p, size = d * front.pivots, d * len(front.nodes) + tail.shape[2]
        panel, rest = np.zeros((size, p), order="F"), np.zeros((size - p, size - p), order="F")
        _enter(panel, front.nodes, front.pivots, front.pairs, frame, pair, tail)
        for left, at in waiting[k]:
            _hand_on(panel, rest, left, at, d)
        waiting[k] = []
        L, info = dpotrf(panel[:p], lower=1, clean=1)
        if info != 0:
            return None
        W = dtrsm(1.0, L, panel[p:], side=1, lower=1, trans_a=1)
        rest = dsyrk(-1.0, W, beta=1.0, c=rest, lower=1, overwrite_c=1)
        if front.parent >= 0:
            waiting[front.parent].append((rest, front.at))
        else:
            last += rest
        lower.append(L)
        below.append(W)
    bottom = _last(last)
    return None if bottom is None else Factor(fronts, tuple(lower), tuple(below), bottom, d)


def _last(matrix: Array) -> Array | None:
    """The border's own factor (B, B), and the right-hand side (B,) as one more row."""
    size = len(matrix) - 1
    if not size:
        return np.zeros((1, 0))
    L, info = dpotrf(matrix[:size, :size], lower=1, clean=1)
    if info != 0:
        return None
    return np.vstack((L, dtrsm(1.0, L, matrix[size:, :size], side=1, lower=1, trans_a=1)))


def solution(factor: Factor, n: int) -> tuple[Array, Array]:
    """The unknowns of the frames (N, d) and of the border (B,)."""
    x, size = np.zeros((n, factor.d)), factor.last.shape[1]
    L, y = factor.last[:size], factor.last[size]
    shared = dtrsv(np.asfortranarray(L), y, lower=1, trans=1) if size else y
    for k in range(len(factor.fronts) - 1, -1, -1):
        front, W = factor.fronts[k], factor.below[k]
        known = np.concatenate((x[front.nodes[front.pivots :]].ravel(), shared))
        y = dgemv(-1.0, W, np.append(known, -1.0), trans=1)
        mine = dtrsv(factor.lower[k], y, lower=1, trans=1)
        x[front.nodes[: front.pivots]] = mine.reshape(-1, factor.d)
    return x, shared
