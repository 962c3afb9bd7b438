"""What the pose graph promises, on flights whose truth is known: correspondences are made, no picture is
drawn.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.frame import Attitude, FrameMeta, GpsFix
from core.pose_graph import solve
from tests.flights.strips import (
    HEIGHT_M,
    LINE,
    SIDE,
    WORLD,
    fly,
    gps_bound_m,
    ground_error_m,
    shape_error_m,
    sources,
    wrong_matches,
)


def test_200_frames_reach_what_their_gps_allows() -> None:
    flight = fly(8, 25)
    solution = flight.solve()
    assert sources(solution) == ["visual"]
    assert shape_error_m(flight, solution)[0] < 0.03
    assert ground_error_m(flight, solution) < 1.3 * gps_bound_m(flight) + 0.05
    assert solution.reprojection_rms_px == pytest.approx(2.0, abs=0.3)  # √2 px a axis, both axes


@pytest.mark.parametrize(("relief_m", "limit_m"), [(2.0, 0.8), (10.0, 2.0)])
def test_error_grows_with_relief_no_faster_than_its_height(relief_m: float, limit_m: float) -> None:
    flight = fly(6, 16, relief_m=relief_m)
    assert ground_error_m(flight, flight.solve()) < limit_m


def test_a_gimbal_keeps_hills_from_stretching_the_map() -> None:
    flight = fly(6, 16, relief_m=10.0)
    level = flight.with_meta(
        lambda k, m: replace(m, attitude=Attitude(None, float(np.arcsin(flight.R[k, 2, 2])), None))
    )
    assert ground_error_m(flight, level.solve()) < 0.9


def test_the_same_sets_in_any_order_give_the_same_bits() -> None:
    flight, rng = fly(), np.random.default_rng(5)
    one = flight.solve()
    other = solve(
        [flight.frames[k] for k in rng.permutation(len(flight.frames))],
        [flight.matches[k] for k in rng.permutation(len(flight.matches))],
    )
    assert one.cameras == other.cameras
    assert one.world == other.world
    assert list(one.poses) == list(other.poses)
    for frame_id, pose in one.poses.items():
        assert pose.center.tobytes() == other.poses[frame_id].center.tobytes()
        assert pose.world_R_cam.tobytes() == other.poses[frame_id].world_R_cam.tobytes()
        assert pose.ground_h_m == other.poses[frame_id].ground_h_m


@pytest.mark.parametrize("count", [10, 60])
def test_wrong_matches_are_named_and_change_nothing(count: int) -> None:
    flight = fly()
    wrong = wrong_matches(flight, count)
    solution = solve(flight.frames, [*flight.matches, *wrong])
    assert set(solution.dropped_pairs) == {(m.low, m.high) for m in wrong}
    assert ground_error_m(flight, solution) == pytest.approx(ground_error_m(flight, flight.solve()), abs=0.02)


@pytest.mark.parametrize("pitch_deg", [10.0, 16.0])
def test_a_pitched_camera_that_tells_nothing_is_found_out(pitch_deg: float) -> None:
    flight = fly(pitch_deg=pitch_deg)
    assert shape_error_m(flight, flight.solve())[0] < 0.5


def test_yaw_that_is_wrong_by_half_a_turn_on_one_line_does_no_harm() -> None:
    def lying(k: int, meta: FrameMeta) -> FrameMeta:
        flipped = k // LINE in (1, 2)  # line 1 flies back, line 2 flies out and lies
        return replace(meta, attitude=Attitude(-np.pi / 2 if flipped else np.pi / 2, -np.pi / 2, 0.0))

    flight = fly().with_meta(lying)
    assert shape_error_m(flight, flight.solve())[0] < 0.2
    assert ground_error_m(flight, flight.solve()) < 1.3 * gps_bound_m(flight) + 0.05


def test_a_radial_lens_is_calibrated() -> None:
    flight = fly(6, 16, k1=-0.05)
    (camera,) = flight.solve().cameras.values()
    assert camera.k1 == pytest.approx(-0.05, abs=0.005)


def test_gps_lost_for_half_the_flight_keeps_every_frame() -> None:
    flight = fly().with_meta(lambda k, meta: replace(meta, gps=None) if k >= 24 else meta)
    solution = flight.solve()
    assert len(solution.poses) == 48
    assert sources(solution) == ["visual"]
    assert shape_error_m(flight, solution)[0] < 0.1
    assert ground_error_m(flight, solution) < 2.5


def test_without_any_gps_the_map_is_local_and_to_scale() -> None:
    flight = fly().with_meta(lambda _, meta: replace(meta, gps=None, relative_alt_m=HEIGHT_M))
    solution = flight.solve()
    assert (solution.world.lat_deg, solution.world.lon_deg) == (0.0, 0.0)
    assert sources(solution) == ["vision-only"]
    assert len(solution.poses) == 48
    local = replace(solution, world=WORLD)
    rms, scale, _ = shape_error_m(flight, local)
    assert rms < 0.1
    assert scale == pytest.approx(1.0, abs=0.02)


def test_two_submaps_are_both_georeferenced() -> None:
    flight = fly().cut(range(24), range(24, 48))
    solution = flight.solve()
    assert sorted(p.submap for p in solution.poses.values()) == [0] * 24 + [1] * 24
    assert ground_error_m(flight, solution) < 1.8


def test_a_submap_without_gps_has_no_place_in_a_mission_that_has() -> None:
    flight = fly().cut(range(24), range(24, 48))
    solution = flight.with_meta(lambda k, m: replace(m, gps=None) if k >= 24 else m).solve()
    assert set(solution.unplaced.values()) == {"not_placeable"}
    assert len(solution.poses) == 24
    assert solution.islands.keys() == solution.unplaced.keys()
    assert {(p.source, p.submap) for p in solution.islands.values()} == {("vision-only", 1)}
    island = replace(solution, world=WORLD, poses=solution.islands)
    alone = replace(flight, frames=flight.frames[24:], centers=flight.centers[24:], R=flight.R[24:])
    assert shape_error_m(alone, island)[0] < 0.15


def test_gps_that_is_wrong_by_300_m_now_and_then_does_not_bend_the_map() -> None:
    def jumping(k: int, meta: FrameMeta) -> FrameMeta:
        assert meta.gps
        return replace(meta, gps=replace(meta.gps, lat_deg=meta.gps.lat_deg + 0.003)) if k % 5 == 0 else meta

    flight = fly()
    solution = flight.with_meta(jumping).solve()
    assert shape_error_m(flight, solution)[0] < 0.1
    assert ground_error_m(flight, solution) < 2 * gps_bound_m(flight) + 0.1


def test_gps_noise_of_30_m_does_not_bend_the_map() -> None:
    flight = fly(gps_m=30.0)
    assert shape_error_m(flight, flight.solve())[0] < 0.2


def test_a_lag_of_the_gps_is_found() -> None:
    def lagging(k: int, meta: FrameMeta) -> FrameMeta:
        assert meta.gps
        speed = (-1 if k // LINE % 2 else 1) * 0.25 * SIDE[1] / 1500 * HEIGHT_M / 2.0
        degrees = np.degrees(speed * 0.4 / (6378137 * np.cos(np.radians(meta.gps.lat_deg))))
        return replace(meta, gps=replace(meta.gps, lon_deg=meta.gps.lon_deg - float(degrees)))

    solution = fly(6).with_meta(lagging).solve()
    assert solution.lag_s["d"] == pytest.approx(0.4, abs=0.15)


@pytest.mark.parametrize("every", [2, 100])
def test_repeated_fixes_give_finite_poses(every: int) -> None:
    fixes = [f.meta.gps for f in fly().frames]
    flight = fly().with_meta(lambda k, meta: replace(meta, gps=fixes[k // every * every]))
    solution = flight.solve()
    assert len(solution.poses) == 48
    for pose in solution.poses.values():
        assert np.isfinite(pose.center).all()
        assert np.isfinite(pose.world_R_cam).all()
        assert 20 < pose.center[2] - pose.ground_h_m < 180


def test_the_crowd_decides_on_which_continent_the_mission_is() -> None:
    def away(k: int, meta: FrameMeta) -> FrameMeta:
        return replace(meta, gps=GpsFix(-33.0, 151.0 + k * 1e-4, 10.0)) if k >= 30 else meta

    solution = fly().cut(range(30), range(30, 48)).with_meta(away).solve()
    assert solution.world.lat_deg == pytest.approx(46.2, abs=0.01)
    assert sorted(solution.unplaced.values()) == ["far_from_mission"] * 18


def test_a_single_wild_fix_is_overruled_by_the_picture() -> None:
    flight = fly().with_meta(lambda k, m: replace(m, gps=GpsFix(-33.0, 151.0, 10.0)) if k == 7 else m)
    solution = flight.solve()
    assert solution.poses[flight.frames[7].frame_id].source == "visual"
    assert shape_error_m(flight, solution)[0] < 0.1


def test_frames_that_tie_to_nothing_lie_where_their_gps_says() -> None:
    flight = fly()
    alone = flight.frames[20].frame_id
    solution = solve(flight.frames, [m for m in flight.matches if alone not in (m.low, m.high)])
    pose = solution.poses[alone]
    assert pose.source == "gnss"
    truth = solution.world.from_geodetic(WORLD.to_geodetic(flight.centers[20:21]))[0]
    assert np.hypot(*(pose.center - truth)[:2]) < 8
    assert pose.center[2] - pose.ground_h_m == pytest.approx(HEIGHT_M, rel=0.1)


def test_a_view_of_the_horizon_is_refused_and_the_rest_goes_on() -> None:
    def looking_up(k: int, meta: FrameMeta) -> FrameMeta:
        return replace(meta, attitude=Attitude(0.0, -0.1 if k == 5 else -np.pi / 2, 0.0))

    flight = fly().with_meta(looking_up)
    solution = flight.solve()
    assert solution.unplaced == {flight.frames[5].frame_id: "oblique"}
    assert len(solution.poses) == 47


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_frames(count: int) -> None:
    flight = fly()
    frames = flight.frames[:count]
    solution = solve(frames, flight.matches)
    assert len(solution.poses) == count
    assert sources(solution) == (["visual"] if count > 1 else ["gnss"][:count])
