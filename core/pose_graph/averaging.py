"""Start values without attitude: every photo as a complex similarity of the ground (ground = z·p + c).

For a level camera, p = x − iy of the viewing ray, |z| is the height above ground, arg z the yaw and c the
ground point below. A match says z_i·p_i + c_i = z_j·p_j + c_j, GPS says c_i: all linear, so that one sparse
solve finds the global optimum; reweighting takes wrong matches and wrong GPS fixes out. This does for the
plane what rotation averaging and scale averaging (Zhao 2020, eq. 1–4) do in space, and needs no baseline per
pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.elimination import plan, solve_blocks
from core.pose_graph.residuals import IntArray

ComplexArray = NDArray[np.complex128]

# Tilt and relief move points by a few per cent of the height: what a similarity cannot explain.
MODEL_ERROR = 0.03
POINTS_WORTH = 4.0
# How well scale and heading are known after chaining, as a share.
CHAINED = 0.03
ROUNDS = 8
MIN_ROUNDS = 3
SETTLED = 0.003


@dataclass(frozen=True, slots=True)
class Similarities:
    """Frames as similarities: `z` (N,) complex metres, `c` (N,) complex metres east + i·north; `error` (E,)
    RMS disagreement of each pair as a share of the height above ground.
    """

    z: ComplexArray
    c: ComplexArray
    error: Array


@dataclass(frozen=True, slots=True)
class Moments:
    """Sums over a pair's points that its quadratic form is made of, (E, 4, 4) each, divided by the count."""

    first: Array
    second: Array
    mixed: Array


def _blocks(a: ComplexArray, b: ComplexArray, counts: IntArray, starts: IntArray) -> Array:
    """Mean of A(a)ᵀA(b) with A(p) = [[pr, −pi, 1, 0], [pi, pr, 0, 1]]: (E, 4, 4)."""
    product = np.add.reduceat(np.conj(a) * b, starts) / counts
    mean_a, mean_b = np.add.reduceat(a, starts) / counts, np.add.reduceat(b, starts) / counts
    out = np.zeros((len(counts), 4, 4))
    for rows, cols, value in (
        (slice(0, 2), slice(0, 2), product),
        (slice(0, 2), slice(2, 4), np.conj(mean_a)),
        (slice(2, 4), slice(0, 2), mean_b),
    ):
        out[:, rows, cols] = np.stack(
            (np.stack((value.real, -value.imag), -1), np.stack((value.imag, value.real), -1)), 1
        )
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def moments(first: ComplexArray, second: ComplexArray, starts: IntArray) -> Moments:
    """Of the rays p (M,) of each pair's points in its two frames; `starts` (E + 1,)."""
    counts, begin = np.diff(starts), starts[:-1]
    return Moments(
        _blocks(first, first, counts, begin),
        _blocks(second, second, counts, begin),
        _blocks(first, second, counts, begin),
    )


def ratios(m: Moments) -> tuple[ComplexArray, Array]:
    """z_i / z_j of each pair (E,), and how widely its points spread (E,)."""
    first = m.first[:, 0, 2] - 1j * m.first[:, 1, 2]
    second = m.second[:, 0, 2] - 1j * m.second[:, 1, 2]
    common = m.mixed[:, 0, 0] + 1j * m.mixed[:, 1, 0] - np.conj(first) * second
    wide_i = np.maximum(m.first[:, 0, 0] - np.abs(first) ** 2, 1e-9)
    wide_j = np.maximum(m.second[:, 0, 0] - np.abs(second) ** 2, 1e-9)
    return np.sqrt(wide_j / wide_i) * np.exp(1j * np.angle(common)), np.sqrt(wide_i * wide_j)


def average(
    pairs: IntArray,
    m: Moments,
    gps: ComplexArray,
    gps_sigma: Array,
    roots: NDArray[np.int64],
    height_m: float,
    expected: ComplexArray,
) -> Similarities:
    """The robust least-squares similarities of all frames.

    `expected`: (N,) z that `ratios` chained up from the root, NaN where GPS holds the scale instead.

    `gps`: (N,) complex metres, NaN where there is none; `gps_sigma` (N,). `roots`: frames held at z =
    `height_m`, c = 0, one in each component that GPS does not hold. `height_m`: a guess; only the weight of
    matches hangs on it.
    """
    n, known = len(gps), np.isfinite(gps)
    i, j = pairs[:, 0], pairs[:, 1]
    edge_weight, gps_weight = np.ones(len(pairs)), np.ones(n)
    height = np.full(n, height_m)
    x, error = np.zeros((n, 4)), np.zeros(len(pairs))
    structure = plan(n, pairs)
    chained = np.isfinite(expected)
    trust = np.where(chained, 1 / (CHAINED * np.maximum(np.abs(expected), 1e-3)) ** 2, 0.0)
    for turn in range(ROUNDS):
        w = edge_weight * POINTS_WORTH / (MODEL_ERROR * np.sqrt(height[i] * height[j])) ** 2
        H, g = np.zeros((n, 4, 4)), np.zeros((n, 4))
        np.add.at(H, i, w[:, None, None] * m.first)
        np.add.at(H, j, w[:, None, None] * m.second)
        wg = np.where(known, gps_weight / gps_sigma**2, 0.0)
        H[:, 2, 2] += wg
        H[:, 3, 3] += wg
        g[known, 2], g[known, 3] = (wg * gps.real)[known], (wg * gps.imag)[known]
        H[:, 0, 0] += trust
        H[:, 1, 1] += trust
        g[chained, 0] = (trust * expected.real)[chained]
        g[chained, 1] = (trust * expected.imag)[chained]
        H[roots] += np.eye(4) * 1e3
        g[roots, 0] += 1e3 * height_m
        H += np.eye(4) * 1e-9
        solved = solve_blocks(structure, H, -w[:, None, None] * m.mixed, g)
        if solved is None:
            break
        x, _ = solved
        before = error
        z = x[:, 0] + 1j * x[:, 1]
        # a frame whose pairs were all turned down tends to z = 0: never let that raise the pairs' weight
        height = np.clip(np.abs(z), 0.3 * np.median(np.abs(z)), 3 * np.median(np.abs(z))).clip(1e-3)
        error = _pair_error(x, i, j, m) / np.sqrt(height[i] * height[j])
        if turn >= MIN_ROUNDS and float(np.abs(error - before).max(initial=0.0)) < SETTLED:
            break
        bend = MODEL_ERROR * max(1.0, 4.0 * 0.6**turn)
        edge_weight = 1 / (1 + (error / bend) ** 2) ** 2
        if known.any():
            miss = np.abs(np.where(known, gps - (x[:, 2] + 1j * x[:, 3]), 0.0))
            scale = np.maximum(gps_sigma, 1.5 * np.median(miss[known])) * max(1.0, 3.0 * 0.6**turn)
            gps_weight = 1 / (1 + (miss / scale) ** 2)
    return Similarities(x[:, 0] + 1j * x[:, 1], x[:, 2] + 1j * x[:, 3], error)


def _pair_error(x: Array, i: IntArray, j: IntArray, m: Moments) -> Array:
    """RMS distance (E,), metres, between a pair's points as its two frames lay them down."""
    a, b = x[i], x[j]
    total = (
        np.einsum("ea,eab,eb->e", a, m.first, a)
        + np.einsum("ea,eab,eb->e", b, m.second, b)
        - 2 * np.einsum("ea,eab,eb->e", a, m.mixed, b)
    )
    return np.asarray(np.sqrt(np.maximum(total, 0.0)))


def fit_similarity(source: ComplexArray, target: ComplexArray, sigma: Array) -> tuple[complex, complex]:
    """Scale-rotation s and shift d of target ≈ s·source + d, robust (Cauchy); s = 1 for a single place."""
    w = np.ones(len(source))
    s, d = 1.0 + 0j, 0j
    for _ in range(15):
        a, b = (w @ source) / w.sum(), (w @ target) / w.sum()
        spread = float(w @ np.abs(source - a) ** 2)
        s = complex((w @ (np.conj(source - a) * (target - b))) / spread) if spread > 1e-9 else 1.0 + 0j
        d = complex(b - s * a)
        miss = np.abs(target - s * source - d)
        w = 1 / (1 + (miss / np.maximum(sigma, 1.5 * float(np.median(miss)) + 1e-9)) ** 2)
    return s, d
