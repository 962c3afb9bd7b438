"""From the coarse lattice of a raster to the pixels of a photo.

A lattice has one knot at the centre of each square cell of `cell_px` pixels, at absolute places of the
raster's pixel plane. Frames are projected exactly, distortion included, at knots only; between knots the map
is bilinear and exact, so that a pixel's value does not depend on the window that it is computed in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.geometry import Camera, PosedFrame, World
from core.grid import Columns, Grid
from core.tone import Gain, curves, lit, show

Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Rgb = NDArray[np.uint8]

KNOT_BITS = 8
"""Knots hold photo coordinates in 1/256 px."""
INSIDE = 256
"""A knot's weight from here on means that it lies inside of the photo; below, that it is near it."""
FULL = 65535
"""The weight of a photo's centre seen straight down."""
STRIP_PX = 32
"""So many rows are drawn at a time: their maps stay near the processor, and little is drawn in vain."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """`rows` × `cols` knots; cell (0, 0) begins at absolute pixel (col0, row0), a multiple of `cell_px`."""

    col0: int
    row0: int
    cols: int
    rows: int
    cell_px: int
    columns: Columns

    def inner(self, rim: int) -> Lattice:
        """The same without the `rim` outermost knots on each side."""
        part = np.s_[rim : self.rows - rim, rim : self.cols - rim]
        foot, slope = (v.reshape(self.rows, self.cols, 2)[part].reshape(-1, 2) for v in self.columns)
        shift = rim * self.cell_px
        return Lattice(
            self.col0 + shift,
            self.row0 + shift,
            self.cols - 2 * rim,
            self.rows - 2 * rim,
            self.cell_px,
            Columns(np.ascontiguousarray(foot), np.ascontiguousarray(slope)),
        )

    @classmethod
    def covering(cls, grid: Grid, world: World, cell_px: int, pad: int) -> Lattice:
        """The knots of every cell that the grid touches, and of `pad` cells more on each side."""
        left, top = grid.col0 // cell_px - pad, grid.row0 // cell_px - pad
        cols = -(-(grid.col0 + grid.width) // cell_px) + pad - left
        rows = -(-(grid.row0 + grid.height) // cell_px) + pad - top
        centre = (cell_px - 1) / 2
        x = (left + np.arange(cols)) * float(cell_px) + centre
        y = (top + np.arange(rows)) * float(cell_px) + centre
        columns = grid.crossings(world, x, y)
        return cls(left * cell_px, top * cell_px, cols, rows, cell_px, columns)


class Views(NamedTuple):
    """Frames seen from the lattice, (frames, rows, cols); `own`, `even`, `detail` of its inner knots only.

    `weight`: int32, 0 where the frame has no say, `INSIDE` … `FULL` inside of its photo. `spot`: (…, 3) int16
    in 1/16 grey levels: how the colours of the smallest things that a knot can tell depart from
    a much coarser mean. `own`: the photo's local mean colour. `even`: the same without its camera's falloff.
    `detail`: how `own` departs from that much coarser mean. `sharp`: uint8, `core.sharpness`, 0 = unknown.
    """

    weight: Int32
    sharp: Rgb
    spot: Int16
    own: Int16
    even: Int16
    detail: Int16

    @classmethod
    def empty(cls, frames: int, lattice: Lattice, rim: int) -> Views:
        """Nobody sees anything yet; the `rim` outer knots on each side of the lattice are not inner ones."""
        wide, inner = (
            (frames, lattice.rows, lattice.cols),
            (frames, lattice.rows - 2 * rim, lattice.cols - 2 * rim),
        )
        return cls(
            np.zeros(wide, np.int32),
            np.zeros(wide, np.uint8),
            # Where a frame has no say, nobody asks what it sees.
            np.empty((*wide, 3), np.int16),
            *(np.empty((*inner, 3), np.int16) for _ in range(3)),
        )

    def first(self, frames: int) -> Views:
        """What the first so many frames see."""
        weight, sharp, spot, own, even, detail = self
        part = np.s_[:frames]
        return Views(weight[part], sharp[part], spot[part], own[part], even[part], detail[part])


@lru_cache(maxsize=256)
def intrinsics(camera: Camera) -> NDArray[np.float64]:
    """What the kernels need: f, cx, cy, k1, k2, the largest useful radius², width, height (float64)."""
    corner = max(math.hypot(*ray) for ray in camera.rays(camera.corners())[:, :2])
    # Beyond the corners a polynomial may fold back into the picture: the factor is frozen from there on.
    return np.array(
        [
            camera.f_px,
            camera.cx,
            camera.cy,
            camera.k1,
            camera.k2,
            (1.02 * corner) ** 2,
            camera.width,
            camera.height,
        ]
    )


def look(
    lattice: Lattice,
    frame: PosedFrame,
    tones: tuple[Rgb, Rgb, Rgb],
    importance: float,
    min_cos_view: float,
    skirt_px: float,
    views: Views,
    k: int,
) -> bool:
    """Weights and tones of one frame at all knots, into the k-th of `views`; whether it has a say at any.

    `tones`: the photo shrunk, (h, w, 3) uint8 or with its sharpness (h, w, 4), to a few pixels, and to fewer
    still. `importance`: 0 … 1, multiplies the weight. `skirt_px`: how far beyond the photo's edge weights
    fade out, in its own pixels.
    """
    pose = frame.pose
    return _look(
        lattice.columns.foot,
        lattice.columns.slope,
        np.ascontiguousarray(pose.world_R_cam, np.float64),
        np.asarray(pose.center, np.float64),
        float(pose.ground_h_m),
        intrinsics(frame.camera),
        *tones,
        np.array([*frame.camera.falloff, *(0.0,) * (15 - len(frame.camera.falloff))]),
        np.array([importance, min_cos_view, skirt_px, _reach_m(frame, skirt_px)]),
        *(column[k] for column in views),
    )


def _reach_m(frame: PosedFrame, skirt_px: float) -> float:
    """No ground farther than this from the point under the camera is in the picture or its skirt."""
    height_m = abs(frame.pose.center[2] - frame.pose.ground_h_m)
    spread = math.sqrt(intrinsics(frame.camera)[5]) + 2 * skirt_px / frame.camera.f_px
    angle = math.acos(min(max(-frame.pose.world_R_cam[2, 2], -1.0), 1.0)) + math.atan(spread)
    return height_m * math.tan(angle) if angle < math.radians(85) else math.inf


def knots(
    lattice: Lattice, frame: PosedFrame, camera: Camera, min_cos_view: float, box: tuple[int, int, int, int]
) -> Int32:
    """Where the knots fall in the photo: x, y in 1/256 px of `camera`'s size.

    `box`: the first row and column and how many (r, c); one knot more all round is given, (r + 2, c + 2, 2)
    int32. At the lattice's own edge the last knot is repeated.
    """
    top, left, rows, cols = box
    out = np.empty((rows + 2, cols + 2, 2), np.int32)
    pose = frame.pose
    _knots(
        lattice.columns.foot.reshape(lattice.rows, lattice.cols, 2),
        lattice.columns.slope.reshape(lattice.rows, lattice.cols, 2),
        np.ascontiguousarray(pose.world_R_cam, np.float64),
        np.asarray(pose.center, np.float64),
        float(pose.ground_h_m),
        intrinsics(camera),
        min_cos_view,
        top - 1,
        left - 1,
        out,
    )
    return out


def warp(
    photo: Rgb, lattice_knots: Int32, needed: NDArray[np.bool_], cell_px: int, cubic: bool, gain: Gain
) -> Rgb:
    """A photo, its light multiplied by `gain`, drawn onto the cells of a lattice.

    `lattice_knots`: (r + 2, c + 2, 2), with one knot around the (r, c) cells `needed`. Returns (r · cell_px,
    c · cell_px, 3) uint8; cells not needed may hold anything.
    """
    rows, cols = needed.shape
    out = np.empty((rows * cell_px, cols * cell_px, 3), np.uint8)
    method = cv2.INTER_CUBIC if cubic else cv2.INTER_LINEAR
    step = max(1, STRIP_PX // cell_px)
    for top in range(0, rows, step):
        bottom = min(top + step, rows)
        wanted = np.flatnonzero(needed[top:bottom].any(0))
        if len(wanted) == 0:
            continue
        left, right = int(wanted[0]), int(wanted[-1]) + 1
        shape = ((bottom - top) * cell_px, (right - left) * cell_px)
        xy, fraction = np.empty(shape, "<i4"), np.empty(shape, np.uint16)
        around = np.ascontiguousarray(lattice_knots[top : bottom + 2, left : right + 2])
        _fine_maps(around, cell_px, xy, fraction)
        view = out[top * cell_px : bottom * cell_px, left * cell_px : right * cell_px]
        places = xy.view(np.int16).reshape(*shape, 2)
        seen = cv2.remap(photo, places, fraction, method, borderMode=cv2.BORDER_REFLECT)
        show(np.asarray(seen, np.uint8), curves(gain), view)
    return out


@compiled
def project(
    x: float,
    y: float,
    h_m: float,
    world_R_cam: NDArray[np.float64],
    center: NDArray[np.float64],
    lens: NDArray[np.float64],
) -> tuple[float, float, float]:
    """A ground point → its pixel and the cosine of the view angle (≤ 0 behind the camera)."""
    dx, dy, dz = x - center[0], y - center[1], h_m - center[2]
    a = world_R_cam[0, 0] * dx + world_R_cam[1, 0] * dy + world_R_cam[2, 0] * dz
    b = world_R_cam[0, 1] * dx + world_R_cam[1, 1] * dy + world_R_cam[2, 1] * dz
    c = world_R_cam[0, 2] * dx + world_R_cam[1, 2] * dy + world_R_cam[2, 2] * dz
    if c <= 1e-6:
        return 0.0, 0.0, -1.0
    cos_view = -dz / math.sqrt(dx * dx + dy * dy + dz * dz)
    a, b = a / c, b / c
    r2 = min(a * a + b * b, lens[5])
    stretch = (1 + lens[3] * r2 + lens[4] * r2 * r2) * lens[0]
    return a * stretch + lens[1], b * stretch + lens[2], cos_view


@compiled
def _knots(
    foot: NDArray[np.float64],
    slope: NDArray[np.float64],
    world_R_cam: NDArray[np.float64],
    center: NDArray[np.float64],
    h_m: float,
    lens: NDArray[np.float64],
    min_cos_view: float,
    top: int,
    left: int,
    out: Int32,
) -> None:
    limit_x, limit_y = min(2 * lens[6], 32000.0), min(2 * lens[7], 32000.0)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            j, i = min(max(top + y, 0), foot.shape[0] - 1), min(max(left + x, 0), foot.shape[1] - 1)
            east, north = foot[j, i, 0] + slope[j, i, 0] * h_m, foot[j, i, 1] + slope[j, i, 1] * h_m
            u, v, cos_view = project(east, north, h_m, world_R_cam, center, lens)
            if cos_view < min_cos_view:
                u, v = -lens[6], -lens[7]
            out[y, x, 0] = math.floor(min(max(u, -lens[6]), limit_x) * 256 + 0.5)
            out[y, x, 1] = math.floor(min(max(v, -lens[7]), limit_y) * 256 + 0.5)


@compiled
def _sample(image: Rgb, right: float, down: float, out: NDArray[np.int64]) -> None:
    """Bilinear at shares (0 … 1) of the picture's width and height; in 1/16 grey levels."""
    x = min(max(right * image.shape[1] - 0.5, 0.0), image.shape[1] - 1.0)
    y = min(max(down * image.shape[0] - 0.5, 0.0), image.shape[0] - 1.0)
    x0, y0 = min(int(x), image.shape[1] - 2), min(int(y), image.shape[0] - 2)
    fx, fy = int((x - x0) * 256 + 0.5), int((y - y0) * 256 + 0.5)
    for c in range(3):
        upper = int(image[y0, x0, c]) * (256 - fx) + int(image[y0, x0 + 1, c]) * fx
        lower = int(image[y0 + 1, x0, c]) * (256 - fx) + int(image[y0 + 1, x0 + 1, c]) * fx
        out[c] = (upper * (256 - fy) + lower * fy + (1 << 11)) >> 12


@compiled
def weight_at(
    u: float, v: float, cos_view: float, width: float, height: float, importance: float, skirt_px: float
) -> int:
    """The weight of a photo at one of its pixels, negative beyond its skirt."""
    beyond = max(max(-u, u - (width - 1)), max(-v, v - (height - 1)))
    if beyond > 0:
        # The flatter a ray, the more ground a pixel covers: this way no skirt is wider on the ground.
        beyond /= cos_view * cos_view
        return int((INSIDE - 1) * (1 - beyond / skirt_px)) if beyond < skirt_px else -1
    across, along = 2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1
    share = (1 - across * across) * (1 - along * along) * cos_view * cos_view * cos_view * cos_view
    return INSIDE + int((FULL - INSIDE) * importance * share)


@compiled
def _look(
    foot: NDArray[np.float64],
    slope: NDArray[np.float64],
    world_R_cam: NDArray[np.float64],
    center: NDArray[np.float64],
    h_m: float,
    lens: NDArray[np.float64],
    thumb: Rgb,
    fine: Rgb,
    coarse: Rgb,
    falloff: NDArray[np.float64],
    limits: NDArray[np.float64],
    weight: Int32,
    sharp: Rgb,
    spot: Int16,
    own: Int16,
    light: Int16,
    detail: Int16,
) -> bool:
    importance, min_cos_view, skirt_px, reach_m = limits
    width, height = lens[6], lens[7]
    bare = not falloff.any()
    cols, rim = weight.shape[1], (weight.shape[1] - own.shape[1]) // 2
    seen = False
    least, value, around = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for k in range(foot.shape[0]):
        x, y = foot[k, 0] + slope[k, 0] * h_m, foot[k, 1] + slope[k, 1] * h_m
        if (x - center[0]) ** 2 + (y - center[1]) ** 2 > reach_m * reach_m:
            continue
        u, v, cos_view = project(x, y, h_m, world_R_cam, center, lens)
        if cos_view < min_cos_view:
            continue
        w = weight_at(u, v, cos_view, width, height, importance, skirt_px)
        if w < 0:
            continue
        j, i = k // cols, k % cols
        weight[j, i], seen = w, True
        right, down = (u + 0.5) / width, (v + 0.5) / height
        if thumb.shape[2] > 3 and w >= INSIDE:
            sharp[j, i] = thumb[int(down * thumb.shape[0]), int(right * thumb.shape[1]), 3]
        _sample(thumb, right, down, least)
        _sample(coarse, right, down, around)
        for c in range(3):
            spot[j, i, c] = least[c] - around[c]
        j, i = j - rim, i - rim
        if min(j, i) < 0 or j >= own.shape[0] or i >= own.shape[1]:
            continue
        _sample(fine, right, down, value)
        rho2 = 4 * ((u - lens[1]) ** 2 + (v - lens[2]) ** 2) / (width * width + height * height)
        away_m = math.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2 + (h_m - center[2]) ** 2)
        east, north = (x - center[0]) / away_m, (y - center[1]) / away_m
        for c in range(3):
            own[j, i, c] = light[j, i, c] = value[c]
            detail[j, i, c] = value[c] - around[c]
            if not bare:
                dim = rho2 * (falloff[3 * c] + rho2 * (falloff[3 * c + 1] + rho2 * falloff[3 * c + 2]))
                dim += falloff[9 + 2 * c] * east + falloff[10 + 2 * c] * north
                light[j, i, c] = math.floor(16 * lit(value[c] / 16, math.exp(-dim)) + 0.5)
    return seen


@compiled
def _fine_maps(lattice_knots: Int32, cell_px: int, xy: Int32, fraction: NDArray[np.uint16]) -> None:
    """Bilinear between knots, as cv2.remap wants it: x in a word's lower half, y in its upper, and the
    5 bits behind the point of both in `fraction`.

    In float64, where every product and sum of these small integers is exact and vectors are fast.
    """
    half, cols = cell_px // 2, lattice_knots.shape[1]
    row = np.empty((2, cols), np.float64)
    line = np.empty((2, cols * cell_px), np.int32)
    ramp = (2.0 * np.arange(cell_px) + 1.0) / (2 * cell_px)
    unit = 1.0 / (1 << (KNOT_BITS - 5))
    for y in range(xy.shape[0]):
        k = (y + half) // cell_px
        part = ramp[y + half - k * cell_px]
        for axis in range(2):
            for j in range(cols):
                upper, lower = float(lattice_knots[k, j, axis]), float(lattice_knots[k + 1, j, axis])
                row[axis, j] = (upper + (lower - upper) * part) * unit + 0.5
            for j in range(cols - 1):
                start, slope = row[axis, j], row[axis, j + 1] - row[axis, j]
                cell = line[axis, j * cell_px : (j + 1) * cell_px]
                for i in range(cell_px):
                    cell[i] = np.int32(math.floor(start + slope * ramp[i]))
        along, down = line[0, half : half + xy.shape[1]], line[1, half : half + xy.shape[1]]
        places, parts = xy[y], fraction[y]
        for x in range(len(along)):
            places[x] = ((down[x] >> 5) << 16) | ((along[x] >> 5) & 0xFFFF)
            parts[x] = ((down[x] & 31) << 5) | (along[x] & 31)
