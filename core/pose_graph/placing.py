"""New frames against posed ones that stay where they are: what keeps the live map ahead of the next solve."""

from __future__ import annotations

from bisect import bisect_left
from collections import ChainMap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.geometry import Array, Camera, Pose
from core.matching import PairMatch
from core.pose_graph.adjustment import adjust
from core.pose_graph.attitude import level_to_world, levelling
from core.pose_graph.fallback import gnss_poses, is_oblique
from core.pose_graph.matchgraph import edges_of
from core.pose_graph.model import GraphFrame, PoseParams, Solution
from core.pose_graph.priors import Priors, gravity, heading
from core.pose_graph.residuals import Edges, State
from core.pose_graph.start import believed_gimbal, expected_down, yaw_offsets
from core.pose_graph.survey import Survey, capture_order, survey, usable_fix

Flags = NDArray[np.bool_]

STEPS = 12
NEIGHBOURS = 24
# A pair's similarity supports another's when it lays points within this share of the height from it.
AGREES = 0.15


@dataclass(frozen=True, slots=True)
class Sight:
    """One pair's view of a new frame as a similarity (ground = z·p + c): `z`, `c` complex metres, `h` of the
    ground.
    """

    z: complex
    c: complex
    h: float


def place(
    solution: Solution,
    known: Mapping[str, GraphFrame],
    new_ids: Collection[str],
    matches: Sequence[PairMatch],
    params: PoseParams | None = None,
) -> Solution:
    """`solution` with the frames `new_ids` in it; every other pose stays as it is.

    `known`: by id, at least the new ones and those they are matched with. A new frame that ties to nothing
    posed lies where its GPS says. The result does not depend on the order of any argument; what it costs does
    not depend on how many frames are posed, as long as the new ones tie to some.
    """
    params = params or PoseParams()
    new = sorted({k for k in new_ids if k in known}, key=lambda k: capture_order(known[k]))
    ties: dict[str, list[PairMatch]] = {k: [] for k in new}
    for m in matches:
        for end in {m.low, m.high} & ties.keys():
            if m.accepted and m.low in known and m.high in known:
                ties[end].append(m)
    posed = solution.poses
    if any(k in posed for k in ties):
        posed = {k: p for k, p in posed.items() if k not in ties}
    poses = ChainMap[str, Pose]({}, posed)  # type: ignore[arg-type]  # only the first map is written to
    near = _Surroundings(known, replace(solution, poses=poses))
    cameras = dict(solution.cameras)
    unplaced = {k: v for k, v in solution.unplaced.items() if k not in ties}
    for frame_id in new:
        meta = known[frame_id].meta
        cameras.setdefault(meta.camera_key, meta.camera())
        now = replace(solution, cameras=cameras, poses=poses)
        pose = _pose(now, known, near, frame_id, ties[frame_id], params)
        if isinstance(pose, str):
            unplaced[frame_id] = pose
        else:
            poses[frame_id] = pose
    return replace(solution, cameras=cameras, poses=poses, unplaced=unplaced)


def _pose(
    solution: Solution,
    known: Mapping[str, GraphFrame],
    near: _Surroundings,
    frame_id: str,
    ties: list[PairMatch],
    params: PoseParams,
) -> Pose | str:
    """The frame's pose, or why it has none."""
    partners = {m.low if m.high == frame_id else m.high for m in ties}
    seen = sorted(k for k in partners if k in solution.poses and solution.poses[k].source != "gnss")[
        :NEIGHBOURS
    ]
    s, me = _survey(known, frame_id, {*seen, *_beside(known, frame_id, partners)}, solution, params)
    camera = solution.cameras[known[frame_id].meta.camera_key]
    down, trusted = expected_down(s)
    if trusted[me] and down[me, 2] < params.min_downward:
        return "oblique"
    pose = _visual(solution, s, me, set(seen), ties, params) if seen else None
    if pose is None:
        s, me = _survey(known, frame_id, near.of(known[frame_id]), solution, params)
        offset = _offset(solution, s)
        pose = gnss_poses(s, np.array([me]), solution.poses, offset, params).get(me)
    if pose is None:
        return "far_from_mission" if s.far[me] else "not_placeable"
    return "oblique" if is_oblique(pose, camera, params.oblique_ratio) else pose


def _survey(
    known: Mapping[str, GraphFrame], frame_id: str, others: set[str], solution: Solution, params: PoseParams
) -> tuple[Survey, int]:
    """A frame among some others, and its row."""
    s = survey([known[k] for k in {frame_id, *others}], params, solution.world)
    return s, next(k for k, f in enumerate(s.frames) if f.frame_id == frame_id)


class _Surroundings:
    """Who flew or lies near a frame that ties to nothing; made once it is asked, for all frames of a call."""

    def __init__(self, known: Mapping[str, GraphFrame], solution: Solution) -> None:
        self._known, self._solution = known, solution

    @cached_property
    def _visual(self) -> list[str]:
        poses = self._solution.poses
        return sorted(k for k, p in poses.items() if p.source != "gnss" and k in self._known)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree([self._solution.poses[k].center[:2] for k in self._visual])

    @cached_property
    def _tracks(self) -> dict[str, list[GraphFrame]]:
        tracks: dict[str, list[GraphFrame]] = {}
        for f in sorted(self._known.values(), key=capture_order):
            tracks.setdefault(f.meta.drone, []).append(f)
        return tracks

    def of(self, frame: GraphFrame) -> set[str]:
        """The same drone's frames just before and after, for speed and heading; the nearest posed ones."""
        track = self._tracks[frame.meta.drone]
        at = bisect_left(track, capture_order(frame), key=capture_order)
        out = {f.frame_id for f in (*track[max(at - 1, 0) : at], *track[at + 1 : at + 2])}
        fix = usable_fix(frame.meta.gps)
        if fix is None or not self._visual:
            return out
        here = self._solution.world.from_geodetic(
            np.array([[fix.lon_deg, fix.lat_deg, self._solution.world.alt_m]])
        )
        _, near = self._tree.query(here[0, :2], k=min(5, len(self._visual)))
        return out | {self._visual[int(k)] for k in np.atleast_1d(near)}


def _beside(known: Mapping[str, GraphFrame], frame_id: str, partners: set[str]) -> set[str]:
    """Of the frames it is matched with, the same drone's just before and after it: for speed and heading."""
    me = known[frame_id]
    same = sorted(
        (known[k] for k in partners if k != frame_id and known[k].meta.drone == me.meta.drone),
        key=capture_order,
    )
    at = bisect_left(same, capture_order(me), key=capture_order)
    return {f.frame_id for f in same[max(at - 1, 0) : at + 1]}


def _offset(solution: Solution, s: Survey) -> Array:
    """Yaw offset by drone: as the last solve found it, or as the posed frames around show it."""
    yaw = np.full(len(s), np.nan)
    for k, f in enumerate(s.frames):
        pose = solution.poses.get(f.frame_id)
        if pose is not None and pose.source == "visual":
            yaw[k] = heading(pose.world_R_cam[None])[0]
    local = yaw_offsets(s, yaw, np.isfinite(yaw))
    solved = np.array([solution.yaw_offset_rad.get(d, np.nan) for d in s.drones])
    return np.where(np.isfinite(solved), solved, local)


def _visual(
    solution: Solution, s: Survey, me: int, seen: set[str], ties: list[PairMatch], params: PoseParams
) -> Pose | None:
    """The pose that the matches with posed frames give, None when they do not agree on one."""
    ids = {f.frame_id: k for k, f in enumerate(s.frames)}
    usable = {k: ids[k] for k in (*seen, s.frames[me].frame_id)}
    lenses = tuple(solution.cameras.get(k, c) for k, c in zip(s.camera_keys, s.cameras, strict=True))
    edges = edges_of(ties, usable, lenses, s.camera, params)
    if not len(edges):
        return None
    posed = [solution.poses.get(f.frame_id) for f in s.frames]
    down, _ = _leaning(s, me, posed)
    level = levelling(down[me : me + 1])[0]
    sights = [_sight(edges, e, me, posed, lenses, level) for e in range(len(edges))]
    best, agree = _consensus(sights)
    edges = edges.subset(agree)
    state = _state(s, me, posed, lenses, best, level)
    held = np.arange(len(s)) != me
    priors = _priors(solution, s, me, posed, state, down, params)
    sigma = params.sigma_of_f * state.lens[:, 0]
    done = adjust(edges, priors, state, sigma, params.robust_scale, STEPS, 1e-5, held)
    error = np.sqrt(np.median(done.squared))
    height = done.state.t[me, 2] - done.state.h[me]
    if not np.isfinite(height) or height < 0.3 * abs(best.z) or error > params.wrong_edge:
        return None
    others = [posed[k] for k in np.unique(edges.pairs) if k != me]
    first = min((p for p in others if p is not None), key=lambda p: p.submap)
    sigmas = [p.sigma_m for p in others if p is not None and p.sigma_m is not None]
    # as well as the worst known of the frames that it hangs on, until the next solve
    certainty = (
        (max(v[0] for v in sigmas), max(v[1] for v in sigmas), max(v[2] for v in sigmas)) if sigmas else None
    )
    return Pose(
        done.state.R[me], done.state.t[me], float(done.state.h[me]), first.source, first.submap, certainty
    )


def _sight(
    edges: Edges, e: int, me: int, posed: list[Pose | None], lenses: tuple[Camera, ...], level: Array
) -> Sight:
    """The similarity of the new frame that one pair's points give, by least squares."""
    points = edges.uv[edges.starts[e] : edges.starts[e + 1]]
    side = int(edges.pairs[e, 1] == me)
    other = int(edges.pairs[e, 1 - side])
    mine, theirs = lenses[edges.camera[me]], lenses[edges.camera[other]]
    pose = posed[other]
    assert pose is not None
    ground = pose.ground(theirs, points[:, 2 - 2 * side : 4 - 2 * side] + (theirs.cx, theirs.cy))
    ray = mine.rays(points[:, 2 * side : 2 * side + 2] + (mine.cx, mine.cy)) @ level.T
    down = np.maximum(ray[:, 2], 0.1)
    p, w = (ray[:, 0] - 1j * ray[:, 1]) / down, ground[:, 0] + 1j * ground[:, 1]
    spread = p - p.mean()
    z = complex(np.vdot(spread, w - w.mean()) / max(float(np.vdot(spread, spread).real), 1e-12))
    return Sight(z, complex(w.mean() - z * p.mean()), pose.ground_h_m)


def _consensus(sights: list[Sight]) -> tuple[Sight, Flags]:
    """The sight that most others support, and (E,) which do."""
    z, c = np.array([s.z for s in sights]), np.array([s.c for s in sights])
    apart = np.abs(c[:, None] - c[None]) + 0.3 * np.abs(z[:, None] - z[None])
    agree = apart < AGREES * np.maximum(np.abs(z)[:, None], 1e-3) * (1 + 0.5)
    best = int(np.argmax(agree.sum(1) - 1e-3 * np.arange(len(sights)) / len(sights)))
    chosen = np.asarray(agree[best])
    middle = Sight(
        complex(z[chosen].mean()), complex(c[chosen].mean()), float(np.mean([s.h for s in sights]))
    )
    return middle, chosen


def _leaning(s: Survey, me: int, posed: list[Pose | None]) -> tuple[Array, bool]:
    """(N, 3) expected directions to the earth; the new frame's by its gimbal, or as its neighbours lean."""
    down, known = expected_down(s)
    for k, pose in enumerate(posed):
        if pose is not None and k != me:
            down[k] = gravity(pose.world_R_cam[None])[0]
    like = [k for k, p in enumerate(posed) if p is not None and k != me and s.camera[k] == s.camera[me]]
    if not known[me] and like:
        down[me] = np.median(down[like], axis=0)
        down[me] /= np.linalg.norm(down[me])
    return down, bool(known[me])


def _state(
    s: Survey, me: int, posed: list[Pose | None], lenses: tuple[Camera, ...], best: Sight, level: Array
) -> State:
    n = len(s)
    R, t, h = np.tile(np.diag([1.0, -1.0, -1.0]), (n, 1, 1)), np.zeros((n, 3)), np.zeros(n)
    t[:, 2] = 1.0
    for k, pose in enumerate(posed):
        if pose is not None and k != me:
            R[k], t[k], h[k] = pose.world_R_cam, pose.center, pose.ground_h_m
    R[me] = level_to_world(np.array([-np.angle(best.z)]))[0] @ level
    t[me], h[me] = (best.c.real, best.c.imag, best.h + abs(best.z)), best.h
    lens = np.array([(c.f_px, c.k1, c.k2) for c in lenses])
    return State(R, t, h, lens, np.zeros(len(s.drones)))


def _priors(
    solution: Solution,
    s: Survey,
    me: int,
    posed: list[Pose | None],
    state: State,
    down: Array,
    params: PoseParams,
) -> Priors:
    """Only the new frame's matter: the others are held."""
    learnt = np.array([solution.gps_sigma_m.get(d, 0.0) for d in s.drones])
    lag = np.array([solution.lag_s.get(d, 0.0) for d in s.drones])
    gps = s.gps.copy()
    gps[:, :2] += s.velocity * lag[s.drone][:, None]
    # heights of posed frames and of GPS may differ by a datum: the matches alone give the new one
    gps[:, 2] = np.nan
    n = len(s)
    return Priors(
        gps=gps,
        gps_sigma=np.maximum(s.gps_sigma, learnt[s.drone]),
        altitude_sigma=s.altitude_sigma,
        velocity=np.zeros((n, 2)),
        drone=s.drone,
        anchor=state.t,
        down=down,
        gimballed=believed_gimbal(s).astype(float),
        tilt_sigma=np.where(believed_gimbal(s), params.gimbal_start_rad, params.tilt_start_rad / 2),
        yaw=np.full(n, np.nan),
        yaw_sigma=np.full(n, params.yaw_sigma_rad),
        height=np.maximum(state.t[:, 2] - state.h, 0.1),
        height_sigma=np.full(n, 1.0),
        ground_step_sigma_m=params.ground_step_sigma_m,
        lens=state.lens,
        lens_sigma=np.full_like(state.lens, 1e-6),
        lag_sigma_s=1e-6,
    )
