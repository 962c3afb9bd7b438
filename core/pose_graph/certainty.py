"""How well each position is known: marginals of the final normal equations."""

from __future__ import annotations

import numpy as np

from core.geometry import Array
from core.pose_graph.adjustment import Adjusted
from core.pose_graph.factor import Border, Factor, factorise
from core.pose_graph.marginals import covariances
from core.pose_graph.priors import Priors, yaw_jacobian
from core.pose_graph.residuals import IntArray, State

# Median length of a plane vector → standard deviation per axis.
MEDIAN_2D = 1.1774
# Nearest neighbours compared, pairs needed for it, and where a misfit is cut off, in robust sigmas.
NEAREST, MIN_NEIGHBOURS, WILD = 3, 12, 3.0
# Holds the frame that a submap without GPS is measured from.
FIXED_M, FIXED_RAD = 1e-3, 1e-5


def position_sigmas(adjusted: Adjusted, priors: Priors, pairs: IntArray, origins: IntArray) -> Array:
    """Standard deviations (N, 3) of the frames' centres, east, north and up, metres; NaN where unknown.

    `origins`: frames whose place, ground and heading are a convention (one in each submap without GPS): that
    submap's positions are relative to them. The marginals are scaled by the unit variance that the residuals
    show, where matches are worse than believed; what hills do to level planes is added as GPS shows it. An
    error that all fixes of a flight share (a receiver's bias, a datum of its heights) is not in it.
    """
    state, factor = adjusted.state, adjusted.factor
    if factor is None or len(origins):
        factor = _held_factor(adjusted, origins)
    if factor is None:
        return np.full((len(state.R), 3), np.nan)
    blocks = covariances(factor, len(state.R))
    unit = max(1.0, float(np.median(adjusted.squared)) / MEDIAN_2D**2) if adjusted.squared.size else 1.0
    variance = np.diagonal(blocks, axis1=1, axis2=2)[:, 3:6] * unit + shared_misfit(priors, state, pairs)
    return np.asarray(np.sqrt(np.where(variance > 0, variance, np.nan)))


def _held_factor(adjusted: Adjusted, origins: IntArray) -> Factor | None:
    """The factor of the normal equations with the origins held in place."""
    normal, R = adjusted.normal, adjusted.state.R
    frame = normal.frame.copy()
    for k in origins.tolist():
        turn = yaw_jacobian(R[k : k + 1])[0]
        frame[k, 3, 3] += 1 / FIXED_M**2
        frame[k, 4, 4] += 1 / FIXED_M**2
        frame[k, 6, 6] += 1 / FIXED_M**2
        frame[k, :3, :3] += np.outer(turn, turn) / FIXED_RAD**2
    border = Border(normal.cross, normal.border, normal.border_rhs)
    return factorise(adjusted.structure, frame, normal.pair, normal.frame_rhs, border)


def shared_misfit(priors: Priors, state: State, pairs: IntArray) -> Array:
    """The variance (3,) of what neighbours have in common in their misfit to GPS, square metres.

    GPS noise differs from photo to photo; what sloping ground does to a centre (height × slope), like a drift
    of the receiver, is nearly the same for the next one.
    """
    aim = priors.gps.copy()
    aim[:, :2] += priors.velocity * state.lag_s[priors.drone][:, None]
    out = np.zeros(3)
    near = _nearest(state.t[:, :2], pairs)
    for axis, miss in enumerate((state.t - aim).T):
        known = np.isfinite(miss)
        both = near[known[near].all(1)]
        if len(both) < MIN_NEIGHBOURS:
            continue
        miss = np.where(known, miss - np.median(miss[known]), 0.0)
        size = 1.4826 * float(np.median(np.abs(miss[known])))
        tame = np.clip(miss, -WILD * size, WILD * size)
        # Not less what chance may show: a sigma that is a little too wide misleads nobody.
        out[axis] = max(0.0, float((tame[both[:, 0]] * tame[both[:, 1]]).mean()))
    return out


def _nearest(xy: Array, pairs: IntArray) -> IntArray:
    """The pairs (K, 2) of each frame with its nearest tied neighbours."""
    apart = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    ends, other = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((other, apart[other], ends))
    first = np.searchsorted(ends[order], ends[order])
    chosen = np.unique(other[order][np.arange(len(order)) - first < NEAREST])
    return np.asarray(pairs[chosen])
