"""The planar-restricted reprojection factor (Zhao 2020, eq. 6–9), one call for all image pairs.

A correspondence (u_i, u_j) gives the ray a = R_i·Proj⁻¹(u_i), the ground point p = t_i + a·(h_i − t_iz)/a_z,
the residual Proj(R_jᵀ(p − t_j)) − u_j, and the same with i and j swapped. Per frame seven unknowns: a
rotation vector ω in the camera's own frame (R ← R·exp(ω)), the centre t and the ground height h; per camera
three: log f, k1, k2. Compiled, because a mission has a million correspondences and ten linearisations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled_loosely
from core.geometry import Array

IntArray = NDArray[np.int64]
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

    def thinned(self, limit: int) -> Edges:
        """The same pairs with every k-th point, at most `limit` each, weighing as much together."""
        counts = np.diff(self.starts)
        rank = np.arange(len(self.uv)) - np.repeat(self.starts[:-1], counts)
        wide = np.repeat(counts, counts)
        kept = np.minimum(wide, limit)
        keep = (rank * kept) // wide != ((rank - 1) * kept) // wide
        size = np.minimum(counts, limit)
        starts = np.concatenate(([0], np.cumsum(size))).astype(np.int64)
        return Edges(self.pairs, starts, self.uv[keep], self.weight * counts / size, self.camera)

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
    `lag_s` (D,) seconds by drone.
    """

    R: Array
    t: Array
    h: Array
    lens: Array
    lag_s: Array


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations H·x = g in blocks: frames (N, 7, 7), pairs (E, 7, 7), and a border (cameras, lags) of
    B unknowns that touches every frame. `cost` is the robust cost they were taken at.
    """

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


@compiled_loosely
def _undistorted(d0: float, d1: float, lens: Array) -> tuple[float, float, float, float]:
    """The ray's x, y, its distortion factor and r² of a pixel from the principal point: Newton on
    r_d = r (1 + k1 r² + k2 r⁴).
    """
    f, k1, k2 = lens[0], lens[1], lens[2]
    xd, yd = d0 / f, d1 / f
    rd = (xd * xd + yd * yd) ** 0.5
    r = rd
    for _ in range(4):
        q = r * r
        r -= (r * (1 + k1 * q + k2 * q * q) - rd) / max(1 + 3 * k1 * q + 5 * k2 * q * q, 0.2)
    r2 = r * r
    s = 1 + k1 * r2 + k2 * r2 * r2
    return xd / s, yd / s, s, r2


@compiled_loosely
def _derive(
    Ri: Array, li: Array, Rj: Array, x: float, y: float, s: float, r2: float, lam: float,
    bx: float, by: float, q0: float, q1: float, q2: float,
    u: float, v: float, w2: float, sj: float, mj: float, g: float, J: Array,
) -> None:  # fmt: skip
    """The Jacobian J (2, 16) of `observe`, from its intermediate values."""
    # d(pixel)/d(q) = g (sj I + mj y yᵀ) [I | −y] / q2
    a00, a01, a11 = g * (sj + mj * u * u) / q2, g * mj * u * v / q2, g * (sj + mj * v * v) / q2
    for k in range(2):
        p0, p1 = (a00, a01) if k == 0 else (a01, a11)
        p2 = -(p0 * u + p1 * v)
        # d(pixel)/d(p), world
        w0 = p0 * Rj[0, 0] + p1 * Rj[0, 1] + p2 * Rj[0, 2]
        w1 = p0 * Rj[1, 0] + p1 * Rj[1, 1] + p2 * Rj[1, 2]
        slope = w0 * bx + w1 * by
        # of the ray: the ground point moves by λ (da − a·da_z/a_z)
        n0, n1, n2 = lam * w0, lam * w1, -lam * slope
        c0 = n0 * Ri[0, 0] + n1 * Ri[1, 0] + n2 * Ri[2, 0]
        c1 = n0 * Ri[0, 1] + n1 * Ri[1, 1] + n2 * Ri[2, 1]
        c2 = n0 * Ri[0, 2] + n1 * Ri[1, 2] + n2 * Ri[2, 2]
        J[k, 0], J[k, 1], J[k, 2] = c2 * y - c1, c0 - c2 * x, c1 * x - c0 * y
        J[k, 3], J[k, 4], J[k, 5] = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
        J[k, 6], J[k, 7], J[k, 8] = w0, w1, slope
        J[k, 9] = p0 * Rj[2, 0] + p1 * Rj[2, 1] + p2 * Rj[2, 2]
        # lens i: every parameter scales the ray's (x, y); lens j: the picture
        along = -(c0 * x + c1 * y) / (s + 2 * (li[1] + 2 * li[2] * r2) * r2)
        y_k = g * (u if k == 0 else v)
        J[k, 10], J[k, 11], J[k, 12] = along * s, along * r2, along * r2 * r2
        J[k, 13], J[k, 14], J[k, 15] = y_k * sj, y_k * w2, y_k * w2 * w2


@compiled_loosely
def observe(
    d0: float, d1: float, e0: float, e1: float,
    Ri: Array, ti: Array, hi: float, li: Array, Rj: Array, tj: Array, lj: Array, J: Array, out: Array,
) -> bool:  # fmt: skip
    """One directed residual and its Jacobian, out = 2 rows of J (2, 16) and 2 of `out`; False when the ray
    misses the ground.

    The columns of J are those that differ: ω_i (3), ω_j (3), the shift east and north, the slope of the ray,
    up, lens i (3), lens j (3); `_spread_columns` makes the unknowns' columns of them.
    """
    x, y, s, r2 = _undistorted(d0, d1, li)
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
    out[0], out[1] = g * sj * u - e0, g * sj * v - e1
    _derive(Ri, li, Rj, x, y, s, r2, lam, bx, by, q0, q1, q2, u, v, w2, sj, mj, g, J)
    return True


def _spread_columns(first: int, second: int, lens_first: int, lens_second: int) -> Array:
    """(16, 20): columns of `observe` → unknowns of a pair (frame, frame, lens, lens), each block's offset
    given.
    """
    T = np.zeros((16, 20))
    for k in range(3):
        T[k, first + k] = 1.0
        T[3 + k, second + k] = 1.0
        T[10 + k, lens_first + k] = 1.0
        T[13 + k, lens_second + k] += 1.0
    for k in range(2):
        T[6 + k, first + 3 + k] = 1.0
        T[6 + k, second + 3 + k] = -1.0
    # d/dt_iz = −slope, d/dh_i = slope + up, d/dt_jz = −up
    T[8, first + 5] = -1.0
    T[8, first + 6] = 1.0
    T[9, first + 6] = 1.0
    T[9, second + 5] = -1.0
    return T


SPREAD = tuple(
    _spread_columns(*offsets) for offsets in ((0, 7, 14, 14), (7, 0, 14, 14), (0, 7, 14, 17), (7, 0, 17, 14))
)
# The few numbers in those matrices: (way + 2·(two lenses), entry) → column of `observe`, unknown, factor.
SOURCE = np.stack([np.nonzero(T)[0] for T in SPREAD])
TARGET = np.stack([np.nonzero(T)[1] for T in SPREAD])
FACTOR = np.stack([T[np.nonzero(T)] for T in SPREAD])


@compiled_loosely
def _gather(K: Array, source: IntArray, target: IntArray, factor: Array, H: Array, g: Array) -> None:
    """Turn the products K (17, 17) of `observe`'s columns into the pair's H (20, 20) and g (20)."""
    for p in range(len(source)):
        row, a, fp = source[p], target[p], factor[p]
        g[a] -= fp * K[row, 16]
        for q in range(len(source)):
            H[a, target[q]] += fp * factor[q] * K[row, source[q]]


@compiled_loosely
def _scatter(
    H: Array, g: Array, i: int, j: int, lens_i: int, lens_j: int, frame: Array, pair: Array, cross: Array,
    border: Array, frame_rhs: Array, border_rhs: Array, at: IntArray,
) -> None:  # fmt: skip
    """Add one pair's blocks to those of its frames and lenses, in place."""
    at[0], at[1], at[2], at[3] = i, j, 3 * lens_i, 3 * lens_j
    for p in range(4):
        first, size = (7 * p, 7) if p < 2 else (8 + 3 * p, 3)
        for a in range(size):
            row = first + a
            if p < 2:
                frame_rhs[at[p], a] += g[row]
                for b in range(7):
                    frame[at[p], a, b] += H[row, first + b]
            else:
                border_rhs[at[p] + a] += g[row]
            for q in range(2, 4):
                for b in range(3):
                    if p < 2:
                        cross[at[p], a, at[q] + b] += H[row, 8 + 3 * q + b]
                    else:
                        border[at[p] + a, at[q] + b] += H[row, 8 + 3 * q + b]
    for a in range(7):
        for b in range(7):
            pair[a, b] = H[a, 7 + b]


@compiled_loosely
def _accumulate(
    pairs: IntArray, starts: IntArray, uv: Array, weight: Array, camera: IntArray,
    R: Array, t: Array, h: Array, lens: Array, sigma: Array, scale: float,
    source: IntArray, target: IntArray, factor: Array, squared: Array,
    frame: Array, pair: Array, cross: Array, border: Array, frame_rhs: Array, border_rhs: Array,
) -> float:  # fmt: skip
    """Add all pairs to the normal equations, in place; the robust cost. `sigma` (C,) px, `scale` of the
    Cauchy loss in sigmas; `squared` (M, 2) takes the squared residuals in sigmas.
    """
    longest = 0
    for e in range(len(pairs)):
        longest = max(longest, starts[e + 1] - starts[e])
    # rows of all points, weighted, the residual in the last column: one product makes H and g
    rows, K = np.zeros((2 * longest, 17)), np.zeros((17, 17))
    J, r, H, g, at = np.zeros((2, 16)), np.zeros(2), np.zeros((20, 20)), np.zeros(20), np.zeros(4, np.int64)
    c2, cost = scale * scale, 0.0
    for e in range(len(pairs)):
        H[:], g[:] = 0.0, 0.0
        one_lens = camera[pairs[e, 0]] == camera[pairs[e, 1]]
        for way in range(2):
            i, j = pairs[e, way], pairs[e, 1 - way]
            lj = camera[j]
            Ri, ti, hi, Li, Rj, tj, Lj = R[i], t[i], h[i], lens[camera[i]], R[j], t[j], lens[lj]
            a, b, used, far = 2 * way, 2 - 2 * way, 0, 1.0
            for m in range(starts[e], starts[e + 1]):
                ok = observe(uv[m, a], uv[m, a + 1], uv[m, b], uv[m, b + 1], Ri, ti, hi, Li, Rj, tj, Lj, J, r)
                s2 = (r[0] * r[0] + r[1] * r[1]) / (sigma[lj] * sigma[lj]) if ok else 1e6
                squared[m, way] = s2
                # the logarithm of a product: one call for many points, before it overflows
                far *= 1 + s2 / c2
                if far > 1e200:
                    cost += 0.5 * weight[e] * c2 * np.log(far)
                    far = 1.0
                if not ok:
                    continue
                w = np.sqrt(weight[e] / ((1 + s2 / c2) * sigma[lj] * sigma[lj]))
                for k in range(2):
                    for col in range(16):
                        rows[used + k, col] = w * J[k, col]
                    rows[used + k, 16] = w * r[k]
                used += 2
            cost += 0.5 * weight[e] * c2 * np.log(far)
            np.dot(rows[:used].T, rows[:used], K)
            # one lens shared by both frames: its columns add up
            case = way if one_lens else way + 2
            _gather(K, source[case], target[case], factor[case], H, g)
        li, lj = camera[pairs[e, 0]], camera[pairs[e, 1]]
        _scatter(
            H, g, pairs[e, 0], pairs[e, 1], li, lj, frame, pair[e], cross, border, frame_rhs, border_rhs, at
        )
    return cost


def linearise(edges: Edges, state: State, sigma_px: Array, robust_scale: float) -> Normal:
    """The normal equations of all pairs at `state`. `sigma_px`: (C,) of one correspondence, by camera."""
    n, e, c = len(state.R), len(edges), CAMERA_DOF * len(state.lens)
    b = c + len(state.lag_s)
    squared = np.zeros((len(edges.uv), 2))
    frame, pair, cross = np.zeros((n, 7, 7)), np.zeros((e, 7, 7)), np.zeros((n, 7, b))
    border, frame_rhs, border_rhs = np.zeros((b, b)), np.zeros((n, 7)), np.zeros(b)
    cost = _accumulate(
        edges.pairs, edges.starts, edges.uv, edges.weight, edges.camera,
        state.R, state.t, state.h, state.lens, sigma_px, robust_scale,
        SOURCE, TARGET, FACTOR, squared, frame, pair, cross, border, frame_rhs, border_rhs,
    )  # fmt: skip
    return Normal(frame, pair, cross, border, frame_rhs, border_rhs, float(cost), squared)


def retract(state: State, frames: Array, border: Array) -> State:
    """`state` moved by steps: `frames` (N, 7) = ω, t, h; `border` = (log f, k1, k2) by camera, then lags."""
    c = CAMERA_DOF * len(state.lens)
    lens_step = border[:c].reshape(-1, CAMERA_DOF)
    lens = np.column_stack((state.lens[:, 0] * np.exp(lens_step[:, 0]), state.lens[:, 1:] + lens_step[:, 1:]))
    t, height = state.t + frames[:, 3:6], state.t[:, 2] - state.h
    # Heights above ground scale like the focal length, which flat ground cannot tell from them: long steps
    # along that valley stay in it.
    height = height * np.exp(np.clip((frames[:, 5] - frames[:, 6]) / height, -2.0, 2.0))
    return State(state.R @ rotations(frames[:, :3]), t, t[:, 2] - height, lens, state.lag_s + border[c:])
