"""What is believed of a frame before its picture is compared with others: GPS, gravity, height, heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.geometry import Array
from core.pose_graph.control import Control, add_control
from core.pose_graph.residuals import IntArray, Normal, State

DOWN = np.array([0.0, 0.0, -1.0])
# Pins what nothing else holds (islands without GPS) without pulling on anything that is held.
ANCHOR_SIGMA_M = 300.0


@dataclass(frozen=True, slots=True)
class Priors:
    """Per frame, NaN where there is none; sigmas in the unit of what they belong to.

    `gps` (N, 3) m and `velocity` (N, 2) m/s with `drone` (N,); `anchor` (N, 3) m; `down` (N, 3) unit vector
    to the earth in the camera's frame, `gimballed` (N,) 1 where a gimbal says so and 0 where not; `yaw` (N,)
    rad; `height` (N,) m above ground, its sigma in log units. `ground_step_sigma_m`: between the two frames
    of a pair. `lens` (C, 3) px, 1, 1 with `lens_sigma` (C, 3) in log f, k1, k2. `control`: surveyed points.
    """

    gps: Array
    gps_sigma: Array
    altitude_sigma: Array
    velocity: Array
    drone: IntArray
    anchor: Array
    down: Array
    gimballed: Array
    tilt_sigma: Array
    yaw: Array
    yaw_sigma: Array
    height: Array
    height_sigma: Array
    ground_step_sigma_m: float
    lens: Array
    lens_sigma: Array
    lag_sigma_s: float
    control: Control | None = None


def gravity(R: Array) -> Array:
    """The direction to the earth in the camera's frame, (N, 3), of rotations (N, 3, 3)."""
    return np.asarray(np.einsum("nij,i->nj", R, DOWN))


def heading(R: Array) -> Array:
    """Heading of the picture's top edge (N,), radians clockwise from north."""
    return np.asarray(np.arctan2(-R[:, 0, 1], -R[:, 1, 1]))


def wrapped(angle: Array) -> Array:
    """Angles brought to −π … π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)


def add_priors(priors: Priors, pairs: IntArray, state: State, normal: Normal) -> float:
    """Add all priors to `normal` in place; their cost."""
    cost = _add_position(priors, state, normal)
    cost += _add_tilt(priors, state, normal)
    cost += _add_yaw(priors, state, normal)
    cost += _add_height(priors, state, normal)
    cost += _add_ground_steps(priors, pairs, state, normal)
    if priors.control is not None:
        cost += add_control(priors.control, state, normal)
    return cost + _add_border(priors, state, normal)


def _cauchy(squared: Array) -> tuple[Array, float]:
    """Weights and cost of residuals whose square is given in sigmas; the loss bends at two sigmas."""
    return 1 / (1 + squared / 4), float(2 * np.log1p(squared / 4).sum())


def nadir(p: Priors, state: State) -> tuple[Array, Array]:
    """What GPS is held against (N, 2), world metres, and its Jacobian by the frame's unknowns (N, 2, 7).

    The centre, or, for a camera whose gimbal is trusted, the ground that the gimbal says is right below it.
    Matches cannot tell a tilted camera from tilted ground, and the level stitching plane makes all of it a
    tilt. On a slope that would leave the centre in place and push the ground downhill by height × slope.
    """
    ray = np.einsum("nij,nj->ni", state.R, p.down)
    down = np.minimum(ray[:, 2], -0.1)
    reach = p.gimballed * (state.h - state.t[:, 2]) / down
    lean = ray[:, :2] / down[:, None]
    J = np.zeros((len(ray), 2, 7))
    for k, axis in enumerate(np.eye(3)):
        turned = np.einsum("nij,nj->ni", state.R, np.cross(axis, p.down))
        J[:, :, k] = reach[:, None] * (turned[:, :2] - lean * turned[:, 2:])
    J[:, 0, 3] = J[:, 1, 4] = 1.0
    J[:, :, 5] = -p.gimballed[:, None] * lean
    J[:, :, 6] = p.gimballed[:, None] * lean
    return state.t[:, :2] + reach[:, None] * ray[:, :2], J


def _add_position(p: Priors, state: State, n: Normal) -> float:
    lag_column = 3 * len(state.lens) + p.drone
    known = np.isfinite(p.gps[:, 0])
    aim = np.where(known[:, None], p.gps[:, :2] + p.velocity * state.lag_s[p.drone][:, None], 0.0)
    at, J = nadir(p, state)
    miss = np.where(known[:, None], at - aim, 0.0)
    weight, cost = _cauchy((miss**2).sum(1) / p.gps_sigma**2)
    w = np.where(known, weight / p.gps_sigma**2, 0.0)
    n.frame[:] += w[:, None, None] * np.einsum("nki,nkj->nij", J, J)
    n.frame_rhs[:] -= w[:, None] * np.einsum("nki,nk->ni", J, miss)
    rows = np.arange(len(w))
    n.cross[rows, :, lag_column] -= w[:, None] * np.einsum("nki,nk->ni", J, p.velocity)
    np.add.at(n.border, (lag_column, lag_column), w * (p.velocity**2).sum(1))
    np.add.at(n.border_rhs, lag_column, w * (p.velocity * miss).sum(1))
    return cost + _add_altitude(p, state, n)


def _add_altitude(p: Priors, state: State, n: Normal) -> float:
    up = np.isfinite(p.gps[:, 2])
    rise = np.where(up, state.t[:, 2] - np.where(up, p.gps[:, 2], 0.0), 0.0)
    weight, cost = _cauchy(rise**2 / p.altitude_sigma**2)
    w = np.where(up, weight / p.altitude_sigma**2, 0.0)
    n.frame[:, 5, 5] += w
    n.frame_rhs[:, 5] -= w * rise
    pull = (state.t - p.anchor) / ANCHOR_SIGMA_M**2
    for axis in range(3):
        n.frame[:, 3 + axis, 3 + axis] += 1 / ANCHOR_SIGMA_M**2
        n.frame_rhs[:, 3 + axis] -= pull[:, axis]
    return cost + float(0.5 * (pull * (state.t - p.anchor)).sum())


def _add_tilt(p: Priors, state: State, n: Normal) -> float:
    down = gravity(state.R)
    miss = down - p.down
    weight, cost = _cauchy((miss**2).sum(1) / p.tilt_sigma**2)
    w = weight / p.tilt_sigma**2
    # d(exp(−ω) d)/dω = [d]×
    J = np.zeros((len(down), 3, 3))
    J[:, 0, 1], J[:, 0, 2], J[:, 1, 2] = -down[:, 2], down[:, 1], -down[:, 0]
    J -= np.transpose(J, (0, 2, 1))
    n.frame[:, :3, :3] += w[:, None, None] * np.einsum("nki,nkj->nij", J, J)
    n.frame_rhs[:, :3] -= w[:, None] * np.einsum("nki,nk->ni", J, miss)
    return cost


def yaw_jacobian(R: Array) -> Array:
    """d(heading)/dω (N, 3)."""
    east, north = -R[:, 0, 1], -R[:, 1, 1]
    size = np.maximum(east**2 + north**2, 1e-6)
    J = np.zeros((len(R), 3))
    J[:, 0] = (north * -R[:, 0, 2] - east * -R[:, 1, 2]) / size
    J[:, 2] = (north * R[:, 0, 0] - east * R[:, 1, 0]) / size
    return J


def _add_yaw(p: Priors, state: State, n: Normal) -> float:
    known = np.isfinite(p.yaw)
    if not known.any():
        return 0.0
    miss = np.where(known, wrapped(heading(state.R) - np.where(known, p.yaw, 0.0)), 0.0)
    weight, cost = _cauchy(miss**2 / p.yaw_sigma**2)
    w = np.where(known, weight / p.yaw_sigma**2, 0.0)
    J = yaw_jacobian(state.R)
    n.frame[:, :3, :3] += w[:, None, None] * J[:, :, None] * J[:, None, :]
    n.frame_rhs[:, :3] -= (w * miss)[:, None] * J
    return cost


def _add_height(p: Priors, state: State, n: Normal) -> float:
    height = state.t[:, 2] - state.h
    if (height <= 0).any():
        return float("inf")
    miss = np.log(height / p.height)
    w = 1 / p.height_sigma**2
    slope = 1 / height
    for a, b, sign in ((5, 5, 1.0), (6, 6, 1.0), (5, 6, -1.0), (6, 5, -1.0)):
        n.frame[:, a, b] += sign * w * slope**2
    n.frame_rhs[:, 5] -= w * slope * miss
    n.frame_rhs[:, 6] += w * slope * miss
    return float(0.5 * (w * miss**2).sum())


def _add_ground_steps(p: Priors, pairs: IntArray, state: State, n: Normal) -> float:
    i, j = pairs[:, 0], pairs[:, 1]
    w = 1 / p.ground_step_sigma_m**2
    step = state.h[i] - state.h[j]
    np.add.at(n.frame[:, 6, 6], i, w)
    np.add.at(n.frame[:, 6, 6], j, w)
    n.pair[:, 6, 6] -= w
    np.add.at(n.frame_rhs[:, 6], i, -w * step)
    np.add.at(n.frame_rhs[:, 6], j, w * step)
    return float(0.5 * w * (step**2).sum())


def _add_border(p: Priors, state: State, n: Normal) -> float:
    lens_miss = np.column_stack((np.log(state.lens[:, 0] / p.lens[:, 0]), state.lens[:, 1:] - p.lens[:, 1:]))
    miss = np.concatenate((lens_miss.ravel(), state.lag_s))
    sigma = np.concatenate((p.lens_sigma.ravel(), np.full(len(state.lag_s), p.lag_sigma_s)))
    n.border[np.diag_indices(len(miss))] += 1 / sigma**2
    n.border_rhs[:] -= miss / sigma**2
    return float(0.5 * ((miss / sigma) ** 2).sum())
