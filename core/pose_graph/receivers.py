"""What each drone's receiver is off by: a constant, where drones' pictures overlap and their GPS disagrees.

Two makes of receiver differ by a metre or three for a whole flight. The overlap says by how much, but not who
is right: the differences are shared out so that receivers that claim the same accuracy move by the same.
"""

from __future__ import annotations

import numpy as np

from core.geometry import Array
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray

# A receiver is off when that shows by so many standard deviations; errors of GPS last longer than a photo.
SHOWS = 4.0
# A map bends by less than this share of its flight height: a smaller difference need not be GPS's.
BENT = 0.02
ROUNDS = 3


def receiver_biases(
    place: ComplexArray, gps: ComplexArray, drone: IntArray, submap: IntArray, prior_m: Array, height_m: float
) -> tuple[ComplexArray, ComplexArray]:
    """By how much each drone's fixes are off (D,), complex metres; 0 for all where none of it is sure. And
    what is left of each place's miss (N,), NaN without a fix, when fixes and submaps have moved.

    `place`: (N,) complex metres where matches lay the frames, right up to a similarity for each `submap`
    (N,). `gps`: (N,) complex metres, NaN without a fix; `drone` (N,); `prior_m`: (D,) standard deviation of
    each bias.
    """
    told, count = np.isfinite(gps), len(prior_m)
    none = np.zeros(count, complex), place - gps
    if len(np.unique(drone[told])) < 2:
        return none
    parts = (submap[told, None] == np.unique(submap[told])).astype(float)
    here = place[told, None] - (parts * place[told, None]).sum(0) / parts.sum(0)
    A = np.hstack((drone[told, None] == np.arange(count), parts, parts * here))
    miss = gps[told] - place[told]
    prior = np.zeros(A.shape[1])
    prior[:count] = 1 / prior_m**2
    x, w, sigma2 = np.zeros(A.shape[1], complex), np.ones(len(miss)), float(np.median(np.abs(miss)) ** 2)
    inverse = np.zeros((len(prior), len(prior)), complex)
    for _ in range(ROUNDS):
        weighted = A.conj().T * w
        inverse = np.linalg.pinv(weighted @ A / sigma2 + np.diag(prior + 1e-12))
        x = inverse @ (weighted @ miss) / sigma2
        off = np.abs(miss - A @ x) ** 2
        sigma2 = max(float(np.median(off)) / (2 * np.log(2)), 1e-6)
        w = 1 / (1 + off / (4 * sigma2))
    bias, left = x[:count], place - gps
    left[told] = A @ x - miss
    # what all share is the prior's doing: only differences show
    contrast = np.eye(count) - 1 / count
    spread = np.sqrt(np.maximum(np.diag(contrast @ inverse[:count, :count] @ contrast).real, 0.0))
    sure = np.maximum(SHOWS * spread, BENT * height_m)
    return (bias, left) if (np.abs(contrast @ bias) > sure).any() else none
