"""What start values promise: wrong fixes, wrong pairs and lying compasses lose against the pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from core.frame import FrameMeta
from core.matching import MatchCounts, PairMatch
from core.pose_graph import GraphFrame, Solution, place, solve
from core.pose_graph.chaining import spanned
from core.pose_graph.fixes import contradicted
from core.simulation import Flight, FlightParams, Shot, plan_flight


@dataclass(frozen=True)
class Flown:
    """A simulated flight, its frames in capture order, and matches made from its truth."""

    flight: Flight
    shots: tuple[Shot, ...]
    frames: tuple[GraphFrame, ...]
    matches: tuple[PairMatch, ...]

    def claiming(self, change: Callable[[int, FrameMeta], FrameMeta]) -> Flown:
        frames = (replace(f, meta=change(k, f.meta)) for k, f in enumerate(self.frames))
        return replace(self, frames=tuple(frames))

    def solve(self) -> Solution:
        return solve(self.frames, self.matches)


def flown(**params: float) -> Flown:
    return _flown(FlightParams(**({"frames": 48, "drones": 1, "gps_noise_m": 2.0} | params)))


@cache
def _flown(params: FlightParams) -> Flown:
    flight = plan_flight(params)
    shots = tuple(sorted(flight.shots, key=lambda s: (s.captured_s, s.name)))
    ids = [hashlib.sha256(s.name.encode()).hexdigest()[:32] for s in shots]
    frames = tuple(GraphFrame(k, s.name, _meta(s)) for k, s in zip(ids, shots, strict=True))
    rng, matches = np.random.default_rng(params.seed), []
    for i, one in enumerate(shots):
        for j, other in enumerate(shots[:i]):
            if np.hypot(*(one.pose.center - other.pose.center)[:2]) < 0.9 * params.height_m:
                uv = rng.uniform((0, 0), (params.width_px, params.height_px), (120, 2))
                seen = other.pose.pixels(other.camera, flight.ground(one, uv))
                both = ((seen > 0) & (seen < (params.width_px - 1, params.height_px - 1))).all(1)
                if both.sum() >= 24:
                    noisy = seen[both] + rng.normal(0, 0.7, (int(both.sum()), 2))
                    matches.append(_pair(ids[i], ids[j], uv[both], noisy))
    return Flown(flight, shots, frames, tuple(matches))


def _meta(shot: Shot) -> FrameMeta:
    c = shot.camera
    return FrameMeta(
        c.width, c.height, c.f_px, shot.captured_s, shot.gps, shot.relative_alt_m, shot.attitude,
        f"drone {shot.drone}", "body",
    )  # fmt: skip


def _pair(a: str, b: str, uv_a: np.ndarray, uv_b: np.ndarray) -> PairMatch:
    low, high, uv_low, uv_high = (a, b, uv_a, uv_b) if a < b else (b, a, uv_b, uv_a)
    counts = MatchCounts(final=len(uv_low))
    return PairMatch(low, high, True, "ok", uv_low.astype("f4"), uv_high.astype("f4"), counts)


def moved(meta: FrameMeta, north_m: float) -> FrameMeta:
    assert meta.gps
    return replace(meta, gps=replace(meta.gps, lat_deg=meta.gps.lat_deg + north_m / 111_000))


def apart_m(one: Solution, other: Solution) -> float:
    """The furthest that a frame lies from itself in another solution."""
    assert one.poses.keys() == other.poses.keys()
    return max(float(np.abs(one.poses[k].center - p.center).max()) for k, p in other.poses.items())


BAD = {
    "the first": [0],
    "one": [17],
    "a run": list(range(20, 27)),
    "the first four": [0, 1, 2, 3],
    "every fourth": list(range(1, 48, 4)),
}


@pytest.mark.parametrize("which", BAD)
@pytest.mark.parametrize("off_m", [300.0, 2_200.0, 30_000.0])
@pytest.mark.parametrize("scattered", [False, True])
def test_a_fix_that_the_pictures_contradict_is_as_good_as_none(
    which: str, off_m: float, scattered: bool
) -> None:
    flight, bad = flown(), BAD[which]

    def lying(k: int, meta: FrameMeta) -> FrameMeta:
        return moved(meta, off_m * (1 + 0.15 * k * scattered)) if k in bad else meta

    told = flight.claiming(lying).solve()
    silent = flight.claiming(lambda k, m: replace(m, gps=None) if k in bad else m).solve()
    assert {p.source for p in told.poses.values()} == {"visual"}
    assert told.dropped_pairs == ()
    assert apart_m(told, silent) < 0.01


def test_one_wrong_pair_between_two_areas_costs_neither_its_fixes() -> None:
    here = flown(frames=24)
    there = flown(frames=24, seed=7)
    away = tuple(
        replace(f, frame_id=f.frame_id[::-1], meta=moved(replace(f.meta, drone="other"), 900.0))
        for f in there.frames
    )
    ids = {f.frame_id: g.frame_id for f, g in zip(there.frames, away, strict=True)}
    matches = [
        *here.matches,
        *(_pair(ids[m.low], ids[m.high], m.uv_low, m.uv_high) for m in there.matches),
    ]
    uv = np.random.default_rng(3).uniform(100, 600, (40, 2))
    wrong = _pair(here.frames[5].frame_id, away[9].frame_id, uv, uv + np.array((20, 35)))
    frames = [*here.frames, *away]
    clean, joined = solve(frames, matches), solve(frames, [*matches, wrong])
    assert joined.dropped_pairs == ((wrong.low, wrong.high),)
    assert apart_m(joined, clean) < 0.2


def test_noise_of_the_usual_size_is_not_contradicted() -> None:
    for gps_noise_m in (1.0, 8.0, 40.0):
        flight = flown(gps_noise_m=gps_noise_m, seed=int(gps_noise_m))
        assert flight.solve().gps_sigma_m["drone 1"] > 0.6 * gps_noise_m


def live(flight: Flown, first: int, bad: Collection[int]) -> Solution:
    """Solved with the first frames, the others placed one by one."""
    told = flight.claiming(lambda k, m: moved(m, 2_200.0) if k in bad else m)
    ids = [f.frame_id for f in told.frames]
    solution = solve(told.frames[:first], told.matches)
    for k in range(first, len(ids)):
        known = set(ids[: k + 1])
        ties = [m for m in told.matches if ids[k] in (m.low, m.high) and {m.low, m.high} <= known]
        solution = place(solution, told.frames[: k + 1], [ids[k]], ties)
    return solution


@pytest.mark.parametrize("bad", [[24], [7], [30, 31, 32, 33], list(range(24, 48))])
def test_a_new_frame_lies_where_its_matches_say_whatever_its_fix(bad: list[int]) -> None:
    flight = flown()
    told, right = live(flight, 24, bad), live(flight, 24, [])
    assert {p.source for p in told.poses.values()} == {"visual"}
    where = {k: p.center - right.poses[k].center for k, p in told.poses.items()}
    assert max(float(np.hypot(*d[:2])) for d in where.values()) < (1.0 if 7 in bad else 0.1)


# Bare arrays: a strip of frames that see four others on either side


def strip(n: int) -> np.ndarray:
    return np.array([(i, j) for i in range(n) for j in range(i + 1, min(n, i + 5))], np.int64)


@pytest.mark.parametrize("seed", range(6))
def test_places_survive_wrong_pairs(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 200
    pairs, truth = strip(n), np.cumsum(rng.normal(10, 2, n) + 1j * rng.normal(0, 2, n))
    step = truth[pairs[:, 0]] - truth[pairs[:, 1]] + rng.normal(0, 0.05, (len(pairs), 2)) @ (1, 1j)
    wrong = rng.choice(len(pairs), len(pairs) // 10, replace=False)
    step[wrong] += rng.uniform(60, 600, len(wrong)) * np.exp(1j * rng.uniform(0, 6.3, len(wrong)))
    place, miss = spanned(pairs, step, np.full(len(pairs), 60.0), [0], n)
    assert np.abs(place - truth + truth[0]).max() < 2.0
    assert set(np.flatnonzero(miss > 0.3).tolist()) == set(wrong.tolist())


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45])
@pytest.mark.parametrize("noise_m", [0.05, 2.0, 25.0])
def test_bad_fixes_are_named_up_to_nearly_half(share: float, noise_m: float) -> None:
    rng, n = np.random.default_rng(int(100 * share)), 120
    pairs, place = strip(n), np.cumsum(rng.normal(10, 2, n) + 1j * rng.normal(0, 2, n))
    gps = 3.0 * np.exp(0.7j) * place + 500 + rng.normal(0, noise_m, (n, 2)) @ (1, 1j)
    bad = rng.choice(n, int(share * n), replace=False)
    gps[bad] += (
        rng.uniform(60, 600, len(bad)) * max(noise_m, 3.0) * np.exp(1j * rng.uniform(0, 6.3, len(bad)))
    )
    step = place[pairs[:, 0]] - place[pairs[:, 1]]
    found = contradicted(gps, np.full(n, 3.0), pairs, step, np.zeros(len(pairs)), place)
    assert set(np.flatnonzero(found).tolist()) == set(bad.tolist())


def test_fixes_that_are_all_the_same_contradict_nothing() -> None:
    pairs, place = strip(30), np.arange(30) * 10.0 + 0j
    step = place[pairs[:, 0]] - place[pairs[:, 1]]
    flat = np.full(30, 7.0 + 2j)
    assert not contradicted(flat, np.full(30, 3.0), pairs, step, np.zeros(len(pairs)), place).any()
