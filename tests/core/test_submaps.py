"""What holds submaps together, on flights whose truth is known: correspondences and looks are made."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from core.features import extract
from core.frame import FrameMeta, GpsFix
from core.geometry import Pose
from core.matching import MatchCounts, PairMatch, match_pair
from core.mosaic import solved
from core.neighbours import NeighbourParams, Pair, Sighting
from core.photography import GroundPicture, develop, expose
from core.pose_graph import GraphFrame, Solution
from core.simulation import Flight, FlightParams, Shot, look_down, plan_flight
from core.submaps import (
    SubmapGraph,
    intersection_angles_deg,
    joins,
    parts,
    spanning,
    strength,
    submap_graph,
)
from core.ties import Canonical, canonical, thresholds, ties_to_try

CELL_M = 8.0
TIES = st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7), st.integers(1, 40)), max_size=20)


@dataclass(frozen=True)
class World:
    """A flight as the search for neighbours and the pose graph see it, and the truth to match it by."""

    flight: Flight
    shots: dict[str, Shot]
    sightings: tuple[Sighting, ...]
    frames: tuple[GraphFrame, ...]
    least_shared: float = 0.2

    def match(self, pair: Pair) -> PairMatch:
        """Accepted when the pictures share enough ground."""
        low, high = (self.shots[k] for k in pair)
        rng = np.random.default_rng(int(pair[0][:8] + pair[1][:8], 16))
        size = (low.camera.width, low.camera.height)
        uv = rng.uniform((0, 0), size, (160, 2))
        seen = high.pose.pixels(high.camera, self.flight.ground(low, uv))
        both = ((seen > 0) & (seen < np.array(size) - 1)).all(1)
        count = int(both.sum()) if both.mean() > self.least_shared else 0
        uv_low, uv_high = (
            uv[both][:count],
            seen[both][:count] + rng.normal(0, 0.7, (int(both.sum()), 2))[:count],
        )
        counts = MatchCounts(guided=count, final=count)
        reason = "ok" if count else "too_few_matches"
        return PairMatch(*pair, count > 0, reason, uv_low.astype("f4"), uv_high.astype("f4"), counts)

    def matched(self, pairs: Sequence[Pair]) -> list[PairMatch]:
        return [m for p in pairs if (m := self.match(p)).accepted]

    def canonical(self) -> Canonical:
        found = canonical(self.sightings, self.matched)
        assert found is not None
        return found

    def solved(self) -> tuple[Solution, SubmapGraph]:
        return solved(self.frames, self.canonical())

    def change(self, how: Callable[[GraphFrame], GraphFrame]) -> World:
        frames = tuple(how(f) for f in self.frames)
        sightings = tuple(
            replace(s, gps=f.meta.gps, captured_s=f.meta.captured_s)
            for s, f in zip(self.sightings, frames, strict=True)
        )
        return replace(self, frames=frames, sightings=sightings)


def looks(flight: Flight, shot: Shot) -> np.ndarray:
    """An appearance that two pictures share as far as they share ground."""
    west, south, east, north = flight.area
    shape = (int((north - south) / CELL_M) + 2, int((east - west) / CELL_M) + 2)
    field = np.random.default_rng(9).normal(0, 1, (*shape, 96))
    u, v = np.meshgrid(np.linspace(0, shot.camera.width, 12), np.linspace(0, shot.camera.height, 9))
    xy = flight.ground(shot, np.column_stack((u.ravel(), v.ravel())))[:, :2] - flight.origin
    column, row = ((xy - (west, south)) / CELL_M).astype(int).T
    words = field[row.clip(0, shape[0] - 1), column.clip(0, shape[1] - 1)].sum(0)
    return np.asarray(words / np.linalg.norm(words), np.float32)


def world(params: FlightParams, least_shared: float = 0.2) -> World:
    flight = plan_flight(params)
    shots = {hashlib.sha256(s.name.encode()).hexdigest()[:32]: s for s in flight.shots}
    frames = tuple(GraphFrame(k, s.name, meta_of(s)) for k, s in shots.items())
    sightings = tuple(
        Sighting(k, s.captured_s, s.name, f"drone {s.drone}", s.gps, looks(flight, s))
        for k, s in shots.items()
    )
    return World(flight, shots, sightings, frames, least_shared)


def meta_of(shot: Shot) -> FrameMeta:
    c = shot.camera
    return FrameMeta(
        c.width, c.height, c.f_px, shot.captured_s, shot.gps, shot.relative_alt_m, shot.attitude,
        f"drone {shot.drone}", "body",
    )  # fmt: skip


def without_gps(frame: GraphFrame) -> GraphFrame:
    return replace(frame, meta=replace(frame.meta, gps=None))


def trajectory_error_m(w: World, solution: Solution, of: set[str]) -> float:
    """RMS distance of the camera positions from the truth after the best shift, metres."""
    ids = sorted(of & solution.poses.keys())
    lon_lat = [(s.gps.lon_deg, s.gps.lat_deg) for s in w.shots.values() if s.gps]
    assert lon_lat
    found = np.array([solution.poses[k].center for k in ids])
    truth = np.array([w.shots[k].pose.center for k in ids])
    a, b = (x[:, :2] @ (1, 1j) for x in (found - found.mean(0), truth - truth.mean(0)))
    z = np.vdot(a, b) / np.vdot(a, a)
    return float(np.sqrt((np.abs(b - z * a) ** 2).mean()))


# Kruskal and strength


@given(TIES)
def test_the_forest_is_as_strong_as_any_and_spans_what_hangs_together(
    ties: list[tuple[int, int, int]],
) -> None:
    best: dict[tuple[int, int], int] = {}
    for i, j, c in ties:
        if i != j:
            best[min(i, j), max(i, j)] = max(c, best.get((min(i, j), max(i, j)), 0))
    distinct = [(i, j, float(c)) for (i, j), c in best.items()]
    chosen = spanning(8, distinct)
    assert spanning(8, [(j, i, c) for i, j, c in reversed(distinct)]) == chosen
    assert parts(8, chosen) == parts(8, best)
    assert len(chosen) == 8 - len(set(parts(8, best)))
    if distinct:
        low, high, c = zip(*distinct, strict=True)
        peer = minimum_spanning_tree(coo_matrix((-np.array(c), (low, high)), shape=(8, 8)))
        assert sum(best[pair] for pair in chosen) == pytest.approx(-peer.sum())


@given(st.integers(2, 50), st.integers(15, 900), st.floats(0, 90), st.integers(0, 5), st.floats(0, 9))
def test_strength_grows_with_frames_points_and_angle_up_to_45_degrees(
    frames: int, points: int, angle_deg: float, more: int, wider: float
) -> None:
    c = strength(frames, points, angle_deg)
    assert strength(frames + more, points + more, min(angle_deg + wider, 90)) >= c
    assert strength(frames, points, 45) == strength(frames, points, 80)
    assert strength(10, 100, 10) == pytest.approx(30.0)


@pytest.mark.parametrize(("baseline_m", "turned_deg"), [(0.0, 0), (15.0, 0), (30.0, 180), (45.0, 90)])
def test_the_intersection_angle_needs_no_pose(baseline_m: float, turned_deg: float) -> None:
    camera = FlightParams().camera()
    poses = [
        Pose(look_down(np.radians(h)), np.array([x, 0, 60.0]), 0.0)
        for x, h in ((0.0, 0.0), (baseline_m, turned_deg))
    ]
    east, north = np.random.default_rng(0).uniform(-9, 9, (2, 50))
    points = np.column_stack((east + baseline_m / 2, north, np.zeros(50)))
    uv = [p.pixels(camera, points).astype(np.float32) for p in poses]
    match = PairMatch("a", "b", True, "ok", uv[0], uv[1], MatchCounts())
    rays = [points - p.center for p in poses]
    cosine = (rays[0] * rays[1]).sum(1) / np.linalg.norm(rays[0], axis=1) / np.linalg.norm(rays[1], axis=1)
    truth = np.degrees(np.arccos(cosine.clip(-1, 1)))
    assert intersection_angles_deg(match, camera, camera) == pytest.approx(truth, abs=0.1)


def test_poses_tell_the_intersection_angle_of_tilted_cameras() -> None:
    camera = FlightParams().camera()
    poses = [
        Pose(look_down(0.4, 0.2, -0.1), np.array([0, 0, 60.0]), 0.0),
        Pose(look_down(2.0, -0.1, 0.2), np.array([30.0, 5, 70.0]), 0.0),
    ]
    east, north = np.random.default_rng(0).uniform(-9, 9, (2, 50))
    points = np.column_stack((east + 15, north, np.zeros(50)))
    uv = [p.pixels(camera, points).astype(np.float32) for p in poses]
    match = PairMatch("a", "b", True, "ok", uv[0], uv[1], MatchCounts())
    rays = [(points - p.center) / np.linalg.norm(points - p.center, axis=1)[:, None] for p in poses]
    truth = np.degrees(np.arccos((rays[0] * rays[1]).sum(1)))
    turn = poses[0].world_R_cam.T @ poses[1].world_R_cam
    assert intersection_angles_deg(match, camera, camera, turn) == pytest.approx(truth, abs=0.1)


def test_thresholds_are_what_half_an_overlap_looks_like_to_the_frame_itself() -> None:
    shared = {1: 100, 2: 52, 3: 20}
    common, score = np.array([0, 60, 30, 50, 90]), np.array([0.0, 0.8, 0.6, 0.7, 0.9])
    assert thresholds(shared, common, score) == (0.5, pytest.approx(0.75))
    assert thresholds({1: 100}, common, score) == (0.5, 0.5)


# Flights


def test_all_that_hangs_together_asks_for_nothing_more() -> None:
    w = world(FlightParams(frames=24, drones=1))
    found = w.canonical()
    assert found.extra == ()
    graph = w.solved()[1]
    assert [(len(s.frame_ids), s.merged, s.georeferenced_by) for s in graph.submaps] == [(24, 0, "gps")]
    assert graph.ties == ()


def test_low_overlap_is_one_submap_from_real_pictures(tmp_path: Path) -> None:
    params = FlightParams(
        frames=25, drones=1, forward_overlap=0.4, side_overlap=0.3, width_px=640, height_px=480, seed=4
    )
    w = world(params)
    picture = GroundPicture.create(tmp_path, w.flight)
    size = (params.width_px, params.height_px)
    features = {k: extract(develop(w.flight, s, expose(picture, s)), size) for k, s in w.shots.items()}
    camera = {f.frame_id: f.meta.camera() for f in w.frames}

    def matched(pairs: Sequence[Pair]) -> list[PairMatch]:
        every = (match_pair(a, features[a], b, features[b], camera[a], camera[b]) for a, b in pairs)
        return [m for m in every if m.accepted]

    seen = [replace(s, words=features[s.frame_id].words) for s in w.sightings]
    found = canonical(seen, matched)
    assert found is not None
    solution, _ = solved(w.frames, found)
    together = [p for p in solution.poses.values() if p.submap == 0 and p.source == "visual"]
    assert len(solution.poses) == 25
    assert len(together) >= 0.95 * 25


@pytest.mark.parametrize("gps", [True, False])
def test_three_interruptions_lose_no_frame_and_hardly_any_accuracy(gps: bool) -> None:
    params = FlightParams(frames=96, drones=1, lines=4, per_line=24, seed=3)
    whole, broken = world(params), world(replace(params, gaps=3, gap_frames=6))
    if not gps:
        whole, broken = whole.change(without_gps), broken.change(without_gps)
    uninterrupted, _ = whole.solved()
    solution, graph = broken.solved()
    assert solution.poses.keys() == {f.frame_id for f in broken.frames}
    assert {p.submap for p in solution.poses.values()} == {0}
    assert {s.merged for s in graph.submaps} == {0}
    both = set(solution.poses)
    error_m, peer_m = (
        trajectory_error_m(broken, solution, both),
        trajectory_error_m(whole, uninterrupted, both),
    )
    assert error_m < 1.05 * peer_m + 0.02


@pytest.mark.parametrize("seed", [1, 2])
def test_a_fifth_of_the_frames_may_be_dropped(seed: int) -> None:
    w = world(FlightParams(frames=60, drones=1, drop=0.2, seed=seed))
    solution, _ = w.solved()
    assert len(solution.poses) == len(w.frames) == 48
    assert {p.submap for p in solution.poses.values()} == {0}


def drones_that_meet_once() -> World:
    return world(FlightParams(frames=40, drones=2, layout="corner", side_overlap=0.5, seed=2))


def test_two_drones_that_meet_once_are_two_submaps_and_one_map() -> None:
    w = drones_that_meet_once()
    solution, graph = w.solved()
    assert len(solution.poses) == 40
    assert {p.submap for p in solution.poses.values()} == {0}
    assert [(s.drone, len(s.frame_ids), s.merged) for s in graph.submaps] == [
        ("drone 1", 20, 0), ("drone 2", 20, 0),
    ]  # fmt: skip
    (tie,) = graph.ties
    assert tie.accepted
    assert tie.strength == strength(tie.frames, tie.points, tie.angle_deg)
    assert 2 <= tie.frames <= 12


def test_a_drone_without_gps_is_georeferenced_by_its_tie() -> None:
    w = drones_that_meet_once().change(lambda f: without_gps(f) if f.meta.drone == "drone 2" else f)
    solution, graph = w.solved()
    assert [s.georeferenced_by for s in graph.submaps] == ["gps", "tie"]
    assert len(solution.poses) == 40
    assert trajectory_error_m(w, solution, set(solution.poses)) < 3.0


def test_islands_that_overlap_nowhere_stay_apart_and_lie_where_their_gps_says() -> None:
    w = world(FlightParams(frames=40, drones=2, layout="corner", side_overlap=0.5, seed=2), least_shared=0.5)
    solution, graph = w.solved()
    assert len(solution.poses) == 40
    assert sorted({p.submap for p in solution.poses.values()}) == sorted({s.merged for s in graph.submaps})
    assert len(graph.submaps) >= 2
    assert {s.georeferenced_by for s in graph.submaps} == {"gps"}
    assert sum(len(s.frame_ids) for s in graph.submaps) == 40


def test_frames_that_tie_to_nothing_are_kept_where_their_gps_says() -> None:
    w = world(FlightParams(frames=24, drones=1, seed=5))
    blind = {f.frame_id for f in w.frames[5:8]}
    ask = w.matched
    found = canonical(w.sightings, lambda pairs: [m for m in ask(pairs) if not blind & {m.low, m.high}])
    assert found is not None
    assert all(blind & set(pair) for pair in found.extra)
    solution, graph = solved(w.frames, found)
    assert {k for k, p in solution.poses.items() if p.source == "gnss"} == blind
    assert len({solution.poses[k].submap for k in blind} | {0}) == 4
    assert [len(s.frame_ids) for s in graph.submaps] == [21, 1, 1, 1]
    assert all(s.merged == solution.poses[s.frame_ids[0]].submap for s in graph.submaps)
    assert graph.tried == len(found.extra)


# Ties to try


def misled() -> World:
    """Two drones over the same ground whose GPS and clocks keep them apart, and pictures that all look alike
    at first: only the best-looking partners of each frame are found.
    """

    def away(f: GraphFrame) -> GraphFrame:
        assert f.meta.gps
        if f.meta.drone == "drone 1":
            return f
        there = GpsFix(f.meta.gps.lat_deg + 0.0018, f.meta.gps.lon_deg, f.meta.gps.alt_m)
        return replace(f, meta=replace(f.meta, gps=there))

    return world(FlightParams(frames=36, drones=2, side_overlap=0.6, seed=7)).change(away)


def first_only(w: World) -> tuple[list[PairMatch], list[Pair]]:
    """Candidates without those between drones, as if looks had not found them."""
    found = w.canonical()
    drone = {f.frame_id: f.meta.drone for f in w.frames}
    first = [p for p in found.first if drone[p[0]] == drone[p[1]]]
    return w.matched(first), first


def test_what_looks_alike_by_each_frames_own_measure_is_tried_between_submaps() -> None:
    w = misled()
    found, first = first_only(w)
    tries = ties_to_try(w.sightings, first, found)
    drone = {f.frame_id: f.meta.drone for f in w.frames}
    assert tries == sorted(set(tries))
    assert all(low < high and drone[low] != drone[high] for low, high in tries)
    assert len(tries) <= 64
    hits = w.matched(tries)
    assert len(hits) >= 3
    graph = submap_graph(w.frames, [*found, *hits], {}, extra=tries)
    assert [(t.low, t.high, t.accepted) for t in graph.ties] == [(0, 1, True)]


def test_ties_to_try_are_a_function_of_the_sets() -> None:
    w = misled()
    found, first = first_only(w)
    rng = np.random.default_rng(0)
    tries = ties_to_try(w.sightings, first, found)
    for _ in range(3):
        order = rng.permutation(len(w.sightings))
        mixed = [w.sightings[k] for k in order]
        shuffled = [found[k] for k in rng.permutation(len(found))]
        assert ties_to_try(mixed, set(first), shuffled) == tries
    assert not set(ties_to_try(w.sightings, [*first, *tries], found)) & set(tries)


def test_frames_whose_gps_lie_far_apart_are_not_tried() -> None:
    def further(f: GraphFrame) -> GraphFrame:
        gps = f.meta.gps
        assert gps
        off = 0.0 if f.meta.drone == "drone 1" else 0.02
        return replace(f, meta=replace(f.meta, gps=replace(gps, lat_deg=gps.lat_deg + off)))

    w = misled()
    found, first = first_only(w)
    assert ties_to_try(w.change(further).sightings, first, found) == []
    lost = w.change(lambda f: without_gps(f) if f.meta.drone == "drone 2" else f)
    assert ties_to_try(lost.sightings, first, found)


def test_canonical_pairs_wait_for_both_rounds_and_end_the_same() -> None:
    w, few = misled(), NeighbourParams(nearest=3, sectors=1, alike=0)
    whole = canonical(w.sightings, w.matched, few)
    assert whole is not None
    assert whole.extra
    tried = set(whole.extra) & {(m.low, m.high) for m in whole.matches}
    assert tried
    known: dict[Pair, PairMatch] = {}

    def patient(pairs: Sequence[Pair]) -> list[PairMatch] | None:
        """Matches ten more pairs each time, the last ones first."""
        missing = [p for p in pairs if p not in known]
        known.update({p: w.match(p) for p in missing[-10:]})
        return None if missing else [known[p] for p in pairs if known[p].accepted]

    rounds = 0
    while (found := canonical(w.sightings[::-1], patient, few)) is None:
        rounds += 1
    assert rounds >= 4
    assert (found.first, found.extra) == (whole.first, whole.extra)
    assert [m.to_bytes() for m in found.matches] == [m.to_bytes() for m in whole.matches]


def test_the_graph_of_submaps_does_not_depend_on_the_order() -> None:
    w = drones_that_meet_once()
    found = w.canonical()
    solution, graph = solved(w.frames, found)
    dropped = solution.dropped_pairs
    assert submap_graph(w.frames[::-1], found.matches[::-1], solution.poses, dropped, found.extra) == graph


def test_a_frame_that_sees_two_maps_joins_them() -> None:
    merged = {"a": 0, "b": 0, "c": 1, "d": 2}

    def match(low: str, high: str, accepted: bool = True) -> PairMatch:
        uv = np.zeros((1, 2), np.float32)
        return PairMatch(low, high, accepted, "ok", uv, uv, MatchCounts())

    assert joins(merged, {"x"}, [match("a", "x"), match("c", "x")])
    assert joins(merged, {"x", "y"}, [match("a", "x"), match("x", "y"), match("d", "y")])
    assert not joins(merged, {"x"}, [match("a", "x"), match("b", "x")])
    assert not joins(merged, {"x"}, [match("a", "x"), match("c", "x", accepted=False)])
    assert not joins(merged, {"x"}, [match("a", "c")])
    assert not joins({}, {"x", "y"}, [match("x", "y")])


def test_more_pairs_never_split_a_submap() -> None:
    rng = np.random.default_rng(3)
    pairs = [tuple(p) for p in rng.integers(0, 12, (25, 2)).tolist()]
    for n in range(len(pairs)):
        less, more = parts(12, pairs[:n]), parts(12, pairs[: n + 1])
        for i, j in combinations(range(12), 2):
            assert less[i] != less[j] or more[i] == more[j]
