"""Which gains and falloffs make all photos that see a point agree on its light: robust least squares.

The brightness of each point is eliminated, and no matrix of all sightings is ever made: a mission has a
million of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from core.compiled import compiled
from core.geometry import Array

Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ExposureParams:
    """How exposure is balanced.

    `side_px`: photos are shrunk to this before their colours are compared; `points_per_side`: ground points
    across a median footprint. `darkest`, `brightest`: grey levels between which a colour is trusted. In
    logarithms: `noise` of one comparison; `outlier` beyond which it fades in the end, `doubt` at first, when
    nobody's gain is known; the `gain_sigma` around 1 and the `falloff_sigma` around a perfect lens and
    ground that looks the same from all sides.
    """

    side_px: int = 32
    points_per_side: int = 16
    darkest: float = 6.0
    brightest: float = 248.0
    noise: float = 0.25
    outlier: float = 0.3
    doubt: float = 1.0
    gain_sigma: float = 0.3
    falloff_sigma: float = 0.3
    iterations: int = 6


DEFAULT = ExposureParams()


@dataclass(frozen=True, slots=True)
class Sightings:
    """Who saw which point in what light. `frame`, `point`: (M,) int64, points ascending; `log`: (M, 3);
    `place`: (M, 3), ρ² of `Camera.falloff` and how far east and north the unit ray goes; `start`: where the
    sightings of each point begin, (P,).
    """

    frame: Index
    point: Index
    log: Array
    place: Array
    start: Index

    @property
    def terms(self) -> Array:
        """What a channel's numbers in a camera's falloff are multiplied with, (M, 5)."""
        rho2 = self.place[:, 0]
        return np.column_stack((rho2, rho2**2, rho2**3, self.place[:, 1:]))

    def sums(self, values: Array) -> Array:
        """The sums of (M, …) values over each point's sightings, (P, …)."""
        return np.asarray(np.add.reduceat(values, self.start, axis=0))


def reweighted(design: Design, seen: Sightings, prior: Array, params: ExposureParams) -> Array:
    """The answer for which log light = point + design · answer, when few may lie: iteratively reweighted."""
    answer, weight = np.zeros((len(prior), 3)), np.ones(len(seen.frame))
    for turn in range(params.iterations):
        answer = design.solve(seen, weight / params.noise**2, prior)
        left = seen.log - design.light(answer)
        mean = seen.sums(weight[:, None] * left) / seen.sums(weight)[:, None]
        off = ((left - mean[seen.point]) ** 2).mean(1)
        scale = max(params.outlier, params.doubt / 2**turn)
        weight = 1 / (1 + off / scale**2) ** 2
    return answer


class Design(Protocol):
    """What the unknowns, gains and falloffs, do to the light of each sighting."""

    def light(self, answer: Array) -> Array:
        """(M, 3) by how much these unknowns (…, 3) lighten each sighting."""

    def solve(self, seen: Sightings, weight: Array, prior: Array) -> Array:
        """Weighted least squares with one free brightness per point and channel, eliminated beforehand."""


class Dense(Design):
    """A handful of gains. `gain`: whose each sighting is, (M,), −1 where that is known."""

    def __init__(self, gain: Index, count: int) -> None:
        mine = np.flatnonzero(gain >= 0)
        self._design = np.zeros((len(gain), count))
        self._design[mine, gain[mine]] = -1.0

    def light(self, answer: Array) -> Array:
        return np.asarray(self._design @ answer)

    def solve(self, seen: Sightings, weight: Array, prior: Array) -> Array:
        weighted = weight[:, None] * self._design
        share, total = seen.sums(weighted), seen.sums(weight)[:, None]
        normal = self._design.T @ weighted - share.T @ (share / total) + np.diag(prior)
        right = weighted.T @ seen.log - share.T @ (seen.sums(weight[:, None] * seen.log) / total)
        return np.asarray(np.linalg.solve(normal, right))


class Sparse(Design):
    """Any number of gains, and the falloffs of some lenses: T numbers each, times `terms` (M, T).

    `gain`: as in Dense; `lens`: (M,). A mission has a million sightings: no matrix of them is made.
    """

    def __init__(self, gain: Index, count: int, lens: Index, lenses: int, terms: Array) -> None:
        self._gain, self._count, self._lens, self._lenses, self._terms = gain, count, lens, lenses, terms

    def light(self, answer: Array) -> Array:
        light = np.zeros((len(self._gain), 3))
        _lighten(self._gain, self._lens, self._terms, self._count, np.ascontiguousarray(answer), light)
        return light

    def solve(self, seen: Sightings, weight: Array, prior: Array) -> Array:
        n, wide = self._count, self._terms.shape[1]
        group, owner = np.unique(seen.point * max(self._lenses, 1) + self._lens, return_inverse=True)
        own, right = np.zeros((n, 1 + wide)), np.zeros((len(prior), 3))
        falloff, shared = np.zeros((self._lenses, wide, wide)), np.zeros((len(group), wide))
        _accumulate(
            self._gain, self._lens, owner, self._terms, weight, seen.log, n, own, falloff, shared, right
        )
        share = self._share(seen, weight, group, shared)
        inverse = sparse.diags(1 / seen.sums(weight))
        normal = self._normal(seen, own, falloff) - share.T @ inverse @ share + sparse.diags(prior)
        right -= share.T @ (inverse @ seen.sums(weight[:, None] * seen.log))
        # Symmetric positive definite: no pivoting, or SuperLU takes forty times as long.
        factor = splu(
            normal.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return np.asarray(factor.solve(right))

    def _share(self, seen: Sightings, weight: Array, group: Index, shared: Array) -> Any:
        """The sums of each point's weighted rows of the design, (P, unknowns)."""
        points, wide, mine = len(seen.start), shared.shape[1], np.flatnonzero(self._gain >= 0)
        ends = np.searchsorted(mine, np.append(seen.start, len(weight)))
        gains = sparse.csr_matrix((-weight[mine], self._gain[mine], ends), shape=(points, self._count))
        if not wide:
            return gains
        point, lens = np.divmod(group, self._lenses)
        columns = (wide * lens[:, None] + np.arange(wide)).ravel()
        ends = wide * np.searchsorted(point, np.arange(points + 1))
        rest = sparse.csr_matrix((shared.ravel(), columns, ends), shape=(points, wide * self._lenses))
        return sparse.hstack((gains, rest), format="csr")

    def _normal(self, seen: Sightings, own: Array, falloff: Array) -> Any:
        """The products of the design's columns: a gain with itself and its lens, a lens with itself."""
        n, (lenses, wide, _) = self._count, falloff.shape
        of = np.zeros(n, np.int64)
        of[self._gain[self._gain >= 0]] = self._lens[self._gain >= 0]
        gain, numbers = np.arange(n), np.arange(wide)
        mixed = n + wide * of[:, None] + numbers
        lens = n + wide * np.arange(lenses)[:, None, None] + np.zeros((wide, wide), np.int64)
        down, across = lens + numbers[:, None], lens + numbers
        twice = np.repeat(gain, wide)
        values = (own[:, 0], own[:, 1:].ravel(), own[:, 1:].ravel(), falloff.ravel())
        rows = np.concatenate((gain, twice, mixed.ravel(), down.ravel()))
        columns = np.concatenate((gain, mixed.ravel(), twice, across.ravel()))
        size = n + wide * lenses
        return sparse.csr_matrix((np.concatenate(values), (rows, columns)), shape=(size, size))


@compiled
def _lighten(gain: Index, lens: Index, terms: Array, gains: int, answer: Array, light: Array) -> None:
    """`Sparse.light` into zeros (M, 3)."""
    wide = terms.shape[1]
    for m in range(len(gain)):
        first = gains + wide * lens[m]
        for c in range(3):
            if gain[m] >= 0:
                light[m, c] = -answer[gain[m], c]
            for k in range(wide):
                light[m, c] += terms[m, k] * answer[first + k, c]


@compiled
def _accumulate(
    gain: Index,
    lens: Index,
    owner: Index,
    terms: Array,
    weight: Array,
    log: Array,
    gains: int,
    own: Array,
    falloff: Array,
    shared: Array,
    right: Array,
) -> None:
    """Add up, in the order of the sightings, what the normal equations are made of.

    `own` (n, 1 + T): each gain's weights, and its products with its lens; `falloff` (C, T, T); `shared`
    (G, T): the weighted terms of each point's sightings by one lens, which `owner` (M,) says; `right`.
    """
    wide = terms.shape[1]
    for m in range(len(weight)):
        g, w, first = gain[m], weight[m], gains + wide * lens[m]
        if g >= 0:
            own[g, 0] += w
            for c in range(3):
                right[g, c] -= w * log[m, c]
        for i in range(wide):
            weighted = w * terms[m, i]
            shared[owner[m], i] += weighted
            if g >= 0:
                own[g, 1 + i] -= weighted
            for c in range(3):
                right[first + i, c] += weighted * log[m, c]
            for k in range(wide):
                falloff[lens[m], k, i] += terms[m, k] * weighted
