"""What is stated of each position's error holds against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from core.pose_graph import PoseParams, solve
from tests.flights.strips import (
    Flight,
    center_errors,
    fly,
    without_gps,
)


@pytest.mark.parametrize(("relief_m", "gps_m"), [(0.0, 2.0), (0.0, 8.0), (10.0, 2.0), (30.0, 2.0)])
def test_true_errors_lie_within_what_the_sigmas_allow(relief_m: float, gps_m: float) -> None:
    both = [
        center_errors(f, f.solve())
        for f in (fly(relief_m=relief_m, gps_m=gps_m, seed=seed) for seed in range(5))
    ]
    in_sigmas = np.concatenate([error / sigma for error, sigma in both])
    assert ((np.abs(in_sigmas) < 3).mean(0) >= 0.9).all()
    # nor is it honest to say ten metres where it is one
    assert (np.sqrt((in_sigmas**2).mean(0)) > 0.4).all()


def test_better_gps_and_more_frames_are_known_better() -> None:
    def typical(flight: Flight) -> np.ndarray:
        return np.median(center_errors(flight, flight.solve())[1], axis=0)

    assert (typical(fly(gps_m=8.0)) > 2 * typical(fly())).all()
    assert (typical(fly(8, 25)) < 0.8 * typical(fly())).all()


def test_without_gps_sigmas_grow_with_the_distance_from_the_first_frame() -> None:
    flight = without_gps(fly(1, 40))
    solution = solve(flight.frames, flight.matches, PoseParams(first_height_m=60.0))
    sigma = [solution.poses[f.frame_id].sigma_m for f in flight.frames]
    across = np.array([np.hypot(s[0], s[1]) for s in sigma if s])
    assert across[0] < 0.01
    assert across[39] > across[20] > across[5] > 0
    assert all(s and s[2] < 6 for s in sigma)  # heights above the first frame's ground
