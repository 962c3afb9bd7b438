"""Without GPS the map is local: shape, heights and scale come from the pictures and one known height."""

from __future__ import annotations

from dataclasses import replace

import pytest

from core.pose_graph import PoseParams, solve
from tests.flights.strips import (
    center_errors,
    fly,
    ground_error_m,
    route_errors,
    shape_error_m,
    sources,
    without_gps,
)


@pytest.mark.parametrize("shape", [(4, 12), (8, 25), (1, 40)])
@pytest.mark.parametrize("relief_m", [0.0, 2.0])
@pytest.mark.parametrize("given", ["height", "marker"])
def test_without_gps_a_first_height_gives_route_and_heights(
    shape: tuple[int, int], relief_m: float, given: str
) -> None:
    flight = without_gps(fly(*shape, relief_m=relief_m))
    height_m = float(flight.centers[0, 2])
    known = PoseParams(first_height_m=height_m)
    marker = PoseParams(ground_px_per_m=flight.camera.f_px / height_m)
    solution = solve(flight.frames, flight.matches, known if given == "height" else marker)
    assert sources(solution) == ["vision-only"]
    shape_share, scale, height_share = route_errors(flight, solution)
    assert shape_share < 0.01
    assert scale == pytest.approx(1.0, abs=0.02)
    assert height_share < 0.03


def test_half_the_first_height_is_half_the_map() -> None:
    flight = without_gps(fly())
    scales = [
        route_errors(flight, solve(flight.frames, flight.matches, PoseParams(first_height_m=h)))[1]
        for h in (60.0, 30.0)
    ]
    assert scales[1] / scales[0] == pytest.approx(2.0, rel=0.02)


def test_parts_that_tie_nowhere_are_taken_to_be_flown_at_the_first_height() -> None:
    flight = without_gps(fly()).cut(range(24), range(24, 48))
    solution = solve(flight.frames, flight.matches, PoseParams(first_height_m=90.0))
    assert {p.submap for p in solution.poses.values()} == {0, 1}
    heights = [p.center[2] - p.ground_h_m for p in solution.poses.values()]
    assert heights == pytest.approx([90.0] * 48, rel=0.1)


def test_a_long_flight_without_gps_keeps_its_scale() -> None:
    flight = without_gps(fly(12, 40))
    shape_share, scale, height_share = route_errors(
        flight, solve(flight.frames, flight.matches, PoseParams(first_height_m=float(flight.centers[0, 2])))
    )
    assert (shape_share < 0.001, height_share < 0.02) == (True, True)
    assert scale == pytest.approx(1.0, abs=0.02)


def test_gps_that_comes_halfway_places_what_was_flown_before() -> None:
    flight = fly(8, 25)
    half = flight.with_meta(lambda k, meta: replace(meta, gps=None) if k < 100 else meta)
    solution = half.solve()
    assert sources(solution) == ["visual"]
    assert shape_error_m(half, solution)[0] < 0.05
    assert ground_error_m(half, solution) < 2.5
    sigma = center_errors(half, solution)[1]
    assert (sigma[:20, :2].mean(0) > 1.1 * sigma[180:, :2].mean(0)).all()
