"""The solution and the marginals of the sparse elimination against dense algebra on graphs of every kind."""

from __future__ import annotations

import numpy as np
import pytest

from core.pose_graph.chaining import chained
from core.pose_graph.elimination import Front, plan
from core.pose_graph.factor import Border, factorise, solution
from core.pose_graph.marginals import covariances

D, SHARED = 3, 2


def ring(n: int, *reach: int) -> np.ndarray:
    return np.array(
        sorted({(min(i, j), max(i, j)) for i in range(n) for r in reach if (j := (i + r) % n) != i})
    )


def grid(side: int) -> np.ndarray:
    at = [(i, j) for i in range(side) for j in range(side)]
    return np.array(
        [
            (a, b)
            for a in range(len(at))
            for b in range(a + 1, len(at))
            if max(abs(at[a][0] - at[b][0]), abs(at[a][1] - at[b][1])) <= 2
        ]
    )


GRAPHS = {
    "small": (5, ring(5, 1)),
    "chain": (80, ring(80, 1)[1:]),
    "ring": (60, ring(60, 1, 2, 9)),
    "grid": (144, grid(12)),
    "apart": (100, np.vstack((ring(40, 1, 2), ring(40, 1, 3) + 45))),
    "one hub": (70, np.array([(0, k) for k in range(1, 70)])),
    "no pairs": (40, np.zeros((0, 2), np.int64)),
}


def system(n: int, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, Border, np.ndarray]:
    """Blocks of a positive definite system and the same as one dense matrix."""
    rng = np.random.default_rng(n)
    frame, pair = np.tile(np.eye(D), (n, 1, 1)), np.zeros((len(pairs), D, D))
    cross, shared = np.zeros((n, D, SHARED)), np.eye(SHARED)
    dense = np.eye(n * D + SHARED)
    for e, (i, j) in enumerate(pairs.tolist()):
        # either direction: a pair's first frame need not be the lower one
        i, j = (i, j) if rng.random() < 0.5 else (j, i)
        pairs[e] = i, j
        J = rng.normal(size=(6, 2 * D + SHARED))
        A = J.T @ J
        where = np.r_[i * D : i * D + D, j * D : j * D + D, n * D : n * D + SHARED]
        dense[np.ix_(where, where)] += A
        frame[i] += A[:D, :D]
        frame[j] += A[D : 2 * D, D : 2 * D]
        pair[e] = A[:D, D : 2 * D]
        cross[i] += A[:D, 2 * D :]
        cross[j] += A[D : 2 * D, 2 * D :]
        shared += A[2 * D :, 2 * D :]
    return frame, pair, rng.normal(size=(n, D)), Border(cross, shared, rng.normal(size=SHARED)), dense


def solve_blocks(
    fronts: tuple[Front, ...],
    frame: np.ndarray,
    pair: np.ndarray,
    rhs: np.ndarray,
    border: Border | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    factor = factorise(fronts, frame, pair, rhs, border)
    return None if factor is None else solution(factor, len(frame))


@pytest.mark.parametrize("name", GRAPHS)
def test_solution_and_inverse_are_those_of_the_dense_matrix(name: str) -> None:
    n, pairs = GRAPHS[name][0], GRAPHS[name][1].astype(np.int64).copy()
    frame, pair, rhs, border, dense = system(n, pairs)
    structure = plan(n, pairs)
    solved = solve_blocks(structure, frame, pair, rhs, border)
    expected = np.linalg.solve(dense, np.concatenate((rhs.ravel(), border.rhs)))
    assert solved is not None
    np.testing.assert_allclose(np.concatenate((solved[0].ravel(), solved[1])), expected, atol=1e-9)
    factor = factorise(structure, frame, pair, rhs, border)
    assert factor is not None
    blocks, inverse = covariances(factor, n), np.linalg.inv(dense)
    for k in range(n):
        at = slice(k * D, k * D + D)
        np.testing.assert_allclose(blocks[k], inverse[at, at], atol=1e-9)


def test_what_is_not_positive_definite_has_no_solution() -> None:
    n, pairs = 60, ring(60, 1, 2).astype(np.int64)
    frame, pair, rhs, border, _ = system(n, pairs)
    frame[17] -= 1e3 * np.eye(D)
    assert solve_blocks(plan(n, pairs), frame, pair, rhs, border) is None
    assert factorise(plan(n, pairs), frame, pair, rhs, border) is None


@pytest.mark.parametrize("name", GRAPHS)
def test_without_a_border_only_frames_are_solved(name: str) -> None:
    n, pairs = GRAPHS[name][0], GRAPHS[name][1].astype(np.int64).copy()
    frame, pair, rhs, _, dense = system(n, pairs)
    solved = solve_blocks(plan(n, pairs), frame, pair, rhs)
    assert solved is not None
    np.testing.assert_allclose(
        solved[0].ravel(), np.linalg.solve(dense[: n * D, : n * D], rhs.ravel()), atol=1e-9
    )
    assert solved[1].shape == (0,)


@pytest.mark.parametrize("name", GRAPHS)
def test_every_frame_is_eliminated_once_and_before_those_it_is_handed_to(name: str) -> None:
    n, pairs = GRAPHS[name][0], GRAPHS[name][1].astype(np.int64)
    fronts = plan(n, pairs)
    assert sorted(k for f in fronts for k in f.nodes[: f.pivots].tolist()) == list(range(n))
    assert sorted(e for f in fronts for e in f.pairs[:, 0].tolist()) == list(range(len(pairs)))
    for k, front in enumerate(fronts):
        rest = front.nodes[front.pivots :].tolist()
        assert not rest or front.parent > k
        assert not rest or fronts[front.parent].nodes[front.at].tolist() == rest


def test_a_grid_stays_sparse_and_grows_no_worse_than_n_log_n() -> None:
    def entries(side: int) -> int:
        fronts = plan(side**2, grid(side).astype(np.int64))
        return sum(f.pivots * len(f.nodes) for f in fronts)

    n = 30**2
    assert entries(30) < 80 * n  # dense: n² / 2 = 450 n
    assert entries(60) < 6 * entries(30)  # n·log n: 4.8, n^1.5: 8


def test_the_same_numbers_give_the_same_bits() -> None:
    n, pairs = GRAPHS["grid"][0], GRAPHS["grid"][1].astype(np.int64).copy()
    frame, pair, rhs, border, _ = system(n, pairs)
    first, again = (solve_blocks(plan(n, pairs), frame, pair, rhs, border) for _ in range(2))
    assert first is not None
    assert again is not None
    assert first[0].tobytes() == again[0].tobytes()
    assert first[1].tobytes() == again[1].tobytes()


def test_chained_scales_survive_wrong_pairs() -> None:
    rng, n = np.random.default_rng(3), 400
    pairs = grid(20).astype(np.int64)
    z = rng.uniform(0.8, 1.2, n) * np.exp(1j * rng.uniform(-3, 3, n))
    ratio = z[pairs[:, 0]] / z[pairs[:, 1]] * np.exp(rng.normal(0, 0.01, (len(pairs), 2)) @ (1, 1j))
    wrong = rng.choice(len(pairs), len(pairs) // 20, replace=False)
    ratio[wrong] *= np.exp(rng.uniform(-1, 1, (len(wrong), 2)) @ (0.2, 3j))
    found = chained(pairs, ratio, np.ones(len(pairs)), [0], n)
    assert np.abs(found * z[0] / z - 1).max() < 0.05
