"""Exposure, white balance and vignetting, balanced over the overlaps of the frames.

Where two photos see the same ground, the logarithms of their light (`core.tone`) may differ only by their
gains, by their lens's falloff, and by the side that the ground is seen from: it is brightest with the sun
behind the camera. Left out, that side would add up from photo to photo to a map bright at one end and dark at
the other. Robust least squares over ground points, whose brightness is eliminated; gains are held near 1, so
that the map as a whole gets neither brighter nor darker.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.geometry import Array, PosedFrame, World
from core.lighting import DEFAULT, Dense, ExposureParams, Index, Sightings, Sparse, reweighted
from core.tone import Gain, log_light
from core.warp import intrinsics, project

Thumb = NDArray[np.uint8]
_Part = tuple[Index, Index, Array, Array]
"""Of one frame's sightings: frame, cell, log, place."""

FLAT_RAY = 0.5
"""How far a ray near a photo's corner goes sideways a unit of its length."""
FEW = 16
"""Up to so many unknown gains are solved for densely, without sparse matrices' overhead."""


def balance(
    frames: Sequence[PosedFrame], world: World, thumbs: Mapping[str, Thumb], params: ExposureParams = DEFAULT
) -> Mapping[str, Gain]:
    """What each frame's channels (R, G, B) are to be multiplied with, by frame id; gains given are ignored.

    `thumbs`: whole photos at about 128 px, or `shrunk`, (h, w, 3 or more) uint8, RGB first. The frames'
    order does not matter.
    """
    return {frame.frame_id: frame.gain for frame in balanced(frames, world, thumbs, params)}


def balanced(
    frames: Sequence[PosedFrame], world: World, thumbs: Mapping[str, Thumb], params: ExposureParams = DEFAULT
) -> list[PosedFrame]:
    """The frames by ascending id, with the gains of `balance` and with their cameras' falloff."""
    ordered = sorted((replace_light(f, (1.0, 1.0, 1.0), ()) for f in frames), key=lambda f: f.frame_id)
    cameras = sorted({f.camera for f in ordered}, key=repr)
    lens = np.array([cameras.index(f.camera) for f in ordered], np.int64)
    seen = _sightings(ordered, thumbs, params)
    if len(seen.frame) == 0:
        return ordered
    gains, falloff = _solve(seen, lens, len(cameras), params)
    return [
        replace_light(f, (g[0], g[1], g[2]), tuple(falloff[k]))
        for f, g, k in zip(ordered, gains.tolist(), lens, strict=True)
    ]


def fitted(
    new: Sequence[PosedFrame],
    known: Sequence[PosedFrame],
    thumbs: Mapping[str, Thumb],
    params: ExposureParams = DEFAULT,
) -> list[PosedFrame]:
    """The new frames by ascending id, with gains that suit the known ones, which keep theirs.

    `thumbs`: as for `balance`, of all of them. Every camera keeps its falloff.
    """
    ids = {f.frame_id for f in new}
    frames = sorted([*new, *(f for f in known if f.frame_id not in ids)], key=lambda f: f.frame_id)
    seen = _sightings(frames, thumbs, params)
    free = np.array([f.frame_id in ids for f in frames], bool)
    gains = _fit(seen, frames, free, params) if len(seen.frame) else np.ones((int(free.sum()), 3))
    lit = zip([f for f in frames if f.frame_id in ids], gains.tolist(), strict=True)
    return [replace(f, gain=(g[0], g[1], g[2])) for f, g in lit]


def replace_light(frame: PosedFrame, gain: Gain, falloff: tuple[float, ...]) -> PosedFrame:
    """The same frame with another gain and falloff."""
    return replace(frame, gain=gain, camera=replace(frame.camera, falloff=falloff))


def shrunk(thumb: Thumb, params: ExposureParams = DEFAULT) -> Thumb:
    """A thumbnail as its colours are compared; what was shrunk before stays as it is."""
    scale = params.side_px / max(thumb.shape[:2])
    size = (max(2, round(thumb.shape[1] * scale)), max(2, round(thumb.shape[0] * scale)))
    return np.asarray(cv2.resize(thumb, size, interpolation=cv2.INTER_AREA), np.uint8)


def light_apart(one: PosedFrame, other: PosedFrame) -> float:
    """By how much, at most, the logarithm of the light in which a frame is drawn is another in these two."""
    gain = np.abs(np.log(one.gain) - np.log(other.gain))
    lens = _by_channel(one.camera.falloff) - _by_channel(other.camera.falloff)
    edge = np.abs(lens[:, :3].sum(1)) + FLAT_RAY * np.hypot(lens[:, 3], lens[:, 4])
    return float((gain + edge).max())


def _sightings(
    frames: Sequence[PosedFrame], thumbs: Mapping[str, Thumb], params: ExposureParams
) -> Sightings:
    """Every frame's colours at the points of one world-wide square lattice that its footprint holds."""
    outlines = [f.pose.footprint(f.camera) for f in frames]
    size = [float(np.sqrt(np.prod(o.max(0) - o.min(0)))) for o in outlines]
    step = float(np.median(size)) / params.points_per_side if size else 1.0
    parts = [
        _sighting(k, f, o, thumbs[f.frame_id], step, params)
        for k, (f, o) in enumerate(zip(frames, outlines, strict=True))
    ]
    if not parts:
        nobody = np.zeros(0, np.int64)
        return Sightings(nobody, nobody, np.zeros((0, 3)), np.zeros((0, 3)), nobody)
    cells = np.concatenate([part[1] for part in parts])
    _, point, count = np.unique(cells, return_inverse=True, return_counts=True)
    order = np.argsort(point, kind="stable")
    order = order[count[point[order]] > 1]
    first = np.diff(point[order], prepend=-1) > 0
    frame, log, place = _in_order(parts, order)
    return Sightings(frame, np.cumsum(first) - 1, log, place, np.flatnonzero(first))


def _in_order(parts: list[_Part], order: Index) -> tuple[Index, Array, Array]:
    """Frame, log and place of the sightings in this order; each part goes as soon as it was copied."""
    rank = np.full(sum(len(part[0]) for part in parts), -1)
    rank[order] = np.arange(len(order))
    frame, log, place = np.empty(len(order), np.int64), np.empty((len(order), 3)), np.empty((len(order), 3))
    end = len(rank)
    while parts:
        frames, _, logs, places = parts.pop()
        to = rank[end - len(frames) : end]
        end, kept = end - len(frames), to >= 0
        frame[to[kept]], log[to[kept]], place[to[kept]] = frames[kept], logs[kept], places[kept]
    return frame, log, place


def _sighting(
    k: int, frame: PosedFrame, outline: Array, thumb: Thumb, step: float, params: ExposureParams
) -> _Part:
    camera, pose = frame.camera, frame.pose
    # A flat ray reaches for the horizon: so far away nothing is compared.
    reach = 3 * (abs(pose.center[2] - pose.ground_h_m) + step)
    low = np.floor(np.maximum(outline.min(0), pose.center[:2] - reach) / step).astype(np.int64)
    high = np.ceil(np.minimum(outline.max(0), pose.center[:2] + reach) / step).astype(np.int64)
    most = int(np.prod(high - low + 1))
    cells, colour, place = np.empty(most, np.int64), np.empty((most, 3)), np.empty((most, 3))
    found = _sight(
        np.concatenate((low, high)),
        step,
        np.ascontiguousarray(pose.world_R_cam, np.float64),
        np.array((*pose.center, pose.ground_h_m), np.float64),
        intrinsics(camera),
        shrunk(thumb, params),
        np.array((params.darkest, params.brightest)),
        cells,
        colour,
        place,
    )
    return np.full(found, k), cells[:found], log_light(colour[:found]), place[:found]


@compiled
def _sight(
    box: Index,
    step: float,
    world_R_cam: Array,
    center: Array,
    lens: Array,
    small: Thumb,
    trusted: Array,
    cells: Index,
    colour: Array,
    place: Array,
) -> int:
    """How many points of the lattice the picture shows in trusted colours; which, how, and where in it.

    `box`: from and to which column and row. `center`: of the camera, and the height of the ground.
    """
    height, width = small.shape[:2]
    count = 0
    for col in range(box[0], box[2] + 1):
        for row in range(box[1], box[3] + 1):
            u, v, cos_view = project(col * step, row * step, center[3], world_R_cam, center[:3], lens)
            x, y = (u + 0.5) / lens[6] * width - 0.5, (v + 0.5) / lens[7] * height - 0.5
            if cos_view <= 0 or not (0 < x < width - 1 and 0 < y < height - 1):
                continue
            x0, y0 = int(x), int(y)
            fx, fy = x - x0, y - y0
            good = True
            for c in range(3):
                upper = small[y0, x0, c] * (1 - fx) + small[y0, x0 + 1, c] * fx
                lower = small[y0 + 1, x0, c] * (1 - fx) + small[y0 + 1, x0 + 1, c] * fx
                colour[count, c] = upper * (1 - fy) + lower * fy
                good = good and trusted[0] < colour[count, c] < trusted[1]
            if good:
                cells[count] = (col << 32) + row
                away = (u - lens[1]) ** 2 + (v - lens[2]) ** 2
                place[count, 0] = 4 * away / (lens[6] * lens[6] + lens[7] * lens[7])
                dx, dy, dz = col * step - center[0], row * step - center[1], center[3] - center[2]
                away_m = math.sqrt(dx * dx + dy * dy + dz * dz)
                place[count, 1] = dx / away_m
                place[count, 2] = dy / away_m
                count += 1
    return count


def _solve(seen: Sightings, lens: Index, lenses: int, params: ExposureParams) -> tuple[Array, Array]:
    """Gains (N, 3) and falloffs (C, 15): log light = point − log gain + falloff."""
    n, terms = len(lens), seen.terms
    wide = terms.shape[1]
    prior = np.full(n + wide * lenses, params.falloff_sigma**-2)
    prior[:n] = params.gain_sigma**-2
    answer = reweighted(Sparse(seen.frame, n, lens[seen.frame], lenses, terms), seen, prior, params)
    by_channel = answer[n:].reshape(lenses, wide, 3).transpose(0, 2, 1)
    falloff = [np.concatenate((of[:, :3].ravel(), of[:, 3:].ravel())) for of in by_channel]
    # Rounded, so that a sum's last bits never show in a tile.
    return np.asarray(np.round(np.exp(answer[:n]), 5), float), np.round(falloff, 5)


def _by_channel(falloff: tuple[float, ...]) -> Array:
    """A camera's falloff as what `terms` are multiplied with, (3, 5)."""
    numbers = np.array([*falloff, *(0.0,) * (15 - len(falloff))])
    return np.column_stack((numbers[:9].reshape(3, 3), numbers[9:].reshape(3, 2)))


def _fit(
    seen: Sightings, frames: Sequence[PosedFrame], free: NDArray[np.bool_], params: ExposureParams
) -> Array:
    """The gains (n, 3) of the n free ones among the frames."""
    lenses = np.array([_by_channel(f.camera.falloff) for f in frames])
    gains = np.array([(1.0, 1.0, 1.0) if new else f.gain for f, new in zip(frames, free, strict=True)])
    known = np.log(gains)[seen.frame] - np.einsum("mct,mt->mc", lenses[seen.frame], seen.terms)
    gain, count = np.where(free, np.cumsum(free) - 1, -1)[seen.frame], int(free.sum())
    nobody = np.zeros(len(gain), np.int64)
    design = Dense(gain, count) if count <= FEW else Sparse(gain, count, nobody, 0, np.zeros((len(gain), 0)))
    even, prior = replace(seen, log=seen.log + known), np.full(count, params.gain_sigma**-2)
    return np.asarray(np.round(np.exp(reweighted(design, even, prior, params)), 5), float)
