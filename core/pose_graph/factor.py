"""Cholesky factor of sparse normal equations, front by front: solutions, and the blocks of the inverse.

Normal equations have a block per frame, one per pair, and a border of unknowns shared by all (lenses, lags).
The inverse's diagonal follows from the factor without the rest of the inverse (Takahashi, Fagan and Chin
1973), from the last front back to the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm
from scipy.linalg.lapack import dpotrf, dpotri

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
    """`lower` (p, p) and `below` (s, p) of each front: H = L·Lᵀ in their order; `d` unknowns a frame."""

    fronts: tuple[Front, ...]
    lower: tuple[Array, ...]
    below: tuple[Array, ...]
    d: int


def _enter(A: Array, nodes: IntArray, pivots: int, pairs: IntArray, frame: Array, pair: Array) -> None:
    """Add the blocks that enter a front to its matrix (lower triangle), in place."""
    d = frame.shape[1]
    for k in range(pivots):
        for b in range(d):
            for a in range(d):
                A[k * d + a, k * d + b] += frame[nodes[k], a, b]
    for m in range(len(pairs)):
        e, row, col, flipped = pairs[m]
        for b in range(d):
            for a in range(d):
                A[row * d + a, col * d + b] += pair[e, b, a] if flipped else pair[e, a, b]


def _hand_on(A: Array, U: Array, at: IntArray, d: int) -> None:
    """Add a child's remainder U (lower triangle) to its parent's matrix, in place."""
    for q in range(len(at)):
        for b in range(d):
            col, to = q * d + b, at[q] * d + b
            for p in range(q, len(at)):
                for a in range(d):
                    A[at[p] * d + a, to] += U[p * d + a, col]


_compile: Callable[[Any], Any] = numba.njit(cache=True, nogil=True)
_enter = _compile(_enter)
_hand_on = _compile(_hand_on)


def factorise(fronts: tuple[Front, ...], frame: Array, pair: Array) -> Factor | None:
    """The factor of `frame` (N, d, d) and `pair` (E, d, d: row the pair's first frame), None where that is
    not positive definite.
    """
    d = frame.shape[1]
    waiting: list[list[tuple[Array, IntArray]]] = [[] for _ in fronts]
    lower, below = [], []
    for k, front in enumerate(fronts):
        size, p = d * len(front.nodes), d * front.pivots
        A = np.zeros((size, size), order="F")
        _enter(A, front.nodes, front.pivots, front.pairs, frame, pair)
        for remainder, at in waiting[k]:
            _hand_on(A, remainder, at, d)
        waiting[k] = []
        L, info = dpotrf(A[:p, :p], lower=1, clean=1)
        if info != 0:
            return None
        W = np.zeros((0, p))
        if size > p:
            W = dtrsm(1.0, L, A[p:, :p], side=1, lower=1, trans_a=1)
            left = dsyrk(-1.0, W, beta=1.0, c=A[p:, p:], lower=1)
            waiting[front.parent].append((left, front.at))
        lower.append(L)
        below.append(W)
    return Factor(fronts, tuple(lower), tuple(below), d)


def solve_factored(factor: Factor, rhs: Array) -> Array:
    """H⁻¹·rhs for `rhs` (N, d, K)."""
    x, d = rhs.copy(), factor.d
    columns = rhs.shape[2]
    for front, L, W in zip(factor.fronts, factor.lower, factor.below, strict=True):
        mine, rest = front.nodes[: front.pivots], front.nodes[front.pivots :]
        y = dtrsm(1.0, L, x[mine].reshape(-1, columns), lower=1)
        x[mine] = y.reshape(-1, d, columns)
        if len(rest):
            x[rest] -= (W @ y).reshape(-1, d, columns)
    for k in range(len(factor.fronts) - 1, -1, -1):
        front, L, W = factor.fronts[k], factor.lower[k], factor.below[k]
        mine, rest = front.nodes[: front.pivots], front.nodes[front.pivots :]
        y = x[mine].reshape(-1, columns)
        if len(rest):
            y = y - W.T @ x[rest].reshape(-1, columns)
        x[mine] = dtrsm(1.0, L, y, lower=1, trans_a=1).reshape(-1, d, columns)
    return x


def solve_blocks(
    fronts: tuple[Front, ...], frame: Array, pair: Array, rhs: Array, border: Border | None = None
) -> tuple[Array, Array] | None:
    """Solution (N, d) and (B,) of H·x = `rhs` (N, d); None where H is not positive definite."""
    factor = factorise(fronts, frame, pair)
    if factor is None:
        return None
    if border is None:
        x, y = solve_factored(factor, rhs[:, :, None])[:, :, 0], np.zeros(0)
    else:
        all_x = solve_factored(factor, np.concatenate((rhs[:, :, None], border.cross), axis=2))
        spread = all_x[:, :, 1:]
        schur = border.matrix - np.einsum("nda,ndb->ab", border.cross, spread)
        if dpotrf(schur, lower=1)[1] != 0:
            return None
        y = np.linalg.solve(schur, border.rhs - np.einsum("nda,nd->a", border.cross, all_x[:, :, 0]))
        x = all_x[:, :, 0] - spread @ y
    return (x, y) if np.isfinite(x).all() and np.isfinite(y).all() else None


def covariances(fronts: tuple[Front, ...], frame: Array, pair: Array, border: Border) -> Array | None:
    """The (N, d, d) diagonal blocks of the inverse of the whole matrix, border included; None where it is not
    positive definite.
    """
    factor = factorise(fronts, frame, pair)
    if factor is None:
        return None
    spread = solve_factored(factor, border.cross)
    schur = border.matrix - np.einsum("nda,ndb->ab", border.cross, spread)
    if dpotrf(schur, lower=1)[1] != 0:
        return None
    shared = np.einsum("nda,ab,neb->nde", spread, np.linalg.inv(schur), spread)
    return np.asarray(_diagonal_of_inverse(factor, len(frame)) + shared)


def _diagonal_of_inverse(factor: Factor, n: int) -> Array:
    """The (N, d, d) diagonal blocks of the inverse without a border."""
    d = factor.d
    out = np.zeros((n, d, d))
    unasked = _children(factor.fronts)
    inverse: list[Array | None] = [None] * len(factor.fronts)
    for k in range(len(factor.fronts) - 1, -1, -1):
        front, L, W = factor.fronts[k], factor.lower[k], factor.below[k]
        p = d * front.pivots
        own = dpotri(L, lower=1)[0]
        own = np.tril(own) + np.tril(own, -1).T
        if front.parent >= 0:
            above = inverse[front.parent]
            assert above is not None
            index = (front.at[:, None] * d + np.arange(d)).ravel()
            rest = above[np.ix_(index, index)]
            unasked[front.parent] -= 1
            if not unasked[front.parent]:
                inverse[front.parent] = None
            G = dtrsm(1.0, L, W, side=1, lower=1)
            mixed = -rest @ G
            own = own - G.T @ mixed
        if unasked[k]:
            whole = np.empty((d * len(front.nodes), d * len(front.nodes)))
            whole[:p, :p] = own
            if front.parent >= 0:
                whole[p:, :p], whole[:p, p:], whole[p:, p:] = mixed, mixed.T, rest
            inverse[k] = whole
        for a, node in enumerate(front.nodes[: front.pivots].tolist()):
            out[node] = own[a * d : (a + 1) * d, a * d : (a + 1) * d]
    return out


def _children(fronts: Sequence[Front]) -> list[int]:
    """How many fronts hand on to each."""
    count = [0] * len(fronts)
    for front in fronts:
        if front.parent >= 0:
            count[front.parent] += 1
    return count
