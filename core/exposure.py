"""Exposure, white balance and vignetting, balanced over the overlaps of the frames.

Where two photos see the same ground, the logarithms of their light (`core.tone`) may differ only by their
gains and by their lens's falloff. Robust least squares over ground points, whose brightness is eliminated;
gains are held near 1, so that the map as a whole gets neither brighter nor darker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from core.geometry import Array, PosedFrame, World
from core.tone import Gain, log_light

Thumb = NDArray[np.uint8]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ExposureParams:
    """How exposure is balanced.

    `side_px`: photos are shrunk to this before their colours are compared; `points_per_side`: ground points
    across a median footprint. `darkest`, `brightest`: grey levels between which a colour is trusted. In
    logarithms: `noise` of one comparison; `outlier` beyond which it fades in the end, `doubt` at first, when
    nobody's gain is known; the `gain_sigma` around 1 and the `falloff_sigma` around a perfect lens.
    """

    side_px: int = 32
    points_per_side: int = 16
    darkest: float = 6.0
    brightest: float = 248.0
    noise: float = 0.25
    outlier: float = 0.3
    doubt: float = 1.0
    gain_sigma: float = 0.5
    falloff_sigma: float = 0.3
    iterations: int = 8


DEFAULT = ExposureParams()


@dataclass(frozen=True, slots=True)
class _Sightings:
    """Who saw which point in what colour. `frame`, `point`: (M,) int64; `log`: (M, 3); `rho2`: (M,)."""

    frame: Index
    point: Index
    log: Array
    rho2: Array


def balance(
    frames: Sequence[PosedFrame], world: World, thumbs: Mapping[str, Thumb], params: ExposureParams = DEFAULT
) -> Mapping[str, Gain]:
    """What each frame's channels (R, G, B) are to be multiplied with, by frame id; gains given are ignored.

    `thumbs`: whole photos at about 128 px, (h, w, 3 or more) uint8, RGB first. The frames' order does
    not matter.
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


def replace_light(frame: PosedFrame, gain: Gain, falloff: tuple[float, ...]) -> PosedFrame:
    """The same frame with another gain and falloff."""
    return replace(frame, gain=gain, camera=replace(frame.camera, falloff=falloff))


def _sightings(
    frames: Sequence[PosedFrame], thumbs: Mapping[str, Thumb], params: ExposureParams
) -> _Sightings:
    """Every frame's colours at the points of one world-wide square lattice that its footprint holds."""
    outlines = [f.pose.footprint(f.camera) for f in frames]
    size = [float(np.sqrt(np.prod(o.max(0) - o.min(0)))) for o in outlines]
    step = float(np.median(size)) / params.points_per_side if size else 1.0
    parts = [
        _sighting(k, f, o, thumbs[f.frame_id], step, params)
        for k, (f, o) in enumerate(zip(frames, outlines, strict=True))
    ]
    if not parts:
        return _Sightings(*(np.zeros(0, np.int64),) * 2, np.zeros((0, 3)), np.zeros(0))
    frame, cells, log, rho2 = (np.concatenate(column) for column in zip(*parts, strict=True))
    _, point, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    shared = count[point] > 1
    point = np.unique(point[shared], return_inverse=True)[1]
    return _Sightings(frame[shared], point, log[shared], rho2[shared])


def _sighting(
    k: int, frame: PosedFrame, outline: Array, thumb: Thumb, step: float, params: ExposureParams
) -> tuple[Index, Index, Array, Array]:
    camera, pose = frame.camera, frame.pose
    # A flat ray reaches for the horizon: so far away nothing is compared.
    reach = 3 * (abs(pose.center[2] - pose.ground_h_m) + step)
    low = np.floor(np.maximum(outline.min(0), pose.center[:2] - reach) / step).astype(np.int64)
    high = np.ceil(np.minimum(outline.max(0), pose.center[:2] + reach) / step).astype(np.int64)
    cols, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    cells = np.column_stack((cols.ravel(), rows.ravel()))
    ground = np.column_stack((cells * step, np.full(len(cells), pose.ground_h_m)))
    ahead = (ground - pose.center) @ pose.world_R_cam[:, 2] > 0
    cells, ground = cells[ahead], ground[ahead]
    uv = pose.pixels(camera, ground)
    share = (uv + 0.5) / (camera.width, camera.height)
    scale = params.side_px / max(thumb.shape[:2])
    size = (max(2, round(thumb.shape[1] * scale)), max(2, round(thumb.shape[0] * scale)))
    small = cv2.resize(thumb[..., :3], size, interpolation=cv2.INTER_AREA).astype(np.float64)
    inside = ((share > 0.5 / np.array(size)) & (share < 1 - 0.5 / np.array(size))).all(1)
    colour = _bilinear(small, share[inside] * size - 0.5)
    good = ((colour > params.darkest) & (colour < params.brightest)).all(1)
    away = (uv[inside][good] - (camera.cx, camera.cy)) ** 2
    rho2 = 4 * away.sum(1) / (camera.width**2 + camera.height**2)
    return np.full(int(good.sum()), k), cells[inside][good], log_light(colour[good]), rho2


def _bilinear(image: Array, xy: Array) -> Array:
    corner = np.clip(np.floor(xy).astype(int), 0, (image.shape[1] - 2, image.shape[0] - 2))
    fx, fy = (xy - corner).T[..., None]
    x, y = corner.T
    upper = image[y, x] * (1 - fx) + image[y, x + 1] * fx
    lower = image[y + 1, x] * (1 - fx) + image[y + 1, x + 1] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


def _solve(seen: _Sightings, lens: Index, lenses: int, params: ExposureParams) -> tuple[Array, Array]:
    """Gains (N, 3) and falloffs (C, 9): log light = point − log gain + falloff, iteratively reweighted."""
    n, m = len(lens), len(seen.frame)
    powers = np.column_stack((seen.rho2, seen.rho2**2, seen.rho2**3))
    at = n + 3 * lens[seen.frame]
    cols = np.column_stack((seen.frame, at, at + 1, at + 2))
    values = np.column_stack((-np.ones(m), powers))
    rows = np.repeat(np.arange(m), 4)
    design = sparse.csr_matrix((values.ravel(), (rows, cols.ravel())), shape=(m, n + 3 * lenses))
    points = sparse.csr_matrix((np.ones(m), (np.arange(m), seen.point)))
    prior = np.full(n + 3 * lenses, params.falloff_sigma**-2)
    prior[:n] = params.gain_sigma**-2
    answer, weight = np.zeros((n + 3 * lenses, 3)), np.ones(m)
    for turn in range(params.iterations):
        answer = _least_squares(design, points, weight / params.noise**2, seen.log, prior)
        left = seen.log - design @ answer
        mean = (points.T @ (weight[:, None] * left)) / (points.T @ weight)[:, None]
        off = ((left - mean[seen.point]) ** 2).mean(1)
        scale = max(params.outlier, params.doubt / 2**turn)
        weight = 1 / (1 + off / scale**2) ** 2
    falloff = answer[n:].reshape(lenses, 3, 3).transpose(0, 2, 1).reshape(lenses, 9)
    # Rounded, so that a sum's last bits never show in a tile.
    return np.asarray(np.round(np.exp(answer[:n]), 5), float), np.round(falloff, 5)


def _least_squares(
    design: sparse.csr_matrix, points: sparse.csr_matrix, weight: Array, log: Array, prior: Array
) -> Array:
    """Weighted least squares with one free brightness per point and channel, eliminated beforehand."""
    weighted = sparse.diags(weight) @ design
    share = (points.T @ weighted).tocsr()
    inverse = sparse.diags(1 / (points.T @ weight))
    normal = (design.T @ weighted - share.T @ inverse @ share + sparse.diags(prior)).tocsc()
    right = weighted.T @ log - share.T @ (inverse @ (points.T @ (weight[:, None] * log)))
    # Symmetric positive definite: no pivoting, or SuperLU takes forty times as long.
    factor = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(right))
