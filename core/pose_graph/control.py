"""Surveyed points as observations of the pose graph: where a marked pixel's ground lies is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.model import Mark, PoseParams
from core.pose_graph.residuals import CAMERA_DOF, IntArray, Normal, State
from core.pose_graph.survey import Survey

Places = NDArray[np.complex128]
"""Points of the plane as x + iy, (N,)."""

ROUNDS = 20


@dataclass(frozen=True, slots=True)
class Control:
    """K marks of surveyed points in frames.

    `frame`, `camera`, `point`: (K,) indices. `uv`: (K, 2) pixels from the principal point. `xyz`: (K, 3) the
    point, world metres; its z counts where `height_known` (K,). `lean`: (K, 2) by how much the plumb line
    through it moves east and north a metre up. `sigma_m`: (K,) of where the pixel's ray meets the ground,
    `height_sigma_m`: (K,) of the point above the level plane of its photo.
    """

    frame: IntArray
    camera: IntArray
    point: IntArray
    uv: Array
    xyz: Array
    height_known: NDArray[np.bool_]
    lean: Array
    sigma_m: Array
    height_sigma_m: Array

    def aim(self, h: Array) -> Array:
        """Where the points' plumb lines (K, 2) meet the heights `h` (K,)."""
        return np.asarray(self.xyz[:, :2] + self.lean * (h - self.xyz[:, 2])[:, None])

    def loosened(self, state: State) -> Control:
        """The same marks, believed no better than `state` fits them."""
        usual = float(np.median(np.linalg.norm(_misses(self, state)[0], axis=1)))
        return replace(self, sigma_m=np.maximum(self.sigma_m, usual))


def control_of(s: Survey, marks: Sequence[Mark], params: PoseParams) -> Control | None:
    """The marks in frames of a survey, whatever their order; None without any.

    The photos of one point share the error of its survey: together they weigh no more than it.
    """
    row = {f.frame_id: k for k, f in enumerate(s.frames)}
    seen = sorted({m for m in marks if m.frame_id in row}, key=lambda m: (m.point, m.frame_id, m.uv))
    if not seen:
        return None
    frame = np.array([row[m.frame_id] for m in seen], np.int64)
    camera = s.camera[frame]
    names = sorted({m.point for m in seen})
    point = np.array([names.index(m.point) for m in seen], np.int64)
    axis = np.array([(c.cx, c.cy) for c in s.cameras])[camera]
    lonlat = np.array([(m.lon_deg, m.lat_deg) for m in seen])
    up = np.array([s.world.alt_m if m.alt_m is None else m.alt_m for m in seen])
    xyz = s.world.from_geodetic(np.column_stack((lonlat, up)))
    lean = s.world.from_geodetic(np.column_stack((lonlat, up + 1.0)))[:, :2] - xyz[:, :2]
    known = np.array([m.alt_m is not None for m in seen])
    share = np.sqrt(np.bincount(point)[point])
    return Control(
        frame, camera, point, np.array([m.uv for m in seen]) - axis, xyz, known, lean,
        share * params.control_sigma_m, share * params.control_height_sigma_m,
    )  # fmt: skip


def with_pixels(control: Control, state: State, params: PoseParams) -> Control:
    """The marks with what a wrongly marked pixel moves them on the ground added to their sigmas."""
    height = (state.t[:, 2] - state.h)[control.frame]
    marked = params.control_px * height / state.lens[control.camera, 0]
    return replace(control, sigma_m=np.hypot(control.sigma_m, marked))


def add_control(control: Control, state: State, normal: Normal) -> float:
    """Add all marks to `normal` in place; their cost (Cauchy, bending at two sigmas)."""
    miss, J = _misses(control, state)
    cost = _add(control, normal, miss, J, control.sigma_m)
    known = control.height_known
    rise = np.where(known, state.h[control.frame] - control.xyz[:, 2], 0.0)[:, None]
    up = np.zeros((len(rise), 1, J.shape[2]))
    up[known, 0, 6] = 1.0
    return cost + _add(control, normal, rise, up, control.height_sigma_m)


def _add(control: Control, n: Normal, miss: Array, J: Array, sigma: Array) -> float:
    squared = (miss**2).sum(1) / sigma**2
    w = 1 / (1 + squared / 4) / sigma**2
    H, g = np.einsum("k,kra,krb->kab", w, J, J), np.einsum("k,kra,kr->ka", w, J, miss)
    lens = CAMERA_DOF * control.camera[:, None] + np.arange(CAMERA_DOF)
    np.add.at(n.frame, control.frame, H[:, :7, :7])
    np.add.at(n.frame_rhs, control.frame, -g[:, :7])
    unknown = np.arange(7)[None, :, None]
    np.add.at(n.cross, (control.frame[:, None, None], unknown, lens[:, None]), H[:, :7, 7:])
    np.add.at(n.border, (lens[:, :, None], lens[:, None]), H[:, 7:, 7:])
    np.add.at(n.border_rhs, lens, -g[:, 7:])
    return float(2 * np.log1p(squared / 4).sum())


def _misses(control: Control, state: State) -> tuple[Array, Array]:
    """How far the marked ground lies from the points (K, 2), metres, and the Jacobian (K, 2, 10) by the
    frame's unknowns and its lens. Rays meet the point's own height where that is known, else the level plane.
    """
    k = control.frame
    R, t, h = state.R[k], state.t[k], state.h[k]
    ray, by_lens = _rays(control.uv, state.lens[control.camera])
    a = np.einsum("kij,kj->ki", R, ray)
    down = np.minimum(a[:, 2], -0.05)
    slope = a[:, :2] / down[:, None]
    level = np.where(control.height_known, control.xyz[:, 2], h)
    reach = (level - t[:, 2]) / down
    aim = control.aim(level)
    miss = t[:, :2] + reach[:, None] * a[:, :2] - aim
    # the ground moves by reach · (da − slope · da_z)
    plane = reach[:, None, None] * (R[:, :2] - slope[:, :, None] * R[:, 2:])
    J = np.zeros((len(k), 2, 7 + CAMERA_DOF))
    for axis, unit in enumerate(np.eye(3)):
        J[:, :, axis] = np.einsum("kij,kj->ki", plane, np.cross(unit, ray))
    J[:, 0, 3] = J[:, 1, 4] = 1.0
    J[:, :, 5] = -slope
    J[:, :, 6] = np.where(control.height_known[:, None], 0.0, slope - control.lean)
    J[:, :, 7:] = np.einsum("kij,kjc->kic", plane, by_lens)
    return miss, J


def _rays(uv: Array, lens: Array) -> tuple[Array, Array]:
    """The rays (K, 3) of pixels (K, 2) from the principal point, and what log f, k1, k2 do to them (K, 3, 3).

    Undistorted by Newton on r_d = r (1 + k1 r² + k2 r⁴).
    """
    f, k1, k2 = lens.T
    distorted = uv / f[:, None]
    rd = np.linalg.norm(distorted, axis=1)
    r = rd.copy()
    for _ in range(8):
        q = r * r
        r -= (r * (1 + k1 * q + k2 * q * q) - rd) / np.maximum(1 + 3 * k1 * q + 5 * k2 * q * q, 0.2)
    q = r * r
    s = 1 + k1 * q + k2 * q * q
    ray = np.column_stack((distorted / s[:, None], np.ones(len(uv))))
    scaled = -np.column_stack((s, q, q * q)) / (s + 2 * (k1 + 2 * k2 * q) * q)[:, None]
    return ray, ray[:, :, None] * scaled[:, None, :] * np.array([1.0, 1.0, 0.0])[None, :, None]


@dataclass(frozen=True, slots=True)
class Similarity:
    """x + iy → `shift` + `turn` · (x + iy − `about`) in the plane; heights above `level_m` scale along.

    `rise_m`: what is added to heights.
    """

    about: complex
    turn: complex
    shift: complex
    level_m: float
    rise_m: float

    def places(self, xyz: Array) -> Array:
        """Places (N, 3) after it; what is NaN stays so."""
        xy = self.shift + self.turn * (xyz[:, :2] @ (1, 1j) - self.about)
        return np.column_stack((xy.real, xy.imag, self.heights(xyz[:, 2])))

    def heights(self, z: Array) -> Array:
        """Heights (N,) after it."""
        return np.asarray(self.level_m + abs(self.turn) * (z - self.level_m) + self.rise_m)

    def state(self, state: State) -> State:
        """The whole map after it."""
        turn = self.turn / abs(self.turn)
        new_R_old = np.array([[turn.real, -turn.imag, 0], [turn.imag, turn.real, 0], [0, 0, 1.0]])
        return replace(state, R=new_R_old @ state.R, t=self.places(state.t), h=self.heights(state.h))


def laid_onto(control: Control, state: State, params: PoseParams) -> Similarity:
    """From where `state` shows the points to where they are, robustly; every point counts once.

    Points close together shift the map, only points far apart turn or scale it.
    """
    h = state.h[control.frame]
    rise, aim = control.xyz[:, 2] - h, control.aim(h)
    # heights of the survey may be in another datum: compared in the level planes until they are
    miss = _misses(replace(control, height_known=np.zeros(len(h), bool)), state)[0]
    groups = [control.point == p for p in range(int(control.point.max()) + 1)]
    here = np.array([np.median((aim + miss)[g], axis=0) for g in groups]) @ (1, 1j)
    there = np.array([np.median(aim[g], axis=0) for g in groups]) @ (1, 1j)
    rises = [np.median(rise[g]) for g in groups if control.height_known[g].all()]
    rise_m = float(np.median(rises)) if rises else 0.0
    return Similarity(*_robust(here, there, params), float(np.median(h)), rise_m)


def _robust(here: Places, there: Places, params: PoseParams) -> tuple[complex, complex, complex]:
    """about, turn, shift of the best similarity, points far off weighing little (Cauchy)."""
    weights = np.ones(len(here))
    prior = (params.control_bend_m / params.control_turn_sigma) ** 2
    about, turn, shift = 0j, 1 + 0j, 0j
    for _ in range(ROUNDS):
        about = complex((weights * here).sum() / weights.sum())
        shift = complex((weights * there).sum() / weights.sum())
        a = here - about
        turn = 1 + complex(
            (weights * a.conj() * (there - shift - a)).sum() / ((weights * abs(a) ** 2).sum() + prior)
        )
        off = np.abs(there - shift - turn * a)
        scale = max(params.control_bend_m, 1.4826 * float(np.median(off)))
        weights = 1 / (1 + (off / (2 * scale)) ** 2)
    return about, turn, shift
