"""Flights in strips whose correspondences are made, without any picture: for laws of the pose graph."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from core.frame import Attitude, FrameMeta, GpsFix
from core.geometry import Camera, World
from core.matching import MatchCounts, PairMatch
from core.pose_graph import GraphFrame, Solution, solve
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


def center_errors(flight: Flight, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the visual frames' centres and their stated sigmas, (N, 3) metres."""
    truth = solution.world.from_geodetic(WORLD.to_geodetic(flight.centers))
    rows = [k for k, f in enumerate(flight.frames) if solution.poses[f.frame_id].source == "visual"]
    poses = [solution.poses[flight.frames[k].frame_id] for k in rows]
    return np.array([p.center for p in poses]) - truth[rows], np.array([p.sigma_m for p in poses], float)
