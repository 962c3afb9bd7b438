"""Blocks of the inverse of sparse normal equations, from their factor.

The inverse's diagonal follows from the factor without the rest of the inverse (Takahashi, Fagan and Chin
1973), from the last front back to the first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg.blas import dgemm, dsymm, dtrsm
from scipy.linalg.lapack import dpotri

from core.compiled import compiled
from core.geometry import Array
from core.pose_graph.elimination import Front
from core.pose_graph.factor import Factor
from core.pose_graph.residuals import IntArray


@compiled
def _pick(out: Array, above: Array, at: IntArray, d: int) -> None:
    """Fill `out` (lower triangle) with what `above` has of the nodes `at` and of the border."""
    size = len(out)
    where = np.empty(size, np.int64)
    for q in range(size):
        where[q] = at[q // d] * d + q % d if q // d < len(at) else len(above) - size + q
    for q in range(size):
        for p in range(q, size):
            out[p, q] = above[where[p], where[q]]


def covariances(factor: Factor, n: int) -> Array:
    """The (N, d, d) diagonal blocks of the inverse of the whole matrix, border included."""
    d, size = factor.d, factor.last.shape[1]
    out = np.zeros((n, d, d))
    unasked = _children(factor.fronts)
    inverse: list[Array | None] = [None] * len(factor.fronts)
    border = np.asfortranarray(factor.last[:size])
    if size:
        border = dpotri(border, lower=1)[0]
    for k in range(len(factor.fronts) - 1, -1, -1):
        front, L, W = factor.fronts[k], factor.lower[k], factor.below[k][:-1]
        rest = border
        if front.parent >= 0:
            above = inverse[front.parent]
            assert above is not None
            rest = np.empty((len(W), len(W)), order="F")
            _pick(rest, above, front.at, d)
            unasked[front.parent] -= 1
            if not unasked[front.parent]:
                inverse[front.parent] = None
        whole = _block(L, W, rest)
        if unasked[k]:
            inverse[k] = whole
        at = d * np.arange(front.pivots)[:, None, None] + np.arange(d)
        out[front.nodes[: front.pivots]] = whole[at.transpose(0, 2, 1), at]
    return np.tril(out) + np.tril(out, -1).transpose(0, 2, 1)


def _block(L: Array, W: Array, rest: Array) -> Array:
    """The inverse's block of a front (lower triangle) from its factor and the block of the rows below."""
    p, s = len(L), len(W)
    whole = np.empty((p + s, p + s), order="F")
    whole[:p, :p] = dpotri(L, lower=1)[0]
    if s:
        G = dtrsm(1.0, L, W, side=1, lower=1)
        mixed = dsymm(-1.0, rest, G, lower=1)
        whole[:p, :p] -= dgemm(1.0, G, mixed, trans_a=1)
        whole[p:, :p], whole[p:, p:] = mixed, rest
    return whole


def _children(fronts: Sequence[Front]) -> list[int]:
    """How many fronts hand on to each."""
    count = [0] * len(fronts)
    for front in fronts:
        if front.parent >= 0:
            count[front.parent] += 1
    return count
