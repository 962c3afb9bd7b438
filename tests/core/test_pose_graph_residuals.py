"""The factors' analytic Jacobians against numerical ones, and what a perfect match must cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.geometry import Camera, Pose
from core.pose_graph import priors as prior_terms
from core.pose_graph import residuals
from core.pose_graph.attitude import level_to_world, levelling
from core.pose_graph.matchgraph import spread, submaps
from core.pose_graph.priors import Priors
from core.pose_graph.residuals import Edges, State, linearise, retract, rotations

STEP = 1e-6


@pytest.fixture
def state() -> State:
    rng = np.random.default_rng(3)
    R = level_to_world(rng.uniform(-3, 3, 2)) @ rotations(rng.normal(0, 0.1, (2, 3)))
    t, h = np.array([[0.0, 0, 60], [15, 8, 63]]), np.array([1.0, -2.0])
    return State(R, t, h, np.array([[900.0, -0.05, 0.01], [1000.0, 0.03, -0.01]]), np.zeros(1))


def observed(state: State, lens_j: int) -> tuple[np.ndarray, np.ndarray]:
    J, r = np.zeros((2, 16)), np.zeros(2)
    lens = state.lens
    args = (state.R[0], state.t[0], state.h[0], lens[0], state.R[1], state.t[1], lens[lens_j])
    assert residuals.observe(120.0, -80.0, 100.0, 50.0, *args, J, r)
    return r, J


@pytest.mark.parametrize("lens_j", [0, 1])
def test_jacobian_of_a_match_is_its_derivative(state: State, lens_j: int) -> None:
    table = residuals.SPREAD[0] if lens_j == 0 else residuals.SPREAD[2]
    analytic = observed(state, lens_j)[1] @ table
    for column in range(17 if lens_j == 0 else 20):
        frames, border = np.zeros((2, 7)), np.zeros(7)
        where = (frames.reshape(-1), column) if column < 14 else (border, column - 14)
        where[0][where[1]] = STEP
        ahead = observed(retract(state, frames, border), lens_j)[0]
        where[0][where[1]] = -STEP
        behind = observed(retract(state, frames, border), lens_j)[0]
        numeric = (ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(analytic[:, column], numeric, rtol=1e-5, atol=1e-4, err_msg=str(column))


def edges_between(uv: np.ndarray, lens: tuple[int, int] = (0, 0)) -> Edges:
    n = len(uv)
    return Edges(np.array([[0, 1]]), np.array([0, n]), uv, np.ones(1), np.array(lens))


@pytest.mark.parametrize("lens", [(0, 0), (0, 1), (1, 0)])
def test_gradient_is_the_derivative_of_the_robust_cost(state: State, lens: tuple[int, int]) -> None:
    uv = np.random.default_rng(0).uniform(-200, 200, (20, 4))
    edges, sigma = edges_between(uv, lens), np.array([1.5, 2.0])
    normal = linearise(edges, state, sigma, 2.0)
    for column in range(20):
        frames, border = np.zeros((2, 7)), np.zeros(7)
        flat, k = (frames.reshape(-1), column) if column < 14 else (border, column - 14)
        costs = []
        for sign in (1, -1):
            flat[k] = sign * STEP
            costs.append(linearise(edges, retract(state, frames, border), sigma, 2.0).cost)
        numeric = (costs[0] - costs[1]) / (2 * STEP)
        analytic = normal.frame_rhs.reshape(-1)[column] if column < 14 else normal.border_rhs[column - 14]
        assert -analytic == pytest.approx(numeric, rel=1e-4, abs=1e-3), column


def test_a_perfect_match_costs_nothing_and_pulls_nowhere(state: State) -> None:
    cameras = [Camera(2000, 1500, f, 0.0, 0.0, k1, k2) for f, k1, k2 in state.lens]
    poses = [Pose(state.R[k], state.t[k], 1.0) for k in range(2)]
    first = np.random.default_rng(1).uniform(-300, 300, (30, 2))
    second = poses[1].pixels(cameras[1], poses[0].ground(cameras[0], first))
    level = State(state.R, state.t, np.ones(2), state.lens, state.lag_s)
    uv = np.column_stack((first, second))
    normal = linearise(edges_between(uv, (0, 1)), level, np.ones(2), 2.0)
    assert normal.cost < 1e-12
    assert np.abs(normal.frame_rhs).max() < 1e-4


def test_a_focal_length_that_heights_follow_changes_no_residual(state: State) -> None:
    """Level cameras at one height cannot tell one from the other, however long the step."""
    level = np.tile(np.diag((1.0, -1.0, -1.0)), (2, 1, 1))
    t = state.t * (1, 1, 0) + (0, 0, 60)
    flat = State(level, t, np.ones(2), np.array([[1200.0, 0, 0], [900.0, 0, 0]]), state.lag_s)
    edges = edges_between(np.random.default_rng(2).uniform(-300, 300, (20, 4)), (0, 1))
    frames, border = np.zeros((2, 7)), np.zeros(7)
    border[[0, 3]] = -0.4
    frames[:, 6] = 0.4 * (flat.t[:, 2] - flat.h)
    before, after = (linearise(edges, s, np.ones(2), 2.0) for s in (flat, retract(flat, frames, border)))
    np.testing.assert_allclose(after.squared, before.squared, rtol=1e-9)


def test_a_ray_above_the_horizon_is_refused(state: State) -> None:
    up = State(state.R @ rotations(np.full((2, 3), 1.5)), state.t, state.h, state.lens, state.lag_s)
    normal = linearise(edges_between(np.zeros((1, 4))), up, np.ones(2), 2.0)
    assert np.isfinite(normal.cost)
    assert normal.cost > 1.0
    assert not normal.frame.any()


def test_heading_jacobian_is_its_derivative(state: State) -> None:
    analytic = prior_terms.yaw_jacobian(state.R)
    for axis in range(3):
        step = np.zeros((2, 3))
        step[:, axis] = STEP
        ahead = prior_terms.heading(state.R @ rotations(step))
        behind = prior_terms.heading(state.R @ rotations(-step))
        numeric = prior_terms.wrapped(ahead - behind) / (2 * STEP)
        np.testing.assert_allclose(analytic[:, axis], numeric, atol=1e-6)


def believed(state: State) -> Priors:
    rng = np.random.default_rng(7)
    down = prior_terms.gravity(state.R) + rng.normal(0, 0.05, (2, 3))
    ones = np.ones(2)
    return Priors(
        gps=state.t + rng.normal(0, 3, (2, 3)),
        gps_sigma=2 * ones,
        altitude_sigma=3 * ones,
        velocity=rng.normal(0, 5, (2, 2)),
        drone=np.zeros(2, int),
        anchor=state.t + 5,
        down=down / np.linalg.norm(down, axis=1, keepdims=True),
        gimballed=np.array([1.0, 0.4]),
        tilt_sigma=0.05 * ones,
        yaw=prior_terms.heading(state.R) + 0.3,
        yaw_sigma=0.5 * ones,
        height=np.array([50.0, 70.0]),
        height_sigma=0.2 * ones,
        ground_step_sigma_m=1.5,
        lens=state.lens * (1.01, 0.9, 1.1),
        lens_sigma=np.full((2, 3), 0.05),
        lag_sigma_s=0.3,
    )


def test_gradient_of_the_priors_is_the_derivative_of_their_cost(state: State) -> None:
    priors, pairs = believed(state), np.array([[0, 1]])
    empty = Edges(pairs[:0], np.zeros(1, int), np.zeros((0, 4)), np.ones(0), np.array([0, 1]))

    def at(moved: State) -> tuple[float, residuals.Normal]:
        normal = linearise(empty, moved, np.ones(2), 2.0)
        blank = replace(normal, pair=np.zeros((1, 7, 7)))
        return prior_terms.add_priors(priors, pairs, moved, blank), blank

    normal = at(state)[1]
    analytic = np.concatenate((normal.frame_rhs.reshape(-1), normal.border_rhs))
    for column in range(21):
        costs = []
        for sign in (1, -1):
            step = np.zeros(21)
            step[column] = sign * STEP
            costs.append(at(retract(state, step[:14].reshape(2, 7), step[14:]))[0])
        numeric = (costs[0] - costs[1]) / (2 * STEP)
        assert -analytic[column] == pytest.approx(numeric, rel=1e-4, abs=1e-4), column


def test_levelling_turns_the_way_down_onto_the_axis() -> None:
    down = np.random.default_rng(2).normal(size=(50, 3)) * (0.4, 0.4, 0.1) + (0, 0, 1)
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    turn = levelling(down)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turn, down), np.tile([0, 0, 1.0], (50, 1)), atol=1e-12)
    np.testing.assert_allclose(
        turn @ np.transpose(turn, (0, 2, 1)), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )


def test_thinning_keeps_every_corner_of_the_picture() -> None:
    rng = np.random.default_rng(4)
    crowd, corners = (
        rng.uniform(0.4, 0.5, (500, 2)),
        np.array([[0.01, 0.01], [0.99, 0.01], [0.99, 0.99], [0.01, 0.99]]),
    )
    where = np.concatenate((crowd, corners, crowd))
    group = np.repeat([0, 1], (504, 500))
    kept = spread(where, group, 16)
    assert {500, 501, 502, 503} <= set(kept.tolist())
    assert np.bincount(group[kept]).tolist() == [16, 16]


def test_thinned_edges_weigh_the_same() -> None:
    edges = Edges(
        np.array([[0, 1], [1, 2]]), np.array([0, 30, 35]), np.zeros((35, 4)), np.ones(2), np.zeros(3, int)
    )
    thin = edges.thinned(10)
    assert np.diff(thin.starts).tolist() == [10, 5]
    np.testing.assert_allclose(thin.weight * np.diff(thin.starts), [30, 5])


def test_submaps_are_numbered_by_size_then_name() -> None:
    pairs = np.array([[0, 1], [3, 4], [4, 5], [6, 7]])
    assert submaps(8, pairs, list("hgfedcba")).tolist() == [2, 2, 3, 0, 0, 0, 1, 1]
