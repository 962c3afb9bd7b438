"""Start values for every tied frame, submap by submap, whatever is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.attitude import circular_median, level_to_world, levelling, rotation_of
from core.pose_graph.averaging import (
    Moments,
    Similarities,
    average,
    fit_similarity,
    moments,
    ratios,
    steps,
)
from core.pose_graph.chaining import chained, spanned
from core.pose_graph.fixes import contradicted
from core.pose_graph.matchgraph import flat_rays
from core.pose_graph.model import PoseParams
from core.pose_graph.priors import gravity
from core.pose_graph.residuals import Edges, IntArray, State
from core.pose_graph.rotations import absolute_rotations, averaged_rotations
from core.pose_graph.sparse import ComplexArray
from core.pose_graph.survey import Survey, capture_order
from core.pose_graph.twoview import TwoViews, two_views

# GPS holds a submap's scale and heading when it knows them better than this (share, radians).
GPS_HOLDS = 0.15
HORIZONTAL_RAD = -0.6
# Where fewer frames (share) have GPS, it places a submap that pairs have shaped.
WELL_COVERED = 0.9
# A compass is believed when more than this share of its frames agree: not when every second strip is flipped.
MOST = 0.6
# Cosine of the furthest that averaged rotations may lean from what was expected.
SANE_TILT = 0.5


@dataclass(frozen=True, slots=True)
class Start:
    """`survey` without the fixes that the pictures contradict; `state` of all frames; `held_by_gps` (S,) by
    submap whether GPS gives it scale and heading; `height` (N,) expected metres above ground; `edge_error`
    (E,) share of the height; `yaw_offset` by drone, NaN if unknown.
    """

    survey: Survey
    state: State
    held_by_gps: NDArray[np.bool_]
    height: Array
    edge_error: Array
    yaw_offset: Array


def believed_gimbal(s: Survey) -> NDArray[np.bool_]:
    """(N,) whether a frame says how its camera was pitched, and is believed."""
    pitch = s.attitude[:, 1]
    known = np.isfinite(pitch)
    # Makes that call the view straight down "0" would have every photo show the horizon: believe none then.
    if known.any() and np.median(pitch[known]) > HORIZONTAL_RAD:
        known = np.zeros_like(known)
    return known


def expected_down(s: Survey) -> tuple[Array, NDArray[np.bool_]]:
    """Each camera's direction to the earth (N, 3) by its gimbal, straight ahead where that is not known
    (N,).
    """
    known = believed_gimbal(s)
    pitch, roll = s.attitude[:, 1], s.attitude[:, 2]
    pitch, roll = np.where(known, pitch, -np.pi / 2), np.where(known & np.isfinite(roll), roll, 0.0)
    return gravity(rotation_of(np.zeros(len(s)), pitch, roll)), known


def starting(s: Survey, edges: Edges, submap: IntArray, params: PoseParams) -> Start:
    """Shapes of all submaps from pairs alone, fixes that contradict them out; averaged rotations make the
    rays level; then one linear solve for all. Where GPS cannot hold a submap, metadata give its scale and
    heading.
    """
    roots, guess = _roots(edges.pairs, submap), _typical(s.relative_alt_m, params.assumed_height_m)
    level = levelling(expected_down(s)[0])
    rays = flat_rays(edges, s.cameras, level)
    m = moments(*rays, edges.starts)
    chain = chained(edges.pairs, *ratios(m), roots, len(s))
    s = s.without_fixes(_contradicted(s, edges.pairs, m, guess * chain, submap, roots))
    count = len(roots)
    held = np.array([_gps_holds(s, submap == k) for k in range(count)])
    views = two_views(*rays, edges.starts, m, level, edges.pairs)
    level = _levelled(s, edges, views, held[submap], roots, params)
    m = moments(*flat_rays(edges, s.cameras, level), edges.starts)
    size = np.bincount(submap, minlength=count)
    whole = held & (np.bincount(submap, s.has_gps, count) >= WELL_COVERED * size)
    gps = np.where(whole[submap] & s.has_gps, s.gps[:, 0] + 1j * s.gps[:, 1], np.nan)
    fixed = np.array([root for k, root in enumerate(roots) if not whole[k]], np.int64)
    if len(fixed):
        chain = chained(edges.pairs, *ratios(m), roots, len(s))
    expected = np.where(whole[submap], np.nan, guess * chain)
    averaged = average(edges.pairs, m, gps, s.gps_sigma, fixed, guess, expected)
    first = first_of_known_height(s, params)
    placed, offset = _georeferenced(s, averaged, submap, held, first, params)
    height, ground = _heights(s, placed, submap)
    centre = np.column_stack((placed.c.real, placed.c.imag, ground + height))
    lens = np.array([(c.f_px, c.k1, c.k2) for c in s.cameras])
    R = level_to_world(-np.angle(placed.z)) @ level
    state = State(R, centre, ground, lens, np.zeros(len(s.drones)))
    typical = [max(float(np.median(np.abs(placed.z[submap == k]))), 1.0) for k in range(count)]
    usual = np.array(typical)[submap]
    if first is not None and not held[submap[first[0]]]:
        usual[first[0]] = first[1]
    return Start(s, state, held, usual, averaged.error, offset)


def _levelled(
    s: Survey, edges: Edges, views: TwoViews, held: NDArray[np.bool_], roots: list[int], params: PoseParams
) -> Array:
    """The rotations (N, 3, 3) that turn each camera's rays level, by rotation averaging."""
    down, known = expected_down(s)
    gps = np.where(held & s.has_gps, s.gps[:, 0] + 1j * s.gps[:, 1], np.nan)
    sigma = np.where(known, params.gimbal_start_rad, params.tilt_start_rad)
    absolute = absolute_rotations(edges.pairs, views, gps, s.gps_sigma, down, sigma)
    found = gravity(averaged_rotations(edges.pairs, views, absolute, np.array(roots, np.int64)))
    sane = np.einsum("ni,ni->n", found, down) > SANE_TILT
    return levelling(np.where(sane[:, None], found, down))


def _roots(pairs: IntArray, submap: IntArray) -> list[int]:
    """The frame with most pairs of each submap."""
    degree = np.bincount(pairs.ravel(), minlength=len(submap))
    order = np.lexsort((np.arange(len(submap)), -degree, submap))
    return [int(k) for k in order[np.searchsorted(submap[order], np.arange(int(submap.max()) + 1))]]


def _contradicted(
    s: Survey, pairs: IntArray, m: Moments, z: ComplexArray, submap: IntArray, roots: list[int]
) -> NDArray[np.bool_]:
    """(N,) which fixes the pictures around them contradict."""
    bad = np.zeros(len(s), bool)
    gps = s.gps[:, 0] + 1j * s.gps[:, 1]
    step = steps(m, pairs, z)
    size = np.sqrt(np.abs(z[pairs[:, 0]] * z[pairs[:, 1]]))
    place, miss = spanned(pairs, step, size, roots, len(s))
    row = np.empty(len(s), np.int64)
    for k in range(len(roots)):
        mine = np.flatnonzero(submap == k)
        row[mine] = np.arange(len(mine))
        own = submap[pairs[:, 0]] == k
        bad[mine] = contradicted(
            gps[mine], s.gps_sigma[mine], row[pairs[own]], step[own], miss[own], place[mine]
        )
    return bad


def _heights(s: Survey, placed: Similarities, submap: IntArray) -> tuple[Array, Array]:
    """Start values (N,) of each frame's height above ground, and of the ground's height."""
    height, ground = np.abs(placed.z), np.zeros(len(s))
    for k in range(int(submap.max()) + 1):
        mine = submap == k
        middle = max(float(np.median(height[mine])), 1.0)
        height[mine] = np.clip(height[mine], 0.4 * middle, 2.5 * middle)
        altitude = s.gps[mine, 2] - height[mine]
        if np.isfinite(altitude).any():
            ground[mine] = np.nanmedian(altitude)
    return height, ground


def first_of_known_height(s: Survey, params: PoseParams) -> tuple[int, float] | None:
    """The first frame of the flight (or the one that a marker is seen in) and its height above ground in
    metres, when that was given.
    """
    among = [k for k, f in enumerate(s.frames) if params.scale_image in (None, f.name)]
    if not among:
        return None
    first = min(among, key=lambda k: capture_order(s.frames[k]))
    if params.first_height_m is not None:
        return first, params.first_height_m
    if params.ground_px_per_m is not None:
        return first, s.cameras[s.camera[first]].f_px / params.ground_px_per_m
    return None


def _gps_holds(s: Survey, mine: NDArray[np.bool_]) -> bool:
    xy, sigma = s.gps[mine & s.has_gps, :2], s.gps_sigma[mine & s.has_gps]
    if len(xy) < 2:
        return False
    radius = float(np.sqrt(((xy - np.median(xy, axis=0)) ** 2).sum(1).mean()))
    return bool(np.median(sigma) < GPS_HOLDS * radius * np.sqrt(len(xy)))


def _typical(values: Array, default: float) -> float:
    good = values[np.isfinite(values) & (values > 5.0)]
    return float(np.median(good)) if len(good) else default


def _georeferenced(
    s: Survey,
    a: Similarities,
    submap: IntArray,
    held: NDArray[np.bool_],
    first: tuple[int, float] | None,
    params: PoseParams,
) -> tuple[Similarities, Array]:
    """Submaps brought to their place; yaw offset by drone as the submaps that GPS holds show it."""
    z, c = a.z.copy(), a.c.copy()
    target = s.gps[:, 0] + 1j * s.gps[:, 1]
    for k in np.flatnonzero(held):
        mine = submap == k
        seen = mine & s.has_gps
        turn, shift = fit_similarity(c[seen], target[seen], s.gps_sigma[seen])
        z[mine], c[mine] = turn * z[mine], turn * c[mine] + shift
    offset = yaw_offsets(s, -np.angle(z), held[submap])
    mission = _typical(np.abs(z)[held[submap]], params.assumed_height_m if first is None else first[1])
    east = 0.0
    for k in np.flatnonzero(~held):
        mine = submap == k
        size = _typical(s.relative_alt_m[mine], mission) / max(float(np.median(np.abs(z[mine]))), 1e-6)
        if first is not None and mine[first[0]]:
            size = first[1] / max(float(np.abs(z[first[0]])), 1e-6)
        turn = size * np.exp(-1j * _turn(s, z, c, offset, mine))
        z[mine], c[mine] = turn * z[mine], turn * c[mine]
        seen = mine & s.has_gps
        if seen.any():
            miss = target[seen] - c[seen]
            c[mine] += np.median(miss.real) + 1j * np.median(miss.imag)
        else:
            # nothing says where it lies: side by side, so that no two islands cover each other
            reach = 2.0 * float(np.median(np.abs(z[mine])))
            c[mine] += east - c[mine].real.min() - 1j * np.median(c[mine].imag)
            east = float(c[mine].real.max()) + reach
    return Similarities(z, c, a.error), offset


def yaw_offsets(s: Survey, yaw: Array, trusted: NDArray[np.bool_]) -> Array:
    """(D,) by drone: what to add to the metadata's yaw to get the picture's, NaN where frames disagree."""
    offset = np.full(len(s.drones), np.nan)
    usable = trusted & np.isfinite(s.attitude[:, 0])
    for d in range(len(s.drones)):
        mine = usable & (s.drone == d)
        if mine.sum() >= 3:
            middle, share = circular_median(yaw[mine] - s.attitude[mine, 0])
            offset[d] = middle if share > MOST else np.nan
    return offset


def _turn(s: Survey, z: ComplexArray, c: ComplexArray, offset: Array, mine: NDArray[np.bool_]) -> float:
    """Clockwise turn of a submap that makes its headings those of the metadata, or its track that of GPS."""
    compass = mine & np.isfinite(s.attitude[:, 0])
    if compass.any():
        expected = s.attitude[compass, 0] + np.nan_to_num(offset[s.drone[compass]])
        middle, share = circular_median(expected + np.angle(z[compass]))
        if share > MOST:
            return middle
    seen = mine & s.has_gps
    if seen.sum() >= 2:
        turn, _ = fit_similarity(c[seen], (s.gps[:, 0] + 1j * s.gps[:, 1])[seen], s.gps_sigma[seen])
        return -float(np.angle(turn))
    first = min(np.flatnonzero(mine).tolist(), key=lambda k: (s.frames[k].name, s.frames[k].frame_id))
    return float(np.angle(z[first]))
