"""Surveyed points in the pose graph, on flights whose truth is known: chosen ones hold it, others check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from core.alignment import marks_of
from core.checkpoints import Checkpoints, Sighting, by_name, checkpoint_errors, parse_gcp_list
from core.geometry import Array, PosedFrame
from core.pose_graph import Solution, solve
from core.pose_graph.control import Control, add_control
from core.pose_graph.residuals import Normal, State, retract, rotations
from core.simulation import FlightParams
from tests.flights.landmarks import LandmarkParams
from tests.flights.missions import (
    Mission,
    center_errors_m,
    fitted,
    ground,
    ground_errors_m,
    mission,
    rms,
    sigmas_m,
)

PARAMS = FlightParams(frames=75, drones=1, gps_noise_m=2.0, gps_bias_m=2.0, relief_m=0.0, seed=4)
WHERE = {"a": (0.1, 0.1), "b": (0.9, 0.15), "c": (0.5, 0.9), "d": (0.2, 0.7), "e": (0.6, 0.4)}
CHOSEN = ("a", "b", "c")
MARKED_PX = 0.5


@cache
def flown(relief_m: float = 0.0) -> Mission:
    return mission(replace(PARAMS, relief_m=relief_m), LandmarkParams(keypoints=220))


@cache
def points_of(relief_m: float = 0.0, names: str = "abcde") -> Checkpoints:
    """Points on the ground, marked to half a pixel where the photos really show them."""
    flight, rng = flown(relief_m).flight, np.random.default_rng(3)
    corners = np.array([s.pose.center[:2] for s in flight.shots])
    low, high = corners.min(0), corners.max(0)
    lines = [f"EPSG:{flight.epsg}"]
    for name in names:
        xy = low + np.array(WHERE[name]) * (high - low)
        z = flight.params.base_alt_m + flight.terrain.height_m(xy[None] - flight.origin)[0]
        place = np.array([[*xy, z]])
        for shot in flight.shots:
            u, v = shot.pose.pixels(shot.camera, place)[0] + rng.normal(0, MARKED_PX, 2)
            if 20 < u < shot.camera.width - 20 and 20 < v < shot.camera.height - 20:
                lines.append(
                    f"{xy[0]:.4f} {xy[1]:.4f} {z + 1e-4 * ord(name):.4f} {u:.2f} {v:.2f} {shot.name} {name}"
                )
    return parse_gcp_list("\n".join(lines))


def solved(m: Mission, points: Checkpoints) -> Solution:
    return solve(m.frames, m.canonical.matches, marks=marks_of(points, m.frames))


def checked_m(m: Mission, solution: Solution, points: Checkpoints) -> float:
    """How far the map shows the points that are not used from where they are, RMS."""
    cameras = {k: solution.cameras[meta.camera_key] for k, meta in m.meta.items()}
    named = {f.frame_id: f.name for f in m.frames}
    posed = ((named[k], PosedFrame(k, cameras[k], pose)) for k, pose in solution.poses.items())
    errors = checkpoint_errors(points, solution.world, by_name(posed))
    assert errors is not None
    return errors.plane_raw_m


def changed(points: Checkpoints, change: Callable[[Sighting], Sighting]) -> Checkpoints:
    return replace(points, sightings=tuple(map(change, points.sightings)))


def test_three_points_hold_the_map_and_the_others_agree() -> None:
    m, points = flown(), points_of().using(CHOSEN)
    assert checked_m(m, m.solved(), points) > 1.0
    assert checked_m(m, solved(m, points), points) < 0.2


def test_points_bend_the_map_as_no_similarity_could() -> None:
    """Hills of 10 m: better than the free map laid onto the truth itself, all of it, by a similarity."""
    m, points = flown(10.0), points_of(10.0)
    free, bent = m.solved(), solved(m, points.using("abcde"))
    assert rms(ground_errors_m(m, bent)) < fitted(*ground(m, free)).rms_m
    assert checked_m(m, solved(m, points.using(CHOSEN)), points.using(CHOSEN)) < 0.2


@pytest.mark.parametrize("off_m", [1.5, 12.0, 300.0])
def test_a_point_with_a_gross_error_is_resisted(off_m: float) -> None:
    m, points = flown(), points_of()
    wrong = changed(points, lambda s: replace(s, xyz=(s.xyz[0] + off_m, *s.xyz[1:])) if s.point == "d" else s)
    solution = solved(m, wrong.using("abcd"))
    assert checked_m(m, solution, points.using("abcd")) < 0.25
    assert len(solution.dropped_pairs) == len(m.solved().dropped_pairs)


def test_a_mark_in_the_wrong_place_of_one_photo_is_resisted() -> None:
    m, points = flown(), points_of().using(CHOSEN)
    first = next(s for s in points.sightings if s.point == "b")
    wrong = changed(points, lambda s: replace(s, uv=(s.uv[0] + 150, s.uv[1])) if s is first else s)
    assert checked_m(m, solved(m, wrong), points) < 0.2


def test_heights_follow_points_that_tell_them_and_ignore_placeholders() -> None:
    m, points = flown(), points_of().using(CHOSEN)
    raised = changed(points, lambda s: replace(s, xyz=(*s.xyz[:2], s.xyz[2] + 47.0)))
    flat = changed(points, lambda s: replace(s, xyz=(*s.xyz[:2], 3.0)))
    level = {
        name: np.median([p.ground_h_m + s.world.alt_m for p in s.poses.values()])
        for name, s in (("right", solved(m, points)), ("raised", solved(m, raised)), ("free", m.solved()))
    }
    assert level["right"] == pytest.approx(m.flight.params.base_alt_m, abs=0.5)
    assert level["raised"] == pytest.approx(m.flight.params.base_alt_m + 47.0, abs=0.5)
    held = solved(m, flat)
    assert checked_m(m, held, points) < 0.2
    flat_m = np.median([p.ground_h_m + held.world.alt_m for p in held.poses.values()])
    assert flat_m == pytest.approx(level["free"], abs=1.0)


def test_held_positions_are_known_better_and_their_sigmas_are_honest() -> None:
    m, points = flown(), points_of()
    free, held = m.solved(), solved(m, points.using("abcde"))
    assert (np.median(sigmas_m(m, held), 0) < np.median(sigmas_m(m, free), 0)).all()
    for hilly, used in ((m, points), (flown(10.0), points_of(10.0))):
        solution = solved(hilly, used.using("abcde"))
        in_sigmas = center_errors_m(hilly, solution) / sigmas_m(hilly, solution)
        assert ((np.abs(in_sigmas) < 3).mean(0) > 0.9).all()


def test_the_order_of_marks_and_points_nobody_sees_change_nothing() -> None:
    m, points = flown(), points_of().using(CHOSEN)
    one = solved(m, points)
    other = solved(m, replace(points, sightings=points.sightings[::-1]))
    unseen = solved(m, changed(points, lambda s: replace(s, image="gone.jpg")))
    for k, pose in m.solved().poses.items():
        assert one.poses[k].center.tobytes() == other.poses[k].center.tobytes()
        assert unseen.poses[k].center.tobytes() == pose.center.tobytes()


def test_the_gradient_is_the_derivative_of_the_cost() -> None:
    rng, step = np.random.default_rng(0), 1e-5
    R = np.diag((1.0, -1.0, -1.0)) @ rotations(rng.normal(0, 0.1, (2, 3)))
    state = State(
        R, np.array([[0.0, 0, 60], [20, 5, 62]]), np.array([1.0, 2.0]),
        np.array([[900.0, -0.02, 0.01], [800.0, 0.03, 0.0]]), np.zeros(1),
    )  # fmt: skip
    uv = rng.uniform(-250, 250, (6, 2))
    ray = np.column_stack((uv / 850, np.ones(6)))[:, :, None]
    at = (state.t[[0, 1] * 3] + 60 * (state.R[[0, 1] * 3] @ ray)[:, :, 0]) + rng.normal(0, 0.3, (6, 3))
    control = Control(
        np.array([0, 1] * 3), np.array([0, 1] * 3), np.arange(6), uv, at, np.array([True, True, False] * 2),
        rng.normal(0, 0.01, (6, 2)), np.full(6, 0.2), np.full(6, 1.0),
    )  # fmt: skip

    def cost(frames: Array, border: Array) -> tuple[float, Normal]:
        normal = Normal(
            np.zeros((2, 7, 7)), np.zeros((0, 7, 7)), np.zeros((2, 7, 7)), np.zeros((7, 7)),
            np.zeros((2, 7)), np.zeros(7), 0.0, np.zeros((0, 2)),
        )  # fmt: skip
        return add_control(control, retract(state, frames, border), normal), normal

    normal = cost(np.zeros((2, 7)), np.zeros(7))[1]
    gradient = -np.concatenate((normal.frame_rhs.ravel(), normal.border_rhs))
    for column in range(14 + 6):
        ahead, behind = (
            cost(move[:14].reshape(2, 7), move[14:])[0]
            for move in (np.eye(21)[column] * step, -np.eye(21)[column] * step)
        )
        assert gradient[column] == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-3), column
