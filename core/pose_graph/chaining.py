"""What pairs alone say of a submap: scales and headings, then places, up to one similarity for all of it.

In ground = z·p + c the solution z = 0 explains every pair; far from what holds it, noise pulls z there. The
logarithm of z_i / z_j has no such trap: scales and headings are averaged as logarithms first, and what they
leave of a pair is the step between its two frames (the relative translation of Zhao 2020, 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.geometry import Array
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray, laplacian_solve, number, plane, solve_hermitian, summed

ROUNDS = 10
L1_ROUNDS = 8
PHASE_ROUNDS = 3
# A miss on the unit circle from which on a pair counts by its absolute value.
WRONG_PHASE = 0.1
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
    held, one = _held(roots, n), np.ones(n, complex)
    x = 1j * np.angle(phases(pairs, ratio / np.abs(ratio), np.ones(len(pairs)), held, one))
    robust = weight / weight.max(initial=1e-12)
    i, j = pairs[:, 0], pairs[:, 1]
    for turn in range(ROUNDS):
        # wide at first: a scale that is far off is not a wrong pair yet
        bend = SPREAD * max(1.0, 100.0 * 0.4**turn)
        miss = np.log(ratio * np.exp(x[j] - x[i]))
        w = robust / (1 + np.abs(miss / bend) ** 2) ** 2
        found = laplacian_solve(pairs, w, held, plane(miss), np.zeros((n, 2)))
        if found is None:
            break
        step = number(found)
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
        found = laplacian_solve(pairs, w / size**2, held, plane(step), plane(c))
        if found is None:
            break
        moved, c = float(np.abs(number(found) - c).max(initial=0.0)), number(found)
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


def phases(
    pairs: IntArray, ratio: ComplexArray, weight: Array, held: Array, own: ComplexArray
) -> ComplexArray:
    """Directions (N,) on the unit circle with u_i = `ratio` (E,)·u_j and u = `own` (N,), weighted by `weight`
    (E,) and `held` (N,).

    Numbers of any length in the place of unit ones make that linear, so that no start is needed, and no tree
    that may lead through wrong pairs: those shorten a number, but seldom turn it.
    """
    u, w, h = own, weight, held
    for _ in range(PHASE_ROUNDS):
        frame = summed(len(own), pairs, w.astype(complex), w.astype(complex)) + h + 1e-12
        found = solve_hermitian(pairs, frame[:, None, None], -(w * ratio)[:, None, None], (h * own)[:, None])
        if found is None:
            break
        length = np.maximum(np.abs(found[:, 0]), 1e-30)
        u = found[:, 0] / length
        w = weight / np.maximum(np.abs(u[pairs[:, 0]] - ratio * u[pairs[:, 1]]), WRONG_PHASE)
        h = held / np.maximum(np.abs(u - own), WRONG_PHASE)
    return u
