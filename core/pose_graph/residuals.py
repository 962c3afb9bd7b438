"""The planar-restricted reprojection factor (Zhao 2020, eq. 6–9), one call for all image pairs.

A correspondence (u_i, u_j) gives the ray a = R_i·Proj⁻¹(u_i), the ground point p = t_i + a·(h_i − t_iz)/a_z,
the residual Proj(R_jᵀ(p − t_j)) − u_j, and the same with i and j swapped. Per frame seven unknowns: a rotation
vector ω in the camera's own frame (R ← R·exp(ω)), the centre t and the ground height h; per camera three:
log f, k1, k2. Compiled, because a mission has a million correspondences and ten linearisations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from core.geometry import Array

IntArray = NDArray[np.int64]
FRAME_DOF = 7
CAMERA_DOF = 3
# A ray closer to the horizon than this, or a point this close to the image plane, says nothing of the ground.
MIN_DOWN = 0.05


@dataclass(frozen=True, slots=True)
class Edges:
    """All image pairs of a graph, correspondences concatenated.

    `pairs`: (E, 2) indices of frames. `starts`: (E + 1,) where each pair's points begin. `uv`: (M, 4) pixels
    from the principal point, (x, y) in the first frame then in the second. `weight`: (E,) of each point of a
    pair. `camera`: (N,) index of each frame's camera.
    """

    pairs: IntArray
    starts: IntArray
    uv: Array
    weight: Array
    camera: IntArray

    def __len__(self) -> int:
        """The number of image pairs."""
        return len(self.pairs)

    def subset(self, keep: NDArray[np.bool_]) -> Edges:
        """The same edges without those whose flag in `keep` (E,) is false."""
        counts = np.diff(self.starts)
        return Edges(
            self.pairs[keep],
            np.concatenate(([0], np.cumsum(counts[keep]))).astype(np.int64),
            self.uv[np.repeat(keep, counts)],
            self.weight[keep],
            self.camera,
        )


@dataclass(frozen=True, slots=True)
class State:
    """The unknowns: `R` (N, 3, 3) world_R_cam, `t` (N, 3) and `h` (N,) metres, `lens` (C, 3) = f px, k1, k2,
    `lag_s` (D,) seconds by drone."""

    R: Array
    t: Array
    h: Array
    lens: Array
    lag_s: Array


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations H·x = g in blocks: frames (N, 7, 7), pairs (E, 7, 7), and a border (cameras, lags) of B
    unknowns that touches every frame. `cost` is the robust cost they were taken at."""

    frame: Array
    pair: Array
    cross: Array
    border: Array
    frame_rhs: Array
    border_rhs: Array
    cost: float
    squared: Array


def rotations(omega: Array) -> Array:
    """Rotation vectors (N, 3), radians → rotation matrices (N, 3, 3)."""
    angle = np.linalg.norm(omega, axis=1)
    axis = omega / np.maximum(angle, 1e-12)[:, None]
    K = np.zeros((len(omega), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    K -= np.transpose(K, (0, 2, 1))
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + s * K + (1 - c) * (K @ K))


def _observe(
    d0: float, d1: float, e0: float, e1: float,
    Ri: Array, ti: Array, hi: float, li: Array, Rj: Array, tj: Array, lj: Array,
    i0: int, j0: int, ci: int, cj: int, J: Array, r: Array,
) -> bool:  # fmt: skip
    """One directed residual r (2,) and its Jacobian J (2, 20): i0, j0, ci, cj are the columns of the two frames
    and cameras. False when the ray misses the ground."""
    # undistort: r_d = r (1 + k1 r² + k2 r⁴), by Newton
    f, k1, k2 = li[0], li[1], li[2]
    xd, yd = d0 / f, d1 / f
    rd = (xd * xd + yd * yd) ** 0.5
    rr = rd
    for _ in range(6):
        q = rr * rr
        rr -= (rr * (1 + k1 * q + k2 * q * q) - rd) / max(1 + 3 * k1 * q + 5 * k2 * q * q, 0.2)
    r2 = rr * rr
    s = 1 + k1 * r2 + k2 * r2 * r2
    x, y = xd / s, yd / s
    ax = Ri[0, 0] * x + Ri[0, 1] * y + Ri[0, 2]
    ay = Ri[1, 0] * x + Ri[1, 1] * y + Ri[1, 2]
    az = Ri[2, 0] * x + Ri[2, 1] * y + Ri[2, 2]
    if az > -MIN_DOWN or ti[2] - hi < 0.1:
        return False
    lam = (hi - ti[2]) / az
    bx, by = ax / az, ay / az
    px, py, pz = ti[0] + lam * ax - tj[0], ti[1] + lam * ay - tj[1], hi - tj[2]
    q0 = Rj[0, 0] * px + Rj[1, 0] * py + Rj[2, 0] * pz
    q1 = Rj[0, 1] * px + Rj[1, 1] * py + Rj[2, 1] * pz
    q2 = Rj[0, 2] * px + Rj[1, 2] * py + Rj[2, 2] * pz
    if q2 < MIN_DOWN * (ti[2] - hi):
        return False
    u, v = q0 / q2, q1 / q2
    g, m1, m2 = lj[0], lj[1], lj[2]
    w2 = u * u + v * v
    sj = 1 + m1 * w2 + m2 * w2 * w2
    mj = 2 * (m1 + 2 * m2 * w2)
    r[0], r[1] = g * sj * u - e0, g * sj * v - e1
    # d(pixel)/d(q) = g (sj I + mj y yᵀ) [I | −y] / q2
    a00, a01, a11 = g * (sj + mj * u * u) / q2, g * mj * u * v / q2, g * (sj + mj * v * v) / q2
    a02, a12 = -(a00 * u + a01 * v), -(a01 * u + a11 * v)
    for k in range(2):
        p0, p1, p2 = (a00, a01, a02) if k == 0 else (a01, a11, a12)
        # d(pixel)/d(p), world
        w0 = p0 * Rj[0, 0] + p1 * Rj[0, 1] + p2 * Rj[0, 2]
        w1 = p0 * Rj[1, 0] + p1 * Rj[1, 1] + p2 * Rj[1, 2]
        wz = p0 * Rj[2, 0] + p1 * Rj[2, 1] + p2 * Rj[2, 2]
        # of the ray: the ground point moves by λ (da − a·da_z/a_z)
        m0, m1_, m2_ = lam * w0, lam * w1, -lam * (w0 * bx + w1 * by)
        c0 = m0 * Ri[0, 0] + m1_ * Ri[1, 0] + m2_ * Ri[2, 0]
        c1 = m0 * Ri[0, 1] + m1_ * Ri[1, 1] + m2_ * Ri[2, 1]
        c2 = m0 * Ri[0, 2] + m1_ * Ri[1, 2] + m2_ * Ri[2, 2]
        J[k, i0], J[k, i0 + 1], J[k, i0 + 2] = c2 * y - c1, c0 - c2 * x, c1 * x - c0 * y
        J[k, i0 + 3], J[k, i0 + 4] = w0, w1
        slope = w0 * bx + w1 * by
        J[k, i0 + 5] = -slope
        J[k, i0 + 6] = slope + wz
        J[k, j0], J[k, j0 + 1], J[k, j0 + 2] = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
        J[k, j0 + 3], J[k, j0 + 4], J[k, j0 + 5] = -w0, -w1, -wz
        J[k, j0 + 6] = 0.0
        # lens of the first frame: every parameter scales the ray's (x, y)
        along = (c0 * x + c1 * y) / (s + 2 * (k1 + 2 * k2 * r2) * r2)
        J[k, ci], J[k, ci + 1], J[k, ci + 2] = -along * s, -along * r2, -along * r2 * r2
    own = ci == cj
    for k in range(2):
        y_k = g * (u if k == 0 else v)
        base0, base1, base2 = (J[k, cj], J[k, cj + 1], J[k, cj + 2]) if own else (0.0, 0.0, 0.0)
        J[k, cj], J[k, cj + 1], J[k, cj + 2] = base0 + y_k * sj, base1 + y_k * w2, base2 + y_k * w2 * w2
    return True


def _accumulate(
    pairs: IntArray, starts: IntArray, uv: Array, weight: Array, camera: IntArray,
    R: Array, t: Array, h: Array, lens: Array, sigma: Array, scale: float,
    frame: Array, pair: Array, cross: Array, border: Array, frame_rhs: Array, border_rhs: Array, squared: Array,
) -> float:  # fmt: skip
    """Add all pairs to the normal equations in place; the robust cost. `sigma` (C,) px, `scale` of the Cauchy
    loss in sigmas; `squared` (M, 2) takes the squared residuals in sigmas."""
    J, r = np.zeros((2, 20)), np.zeros(2)
    H, g = np.zeros((20, 20)), np.zeros(20)
    c2 = scale * scale
    cost = 0.0
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        ci, cj = camera[i], camera[j]
        n = 17 if ci == cj else 20
        H[:], g[:] = 0.0, 0.0
        for m in range(starts[e], starts[e + 1]):
            for way in range(2):
                if way == 0:
                    ok = _observe(uv[m, 0], uv[m, 1], uv[m, 2], uv[m, 3], R[i], t[i], h[i], lens[ci],
                                  R[j], t[j], lens[cj], 0, 7, 14, n - 3, J, r)  # fmt: skip
                    sg = sigma[cj]
                else:
                    ok = _observe(uv[m, 2], uv[m, 3], uv[m, 0], uv[m, 1], R[j], t[j], h[j], lens[cj],
                                  R[i], t[i], lens[ci], 7, 0, n - 3, 14, J, r)  # fmt: skip
                    sg = sigma[ci]
                s2 = (r[0] * r[0] + r[1] * r[1]) / (sg * sg) if ok else 1e6
                squared[m, way] = s2
                cost += 0.5 * weight[e] * c2 * np.log1p(s2 / c2)
                if not ok:
                    continue
                w = weight[e] / ((1 + s2 / c2) * sg * sg)
                for a in range(n):
                    x, y = w * J[0, a], w * J[1, a]
                    g[a] -= x * r[0] + y * r[1]
                    for b in range(a, n):
                        H[a, b] += x * J[0, b] + y * J[1, b]
        for a in range(n):
            for b in range(a):
                H[a, b] = H[b, a]
        bi, bj = 3 * ci, 3 * cj
        frame[i] += H[:7, :7]
        frame[j] += H[7:14, 7:14]
        pair[e] = H[:7, 7:14]
        frame_rhs[i] += g[:7]
        frame_rhs[j] += g[7:14]
        cross[i, :, bi : bi + 3] += H[:7, 14:17]
        cross[j, :, bi : bi + 3] += H[7:14, 14:17]
        border[bi : bi + 3, bi : bi + 3] += H[14:17, 14:17]
        border_rhs[bi : bi + 3] += g[14:17]
        if n == 20:
            cross[i, :, bj : bj + 3] += H[:7, 17:20]
            cross[j, :, bj : bj + 3] += H[7:14, 17:20]
            border[bi : bi + 3, bj : bj + 3] += H[14:17, 17:20]
            border[bj : bj + 3, bi : bi + 3] += H[17:20, 14:17]
            border[bj : bj + 3, bj : bj + 3] += H[17:20, 17:20]
            border_rhs[bj : bj + 3] += g[17:20]
    return cost


_compile: Callable[[Any], Any] = numba.njit(cache=True, nogil=True)
observe = _observe  # the plain Python function, for tests
_observe = _compile(_observe)
_accumulate = _compile(_accumulate)


def linearise(edges: Edges, state: State, sigma_px: Array, robust_scale: float) -> Normal:
    """The normal equations of all image pairs at `state`. `sigma_px`: (C,) of one correspondence, by camera."""
    n, e, b = len(state.R), len(edges), CAMERA_DOF * len(state.lens) + len(state.lag_s)
    frame, pair, cross = np.zeros((n, 7, 7)), np.zeros((e, 7, 7)), np.zeros((n, 7, b))
    border, frame_rhs, border_rhs = np.zeros((b, b)), np.zeros((n, 7)), np.zeros(b)
    squared = np.zeros((len(edges.uv), 2))
    cost = _accumulate(
        edges.pairs, edges.starts, edges.uv, edges.weight, edges.camera, state.R, state.t, state.h, state.lens,
        sigma_px, robust_scale, frame, pair, cross, border, frame_rhs, border_rhs, squared,
    )  # fmt: skip
    return Normal(frame, pair, cross, border, frame_rhs, border_rhs, float(cost), squared)


def retract(state: State, frames: Array, border: Array) -> State:
    """`state` moved by steps: `frames` (N, 7) = ω, t, h; `border` = (log f, k1, k2) by camera, then lags."""
    c = CAMERA_DOF * len(state.lens)
    lens_step = border[:c].reshape(-1, CAMERA_DOF)
    lens = np.column_stack((state.lens[:, 0] * np.exp(lens_step[:, 0]), state.lens[:, 1:] + lens_step[:, 1:]))
    return State(
        state.R @ rotations(frames[:, :3]),
        state.t + frames[:, 3:6],
        state.h + frames[:, 6],
        lens,
        state.lag_s + border[c:],
    )
