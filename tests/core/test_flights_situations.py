"""Every situation that a flight gets into, from keypoints to poses, against the truth.

Keypoints are projected landmarks (no picture is drawn); neighbours, matching, submaps and the pose graph are
the real ones. Each bound held for twenty seeds, with a margin; the tests fix two.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from core.frame import Attitude, FrameMeta, GpsFix
from core.pose_graph import PoseParams, Solution, solve
from core.pose_graph.priors import heading
from core.simulation import FlightParams, Shot
from tests.flights.landmarks import LandmarkParams
from tests.flights.missions import (
    Mission,
    fitted,
    gps_bound_m,
    ground,
    ground_errors_m,
    height_errors,
    mission,
    posed,
    reclaimed,
    rms,
    route_fit,
    route_length_m,
    without_gps,
)

BASE = FlightParams(frames=54, drones=1, gps_noise_m=2.0)
SEEDS = (1, 2)
FEW = LandmarkParams(keypoints=220)


CLAIMS = ("gps_lag_s", "gps_outage", "no_gps", "yaw_offset_deg", "yaw_flip", "xmp", "barometer")


@cache
def pictures(params: FlightParams) -> Mission:
    return mission(params, FEW)


@cache
def flown(params: FlightParams) -> tuple[Mission, Solution]:
    """A flight and its poses; flights that differ in what their metadata claim share their pictures."""
    m = reclaimed(pictures(replace(params, **{name: getattr(BASE, name) for name in CLAIMS})), params)
    return m, m.solved()


def one_map(m: Mission, solution: Solution) -> bool:
    """Whether all frames are tied in a single map."""
    return set(posed(m, solution)) == set(m.meta) and {p.submap for p in solution.poses.values()} == {0}


# ---- accuracy: what the matches give (shape) and what GPS allows (place)

FLAT = {
    "as planned": BASE,
    "a fifth of the frames dropped": replace(BASE, drop=0.2),
    "cameras that keep their heading": replace(BASE, turn="hold"),
    "stated yaw wrong by half a turn on every second strip": replace(BASE, yaw_flip=True),
    "stated yaw 35 degrees off": replace(BASE, yaw_offset_deg=35.0),
    "stated yaw 160 degrees off": replace(BASE, yaw_offset_deg=-160.0),
    "no attitude, no barometer": replace(BASE, xmp=False, barometer=False),
    "moving cars": replace(BASE, cars=60),
    "GPS lost for the second half": replace(BASE, gps_outage=(0.5, 1.0)),
    "GPS from the second half on": replace(BASE, gps_outage=(0.0, 0.5)),
    "a third of the photos without a fix": replace(BASE, no_gps=0.33),
    "GPS late by 0.4 s": replace(BASE, gps_lag_s=0.4),
}


@pytest.mark.parametrize(("name", "seed"), [(name, SEEDS[k % len(SEEDS)]) for k, name in enumerate(FLAT)])
def test_flat_ground_is_mapped_to_centimetres_of_shape_and_to_what_gps_allows(name: str, seed: int) -> None:
    m, solution = flown(replace(FLAT[name], seed=seed))
    assert one_map(m, solution)
    assert fitted(*ground(m, solution)).rms_m < 0.1
    assert rms(ground_errors_m(m, solution)) < 2 * gps_bound_m(m) + 0.6


@pytest.mark.parametrize(("relief_m", "shape_m", "seed"), [(2.0, 0.15, 1), (10.0, 0.6, 2), (30.0, 2.2, 1)])
def test_hills_bend_the_map_by_a_small_share_of_their_height(
    relief_m: float, shape_m: float, seed: int
) -> None:
    m, solution = flown(replace(BASE, relief_m=relief_m, seed=seed))
    assert one_map(m, solution)
    assert fitted(*ground(m, solution)).rms_m < shape_m
    assert rms(ground_errors_m(m, solution)) < 2 * gps_bound_m(m) + 0.6 + shape_m


@pytest.mark.parametrize("seed", SEEDS)
def test_low_overlap_is_one_map(seed: int) -> None:
    m, solution = flown(replace(BASE, forward_overlap=0.4, side_overlap=0.3, seed=seed))
    assert len(posed(m, solution)) >= 0.95 * len(m.frames)
    assert len(solution.poses) == len(m.frames)
    assert fitted(*ground(m, solution)).rms_m < 0.35


@pytest.mark.parametrize("seed", SEEDS)
def test_two_drones_that_meet_once_lie_right_to_each_other(seed: int) -> None:
    m, solution = flown(replace(BASE, drones=2, layout="corner", side_overlap=0.5, seed=seed))
    graph = m.submaps(solution)
    assert one_map(m, solution)
    assert [(len(s.frame_ids), s.merged) for s in graph.submaps] == [(27, 0), (27, 0)]
    assert [(t.low, t.high, t.accepted) for t in graph.ties] == [(0, 1, True)]
    assert fitted(*ground(m, solution)).rms_m < 0.4


@pytest.mark.parametrize("seed", SEEDS)
def test_the_second_of_two_drones_needs_no_gps_of_its_own(seed: int) -> None:
    params = replace(BASE, frames=60, drones=2, layout="corner", side_overlap=0.5, seed=seed)
    m = mission(params, LandmarkParams(keypoints=250))
    half = m.claiming(lambda shot, meta: replace(meta, gps=None) if shot.drone == 2 else meta)
    solution = half.solved()
    assert one_map(half, solution)
    assert sorted(s.georeferenced_by for s in half.submaps(solution).submaps) == ["gps", "tie"]
    assert fitted(*ground(half, solution)).rms_m < 0.6
    assert rms(ground_errors_m(half, solution)) < 6.0  # 2 m of GPS noise, carried 150 m beyond the last fix


def test_traffic_changes_no_pose() -> None:
    quiet, busy = (flown(replace(BASE, cars=cars, seed=3)) for cars in (0, 150))
    seen = sum(len(f.keypoints) for f in busy[0].features.values())
    more = seen / sum(len(f.keypoints) for f in quiet[0].features.values())
    assert more > 1.05  # the cars are there
    found = np.array([(p.center, busy[1].poses[k].center) for k, p in quiet[1].poses.items()])
    assert rms((found[:, 0] - found[:, 1])[:, :2]) < 0.05


# ---- yaw


@pytest.mark.parametrize("offset_deg", [-100.0, 178.0])
def test_a_constant_yaw_offset_is_found(offset_deg: float) -> None:
    _, solution = flown(replace(BASE, yaw_offset_deg=offset_deg, seed=1))
    found = np.degrees(solution.yaw_offset_rad["drone 1"])
    assert (found + offset_deg + 180) % 360 - 180 == pytest.approx(0, abs=1.0)


def test_the_offset_turns_photos_that_tie_to_nothing() -> None:
    m, _ = flown(replace(BASE, yaw_offset_deg=35.0, seed=1))
    alone = list(m.shots)[31]
    matches = [found for found in m.canonical.matches if alone not in (found.low, found.high)]
    solution = solve(m.frames, matches)
    pose, truth = solution.poses[alone], m.shots[alone].pose
    assert pose.source == "gnss"
    wrong = heading(pose.world_R_cam[None])[0] - heading(truth.world_R_cam[None])[0]
    assert abs((np.degrees(wrong) + 180) % 360 - 180) < 5  # 2° of convergence, 1° of compass


def test_yaw_that_contradicts_itself_is_not_believed() -> None:
    _, solution = flown(replace(BASE, yaw_flip=True, seed=1))
    assert "drone 1" not in solution.yaw_offset_rad


# ---- without GPS


@pytest.mark.parametrize(("relief_m", "xmp", "seed"), [(0.0, True, 1), (2.0, True, 2), (2.0, False, 1)])
def test_a_first_height_gives_the_route_and_all_heights(relief_m: float, xmp: bool, seed: int) -> None:
    m, _ = flown(replace(BASE, relief_m=relief_m, seed=seed))
    m = m.claiming(without_gps)
    if not xmp:
        m = m.claiming(lambda _, meta: replace(meta, attitude=Attitude(), relative_alt_m=None))
    first = m.shots[next(iter(m.shots))].pose
    solution = m.solved(PoseParams(first_height_m=float(first.center[2] - first.ground_h_m)))
    assert {p.source for p in solution.poses.values()} == {"vision-only"}
    assert one_map(m, solution)
    fit = route_fit(m, solution)
    assert fit.rms_m < 0.01 * route_length_m(m)
    assert fit.scale == pytest.approx(1.0, abs=0.03)
    assert np.sqrt((height_errors(m, solution) ** 2).mean()) < 0.03


# ---- GPS that returns, and GPS that lies


def jumps(_: Shot, meta: FrameMeta) -> FrameMeta:
    """A hundred metres north in a fifth of the fixes."""
    wrong = meta.gps is not None and int(meta.captured_s or 0) % 5 == 0
    if not (wrong and meta.gps):
        return meta
    return replace(meta, gps=replace(meta.gps, lat_deg=meta.gps.lat_deg + 0.0009))


@pytest.mark.parametrize("seed", SEEDS)
def test_gps_that_returns_places_the_map_even_when_a_fifth_of_it_is_wild(seed: int) -> None:
    m, _ = flown(replace(BASE, gps_outage=(0.0, 0.5), seed=seed))
    wild = m.claiming(jumps)
    moved = sum(wild.meta[k].gps != m.meta[k].gps for k in m.meta)
    assert 3 <= moved <= 10
    solution = wild.solved()
    assert one_map(wild, solution)
    assert fitted(*ground(wild, solution)).rms_m < 0.15
    assert rms(ground_errors_m(wild, solution)) < 2 * gps_bound_m(m) + 1.2


@pytest.mark.parametrize("seed", SEEDS)
def test_a_fix_that_states_centimetres_gives_centimetres(seed: int) -> None:
    m, solution = flown(replace(BASE, rtk=True, gps_noise_m=0.02, tilt_deg=0.0, seed=seed))
    assert one_map(m, solution)
    assert rms(ground_errors_m(m, solution)) < 0.05


@pytest.mark.parametrize("seed", SEEDS)
def test_receivers_that_disagree_by_metres_do_not_tear_the_map(seed: int) -> None:
    m, solution = flown(replace(BASE, drones=3, gps_bias_m=5.0, seed=seed))
    assert one_map(m, solution)
    assert fitted(*ground(m, solution)).rms_m < 0.1


@pytest.mark.parametrize("lag_s", [0.0, 0.5])
def test_how_late_a_fix_is_is_found(lag_s: float) -> None:
    found = [flown(replace(BASE, gps_lag_s=lag_s, seed=seed))[1].lag_s["drone 1"] for seed in SEEDS]
    assert found == pytest.approx([lag_s] * len(found), abs=0.2)


def test_a_map_without_gps_moves_into_place_when_gps_comes() -> None:
    m, _ = flown(replace(BASE, seed=2))
    order = list(m.shots)
    late = m.claiming(
        lambda s, meta: replace(meta, gps=None) if s.captured_s < m.shots[order[40]].captured_s else meta
    )
    early = late.without(order[40:])
    before = early.solved(PoseParams(first_height_m=60.0))
    after = late.solved()
    assert {p.source for p in before.poses.values()} == {"vision-only"}
    assert {p.source for p in after.poses.values()} == {"visual"}
    # the same shape, laid elsewhere
    shape = fitted(
        np.array([before.poses[k].center for k in order[:40]]),
        np.array([after.poses[k].center for k in order[:40]]),
    )
    assert shape.rms_m < 0.15
    assert rms(ground_errors_m(late, after)) < 2 * gps_bound_m(late) + 0.6


def test_a_fix_on_another_continent_moves_nothing() -> None:
    m, clean = flown(replace(BASE, seed=2))
    odd = list(m.shots)[20]
    there = m.claiming(
        lambda s, meta: replace(meta, gps=GpsFix(-33.0, 151.0, 10.0)) if s is m.shots[odd] else meta
    )
    solution = there.solved()
    assert one_map(there, solution)
    shift = np.array([solution.poses[k].center - clean.poses[k].center for k in m.shots])
    assert rms(shift[:, :2]) < 0.3
