"""What the pose graph promises, on flights whose truth is known: correspondences are made, no picture is
drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from core.frame import Attitude, FrameMeta, GpsFix
from core.geometry import Camera, World
from core.matching import MatchCounts, PairMatch
from core.pose_graph import GraphFrame, PoseParams, Solution, place, solve
from core.pose_graph.attitude import rotation_of

WORLD = World(46.2, 7.1, 400.0)
HEIGHT_M, SIDE = 60.0, (2000, 1500)
LINE = 12


@dataclass(frozen=True)
class Flight:
    frames: tuple[GraphFrame, ...]
    matches: tuple[PairMatch, ...]
    camera: Camera
    centers: np.ndarray
    R: np.ndarray
    ground: Callable[[np.ndarray], np.ndarray]

    def with_meta(self, change: Callable[[int, FrameMeta], FrameMeta]) -> Flight:
        return replace(
            self, frames=tuple(replace(f, meta=change(k, f.meta)) for k, f in enumerate(self.frames))
        )

    def cut(self, *parts: range) -> Flight:
        """Without the matches between frames of different parts."""
        part = {self.frames[k].frame_id: n for n, r in enumerate(parts) for k in r}
        return replace(self, matches=tuple(m for m in self.matches if part[m.low] == part[m.high]))

    def solve(self) -> Solution:
        return solve(self.frames, self.matches)


def hills(relief_m: float) -> Callable[[np.ndarray], np.ndarray]:
    def height(xy: np.ndarray) -> np.ndarray:
        x, y = xy.T
        waves = (
            0.5 * np.sin(x / 45) * np.cos(y / 60) + 0.3 * np.sin(x / 80 - y / 70) + 0.2 * np.cos((x + y) / 31)
        )
        return relief_m * waves

    return height


@cache
def fly(
    lines: int = 4, columns: int = LINE, relief_m: float = 0.0, pitch_deg: float = 0.0, k1: float = 0.0,
    gps_m: float = 2.0, seed: int = 0,
) -> Flight:  # fmt: skip
    """A boustrophedon of `lines` × `columns` photos, 75% forward and 60% side overlap."""
    rng = np.random.default_rng(seed)
    camera = Camera(*SIDE, 1500.0, (SIDE[0] - 1) / 2, (SIDE[1] - 1) / 2, k1)
    wide, high = (s / camera.f_px * HEIGHT_M for s in SIDE)
    line, column = np.divmod(np.arange(lines * columns), columns)
    back = line % 2 == 1
    along = np.where(back, columns - 1 - column, column) * high * 0.25
    centers = np.column_stack((along, line * wide * 0.4, np.full(len(line), HEIGHT_M)))
    centers += rng.normal(0, 1, centers.shape) * (1, 1, 0.5)
    yaw = np.where(back, -1, 1) * np.pi / 2 + rng.normal(0, 0.05, len(line))
    tilt = np.radians(rng.normal(0, 2, (2, len(line))))
    R = rotation_of(yaw, np.radians(pitch_deg - 90) + tilt[0], tilt[1])
    fixes = WORLD.to_geodetic(centers + rng.normal(0, gps_m, centers.shape) * (1, 1, 2))
    ids = [f"{k:032x}" for k in rng.integers(0, 2**60, len(line)).tolist()]
    frames = tuple(
        GraphFrame(
            i, f"{k:04d}.jpg",
            FrameMeta(*SIDE, camera.f_px, 1.6e9 + 2 * k, GpsFix(lat, lon, alt), None, Attitude(), "d", "b"),
        )
        for k, (i, (lon, lat, alt)) in enumerate(zip(ids, fixes.tolist(), strict=True))
    )  # fmt: skip
    ground = hills(relief_m)
    matches = []
    for i in range(len(line)):
        for j in range(i + 1, len(line)):
            apart = np.abs(centers[i] - centers[j])
            if apart[0] < 0.8 * high and apart[1] < 0.6 * wide:
                matches += _match(rng, camera, ids, centers, R, ground, (i, j))
    return Flight(frames, tuple(matches), camera, centers, R, ground)


def _match(
    rng: np.random.Generator, camera: Camera, ids: Sequence[str], centers: np.ndarray, R: np.ndarray,
    ground: Callable[[np.ndarray], np.ndarray], pair: tuple[int, int],
) -> list[PairMatch]:  # fmt: skip
    i, j = sorted(pair, key=lambda k: ids[k])
    middle = (centers[i] + centers[j])[:2] / 2 + HEIGHT_M * 0.5 * (R[i] + R[j])[:2, 2]
    xy = middle + rng.uniform(-60, 60, (400, 2))
    points = np.column_stack((xy, ground(xy)))
    uv = [camera.project((points - centers[k]) @ R[k]) for k in (i, j)]
    seen = np.flatnonzero(np.all([((u > 5) & (u < np.array(SIDE) - 5)).all(1) for u in uv], axis=0))[:60]
    if len(seen) < 15:
        return []
    low, high = ((u[seen] + rng.normal(0, 1, (len(seen), 2))).astype(np.float32) for u in uv)
    return [PairMatch(ids[i], ids[j], True, "ok", low, high, MatchCounts(final=len(seen)))]


def wrong_matches(flight: Flight, count: int) -> list[PairMatch]:
    """Pairs that verified well and are nonsense all the same, as repetitive fields give them."""
    rng, have = np.random.default_rng(1), {(m.low, m.high) for m in flight.matches}
    ids, out = sorted(f.frame_id for f in flight.frames), []
    while len(out) < count:
        low, high = sorted(rng.choice(ids, 2, replace=False).tolist())
        if (low, high) in have:
            continue
        have.add((low, high))
        turn = np.exp(1j * rng.uniform(0, 6.3)) * rng.uniform(0.8, 1.2)
        at = rng.uniform((200, 200), (1800, 1300), (40, 2))
        z = ((at - (1000, 750)) @ (1, 1j)) * turn
        to = np.column_stack((z.real + 1000, z.imag + 750)) + rng.uniform(-300, 300, 2)
        out.append(
            PairMatch(
                low, high, True, "ok", at.astype(np.float32), to.astype(np.float32), MatchCounts(final=40)
            )
        )
    return out


def truth_and_found(flight: Flight, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Where each posed frame's centre pixel really lies, and where the solution puts it: (N, 2) metres."""
    truth, found = [], []
    for k, f in enumerate(flight.frames):
        if f.frame_id not in solution.poses:
            continue
        middle = np.array([[flight.camera.cx, flight.camera.cy]])
        ray, h = flight.R[k, :, 2], np.zeros(1)
        for _ in range(20):
            q = flight.centers[k] + ray * ((h[0] - flight.centers[k, 2]) / ray[2])
            h = flight.ground(q[None, :2])
        g = solution.poses[f.frame_id].ground(solution.cameras[f.meta.camera_key], middle)
        truth.append(q[:2])
        found.append(WORLD.from_geodetic(solution.world.to_geodetic(g))[0, :2])
    return np.array(truth), np.array(found)


def ground_error_m(flight: Flight, solution: Solution) -> float:
    truth, found = truth_and_found(flight, solution)
    return float(np.sqrt(((truth - found) ** 2).sum(1).mean()))


def shape_error_m(flight: Flight, solution: Solution) -> tuple[float, float, float]:
    """After the best similarity: RMS, metres; and that similarity's scale and turn (radians)."""
    truth, found = (p[:, 0] + 1j * p[:, 1] for p in truth_and_found(flight, solution))
    a, b = found - found.mean(), truth - truth.mean()
    s = np.vdot(a, b) / np.vdot(a, a).real
    return float(np.sqrt((np.abs(b - s * a) ** 2).mean())), float(abs(s)), float(np.angle(s))


def gps_bound_m(flight: Flight) -> float:
    """The error of the best similarity fitted to the GPS fixes alone: no matches can do better absolutely."""
    fixes = np.array(
        [(f.meta.gps.lon_deg, f.meta.gps.lat_deg, f.meta.gps.alt_m) for f in flight.frames if f.meta.gps]
    )
    miss = ((WORLD.from_geodetic(fixes) - flight.centers)[:, :2]) @ (1, 1j)
    basis = np.column_stack((np.ones(len(miss)), flight.centers[:, :2] @ (1, 1j)))
    fitted = basis @ np.linalg.lstsq(basis, miss, rcond=None)[0]
    return float(np.sqrt((np.abs(fitted) ** 2).mean()))


def sources(solution: Solution) -> list[str]:
    return sorted({p.source for p in solution.poses.values()})


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


def live(flight: Flight, first: int) -> tuple[Solution, Solution]:
    """Solved with the first frames, and with the others placed one by one."""
    ids = [f.frame_id for f in flight.frames]
    before = solution = solve(flight.frames[:first], flight.matches)
    for k in range(first, len(ids)):
        known = set(ids[: k + 1])
        ties = [m for m in flight.matches if ids[k] in (m.low, m.high) and {m.low, m.high} <= known]
        solution = place(solution, flight.frames[: k + 1], [ids[k]], ties)
    return before, solution


def test_placed_frames_fit_and_posed_ones_stay() -> None:
    flight = fly()
    before, after = live(flight, 36)
    assert len(after.poses) == 48
    assert sources(after) == ["visual"]
    assert all(after.poses[k] is p for k, p in before.poses.items())
    assert shape_error_m(flight, after)[0] < 0.3


def test_placing_does_not_depend_on_the_order_of_anything() -> None:
    flight, rng = fly(), np.random.default_rng(2)
    base = solve(flight.frames[:36], flight.matches)
    new = [f.frame_id for f in flight.frames[36:]]
    one = place(base, flight.frames, new, flight.matches)
    other = place(
        base,
        [flight.frames[k] for k in rng.permutation(48)],
        set(new),
        [flight.matches[k] for k in rng.permutation(len(flight.matches))],
    )
    assert {k: p.center.tobytes() for k, p in one.poses.items()} == {
        k: p.center.tobytes() for k, p in other.poses.items()
    }


def test_a_wrong_match_does_not_misplace_a_new_frame() -> None:
    flight = fly()
    new = flight.frames[30].frame_id
    rest = [m for m in flight.matches if new not in (m.low, m.high)]
    base = solve([f for f in flight.frames if f.frame_id != new], rest)
    wrong = [m for m in wrong_matches(flight, 400) if new in (m.low, m.high)][:3]
    placed = place(base, flight.frames, [new], [*flight.matches, *wrong])
    clean = place(base, flight.frames, [new], flight.matches)
    assert wrong
    np.testing.assert_allclose(placed.poses[new].center, clean.poses[new].center, atol=0.3)


def test_a_new_frame_that_ties_to_nothing_falls_back_or_is_refused() -> None:
    flight = fly()
    base = solve(flight.frames[:40], flight.matches)
    blind = replace(flight.frames[41], meta=replace(flight.frames[41].meta, gps=None))
    frames = [*flight.frames[:41], blind]
    placed = place(base, frames, [frames[40].frame_id, blind.frame_id], [])
    assert placed.poses[frames[40].frame_id].source == "gnss"
    assert placed.unplaced[blind.frame_id] == "not_placeable"


def center_errors(flight: Flight, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the visual frames' centres and their stated sigmas, (N, 3) metres."""
    truth = solution.world.from_geodetic(WORLD.to_geodetic(flight.centers))
    rows = [k for k, f in enumerate(flight.frames) if solution.poses[f.frame_id].source == "visual"]
    poses = [solution.poses[flight.frames[k].frame_id] for k in rows]
    return np.array([p.center for p in poses]) - truth[rows], np.array([p.sigma_m for p in poses], float)


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


def without_gps(flight: Flight) -> Flight:
    return flight.with_meta(lambda _, meta: replace(meta, gps=None))


def route_errors(flight: Flight, solution: Solution) -> tuple[float, float, float]:
    """Of the route's shape (RMS after a similarity, share of its length), its scale, and of heights."""
    poses = [solution.poses[f.frame_id] for f in flight.frames]
    a = np.array([p.center[:2] for p in poses]) @ (1, 1j)
    b = flight.centers[:, :2] @ (1, 1j)
    a, b = a - a.mean(), b - b.mean()
    z = np.vdot(a, b) / np.vdot(a, a).real
    height = np.array([p.center[2] - p.ground_h_m for p in poses]) / flight.centers[:, 2]
    rms = float(np.sqrt((np.abs(b - z * a) ** 2).mean()))
    return rms / float(np.abs(np.diff(b)).sum()), float(abs(z)), float(np.sqrt(((height - 1) ** 2).mean()))


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


def test_without_gps_sigmas_grow_with_the_distance_from_the_first_frame() -> None:
    flight = without_gps(fly(1, 40))
    solution = solve(flight.frames, flight.matches, PoseParams(first_height_m=60.0))
    sigma = [solution.poses[f.frame_id].sigma_m for f in flight.frames]
    across = np.array([np.hypot(s[0], s[1]) for s in sigma if s])
    assert across[0] < 0.01
    assert across[39] > across[20] > across[5] > 0
    assert all(s and s[2] < 6 for s in sigma)  # heights above the first frame's ground


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


def test_frames_are_placed_in_a_map_without_gps() -> None:
    flight = without_gps(fly()).with_meta(lambda _, m: replace(m, relative_alt_m=HEIGHT_M))
    before, after = live(flight, 36)
    assert sources(after) == ["vision-only"]
    assert len(after.poses) == 48
    assert all(after.poses[k] is p for k, p in before.poses.items())
    assert route_errors(flight, after)[0] < 0.01
    assert all(p.sigma_m for p in after.poses.values())


def test_placing_looks_at_matched_frames_only() -> None:
    flight = fly(8, 25)
    base = solve(flight.frames[:190], flight.matches)
    new = flight.frames[195].frame_id
    ties = [m for m in flight.matches if new in (m.low, m.high)]
    near = {new} | {m.low for m in ties} | {m.high for m in ties}
    some = [f for f in flight.frames if f.frame_id in near]
    fewer = place(replace(base, poses={k: p for k, p in base.poses.items() if k in near}), some, [new], ties)
    whole = place(base, flight.frames, [new], ties)
    assert whole.poses[new].center.tobytes() == fewer.poses[new].center.tobytes()
