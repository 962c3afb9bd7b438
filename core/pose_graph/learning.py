"""What a coarse adjustment teaches: how good each drone's GPS is, and how its camera is mounted."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from core.geometry import Array
from core.pose_graph.matchgraph import submaps
from core.pose_graph.model import PoseParams
from core.pose_graph.priors import Priors, gravity, heading, nadir
from core.pose_graph.receivers import receiver_biases
from core.pose_graph.residuals import IntArray, State
from core.pose_graph.sparse import number, plane
from core.pose_graph.survey import Survey

MIN_OPPOSITE = 10
# Median of |x| and of a plane vector's length → standard deviation per axis.
MEDIAN_1D, MEDIAN_2D = 1.4826, 1.1774


def learnt(s: Survey, pairs: IntArray, priors: Priors, state: State, params: PoseParams) -> Priors:
    """Priors after the coarse adjustment: by what and how widely each drone's GPS is off, and how its camera
    is mounted.
    """
    gps_sigma, altitude_sigma = priors.gps_sigma.copy(), priors.altitude_sigma.copy()
    miss = np.column_stack((nadir(priors, state)[0], state.t[:, 2])) - priors.gps
    if len(s.drones) > 1:
        priors, miss[:, :2] = _unbiased(s, pairs, priors, state, params)
    for d in range(len(s.drones)):
        mine = (s.drone == d) & s.has_gps
        if mine.sum() >= params.min_frames_to_learn:
            observed = max(
                float(np.median(np.hypot(*miss[mine, :2].T))) / MEDIAN_2D, params.gps_learnt_floor_m
            )
            stated = s.gps_sigma[mine] < params.gps_sigma_m
            gps_sigma[mine] = np.where(stated, np.maximum(s.gps_sigma[mine], observed), observed)
        high = mine & np.isfinite(miss[:, 2])
        if high.sum() >= params.min_frames_to_learn:
            observed = MEDIAN_1D * float(np.median(np.abs(miss[high, 2] - np.median(miss[high, 2]))))
            observed = min(max(observed, params.altitude_learnt_floor_m), params.altitude_sigma_m)
            altitude_sigma[high] = observed
    return _mounted(
        s, pairs, replace(priors, gps_sigma=gps_sigma, altitude_sigma=altitude_sigma), state, params
    )


def _unbiased(
    s: Survey, pairs: IntArray, priors: Priors, state: State, params: PoseParams
) -> tuple[Priors, Array]:
    """Priors with each drone's fixes moved by what its receiver is off by; what is left of misses (N, 2)."""
    own = [s.gps_sigma[(s.drone == d) & s.has_gps] for d in range(len(s.drones))]
    typical = [float(np.median(sigma)) if len(sigma) else params.gps_sigma_m for sigma in own]
    bias, left = receiver_biases(
        number(nadir(priors, state)[0]),
        number(priors.gps),
        s.drone,
        submaps(len(s), pairs, range(len(s))),
        np.minimum(typical, params.gps_sigma_m),
        float(np.median(state.t[:, 2] - state.h)),
    )
    moved = priors.gps.copy()
    moved[:, :2] -= plane(bias[s.drone])
    return replace(priors, gps=moved), plane(left)


def _mounted(s: Survey, pairs: IntArray, priors: Priors, state: State, params: PoseParams) -> Priors:
    """What a gimbal or an airframe adds to the expected way down, in the camera's own frame; and, where no
    gimbal tells, how much of the tilt is the ground's.
    """
    down, tilt, known = priors.down.copy(), priors.tilt_sigma.copy(), priors.gimballed > 0
    lean = (gravity(state.R) - priors.down)[:, :2]
    for d, c, gimbal in product(range(len(s.drones)), np.unique(s.camera), (True, False)):
        group = (s.drone == d) & (s.camera == c) & (known == gimbal)
        if group.sum() < params.min_frames_to_learn:
            continue
        middle = np.median(lean[group], axis=0)
        off = float(np.median(np.linalg.norm(lean[group] - middle, axis=1))) / MEDIAN_2D
        down[group, :2] += middle
        tilt[group] = params.gimbal_sigma_rad if gimbal else max(params.tilt_floor_rad, off)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    slope = _share_of_ground(pairs[~known[pairs[:, 0]] & ~known[pairs[:, 1]]], down, state)
    return replace(priors, down=down, tilt_sigma=tilt, gimballed=np.where(known, 1.0, slope))


def _share_of_ground(pairs: IntArray, down: Array, state: State) -> float:
    """How much of the cameras' tilt comes from sloping ground (0 … 1).

    A slope tilts two neighbours to the same side of the world even when they fly in opposite directions; what
    the airframe does differs from photo to photo or turns with its heading.
    """
    tilt = np.einsum("nij,nj->ni", state.R, down)[:, :2]
    yaw = heading(state.R)
    opposite = pairs[np.cos(yaw[pairs[:, 0]] - yaw[pairs[:, 1]]) < -0.5]
    if len(opposite) < MIN_OPPOSITE:
        return 0.0
    first, second = tilt[opposite[:, 0]], tilt[opposite[:, 1]]
    spread = float(((first**2).sum() + (second**2).sum()) / 2)
    return float(np.clip((first * second).sum() / max(spread, 1e-12), 0.0, 1.0))
