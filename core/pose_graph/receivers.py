"""What each drone's receiver is off by: a constant, where drones' pictures overlap and their GPS disagrees.

Two makes of receiver differ by a metre or three for a whole flight. The overlap says by how much, but not who
is right: the differences are shared out so that receivers that claim the same accuracy move by the same.
"""

from __future__ import annotations

import numpy as np

from core.geometry import Array
from core.pose_graph.averaging import Similarities
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray, solve_hermitian

# A receiver is off when that shows by so many standard deviations; errors of GPS last longer than a photo.
SHOWS = 4.0
# Start values bend by less than this share of the flight height: a smaller difference need not be GPS's.
BENT = 0.02
# Median length of a vector in the plane, in standard deviations per axis.
MEDIAN_2D = 1.1774


def receiver_biases(
    a: Similarities, pairs: IntArray, gps: ComplexArray, drone: IntArray, prior_m: Array
) -> ComplexArray:
    """By how much each drone's fixes are off (D,), complex metres; 0 for all where none of it is sure.

    The biases are unknowns beside the similarities `a`, which follow them linearly. `gps`: (N,) complex
    metres, NaN without a fix; `drone` (N,); `prior_m`: (D,) standard deviation of each bias.
    """
    count, weight = len(prior_m), np.where(np.isfinite(gps), a.fix_weight, 0.0)
    own = (drone[:, None] == np.arange(count)) * weight[:, None]
    none = np.zeros(count, complex)
    if (own.sum(0) > 0).sum() < 2:
        return none
    rhs = np.zeros((len(gps), 2, count), complex)
    rhs[:, 1] = own
    follows = solve_hermitian(pairs, a.frame, a.pair, rhs)
    if follows is None:
        return none
    miss = np.where(weight > 0, np.where(weight > 0, gps, 0) - a.c, 0)
    usual = float(np.median((np.abs(miss) * np.sqrt(weight))[weight > 0])) / MEDIAN_2D
    M = np.diag(own.sum(0)) - own.T @ follows[:, 1]
    covariance = np.linalg.inv(M / usual**2 + np.diag(1 / prior_m**2))
    bias = covariance @ (own.T @ miss) / usual**2
    # what all share is the prior's doing: only differences show
    contrast = np.eye(count) - 1 / count
    sigma = np.sqrt(np.maximum(np.diag(contrast @ covariance @ contrast).real, 1e-12))
    sure = np.maximum(SHOWS * sigma, BENT * float(np.median(np.abs(a.z))))
    return bias if (np.abs(contrast @ bias) > sure).any() else none
