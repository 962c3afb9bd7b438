"""What pairs alone say of a submap: scales and headings, then places, up to one similarity for all of it.

In ground = z·p + c the solution z = 0 explains every pair; far from what holds it, noise pulls z there. The
logarithm of z_i / z_j has no such trap: scales and headings are averaged as logarithms first, and what they
leave of a pair is the step between its two frames (the relative translation of Zhao 2020, 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order

from core.geometry import Array
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray, laplacian_solve

ROUNDS = 10
L1_ROUNDS = 8
# Log-scale and radians by which the similarities of good pairs differ.
SPREAD = 0.03
# The share of the height by which the steps of good pairs differ.
STEP_SPREAD = 0.05
HELD = 1e6


def chained(
    pairs: IntArray, ratio: ComplexArray, weight: Array, roots: Sequence[int], n: int
) -> ComplexArray:
    """The z (N,) of all frames, 1 at the `roots` (one in each connected part), from z_i / z_j =
    `ratio` (E,) of the pairs, robustly; `weight` (E,) orders the pairs by how well they are known.
    """
    x = _along_trees(pairs, np.log(ratio), roots, n)
    robust = weight / weight.max(initial=1e-12)
    i, j = pairs[:, 0], pairs[:, 1]
    for turn in range(ROUNDS):
        # plain least squares at first: a wrong pair that a tree went through loses against all around it
        bend = SPREAD * max(1.0, 100.0 * 0.4**turn)
        miss = np.log(ratio * np.exp(x[j] - x[i]))
        w = robust / (1 + np.abs(miss / bend) ** 2) ** 2
        step = laplacian_solve(pairs, w, _held(roots, n), miss, np.zeros(n, complex))
        if step is None:
            break
        x = x + step
        if bend == SPREAD and float(np.abs(step).max(initial=0.0)) < SPREAD / 30:
            break
    return np.asarray(np.exp(x))


def spanned(
    pairs: IntArray, step: ComplexArray, size: Array, roots: Sequence[int], n: int
) -> tuple[ComplexArray, Array]:
    """The places c (N,) of all frames, 0 at the `roots`, from c_i − c_j = `step` (E,) of the pairs, robustly;
    and by how much each pair misses them (E,), as a share of its height `size` (E,).
    """
    i, j = pairs[:, 0], pairs[:, 1]
    c, w, held = np.zeros(n, complex), np.ones(len(pairs)), _held(roots, n)
    settled = STEP_SPREAD * float(np.median(size)) / 300
    for turn in range(L1_ROUNDS + ROUNDS):
        found = laplacian_solve(pairs, w / size**2, held, step, c)
        if found is None:
            break
        moved, c = float(np.abs(found - c).max(initial=0.0)), found
        miss = np.abs(step - c[i] + c[j]) / size
        # least absolute misses have one optimum whatever the start; from there on wrong pairs count nothing
        if turn < L1_ROUNDS:
            w = STEP_SPREAD / np.maximum(miss, STEP_SPREAD * 0.5)
        elif turn > L1_ROUNDS and moved < settled:
            break
        else:
            w = 1 / (1 + (miss / (2 * STEP_SPREAD)) ** 2) ** 2
    return c, np.abs(step - c[i] + c[j]) / size


def _held(roots: Sequence[int], n: int) -> Array:
    held = np.full(n, 1e-9)
    held[list(roots)] = HELD
    return held


def _along_trees(pairs: IntArray, step: ComplexArray, roots: Sequence[int], n: int) -> ComplexArray:
    """The x (N,), 0 at the roots, by going from each root from pair to pair, x_i − x_j = `step`, the fewest
    pairs that lead to a frame.
    """
    rows = np.concatenate((pairs[:, 0], pairs[:, 1]))
    cols = np.concatenate((pairs[:, 1], pairs[:, 0]))
    onward = np.concatenate((-step, step))
    index = coo_matrix((np.arange(1, len(rows) + 1), (rows, cols)), shape=(n, n)).tocsr()
    x = np.zeros(n, complex)
    for root in roots:
        order, before = breadth_first_order(index, root)
        for k in order[1:].tolist():
            x[k] = x[before[k]] + onward[index[before[k], k] - 1]
    return x
