"""What start values promise: wrong fixes, wrong pairs and lying compasses lose against the pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from pyproj import Transformer

from core.frame import Attitude, FrameMeta
from core.matching import MatchCounts, PairMatch
from core.pose_graph import GraphFrame, Solution, place, solve
from core.pose_graph.attitude import circular_median, levelling, rotation_of
from core.pose_graph.averaging import moments
from core.pose_graph.chaining import spanned
from core.pose_graph.fixes import contradicted
from core.pose_graph.receivers import receiver_biases
from core.pose_graph.residuals import rotations
from core.pose_graph.rotations import Absolute, absolute_rotations, angles, averaged_rotations, horn
from core.pose_graph.twoview import TwoViews, two_views
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
@pytest.mark.parametrize(("off_m", "scattered"), [(300.0, False), (2_200.0, True), (30_000.0, False)])
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
        solution = place(solution, {f.frame_id: f for f in told.frames[: k + 1]}, [ids[k]], ties)
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


# Rotations (Zhao 2020, eq. 1–4)


def off_deg(R: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.degrees(np.linalg.norm(angles(np.einsum("nji,njk->nik", truth, R)), axis=1))


def cameras(n: int, seed: int, tilt_deg: float = 6.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    pitch, roll = np.radians(rng.normal(0, tilt_deg, (2, n)))
    return rotation_of(rng.uniform(-3.1, 3.1, n), pitch - np.pi / 2, roll)


def test_rotation_vectors_are_inverted() -> None:
    turned = np.random.default_rng(0).normal(0, 0.8, (100, 3))
    np.testing.assert_allclose(angles(rotations(turned)), turned, atol=1e-9)


@pytest.mark.parametrize("vectors", [2, 3, 12])
def test_horn_finds_the_rotation_of_vectors(vectors: int) -> None:
    rng, n = np.random.default_rng(vectors), 20
    R, frame = cameras(n, 1), np.repeat(np.arange(n), vectors)
    seen = rng.normal(0, 10, (len(frame), 3))
    world = np.einsum("vij,vj->vi", R[frame], seen)
    weight = rng.uniform(0.1, 3, len(frame))
    np.testing.assert_allclose(horn(seen, world, weight, frame, n), R, atol=1e-8)


def test_horn_is_the_best_of_all_rotations_near_it() -> None:
    rng = np.random.default_rng(4)
    seen, world, weight = rng.normal(0, 1, (9, 3)), rng.normal(0, 1, (9, 3)), rng.uniform(0.5, 2, 9)
    R = horn(seen, world, weight, np.zeros(9, np.int64), 1)[0]

    def gain(R: np.ndarray) -> float:
        return float((weight * ((seen @ R.T) * world).sum(1)).sum())

    assert np.linalg.det(R) == pytest.approx(1.0)
    assert all(gain(R) > gain(R @ turn) for turn in rotations(rng.normal(0, 0.2, (50, 3))))


def looked(R: np.ndarray, centre: np.ndarray, pairs: np.ndarray, noise: float = 0.0) -> TwoViews:
    """What pairs of cameras (with a wide lens) over flat ground say, from 30 points each."""
    rng, rays, starts = np.random.default_rng(0), ([], []), np.arange(len(pairs) + 1) * 30
    for i, j in pairs:
        middle = (centre[i] + centre[j]) / 2
        points = np.column_stack((rng.uniform(-25, 25, (30, 2)) + middle[:2], np.zeros(30)))
        for side, k in enumerate((i, j)):
            ray = (points - centre[k]) @ R[k]
            rays[side].append(
                (ray[:, 0] - 1j * ray[:, 1]) / ray[:, 2] + rng.normal(0, noise, (30, 2)) @ (1, 1j)
            )
    first, second = (np.concatenate(r) for r in rays)
    level = np.tile(np.eye(3), (len(R), 1, 1))
    return two_views(first, second, starts, moments(first, second, starts), level, pairs)


def block(lines: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres of a block of photos, metres, and the pairs of those that overlap."""
    rng = np.random.default_rng(seed)
    line, column = np.divmod(np.arange(lines * columns), columns)
    centre = np.column_stack((column * 15.0, line * 25.0, np.full(len(line), 60.0)))
    centre += rng.normal(0, 1, centre.shape)
    near = np.hypot(*(centre[:, None, :2] - centre[None, :, :2]).transpose(2, 0, 1)) < 34
    return centre, np.argwhere(np.triu(near, 1)).astype(np.int64)


@pytest.mark.parametrize("tilt_deg", [2.0, 6.0])
def test_a_pair_over_flat_ground_tells_its_relative_rotation(tilt_deg: float) -> None:
    centre, pairs = block(4, 6, 3)
    R = cameras(24, 5, tilt_deg)
    views = looked(R, centre, pairs, noise=5e-4)
    truth = np.einsum("eji,ejk->eik", R[pairs[:, 0]], R[pairs[:, 1]])
    assert np.median(off_deg(views.turn, truth)) < 0.25 * tilt_deg
    step = np.einsum("eji,ej->ei", R[pairs[:, 0]], centre[pairs[:, 1]] - centre[pairs[:, 0]])
    across = np.cross(views.step, step)
    sine = np.linalg.norm(across, axis=1) / np.linalg.norm(views.step, axis=1) / np.linalg.norm(step, axis=1)
    assert np.median(sine) < 1.6 * np.radians(tilt_deg)


def test_gps_gives_every_frame_a_rotation_by_itself() -> None:
    centre, pairs = block(6, 8, 1)
    R, rng = cameras(48, 2), np.random.default_rng(3)
    gps = (centre[:, :2] + rng.normal(0, 1.0, (48, 2))) @ (1, 1j)
    gps[40:] = np.nan
    down = np.tile((0.0, 0.0, 1.0), (48, 1))
    found = absolute_rotations(pairs, looked(R, centre, pairs), gps, np.ones(48), down, np.full(48, 0.3))
    told = found.heading > 0
    assert not told[41:].any()
    assert np.percentile(off_deg(found.R, R)[:40], 90) < 12
    # averaging with the pairs takes the noise out, and carries headings to where there is no GPS
    better = averaged_rotations(pairs, looked(R, centre, pairs), found, np.array([0]))
    assert off_deg(better, R).max() < 4
    assert np.median(off_deg(better, R)) < 0.6 * np.median(off_deg(found.R, R)[:40])


@pytest.mark.parametrize("share", [0.1, 0.2])
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("with_gps", [True, False])
def test_rotations_survive_a_fifth_of_wrong_pairs(share: float, seed: int, with_gps: bool) -> None:
    rng, (_, pairs) = np.random.default_rng(seed), block(12, 15, seed)
    n = 180
    R = cameras(n, seed)
    noise = rotations(rng.normal(0, 0.01, (len(pairs), 3)))
    turn = np.einsum("eji,ejk->eik", R[pairs[:, 0]], R[pairs[:, 1]]) @ noise
    wrong = rng.choice(len(pairs), int(share * len(pairs)), replace=False)
    turn[wrong] = rotations(rng.normal(0, 1.5, (len(wrong), 3)))
    views = TwoViews(turn, np.zeros((len(pairs), 3)), np.zeros((len(pairs), 2, 3)), np.zeros(len(pairs)))
    guessed = rotations(rng.normal(0, 0.1, (n, 3))) @ R
    heading = np.full(n, 100.0 if with_gps else 0.0)
    found = averaged_rotations(pairs, views, Absolute(guessed, np.full(n, 25.0), heading), np.array([0]))
    # without a heading all turn together with the root
    gauge = np.eye(3) if with_gps else found[0] @ R[0].T
    assert np.percentile(off_deg(gauge.T @ found, R), 95) < (3.0 if with_gps else 9.0)


def test_levelled_rays_point_down() -> None:
    R = cameras(30, 8, 10.0)
    down = -R[:, 2]
    np.testing.assert_allclose(np.einsum("nij,nj->ni", levelling(down), down)[:, 2], 1.0)


# Compasses


@pytest.mark.parametrize("flipped", [0.0, 0.2, 0.4])
def test_a_yaw_offset_is_found_through_flips_of_half_a_turn(flipped: float) -> None:
    rng = np.random.default_rng(6)
    angle = 0.6 + rng.normal(0, 0.05, 100) + np.pi * (np.arange(100) < 100 * flipped)
    middle, share = circular_median(angle)
    assert middle == pytest.approx(0.6, abs=0.03)
    assert share == pytest.approx(1 - flipped, abs=0.02)


def lying_compass(flight: Flown, offset_rad: float, flipped: Collection[int]) -> Flown:
    def change(k: int, meta: FrameMeta) -> FrameMeta:
        yaw = meta.attitude.yaw_rad
        assert yaw is not None
        lie = yaw - offset_rad + np.pi * (k in flipped)
        return replace(meta, attitude=replace(meta.attitude, yaw_rad=float(lie)))

    return flight.claiming(change)


def test_wrong_yaw_changes_nothing_where_gps_tells_and_its_offset_is_named() -> None:
    flight = flown(yaw_noise_deg=1.0)
    honest, told = flight.solve(), lying_compass(flight, 0.5, range(0, 48, 3)).solve()
    assert apart_m(told, honest) < 0.01
    shift = told.yaw_offset_rad["drone 1"] - honest.yaw_offset_rad["drone 1"]
    assert shift == pytest.approx(0.5, abs=0.02)


def test_without_gps_the_compass_turns_the_map_in_spite_of_flips() -> None:
    flight = flown(yaw_noise_deg=1.0).claiming(lambda _, m: replace(m, gps=None))
    honest, told = flight.solve(), lying_compass(flight, 0.0, range(0, 48, 3)).solve()
    assert apart_m(told, honest) < 4.0


def test_no_attitude_at_all_is_no_loss_where_there_is_gps() -> None:
    flight = flown()
    blind = flight.claiming(lambda _, m: replace(m, attitude=Attitude())).solve()
    assert {p.source for p in blind.poses.values()} == {"visual"}
    assert blind.dropped_pairs == ()
    level = [np.degrees(np.arccos(-p.world_R_cam[2, 2])) for p in blind.poses.values()]
    assert max(level) < 8


# Receivers


def off_m(flight: Flown, solution: Solution) -> float:
    """RMS error of the ground below the photos' middles, metres."""
    to_grid = Transformer.from_crs(4326, flight.flight.epsg, always_xy=True)
    missed = []
    for frame, shot in zip(flight.frames, flight.shots, strict=True):
        camera = solution.cameras[frame.meta.camera_key]
        middle = np.array([[camera.cx, camera.cy]])
        ground = solution.poses[frame.frame_id].ground(camera, middle)
        lon, lat, _ = solution.world.to_geodetic(ground)[0]
        missed.append(np.array(to_grid.transform(lon, lat)) - flight.flight.ground(shot, middle)[0, :2])
    return float(np.sqrt((np.array(missed) ** 2).sum(1).mean()))


def differing(flight: Flown, *north_m: float) -> Flown:
    """With receivers that are off by a constant."""
    return flight.claiming(lambda _, m: moved(m, north_m[int(m.drone[-1]) - 1]))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_receivers_that_differ_do_not_bend_the_map(seed: int) -> None:
    flight = flown(frames=90, drones=3, gps_noise_m=1.0, seed=seed)
    alike, apart = flight.solve(), differing(flight, 4.0, -3.0, -1.0).solve()
    assert off_m(flight, apart) < off_m(flight, alike) + 1.0
    # each receiver is found to be as noisy as it is, not as wrong as it is
    for drone, sigma_m in apart.gps_sigma_m.items():
        assert sigma_m < 1.25 * alike.gps_sigma_m[drone]


def blocks(noise_m: float, off_m: tuple[complex, ...], seed: int) -> tuple[np.ndarray, ...]:
    """Places, fixes and drones of 50 frames a drone, side by side and overlapping."""
    rng, drone = np.random.default_rng(seed), np.repeat(np.arange(len(off_m)), 50)
    place = rng.uniform(0, 80, len(drone)) + 60 * drone + 1j * rng.uniform(0, 100, len(drone))
    noise = rng.normal(0, noise_m, (len(drone), 2)) @ (1, 1j)
    return place, 1.02 * np.exp(0.01j) * place + 7 - 3j + np.array(off_m)[drone] + noise, drone


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("off_m", [(4 + 0j, -4 + 0j), (3 + 1j, -2 + 1j, -1 - 2j)])
def test_what_receivers_differ_by_is_found(off_m: tuple[complex, ...], seed: int) -> None:
    place, gps, drone = blocks(0.3, off_m, seed)
    alone = np.zeros(len(place), np.int64)
    found, left = receiver_biases(place, gps, drone, alone, np.full(len(off_m), 3.0), 60.0)
    assert np.abs(found - found.mean() - np.array(off_m) + np.mean(off_m)).max() < 0.8
    assert np.median(np.abs(left)) < 0.5


@pytest.mark.parametrize("seed", range(4))
def test_receivers_that_agree_are_left_alone(seed: int) -> None:
    place, gps, drone = blocks(2.0, (0j, 0j, 0j), seed)
    alone = np.zeros(len(place), np.int64)
    assert not receiver_biases(place, gps, drone, alone, np.full(3, 3.0), 60.0)[0].any()


def test_drones_that_never_meet_are_left_alone() -> None:
    place, gps, drone = blocks(0.3, (4 + 0j, -4 + 0j), 0)
    assert not receiver_biases(place, gps, drone, drone, np.full(2, 3.0), 60.0)[0].any()


def test_the_receiver_that_claims_less_gives_way() -> None:
    place, gps, drone = blocks(0.3, (0j, 4 + 0j), 0)
    found, _ = receiver_biases(place, gps, drone, np.zeros(100, np.int64), np.array([0.05, 3.0]), 60.0)
    assert abs(found[0]) < 0.05
    assert abs(found[1]) > 2.0
