"""Which GPS fixes to believe: those that contradict the pictures around them count as absent.

A fix that is off by kilometres, left in, would pull its frame so far that the frame's good matches look like
the wrong ones. Pairs alone give the shape of a submap; held against it, fixes fall into groups that agree
within themselves, and the largest group says where the submap lies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from core.geometry import Array
from core.pose_graph.averaging import fit_similarity
from core.pose_graph.residuals import IntArray
from core.pose_graph.sparse import ComplexArray

Flags = NDArray[np.bool_]

# With fewer fixes none can be told from the others.
ENOUGH = 5
# A fix is doubted when it is off by more than this many sigmas, and this many times what fixes usually are.
SIGMAS, USUAL = 10.0, 6.0
# A pair whose step departs from those around it by more than this share of the height tells nothing of GPS.
LOOSE_PAIR = 0.5
# Scale and heading drift along a submap: a step in metres is known to this share.
DRIFT = 0.5
TRIALS, JUDGES = 300, 400


def contradicted(
    gps: ComplexArray, sigma: Array, pairs: IntArray, step: ComplexArray, miss: Array, place: ComplexArray
) -> Flags:
    """(N,) the fixes of one submap that the pictures contradict.

    `gps`: (N,) complex metres, NaN without a fix; `sigma` (N,). `pairs`: (E, 2), with c_i − c_j = `step` (E,)
    and by how much that `miss`es the rest, as a share of the height (E,). `place`: (N,) the c. Steps and
    places are known up to one similarity.
    """
    n, known = len(gps), np.isfinite(gps)
    if known.sum() < ENOUGH:
        return np.zeros(n, bool)
    turn, shift = _consensus(place[known], gps[known], sigma[known])
    off = np.where(known, np.abs(np.where(known, gps, 0) - turn * place - shift), 0.0)
    usual = USUAL * float(np.median(off[known]))
    suspect = known & (off > np.maximum(SIGMAS * sigma, usual))
    if not suspect.any():
        return suspect
    i, j = pairs[(known[pairs] & (miss < LOOSE_PAIR)[:, None]).all(1)].T
    told = turn * step[(known[pairs] & (miss < LOOSE_PAIR)[:, None]).all(1)]
    apart = np.abs(gps[i] - gps[j] - told)
    agree = apart < np.maximum(SIGMAS * np.hypot(sigma[i], sigma[j]), usual) + DRIFT * np.abs(told)
    links = coo_matrix((np.ones(int(agree.sum())), (i[agree], j[agree])), shape=(n, n))
    count, group = connected_components(links, directed=False)
    size = np.bincount(group[known], minlength=count)
    against = np.bincount(group[i], ~agree, count) + np.bincount(group[j], ~agree, count)
    # one pair against a fix may be the wrong one itself; the more fixes agree, the more it takes
    overruled = against >= np.maximum(2.0, np.sqrt(size))
    largest = int(np.argmax(size))
    overruled[largest] = False
    doubted = np.bincount(group[suspect], minlength=count) > 0.5 * size
    return np.asarray(known & (overruled & doubted)[group])


def _consensus(place: ComplexArray, gps: ComplexArray, sigma: Array) -> tuple[complex, complex]:
    """The similarity place → gps with the least median miss over pairs of frames, refined by those that fit:
    right as long as more than half of the fixes are.
    """
    rng, n = np.random.default_rng(0), len(place)
    a = rng.integers(0, n, TRIALS)
    b = (a + rng.integers(1, n, TRIALS)) % n
    judges = np.unique(np.linspace(0, n - 1, min(n, JUDGES)).astype(int))
    span = place[b] - place[a]
    turn = (gps[b] - gps[a]) / np.where(np.abs(span) < 1e-9, np.inf, span)
    shift = gps[a] - turn * place[a]
    off = np.median(np.abs(gps[judges] - turn[:, None] * place[judges] - shift[:, None]), axis=1)
    best = int(np.argmin(np.where(turn == 0, np.inf, off)))
    misses = np.abs(gps - turn[best] * place - shift[best])
    good = misses <= 3 * max(float(off[best]), float(np.median(sigma)))
    return fit_similarity(place[good], gps[good], sigma[good])
