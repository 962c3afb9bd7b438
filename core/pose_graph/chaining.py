"""Scale and heading of every frame from pairs alone, without the shrinking that least squares has.

In ground = z·p + c the solution z = 0 explains every pair; far from what holds it, noise pulls z there. The
logarithm of z_i / z_j has no such trap: scales and headings are averaged as logarithms first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order

from core.geometry import Array
from core.pose_graph.elimination import plan, solve_blocks
from core.pose_graph.residuals import IntArray

ComplexArray = NDArray[np.complex128]

ROUNDS = 10
# Log-scale and radians by which the similarities of good pairs differ.
SPREAD = 0.03
HELD = 1e6


def chained(
    pairs: IntArray, ratio: ComplexArray, weight: Array, roots: Sequence[int], n: int
) -> ComplexArray:
    """The z (N,) of all frames, 1 at the `roots` (one in each connected part), from z_i / z_j =
    `ratio` (E,) of the pairs, robustly; `weight` (E,) orders the pairs by how well they are known.
    """
    x = _along_trees(pairs, ratio, weight, roots, n)
    structure, robust = plan(n, pairs), weight / weight.max(initial=1e-12)
    i, j = pairs[:, 0], pairs[:, 1]
    for turn in range(ROUNDS):
        # plain least squares at first: a wrong pair that a tree went through loses against all around it
        bend = SPREAD * max(1.0, 100.0 * 0.4**turn)
        miss = np.log(ratio * np.exp(x[j] - x[i]))
        w = robust / (1 + np.abs(miss / bend) ** 2) ** 2
        H, g = np.zeros((n, 2, 2)), np.zeros((n, 2))
        total = np.bincount(i, w, n) + np.bincount(j, w, n) + 1e-9
        total[list(roots)] += HELD
        H[:, 0, 0] = H[:, 1, 1] = total
        pull = w[:, None] * np.column_stack((miss.real, miss.imag))
        np.add.at(g, i, pull)
        np.add.at(g, j, -pull)
        solved = solve_blocks(structure, H, -w[:, None, None] * np.eye(2), g)
        if solved is None:
            break
        step = solved[0][:, 0] + 1j * solved[0][:, 1]
        x = x + step
        if bend == SPREAD and float(np.abs(step).max(initial=0.0)) < SPREAD / 30:
            break
    return np.asarray(np.exp(x))


def _along_trees(
    pairs: IntArray, ratio: ComplexArray, weight: Array, roots: Sequence[int], n: int
) -> ComplexArray:
    """The log z (N,) by going from each root from pair to pair, the fewest pairs that lead to a frame."""
    rows = np.concatenate((pairs[:, 0], pairs[:, 1]))
    cols = np.concatenate((pairs[:, 1], pairs[:, 0]))
    # z_col = z_row · step
    step = np.concatenate((-np.log(ratio), np.log(ratio)))
    index = coo_matrix((np.arange(1, len(rows) + 1), (rows, cols)), shape=(n, n)).tocsr()
    x = np.zeros(n, complex)
    for root in roots:
        order, before = breadth_first_order(index, root)
        for k in order[1:].tolist():
            x[k] = x[before[k]] + step[index[before[k], k] - 1]
    return x
