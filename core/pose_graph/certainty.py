"""How well each position is known: marginals of the final normal equations."""

from __future__ import annotations

import numpy as np

from core.geometry import Array
from core.pose_graph.adjustment import Adjusted
from core.pose_graph.factor import Border, covariances
from core.pose_graph.priors import yaw_jacobian
from core.pose_graph.residuals import IntArray

# Median length of a plane vector → standard deviation per axis.
MEDIAN_2D = 1.1774
# Holds the frame that a submap without GPS is measured from.
FIXED_M, FIXED_RAD = 1e-3, 1e-5


def position_sigmas(adjusted: Adjusted, origins: IntArray) -> Array:
    """Standard deviations (N, 3) of the frames' centres, east, north and up, metres; NaN where unknown.

    `origins`: frames whose place and heading are a convention (one in each submap without GPS): positions of
    their submap are relative to them. Scaled by the unit variance that the residuals show, where that says
    that matches are worse than believed. What the model does not hold is not in it: an error that all fixes
    of a flight share (a receiver's bias, a datum of its heights).
    """
    normal, state = adjusted.normal, adjusted.state
    frame = normal.frame.copy()
    for k in origins.tolist():
        turn = yaw_jacobian(state.R[k : k + 1])[0]
        frame[k, 3, 3] += 1 / FIXED_M**2
        frame[k, 4, 4] += 1 / FIXED_M**2
        frame[k, :3, :3] += np.outer(turn, turn) / FIXED_RAD**2
    border = Border(normal.cross, normal.border, normal.border_rhs)
    blocks = covariances(adjusted.fronts, frame, normal.pair, border)
    if blocks is None:
        return np.full((len(frame), 3), np.nan)
    unit = max(1.0, float(np.median(adjusted.squared)) / MEDIAN_2D**2) if adjusted.squared.size else 1.0
    variance = np.diagonal(blocks, axis1=1, axis2=2)[:, 3:6] * unit
    return np.asarray(np.sqrt(np.where(variance > 0, variance, np.nan)))
