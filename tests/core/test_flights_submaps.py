"""Tracking lost and found again (Zhan 2021), and how sure a position is, on flights whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from core.geometry import Array
from core.neighbours import NeighbourParams, Pair
from core.pose_graph import solve
from core.simulation import FlightParams
from core.submaps import parts, strength, submap_graph
from core.ties import canonical, ties_to_try
from tests.flights.landmarks import LandmarkParams
from tests.flights.missions import (
    Mission,
    center_errors_m,
    fitted,
    ground,
    interrupted,
    mission,
    posed,
    rms,
    route_fit,
    sigmas_m,
    without_gps,
)

FEW = LandmarkParams(keypoints=220)
SERPENTINE = FlightParams(frames=80, drones=1, lines=4, per_line=20, gps_noise_m=2.0)
SEEDS = (1, 2)


@cache
def flown(params: FlightParams) -> Mission:
    return mission(params, FEW)


# ---- three interruptions


@pytest.mark.parametrize("gps", [True, False])
def test_three_interruptions_keep_every_frame_in_one_map_as_exact_as_ever(gps: bool) -> None:
    whole_m, broken_m = [], []
    for seed in SEEDS:
        whole = flown(replace(SERPENTINE, seed=seed))
        whole = whole if gps else whole.claiming(without_gps)
        broken = interrupted(whole, 3)
        solution = broken.solved()
        assert set(posed(broken, solution)) == set(broken.meta)
        assert {p.submap for p in solution.poses.values()} == {0}
        whole_m.append(trajectory_m(whole, gps))
        broken_m.append(trajectory_m(broken, gps))
    # without GPS it is the centimetres of the pictures' noise, and an eighth of the pairs is missing
    limit = 1.05 if gps else 1.25
    assert rms(np.array(broken_m)[:, None]) < (1.0 if gps else 0.15)
    assert rms(np.array(broken_m)[:, None]) < limit * rms(np.array(whole_m)[:, None])


def trajectory_m(m: Mission, gps: bool) -> float:
    solution = m.solved()
    return rms(center_errors_m(m, solution)[:, :2]) if gps else route_fit(m, solution).rms_m


def stretches(m: Mission, count: int) -> dict[str, int]:
    """Each frame's stretch of the flight between interruptions."""
    order = list(m.shots)
    return {k: i * count // len(order) for i, k in enumerate(order)}


@pytest.mark.parametrize("seed", SEEDS)
def test_stretches_that_only_looks_can_tie_are_tied_by_each_frames_own_thresholds(seed: int) -> None:
    """No GPS, and the first matches are those of neighbours in time: each stretch is a submap of its own."""
    m = flown(replace(SERPENTINE, seed=seed)).claiming(without_gps)
    stretch = stretches(m, 4)
    few = NeighbourParams(nearest=0, sectors=0, alike=0, alike_without_gps=0)

    def matched(pairs: list[Pair]) -> list:  # type: ignore[type-arg]
        order = list(m.shots)
        lost = {
            p
            for p in pairs
            if stretch[p[0]] != stretch[p[1]] and abs(order.index(p[0]) - order.index(p[1])) <= 8
        }
        return m.matched([p for p in pairs if p not in lost])

    found = canonical(m.sightings, matched, few)  # type: ignore[arg-type]
    assert found is not None
    first = [v for v in found.matches if (v.low, v.high) in set(found.first)]
    ids = sorted(m.meta)
    assert max(parts(len(ids), [(ids.index(v.low), ids.index(v.high)) for v in first])) == 3  # four submaps
    solution = solve(m.frames, found.matches)
    graph = submap_graph(m.frames, found.matches, solution.poses, solution.dropped_pairs, found.extra)
    assert {p.submap for p in solution.poses.values()} == {0}
    assert [len(s.frame_ids) for s in graph.submaps] == [20, 20, 20, 20]
    assert sum(t.accepted for t in graph.ties) == 3
    assert all(t.strength == strength(t.frames, t.points, t.angle_deg) for t in graph.ties)
    assert route_fit(m, solution).rms_m < 0.3
    # what is tried is worth trying, and far from everything
    between = len(ids) ** 2 * 3 / 8
    assert len(found.extra) < 0.15 * between
    hits = sum((v.low, v.high) in set(found.extra) for v in found.matches)
    assert hits > 0.1 * len(found.extra)


def test_what_is_tried_first_shares_ground_more_often_than_chance() -> None:
    m = flown(replace(SERPENTINE, seed=1)).claiming(without_gps)
    stretch = stretches(m, 4)
    within = [(v.low, v.high) for v in m.canonical.matches if stretch[v.low] == stretch[v.high]]
    tries = ties_to_try(m.sightings, within, m.matched(within))
    good = np.mean([m.match(p).accepted for p in tries])
    order = sorted(m.meta)
    every = [(a, b) for i, a in enumerate(order) for b in order[i + 1 :] if stretch[a] != stretch[b]]
    chance = np.mean([m.match(p).accepted for p in every[::7]])
    assert good > 1.5 * chance


# ---- how sure a position is


@cache
def in_sigmas(relief_m: float, outage: float) -> Array:
    """True errors over stated sigmas of six flights, (N, 3)."""
    params = FlightParams(
        frames=36, drones=1, gps_noise_m=2.0, relief_m=relief_m, gps_outage=(1 - outage, 1.0)
    )
    flights = [flown(replace(params, seed=seed)) for seed in range(6)]
    return np.concatenate([center_errors_m(m, s) / sigmas_m(m, s) for m in flights for s in [m.solved()]])


@pytest.mark.parametrize(("relief_m", "outage"), [(0.0, 0.5), (5.0, 0.0)])
def test_sigmas_are_honest(relief_m: float, outage: float) -> None:
    errors = in_sigmas(relief_m, outage)
    assert np.isfinite(errors).all()
    assert (np.abs(errors) < 3).mean() >= 0.9
    # nor may a sigma claim more doubt than there is
    assert (np.sqrt((errors**2).mean(0)) > 0.5).all()
    assert np.sqrt((errors**2).mean()) < 2.0


@pytest.mark.parametrize("wrong", [False, True])
def test_a_frame_whose_matches_are_missing_or_all_wrong_costs_the_others_nothing(wrong: bool) -> None:
    m = flown(replace(SERPENTINE, seed=1))
    alone = list(m.shots)[30]
    rest = [v for v in m.canonical.matches if alone not in (v.low, v.high)]
    odd = [v for v in m.canonical.matches if alone in (v.low, v.high)] if wrong else []
    rng = np.random.default_rng(0)
    odd = [replace(v, uv_high=(v.uv_high[::-1] + rng.uniform(-300, 300, 2)).astype(np.float32)) for v in odd]
    solution = solve(m.frames, [*rest, *odd])
    assert solution.poses[alone].source == "gnss"
    assert len(posed(m, solution)) == len(m.frames) - 1
    assert {(v.low, v.high) for v in odd} == set(solution.dropped_pairs)
    assert np.isfinite(sigmas_m(m, solution)).all()
    assert fitted(*ground(m, solution)).rms_m < 0.1
