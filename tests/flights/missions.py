"""Simulated flights taken through neighbours, matching and pose graph, and held against their truth."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from pyproj import Transformer

from core.features import Features
from core.frame import FrameMeta
from core.geometry import Array, World
from core.matching import MatchCounts, PairMatch, match_pair
from core.neighbours import Pair, Sighting
from core.pose_graph import GraphFrame, PoseParams, Solution, solve
from core.simulation import Flight, FlightParams, Shot, plan_flight
from core.submaps import SubmapGraph, submap_graph
from core.ties import Canonical, canonical
from tests.flights.landmarks import LandmarkParams, features

NONE = np.zeros((0, 2), np.float32)


@dataclass(frozen=True)
class Mission:
    """A flight as the service sees it: frames by id, their features, and matches as they are asked for."""

    flight: Flight
    shots: dict[str, Shot]
    frames: tuple[GraphFrame, ...]
    features: dict[str, Features]
    known: dict[Pair, PairMatch] = field(default_factory=dict)

    def match(self, pair: Pair) -> PairMatch:
        """What `core.matching` says of a pair; matched once."""
        if pair not in self.known:
            low, high = pair
            cameras = (self.meta[low].camera(), self.meta[high].camera())
            self.known[pair] = match_pair(low, self.features[low], high, self.features[high], *cameras)
        return self.known[pair]

    def matched(self, pairs: Sequence[Pair]) -> list[PairMatch]:
        """The accepted ones."""
        return [m for p in pairs if (m := self.match(p)).accepted]

    @cached_property
    def meta(self) -> dict[str, FrameMeta]:
        return {f.frame_id: f.meta for f in self.frames}

    @cached_property
    def sightings(self) -> tuple[Sighting, ...]:
        return tuple(
            Sighting(
                f.frame_id,
                f.meta.captured_s,
                f.name,
                f.meta.drone,
                f.meta.gps,
                self.features[f.frame_id].words,
            )
            for f in self.frames
        )

    @cached_property
    def canonical(self) -> Canonical:
        found = canonical(self.sightings, self.matched)
        assert found is not None
        return found

    def solved(self, params: PoseParams | None = None) -> Solution:
        """The final poses."""
        return solve(self.frames, self.canonical.matches, params)

    def submaps(self, solution: Solution) -> SubmapGraph:
        found = self.canonical
        return submap_graph(self.frames, found.matches, solution.poses, solution.dropped_pairs, found.extra)

    def claiming(self, change: Callable[[Shot, FrameMeta], FrameMeta]) -> Mission:
        """The same pictures with other metadata; matches hang on pictures and cameras only."""
        changed = (replace(f, meta=change(self.shots[f.frame_id], f.meta)) for f in self.frames)
        return Mission(self.flight, self.shots, tuple(changed), self.features, self.known)

    def without(self, ids: Collection[str]) -> Mission:
        """As if some photos had never been taken."""
        kept = tuple(f for f in self.frames if f.frame_id not in ids)
        return Mission(self.flight, self.shots, kept, self.features, self.known)


def interrupted(m: Mission, times: int, reach: int = 8) -> Mission:
    """All photos, but tracking is lost so many times (Zhan 2021, table 2): no photo of the last `reach`
    before an interruption matches one of the first `reach` after it.
    """
    order = list(m.shots)
    refused = dict(m.known)
    for at in (round((k + 1) * len(order) / (times + 1)) for k in range(times)):
        for before, after in product(order[max(at - reach, 0) : at], order[at : at + reach]):
            low, high = sorted((before, after))
            refused[low, high] = PairMatch(low, high, False, "too_few_matches", NONE, NONE, MatchCounts())
    return Mission(m.flight, m.shots, m.frames, m.features, refused)


def frame_id(shot: Shot) -> str:
    """Photos without bytes need an id as well."""
    return hashlib.sha256(shot.name.encode()).hexdigest()[:32]


def mission(params: FlightParams, seen: LandmarkParams | None = None) -> Mission:
    """A simulated flight without pictures."""
    flight = plan_flight(params)
    shots = {frame_id(s): s for s in flight.shots}
    frames = tuple(GraphFrame(k, s.name, meta_of(params, s)) for k, s in shots.items())
    return Mission(flight, shots, frames, dict(zip(shots, features(flight, seen), strict=True)))


def reclaimed(m: Mission, params: FlightParams) -> Mission:
    """The same pictures with the claims of a flight whose truth is the same."""
    flight = plan_flight(params)
    shots = {frame_id(s): s for s in flight.shots}
    assert {k: s.pose.center.tolist() for k, s in shots.items()} == {
        k: s.pose.center.tolist() for k, s in m.shots.items()
    }
    frames = tuple(GraphFrame(k, s.name, meta_of(params, s)) for k, s in shots.items())
    return Mission(flight, shots, frames, m.features, m.known)


def meta_of(params: FlightParams, shot: Shot) -> FrameMeta:
    """What the photo's metadata say."""
    return FrameMeta(
        params.width_px, params.height_px, params.nominal_f_px, shot.captured_s, shot.gps,
        shot.relative_alt_m, shot.attitude, f"drone {shot.drone}", "body",
    )  # fmt: skip


def without_gps(_: Shot, meta: FrameMeta) -> FrameMeta:
    """For `Mission.claiming`."""
    return replace(meta, gps=None)


# ---- the truth


def posed(m: Mission, solution: Solution, tied: bool = True) -> list[str]:
    """The ids of the frames that have a pose, by their matches, in the order of capture."""
    sources = ("visual", "vision-only") if tied else ("visual", "vision-only", "gnss")
    return [k for k in m.shots if k in solution.poses and solution.poses[k].source in sources]


def utm(m: Mission, solution: Solution, xyz: Array) -> Array:
    """Points (N, 3) of a solution's world → the flight's grid, metres. A map without GPS is laid near it."""
    params, world = m.flight.params, solution.world
    if not any(meta.gps for meta in m.meta.values()):
        world = World(params.lat_deg, params.lon_deg, params.base_alt_m)
    geodetic = world.to_geodetic(xyz)
    to_utm = Transformer.from_crs(4326, m.flight.epsg, always_xy=True)
    return np.column_stack((*to_utm.transform(geodetic[:, 0], geodetic[:, 1]), geodetic[:, 2]))


def ground(m: Mission, solution: Solution) -> tuple[Array, Array]:
    """Where the map shows the middle of each tied frame's picture, and where it is: (N, 2) metres each."""
    found, truth = [], []
    for k in posed(m, solution):
        shot, camera = m.shots[k], solution.cameras[m.meta[k].camera_key]
        middle = np.array([[shot.camera.cx, shot.camera.cy]])
        found.append(solution.poses[k].ground(camera, middle))
        truth.append(m.flight.ground(shot, middle))
    return utm(m, solution, np.concatenate(found))[:, :2], np.concatenate(truth)[:, :2]


def ground_errors_m(m: Mission, solution: Solution) -> Array:
    """How far the map shows the ground from where it is, (N, 2) metres east and north."""
    found, truth = ground(m, solution)
    return found - truth


def center_errors_m(m: Mission, solution: Solution) -> Array:
    """Of the tied frames' centres, (N, 3) metres east, north and up."""
    ids = posed(m, solution)
    found = np.array([solution.poses[k].center for k in ids])
    return np.asarray(utm(m, solution, found) - np.array([m.shots[k].pose.center for k in ids]))


def sigmas_m(m: Mission, solution: Solution) -> Array:
    """As stated for the frames of `center_errors_m`, (N, 3) metres; NaN where nothing is stated."""
    return np.array([solution.poses[k].sigma_m or (np.nan,) * 3 for k in posed(m, solution)])


def height_errors(m: Mission, solution: Solution) -> Array:
    """Of the tied frames' heights above ground, (N,) as shares of the true ones."""
    poses = [(solution.poses[k], m.shots[k].pose) for k in posed(m, solution)]
    return np.array([(p.center[2] - p.ground_h_m) / (q.center[2] - q.ground_h_m) - 1 for p, q in poses])


@dataclass(frozen=True)
class Fit:
    """What is left after the best similarity: RMS, metres; and that similarity's scale and turn."""

    rms_m: float
    scale: float
    turn_rad: float


def fitted(found: Array, truth: Array) -> Fit:
    """Points (N, 2) against true ones."""
    a, b = (x[:, :2] @ (1, 1j) for x in (found, truth))
    a, b = a - a.mean(), b - b.mean()
    z = complex(np.vdot(a, b) / np.vdot(a, a).real)
    return Fit(float(np.sqrt((np.abs(b - z * a) ** 2).mean())), abs(z), float(np.angle(z)))


def route_fit(m: Mission, solution: Solution, ids: Collection[str] | None = None) -> Fit:
    """Of the tied frames' centres, or of those among them that are named."""
    chosen = [k for k in posed(m, solution) if ids is None or k in ids]
    found = utm(m, solution, np.array([solution.poses[k].center for k in chosen]))
    return fitted(found, np.array([m.shots[k].pose.center for k in chosen]))


def route_length_m(m: Mission) -> float:
    """Of all drones' ways from photo to photo."""
    at = [(s.drone, complex(*s.pose.center[:2])) for s in m.shots.values()]
    drones = {d for d, _ in at}
    return float(sum(np.abs(np.diff([c for e, c in at if e == d])).sum() for d in drones))


def rms(errors: Array) -> float:
    """Of errors (N, D): the root of the mean squared length."""
    return float(np.sqrt((np.asarray(errors) ** 2).sum(-1).mean()))


def gps_bound_m(m: Mission) -> float:
    """The error of the best similarity from the fixes alone: what no matches can lessen, metres."""
    to_utm = Transformer.from_crs(4326, m.flight.epsg, always_xy=True)
    fixed = [(m.meta[k].gps, s.pose.center) for k, s in m.shots.items() if k in m.meta and m.meta[k].gps]
    east, north = to_utm.transform([g.lon_deg for g, _ in fixed], [g.lat_deg for g, _ in fixed])
    at = np.array([c[:2] for _, c in fixed]) @ (1, 1j)
    miss = np.asarray(east) + 1j * np.asarray(north) - at
    basis = np.column_stack((np.ones(len(at)), at - at.mean()))
    fitted = basis @ np.linalg.lstsq(basis, miss, rcond=None)[0]
    return float(np.sqrt((np.abs(fitted) ** 2).mean()))
