"""Absolute rotation averaging (Zhao 2020, eq. 1–4): every frame's rotation from GPS and from its pairs.

Horn's closed form gives each frame by itself a rotation: the one that lays the steps to its neighbours, as
it sees them, along those between their GPS fixes, and the way down along gravity. Relative rotations of the
pairs and these absolute ones are then averaged over the whole graph, by least absolute angles (IRLS).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.attitude import level_to_world, levelling
from core.pose_graph.chaining import phases
from core.pose_graph.priors import gravity, heading
from core.pose_graph.residuals import IntArray, rotations
from core.pose_graph.sparse import ComplexArray, laplacian_solve, number
from core.pose_graph.twoview import TwoViews

# Radians by which relative rotations of good pairs are off.
SPREAD = 0.05
ROUNDS = 8
# How well one pair's ground plane is level, radians: hills are not.
PLANE = 0.07
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, slots=True)
class Absolute:
    """What is known of each frame by itself: `R` (N, 3, 3) world_R_cam; how well, as 1/σ² in rad⁻²: of its
    tilt, `level` (N,), and of its heading, `heading` (N,), 0 where nothing tells.
    """

    R: Array
    level: Array
    heading: Array


def horn(seen: Array, world: Array, weight: Array, frame: IntArray, n: int) -> Array:
    """The rotations (n, 3, 3) that best turn the vectors `seen` (V, 3) of each `frame` (V,) into `world`
    (V, 3): eigenvectors of Horn's matrix N (eq. 4).
    """
    product = (weight[:, None] * seen)[:, :, None] * world[:, None, :]
    flat = product.reshape(-1, 9)
    S = np.column_stack([np.bincount(frame, flat[:, k], n) for k in range(9)]).reshape(n, 3, 3)
    trace = np.trace(S, axis1=1, axis2=2)
    N = np.empty((n, 4, 4))
    N[:, 0, 0] = trace
    N[:, 0, 1:] = N[:, 1:, 0] = np.stack(
        (S[:, 1, 2] - S[:, 2, 1], S[:, 2, 0] - S[:, 0, 2], S[:, 0, 1] - S[:, 1, 0]), -1
    )
    N[:, 1:, 1:] = S + S.transpose(0, 2, 1) - trace[:, None, None] * np.eye(3)
    w, x, y, z = np.linalg.eigh(N)[1][:, :, 3].T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], 1)


def angles(R: Array) -> Array:
    """The rotation vectors (…, 3), radians, of rotations (…, 3, 3)."""
    axis = np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), -1
    )
    twice_sin = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(twice_sin, np.trace(R, axis1=-2, axis2=-1) - 1)
    return np.asarray(axis * (angle / np.maximum(twice_sin, 1e-12))[..., None])


def averaged_rotations(
    pairs: IntArray, views: TwoViews, absolute: Absolute, roots: NDArray[np.int64]
) -> Array:
    """The rotations world_R_cam (N, 3, 3) closest to the relative ones of the pairs and to the absolute ones.

    `roots`: one frame of each connected part, for those parts where no heading is known.
    """
    turn = views.turn
    R = _headed(pairs, views, absolute, roots)
    i, j = pairs[:, 0], pairs[:, 1]
    spread = np.hypot(SPREAD, views.sigma)
    no_heading = np.full(len(R), 1e-6)
    no_heading[roots] += 1.0
    for _ in range(ROUNDS):
        miss = angles(R[i] @ turn @ R[j].transpose(0, 2, 1))
        off = angles(absolute.R @ R.transpose(0, 2, 1))
        w = _least_absolute(np.linalg.norm(miss, axis=1) / spread) / spread**2
        level = absolute.level * _least_absolute(np.linalg.norm(off[:, :2], axis=1) * np.sqrt(absolute.level))
        headed = absolute.heading * _least_absolute(np.abs(off[:, 2]) * np.sqrt(absolute.heading))
        own = np.where(headed[:, None] > 0, off[:, 2:], 0.0)
        lean = laplacian_solve(pairs, w, level + 1e-6, -miss[:, :2], off[:, :2])
        yaw = laplacian_solve(pairs, w, headed + no_heading, -miss[:, 2:], own)
        if lean is None or yaw is None:
            break
        step = np.column_stack((lean, yaw))
        R = rotations(step) @ R
        if float(np.abs(step).max()) < SPREAD / 10:
            break
    return R


def _least_absolute(miss: Array) -> Array:
    """Weights that make squares into absolute values; a miss within one sigma stays as it is."""
    return 1 / np.maximum(miss, 1.0)


def _headed(pairs: IntArray, views: TwoViews, absolute: Absolute, roots: NDArray[np.int64]) -> Array:
    """Rotations (N, 3, 3) with the tilts of the absolute ones, and headings that all pairs agree on."""
    level = levelling(gravity(absolute.R))
    between = level[pairs[:, 0]] @ views.turn @ level[pairs[:, 1]].transpose(0, 2, 1)
    ratio = np.exp(-1j * heading(level_to_world(np.zeros(1)) @ between))
    held = absolute.heading.copy()
    held[roots] += 1.0
    u = phases(pairs, ratio, 1 / np.hypot(SPREAD, views.sigma) ** 2, held, np.exp(1j * heading(absolute.R)))
    return level_to_world(np.angle(u)) @ level


def absolute_rotations(
    pairs: IntArray,
    views: TwoViews,
    gps: ComplexArray,
    gps_sigma: Array,
    down: Array,
    down_sigma: Array,
) -> Absolute:
    """Each frame's rotation by itself (eq. 1–3), from `gps` (N,) complex metres, NaN where it has none, with
    `gps_sigma` (N,), and the way `down` (N, 3) in the camera with `down_sigma` (N,) rad.
    """
    n, (i, j) = len(gps), pairs.T
    step, flat = views.step, views.down
    apart = gps[j] - gps[i]
    told = np.isfinite(apart)
    apart = np.where(told, apart, 0)
    up = -np.einsum("ei,ei->e", step, flat[:, 0])
    level = np.sqrt(np.maximum((step**2).sum(1) - up**2, 1e-12))
    # eq. 1: the fixes give the step its length; heights of fixes are too noisy to give it a slope
    world = _unit(np.column_stack((apart.real, apart.imag, up / level * np.abs(apart))))
    sure = np.abs(apart) ** 2 / (gps_sigma[i] ** 2 + gps_sigma[j] ** 2)
    back = -np.einsum("eji,ej->ei", views.turn, step)
    seen = np.concatenate((_unit(step), _unit(back), flat[:, 0], flat[:, 1], down))
    below = np.tile(DOWN, (2 * len(pairs) + n, 1))
    frame = np.concatenate((i, j, i, j, np.arange(n)))
    plane = np.full(2 * len(pairs), 1 / PLANE**2)
    weight = np.concatenate((sure, sure, plane, 1 / down_sigma**2))
    R = horn(seen, np.concatenate((world, -world, below)), weight, frame, n)
    headed = np.bincount(np.concatenate((i, j)), np.concatenate((sure, sure)), n)
    off = np.abs(np.angle(number(np.einsum("eij,ej->ei", R[i], step)) * np.conj(apart)))
    usual = 1.5 * float(np.median((off * np.sqrt(sure))[told])) if told.any() else 1.0
    lean = np.asarray(np.bincount(frame[2 * len(i) :], weight[2 * len(i) :], n), float)
    return Absolute(R, lean, headed / max(usual, 1.0) ** 2)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12))
