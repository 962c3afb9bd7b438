"""Places, heights and headings: every photo as a complex similarity of the ground (ground = z·p + c).

For a camera whose rays were turned level, p = x − iy of the viewing ray, |z| is the height above ground,
arg z the yaw and c the ground point below. A match says z_i·p_i + c_i = z_j·p_j + c_j, GPS says c_i: all
linear, so that one sparse solve finds the global optimum; reweighting takes wrong matches and wrong GPS fixes
out. It is the translation averaging of Zhao 2020, 3.3, with the scales in it, and needs no baseline per pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray, solve_hermitian, summed

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
    """Means over a pair's points that its quadratic form is made of, (E, 2, 2) each."""

    first: ComplexArray
    second: ComplexArray
    mixed: ComplexArray


def _blocks(a: ComplexArray, b: ComplexArray, counts: IntArray, starts: IntArray) -> ComplexArray:
    """Mean of (p, 1)ᴴ(q, 1) over each pair's points: (E, 2, 2)."""
    out = np.ones((len(counts), 2, 2), complex)
    out[:, 0, 0] = np.add.reduceat(np.conj(a) * b, starts) / counts
    out[:, 0, 1] = np.conj(np.add.reduceat(a, starts)) / counts
    out[:, 1, 0] = np.add.reduceat(b, starts) / counts
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
    first, second = m.first[:, 1, 0], m.second[:, 1, 0]
    common = m.mixed[:, 0, 0] - np.conj(first) * second
    wide_i = np.maximum(m.first[:, 0, 0].real - np.abs(first) ** 2, 1e-9)
    wide_j = np.maximum(m.second[:, 0, 0].real - np.abs(second) ** 2, 1e-9)
    return np.sqrt(wide_j / wide_i) * np.exp(1j * np.angle(common)), np.sqrt(wide_i * wide_j)


def steps(m: Moments, pairs: IntArray, z: ComplexArray) -> ComplexArray:
    """c_i − c_j of each pair (E,) when its frames have the scales and headings `z` (N,)."""
    return np.asarray(z[pairs[:, 1]] * m.second[:, 1, 0] - z[pairs[:, 0]] * m.first[:, 1, 0])


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
    x, error = np.zeros((n, 2), complex), np.zeros(len(pairs))
    chained = np.isfinite(expected)
    trust = np.where(chained, 1 / (CHAINED * np.maximum(np.abs(expected), 1e-3)) ** 2, 0.0)
    for turn in range(ROUNDS):
        w = (edge_weight * POINTS_WORTH / (MODEL_ERROR * np.sqrt(height[i] * height[j])) ** 2)[:, None, None]
        wg = np.where(known, gps_weight / gps_sigma**2, 0.0)
        H = summed(n, pairs, w * m.first, w * m.second) + np.eye(2) * 1e-9
        H[:, 0, 0] += trust
        H[:, 1, 1] += wg
        H[roots] += np.eye(2) * 1e3
        g = np.column_stack((np.where(chained, trust * expected, 0.0), np.where(known, wg * gps, 0.0)))
        g[roots, 0] += 1e3 * height_m
        solved = solve_hermitian(pairs, H, -w * m.mixed, g)
        if solved is None:
            break
        x, before = solved, error
        z = x[:, 0]
        # a frame whose pairs were all turned down tends to z = 0: never let that raise the pairs' weight
        height = np.clip(np.abs(z), 0.3 * np.median(np.abs(z)), 3 * np.median(np.abs(z))).clip(1e-3)
        error = _pair_error(x, i, j, m) / np.sqrt(height[i] * height[j])
        if turn >= MIN_ROUNDS and float(np.abs(error - before).max(initial=0.0)) < SETTLED:
            break
        bend = MODEL_ERROR * max(1.0, 4.0 * 0.6**turn)
        edge_weight = 1 / (1 + (error / bend) ** 2) ** 2
        if known.any():
            miss = np.abs(np.where(known, gps - x[:, 1], 0.0))
            scale = np.maximum(gps_sigma, 1.5 * np.median(miss[known])) * max(1.0, 3.0 * 0.6**turn)
            gps_weight = 1 / (1 + (miss / scale) ** 2)
    return Similarities(x[:, 0], x[:, 1], error)


def _pair_error(x: ComplexArray, i: IntArray, j: IntArray, m: Moments) -> Array:
    """RMS distance (E,), metres, between a pair's points as its two frames lay them down."""
    a, b = x[i], x[j]
    total = (
        np.einsum("ea,eab,eb->e", np.conj(a), m.first, a)
        + np.einsum("ea,eab,eb->e", np.conj(b), m.second, b)
        - 2 * np.einsum("ea,eab,eb->e", np.conj(a), m.mixed, b)
    )
    return np.asarray(np.sqrt(np.maximum(total.real, 0.0)))


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
