"""The sparse systems of the start values: complex, one small block per frame and one per pair, by SuperLU.

A start value needs no covariances and its blocks hold one or two complex numbers: here the factors cost less
than building a factor graph of them would.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from core.geometry import Array
from core.pose_graph.residuals import IntArray

ComplexArray = NDArray[np.complex128]


def solve_hermitian(
    pairs: IntArray, frame: ComplexArray, pair: ComplexArray, rhs: ComplexArray
) -> ComplexArray | None:
    """The solution (N, d) of H·x = `rhs` (N, d); None where H is singular.

    `frame` (N, d, d): the diagonal blocks. `pair` (E, d, d): the block in the row of a pair's first frame and
    the column of its second; the other way round stands its conjugate transpose.
    """
    n, d = rhs.shape
    i, j, own = (k[:, None, None] * d for k in (pairs[:, 0], pairs[:, 1], np.arange(n)))
    row, col = np.arange(d)[:, None], np.arange(d)[None]
    parts = ((pair, i, j), (np.conj(pair.transpose(0, 2, 1)), j, i), (frame, own, own))
    values = np.concatenate([v.ravel() for v, _, _ in parts])
    rows = np.concatenate([np.broadcast_to(a + row, v.shape).ravel() for v, a, _ in parts])
    cols = np.concatenate([np.broadcast_to(b + col, v.shape).ravel() for v, _, b in parts])
    x = _solved(coo_matrix((values, (rows, cols)), shape=(n * d, n * d)), rhs.reshape(-1, 1))
    return None if x is None else x.reshape(rhs.shape)


def laplacian_solve(pairs: IntArray, weight: Array, held: Array, pull: Array, own: Array) -> Array | None:
    """The x (N, k) that minimises Σ weight·|x_i − x_j − pull|² + Σ held·|x − own|² over pairs and frames, of
    `pull` (E, k) and `own` (N, k); None where nothing holds a part.
    """
    n, (i, j) = len(held), pairs.T
    diagonal = np.bincount(i, weight, n) + np.bincount(j, weight, n) + held
    values = np.concatenate((-weight, -weight, diagonal))
    where = (np.concatenate((i, j, np.arange(n))), np.concatenate((j, i, np.arange(n))))
    pulled = weight[:, None] * pull
    net = [np.bincount(i, column, n) - np.bincount(j, column, n) for column in pulled.T]
    return _solved(coo_matrix((values, where), shape=(n, n)), np.column_stack(net) + held[:, None] * own)


def _solved(matrix: coo_matrix, rhs: NDArray[Any]) -> NDArray[Any] | None:
    try:
        factor = splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            relax=1,
            panel_size=1,
            options={"SymmetricMode": True},
        )
    except RuntimeError:
        return None
    x = np.asarray(factor.solve(rhs))
    return x if np.isfinite(x).all() else None


def summed(n: int, pairs: IntArray, first: ComplexArray, second: ComplexArray) -> ComplexArray:
    """What each frame gets (n, …) from its pairs: `first` (E, …) goes to a pair's first frame, `second` to
    its second.
    """
    where = np.concatenate((pairs[:, 0], pairs[:, 1]))
    flat = np.concatenate((first, second)).reshape(len(where), -1).astype(complex).view(float)
    out = np.column_stack([np.bincount(where, column, n) for column in flat.T])
    return np.ascontiguousarray(out).view(complex).reshape(n, *first.shape[1:])


def plane(z: ComplexArray) -> Array:
    """Complex numbers (N,) as their real and imaginary parts (N, 2)."""
    return np.ascontiguousarray(z).view(float).reshape(-1, 2)


def number(xy: Array) -> ComplexArray:
    """The inverse of `plane`."""
    return np.asarray(xy[:, 0] + 1j * xy[:, 1])
