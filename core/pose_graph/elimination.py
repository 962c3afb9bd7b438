"""Sparse normal equations as a gtsam factor graph: a variable per frame, one border shared by all."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from core.geometry import Array
from core.pose_graph.residuals import IntArray


@dataclass(frozen=True, slots=True)
class Border:
    """Unknowns that touch every frame: `cross` (N, d, B), `matrix` (B, B), `rhs` (B,)."""

    cross: Array
    matrix: Array
    rhs: Array


def gaussian_graph(
    frame: Array, pairs: IntArray, pair: Array, rhs: Array, border: Border | None
) -> gtsam.GaussianFactorGraph:
    """Blocks of H·x = g as HessianFactors: `frame` (N, d, d), `pair` (E, d, d) above the diagonal, `rhs`
    (N, d).

    A pair's factor carries only its block off the diagonal: its share of the diagonal is in `frame` already,
    and elimination sums all factors of a variable before it factorises.
    """
    n, d = rhs.shape
    graph = gtsam.GaussianFactorGraph()
    if border is None:
        for k in range(n):
            graph.push_back(gtsam.HessianFactor(k, frame[k], rhs[k], 0.0))
    else:
        zero_matrix, zero = np.zeros_like(border.matrix), np.zeros_like(border.rhs)
        graph.push_back(gtsam.HessianFactor(n, border.matrix, border.rhs, 0.0))
        for k in range(n):
            factor = gtsam.HessianFactor(k, n, frame[k], border.cross[k], rhs[k], zero_matrix, zero, 0.0)
            graph.push_back(factor)
    nothing, none = np.zeros((d, d)), np.zeros(d)
    for (i, j), block in zip(pairs.tolist(), pair, strict=True):
        graph.push_back(gtsam.HessianFactor(i, j, nothing, block, none, nothing, none, 0.0))
    return graph


def ordering_of(graph: gtsam.GaussianFactorGraph) -> gtsam.Ordering:
    """An elimination order with little fill-in; good for every graph of the same pairs."""
    return gtsam.Ordering.ColamdGaussianFactorGraph(graph)


def solve_blocks(
    frame: Array,
    pairs: IntArray,
    pair: Array,
    rhs: Array,
    border: Border | None = None,
    ordering: gtsam.Ordering | None = None,
) -> tuple[Array, Array, gtsam.Ordering] | None:
    """The solution (N, d) and (B,), and the ordering for the next time; None where H is not positive
    definite.
    """
    graph = gaussian_graph(frame, pairs, pair, rhs, border)
    ordering = ordering or ordering_of(graph)
    n, d = rhs.shape
    try:
        step = graph.optimize(ordering)
    except RuntimeError:
        return None
    x = np.array([step.at(k) for k in range(n)]).reshape(n, d)
    y = np.zeros(0) if border is None else np.asarray(step.at(n), float)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return None
    return x, y, ordering
