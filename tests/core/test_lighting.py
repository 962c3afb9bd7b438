"""However the normal equations are made, they are those of the whole matrix of all sightings."""

from __future__ import annotations

import numpy as np
import pytest

from core.geometry import Array
from core.lighting import DEFAULT, Dense, Index, Sightings, Sparse, reweighted


def seen_by_chance(frames: int, points: int, seed: int) -> Sightings:
    """Each point is seen by two frames or more, each of which sees it once."""
    rng = np.random.default_rng(seed)
    pick = rng.random((points, frames)) < 0.4
    pick[:, :2] |= pick.sum(1, keepdims=True) < 2
    point, frame = np.nonzero(pick)
    m = len(point)
    first = np.flatnonzero(np.diff(point, prepend=-1))
    return Sightings(frame, point, rng.normal(0, 0.5, (m, 3)), rng.uniform(-1, 1, (m, 3)), first)


def whole(seen: Sightings, gain: Index, count: int, lens: Index, lenses: int, terms: Array) -> Array:
    """The matrix (M, unknowns), written down."""
    wide = terms.shape[1]
    out = np.zeros((len(gain), count + wide * lenses))
    for m, (g, k) in enumerate(zip(gain, lens, strict=True)):
        if g >= 0:
            out[m, g] = -1.0
        out[m, count + wide * k : count + wide * (k + 1)] = terms[m]
    return out


def least_squares(matrix: Array, seen: Sightings, weight: Array, prior: Array) -> Array:
    """The same with every point's brightness as an unknown, by the book."""
    points = len(seen.start)
    bright = np.eye(points)[seen.point]
    full = np.column_stack((matrix, bright)) * np.sqrt(weight)[:, None]
    held = np.diag(np.sqrt(np.append(prior, np.zeros(points))))[: len(prior)]
    right = np.concatenate((seen.log * np.sqrt(weight)[:, None], np.zeros((len(prior), 3))))
    return np.asarray(np.linalg.lstsq(np.concatenate((full, held)), right, rcond=None)[0][: len(prior)])


@pytest.mark.parametrize(("frames", "lenses", "seed"), [(6, 1, 0), (20, 3, 1), (20, 20, 2)])
def test_gains_and_falloffs_are_those_of_the_whole_matrix(frames: int, lenses: int, seed: int) -> None:
    seen, rng = seen_by_chance(frames, 90, seed), np.random.default_rng(seed)
    lens_of = np.arange(frames) % lenses
    lens = lens_of[seen.frame]
    matrix = whole(seen, seen.frame, frames, lens, lenses, seen.terms)
    weight, prior = rng.uniform(0.1, 1.0, len(lens)), rng.uniform(1.0, 10.0, matrix.shape[1])
    design = Sparse(seen.frame, frames, lens, lenses, seen.terms)
    answer = design.solve(seen, weight, prior)
    np.testing.assert_allclose(answer, least_squares(matrix, seen, weight, prior), rtol=0, atol=1e-10)
    np.testing.assert_allclose(design.light(answer), matrix @ answer, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_few_gains_are_the_same_with_and_without_sparse_matrices(seed: int) -> None:
    seen, count = seen_by_chance(12, 60, seed), 5
    gain = np.where(seen.frame < count, seen.frame, -1)  # the others' are known
    nothing = np.zeros(len(gain), np.int64), 0, np.zeros((len(gain), 0))
    prior = np.full(count, 3.0)
    weight = np.random.default_rng(seed).uniform(0.1, 1.0, len(gain))
    dense, sparse = Dense(gain, count), Sparse(gain, count, *nothing)
    answer = dense.solve(seen, weight, prior)
    np.testing.assert_allclose(sparse.solve(seen, weight, prior), answer, rtol=0, atol=1e-11)
    np.testing.assert_allclose(sparse.light(answer), dense.light(answer), rtol=0, atol=1e-12)
    matrix = whole(seen, gain, count, *nothing)
    np.testing.assert_allclose(answer, least_squares(matrix, seen, weight, prior), rtol=0, atol=1e-11)
    both = [reweighted(design, seen, prior, DEFAULT) for design in (dense, sparse)]
    np.testing.assert_allclose(both[0], both[1], rtol=0, atol=1e-10)
