"""All frames and all matches at once: what a mission is finalised with, and each time its loops close."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array, Camera, Pose, World
from core.matching import PairMatch
from core.pose_graph.adjustment import Adjusted, adjust
from core.pose_graph.certainty import position_sigmas
from core.pose_graph.control import Control, Similarity, control_of, laid_onto, with_pixels
from core.pose_graph.fallback import gnss_poses, is_oblique
from core.pose_graph.learning import MEDIAN_2D, learnt
from core.pose_graph.matchgraph import edges_of, submaps
from core.pose_graph.model import GraphFrame, Mark, PoseParams, Solution
from core.pose_graph.priors import Priors, heading
from core.pose_graph.residuals import Edges, IntArray, State
from core.pose_graph.start import Start, expected_down, first_of_known_height, starting, yaw_offsets
from core.pose_graph.survey import Survey, capture_order, survey

WILD = 10.0


@dataclass(frozen=True, slots=True)
class Graph:
    """Tied frames (a part of the survey, `rows` of it), their pairs, and where they ended up.

    `laid`: how surveyed points moved the map before they held it.
    """

    s: Survey
    rows: IntArray
    edges: Edges
    adjusted: Adjusted
    dropped: tuple[tuple[str, str], ...]
    gps_sigma: Array
    sigma_px: Array
    sigma_m: Array
    laid: Similarity | None = None


def solve(
    frames: Sequence[GraphFrame],
    matches: Sequence[PairMatch],
    params: PoseParams | None = None,
    world: World | None = None,
    marks: Sequence[Mark] = (),
) -> Solution:
    """Poses of all frames from all their matches; a function of the sets, whatever their order.

    `world` keeps the origin of an earlier solution. Every frame is in `poses` or in `unplaced`. `marks`: of
    the surveyed points that hold the map in place.
    """
    params = params or PoseParams()
    s = survey(frames, params, world)
    down, known = expected_down(s)
    away = known & (down[:, 2] < params.min_downward)
    index = {f.frame_id: k for k, f in enumerate(s.frames) if not away[k]}
    edges = edges_of(matches, index, s.cameras, s.camera, params)
    graph = optimise(s, edges, params, marks) if len(edges) else None
    if graph is not None and graph.laid is not None:
        s = replace(s, gps=graph.laid.places(s.gps))
    return _solution(s, graph, params)


def optimise(s: Survey, edges: Edges, params: PoseParams, marks: Sequence[Mark] = ()) -> Graph:
    """Start values, a coarse adjustment, wrong pairs out, and the fine one with lenses and lags free."""
    rows = np.unique(edges.pairs)
    tied = s.take(rows)
    edges = replace(edges, pairs=np.searchsorted(rows, edges.pairs), camera=tied.camera)
    names = [(f.name, f.frame_id) for f in tied.frames]
    every, submap = edges, submaps(len(tied), edges.pairs, names)
    start = starting(tied, edges.thinned(params.coarse_points), submap, params)
    tied = start.survey
    keep = start.edge_error < max(0.3, 6 * float(np.median(start.edge_error)))
    edges = edges.subset(keep)
    priors = priors_of(tied, start, submap, params)
    sigma = params.sigma_of_f * start.state.lens[:, 0]
    held = replace(priors, lens_sigma=np.full_like(priors.lens_sigma, 1e-6), lag_sigma_s=1e-6)
    thin = edges.thinned(params.coarse_points)
    coarse = adjust(thin, held, start.state, sigma, 5 * params.robust_scale, params.coarse_steps, 2e-2)
    good = _right_edges(thin, coarse.squared, params.wrong_edge)
    edges = edges.subset(good)
    # relief makes most of the residuals: what this ground does decides how far a match is believed
    observed = float(np.sqrt(np.median(coarse.squared))) / MEDIAN_2D
    sigma = sigma * np.clip(observed, *params.sigma_range)
    control = control_of(tied, marks, params) if tied.has_gps.any() else None
    laid = laid_onto(control, coarse.state, params) if control else None
    if laid is not None:
        priors, coarse = _laid(priors, laid), replace(coarse, state=laid.state(coarse.state))
    priors = learnt(tied, edges.pairs, priors, coarse.state, params)
    fine, fine_steps = coarse, 0
    for known in _control_rounds(control, coarse.state, params):
        fine = adjust(
            edges, replace(priors, control=known), fine.state, sigma, params.robust_scale, params.fine_steps,
            1.5e-4, structure=fine.structure if len(fine.normal.pair) == len(edges) else None,
        )  # fmt: skip
        fine_steps += fine.steps
    left = {tuple(p) for p in edges.pairs.tolist()}
    ids = [f.frame_id for f in tied.frames]
    dropped = tuple((ids[i], ids[j]) for i, j in every.pairs.tolist() if (i, j) not in left)
    fine = replace(fine, steps=fine_steps + coarse.steps)
    sigma_m = position_sigmas(fine, priors, edges.pairs, _origins(tied, edges.pairs, names))
    return Graph(tied, rows, edges, fine, dropped, priors.gps_sigma, sigma, sigma_m, laid)


def _control_rounds(control: Control | None, state: State, params: PoseParams) -> list[Control | None]:
    """What the fine adjustment is to believe of surveyed points: first no more than they fit so far, so that
    points which the map bends away from are not taken for wrong ones.
    """
    if control is None:
        return [None]
    control = with_pixels(control, state, params)
    return [control.loosened(state), control]


def _laid(priors: Priors, laid: Similarity) -> Priors:
    """Priors after the map, and GPS with it, was laid onto surveyed points."""
    velocity = laid.turn * (priors.velocity @ (1, 1j))
    return replace(
        priors,
        gps=laid.places(priors.gps),
        velocity=np.column_stack((velocity.real, velocity.imag)),
        anchor=laid.places(priors.anchor),
        yaw=priors.yaw - np.angle(laid.turn),
        height=priors.height * abs(laid.turn),
    )


def _origins(s: Survey, pairs: IntArray, names: Sequence[tuple[str, str]]) -> IntArray:
    """The first frame of each submap that no GPS holds."""
    label = submaps(len(s), pairs, names)
    first: dict[int, int] = {}
    for k in sorted(range(len(s)), key=lambda k: capture_order(s.frames[k])):
        first.setdefault(int(label[k]), k)
    held = set(label[s.has_gps].tolist())
    return np.array([k for submap, k in sorted(first.items()) if submap not in held], np.int64)


def _right_edges(edges: Edges, squared: Array, limit: float) -> NDArray[np.bool_]:
    """(E,) which pairs agree with the rest: by the median of their residuals, in sigmas."""
    counts = 2 * np.diff(edges.starts)
    padded = np.full((len(edges), int(counts.max(initial=1))), np.inf)
    padded[np.arange(padded.shape[1]) < counts[:, None]] = squared.ravel()
    padded.sort(axis=1)
    rows = np.arange(len(edges))
    middle = (padded[rows, (counts - 1) // 2] + padded[rows, counts // 2]) / 2
    residual = np.sqrt(middle)
    return np.asarray(residual <= max(limit, 4 * float(np.median(residual))))


def priors_of(s: Survey, start: Start, submap: IntArray, params: PoseParams) -> Priors:
    """What is believed before the first adjustment."""
    down, known = expected_down(s)
    loose = ~start.held_by_gps[submap]
    yaw = s.attitude[:, 0] + np.nan_to_num(start.yaw_offset[s.drone])
    yaw = np.where(np.isfinite(yaw), yaw, heading(start.state.R))
    # where GPS cannot tell scale or heading its fixes only say where the middle is, and that the start has
    # used
    gps = s.gps.copy()
    gps[loose & s.has_gps, :2] = start.state.t[loose & s.has_gps, :2]
    c = len(s.cameras)
    focal = np.where(s.focal_known, params.focal_log_sigma, 3 * params.focal_log_sigma)
    # noise in both photos of a pair pulls a focal length that flat ground hides, the more the more frames
    focal = focal / np.sqrt(np.maximum(1.0, np.bincount(s.camera, minlength=c) / params.focal_frames))
    k1 = np.full(c, params.k1_sigma)
    k2 = np.full(c, params.k2_sigma)
    free = params.self_calibrate & (np.bincount(s.camera, minlength=c) >= params.min_frames_to_calibrate)
    lens_sigma = np.where(free[:, None], np.column_stack((focal, k1, k2)), 1e-6)
    # of a whole submap, not of each frame: its frames share one start value
    share = np.sqrt(np.bincount(submap)[submap])
    height_sigma = np.where(loose, 0.1, 1.0) * share
    first = first_of_known_height(s, params)
    if first is not None and loose[first[0]]:
        height_sigma[submap == submap[first[0]]] *= 10.0
        height_sigma[first[0]] = params.first_height_log_sigma
    return Priors(
        gps=gps,
        gps_sigma=s.gps_sigma,
        altitude_sigma=s.altitude_sigma,
        velocity=np.where(loose[:, None], 0.0, s.velocity),
        drone=s.drone,
        anchor=start.state.t,
        down=down,
        gimballed=known.astype(float),
        tilt_sigma=np.where(known, params.gimbal_start_rad, params.tilt_start_rad),
        yaw=np.where(loose, yaw, np.nan),
        yaw_sigma=np.full(len(s), params.yaw_sigma_rad),
        height=start.height,
        height_sigma=height_sigma,
        ground_step_sigma_m=params.ground_step_sigma_m,
        lens=start.state.lens,
        lens_sigma=lens_sigma,
        lag_sigma_s=params.lag_sigma_s,
    )


def _solution(s: Survey, graph: Graph | None, params: PoseParams) -> Solution:
    poses: dict[str, Pose] = {}
    islands: dict[str, Pose] = {}
    cameras = dict(zip(s.camera_keys, s.cameras, strict=True))
    names = [(f.name, f.frame_id) for f in s.frames]
    label = np.arange(len(s))
    offset = np.full(len(s.drones), np.nan)
    lag: dict[str, float] = {}
    gps_sigma: dict[str, float] = {}
    rms, steps, unplaced = 0.0, 0, {}
    if graph is not None:
        state = graph.adjusted.state
        cameras = {k: refined(c, lens) for (k, c), lens in zip(cameras.items(), state.lens, strict=True)}
        label = submaps(len(s), graph.rows[graph.edges.pairs], names)
        poses, islands = _visual(s, graph, label)
        lag = {d: float(v) for d, v in zip(s.drones, state.lag_s, strict=True)}
        offset = yaw_offsets(graph.s, heading(state.R), np.ones(len(graph.s), bool))
        gps_sigma = {
            d: float(np.median(graph.gps_sigma[graph.s.drone == k]))
            for k, d in enumerate(s.drones)
            if (graph.s.drone == k).any()
        }
        rms, steps = reprojection_rms(graph, params), graph.adjusted.steps
    rest = np.array([k for k, f in enumerate(s.frames) if f.frame_id not in poses], np.int64)
    for k, pose in gnss_poses(s, rest, poses, offset, params).items():
        poses[s.frames[k].frame_id] = replace(pose, submap=int(label[k]))
    for k, f in enumerate(s.frames):
        home = poses if f.frame_id in poses else islands
        if f.frame_id not in poses:
            unplaced[f.frame_id] = "far_from_mission" if s.far[k] else "not_placeable"
        if f.frame_id in home and is_oblique(
            home[f.frame_id], cameras[f.meta.camera_key], params.oblique_ratio
        ):
            del home[f.frame_id]
            unplaced[f.frame_id] = "oblique"
    return Solution(
        world=s.world,
        cameras=cameras,
        poses={k: poses[k] for k in sorted(poses)},
        unplaced=unplaced,
        reprojection_rms_px=rms,
        dropped_pairs=graph.dropped if graph else (),
        lag_s=lag,
        yaw_offset_rad={d: float(v) for d, v in zip(s.drones, offset, strict=True) if np.isfinite(v)},
        gps_sigma_m=gps_sigma,
        islands={k: islands[k] for k in sorted(islands)},
        edges=len(graph.edges) if graph else 0,
        observations=len(graph.edges.uv) if graph else 0,
        steps=steps,
    )


def refined(camera: Camera, lens: Array) -> Camera:
    """The camera with self-calibrated (f px, k1, k2)."""
    f_px, k1, k2 = (float(v) for v in lens)
    return replace(camera, f_px=f_px, k1=k1, k2=k2)


def _visual(s: Survey, graph: Graph, label: IntArray) -> tuple[dict[str, Pose], dict[str, Pose]]:
    """Poses of the tied frames whose submap has a place: GPS somewhere in it, or no GPS in the whole
    mission; and of those on islands, which have none.
    """
    state = graph.adjusted.state
    nowhere = not s.has_gps.any()
    size = np.bincount(label)
    fixed = np.zeros(len(size), bool)
    fixed[label[s.has_gps]] = True
    poses, islands = dict[str, Pose](), dict[str, Pose]()
    for k, row in enumerate(graph.rows.tolist()):
        sane = state.t[k, 2] - state.h[k] > 0.5 and np.isfinite(state.R[k]).all()
        if size[label[row]] < 2 or not sane:
            continue
        home = poses if fixed[label[row]] or nowhere else islands
        home[s.frames[row].frame_id] = Pose(
            world_R_cam=state.R[k],
            center=state.t[k],
            ground_h_m=float(state.h[k]),
            source="visual" if fixed[label[row]] else "vision-only",
            submap=int(label[row]),
            sigma_m=_triple(graph.sigma_m[k]),
        )
    return poses, islands


def _triple(sigma: Array) -> tuple[float, float, float] | None:
    east, north, up = (float(v) for v in sigma)
    return (east, north, up) if np.isfinite(sigma).all() else None


def reprojection_rms(graph: Graph, params: PoseParams) -> float:
    """Pixels of the original photos, over all correspondences but the wild ones."""
    squared, edges = graph.adjusted.squared, graph.edges
    camera = graph.s.camera[edges.pairs[:, ::-1]]
    target = np.repeat(graph.sigma_px[camera], np.diff(edges.starts), axis=0)
    tame = squared < (WILD * params.robust_scale) ** 2
    return float(np.sqrt((squared * target**2)[tame].mean())) if tame.any() else 0.0
