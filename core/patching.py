"""Live drawing in parts: what a map does not show yet is drawn and laid beside what it shows.

While photos come in, redrawing all that each of them touches would draw every place many times over. Only
holes are filled; where a filled part meets what was drawn before, the two fade into each other. The final
map is never made of parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coverage import FUSION, Encoded, block_grid
from core.fusion import FrameIndex, FusionParams, Photos, render
from core.geometry import Array, PosedFrame, World
from core.grid import TILE_PX, MercatorGrid, TileKey
from core.pyramid import Rgba, encode

CELL_PX = 16
FADE_PX = 24
"""A part overlaps what is shown by so much, and fades into it."""
WORTH_A_CUT_PX = 24_000
"""Two parts instead of one must save so many pixels: each has its own price."""
MOST_CUTS, STEP_CELLS = 2, 4

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Patched:
    """`changed`: the tiles that look different now; `pixels`: how many were rendered for that."""

    changed: Mapping[TileKey, Encoded | None]
    pixels: int


@dataclass(frozen=True, slots=True)
class Part:
    """Pixels from (left, top) to (right, bottom), the latter not included."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def pixels(self) -> int:
        """How many it holds."""
        return (self.right - self.left) * (self.bottom - self.top)


def fill_block(
    shown: Mapping[TileKey, Rgba | None],
    world: World,
    frames: FrameIndex,
    photos: Photos,
    params: FusionParams = FUSION,
) -> Patched:
    """Draws what these neighbouring tiles of one zoom do not show yet. `shown`: their pictures so far."""
    grid = block_grid(list(shown))
    canvas = _canvas(grid, shown)
    near = frames.overlapping(grid, world)
    drawn = parts(holes(grid, world, near, canvas[..., 3], _wanted(grid, shown), params))
    for part in drawn:
        corner = grid.col0 + part.left, grid.row0 + part.top
        window = grid.window(*corner, part.right - part.left, part.bottom - part.top)
        fresh = render(window, world, frames.overlapping(window, world), photos, params)
        lay(canvas[part.top : part.bottom, part.left : part.right], fresh)
    return Patched(_touched(grid, canvas, shown, drawn), sum(part.pixels for part in drawn))


def holes(
    grid: MercatorGrid,
    world: World,
    frames: Iterable[PosedFrame],
    alpha: NDArray[np.uint8],
    wanted: Mask,
    params: FusionParams = FUSION,
) -> Mask:
    """Cells (H / 16, W / 16) among those `wanted` with something transparent that a photo surely shows.

    `alpha`: (H, W) of what is shown so far.
    """
    rows, cols = wanted.shape
    empty = np.asarray((alpha.reshape(rows, CELL_PX, cols, CELL_PX) == 0).any((1, 3)) & wanted)
    ys, xs = np.nonzero(empty)
    middle = (CELL_PX - 1) / 2
    lines = grid.columns(world, grid.col0 + xs * CELL_PX + middle, grid.row0 + ys * CELL_PX + middle)
    seen = np.zeros(len(xs), bool)
    for frame in frames if len(xs) else ():
        seen |= _sees(frame, lines.at(frame.pose.ground_h_m), CELL_PX * grid.resolution_m(world), params)
    found = np.zeros_like(empty)
    found[ys[seen], xs[seen]] = True
    return found


def _sees(frame: PosedFrame, ground: Array, cell_m: float, params: FusionParams) -> Mask:
    """Whether the frame shows all of the cell around each of these places (N, 2) of its ground plane."""
    camera, pose = frame.camera, frame.pose
    rays = np.column_stack((ground, np.full(len(ground), pose.ground_h_m))) - pose.center
    steep = -rays[:, 2] > np.hypot(rays[:, 0], rays[:, 1]) / math.tan(math.radians(params.max_view_deg))
    xyz_cam = rays @ pose.world_R_cam
    ahead = steep & (xyz_cam[:, 2] > 0)
    xyz_cam[~ahead] = (0.0, 0.0, 1.0)
    uv = camera.project(xyz_cam)
    margin = 1.5 * cell_m / abs(pose.gsd_m(camera))
    size = np.array([camera.width, camera.height])
    return np.asarray(ahead & ((uv >= margin) & (uv <= size - 1 - margin)).all(1))


def parts(empty: Mask, cuts: int = MOST_CUTS) -> list[Part]:
    """Few rectangles, with room to fade, that hold all these cells and not many others."""
    whole = _around(empty)
    if whole is None:
        return []
    best, cut = whole.pixels - WORTH_A_CUT_PX, None
    loose = int(empty.sum()) * CELL_PX**2 < best
    for axis in range(2 if cuts and loose else 0):
        for place in range(STEP_CELLS, empty.shape[axis], STEP_CELLS):
            halves = [_around(h) for h in _cut(empty, axis, place)]
            pixels = sum(h.pixels for h in halves if h is not None)
            if None not in halves and pixels < best:
                best, cut = pixels, (axis, place)
    if cut is None:
        return [whole]
    return [part for half in _cut(empty, *cut) for part in parts(half, cuts - 1)]


def _cut(cells: Mask, axis: int, place: int) -> tuple[Mask, Mask]:
    low, high = cells.copy(), cells.copy()
    np.moveaxis(low, axis, 0)[place:] = False
    np.moveaxis(high, axis, 0)[:place] = False
    return low, high


def _around(cells: Mask) -> Part | None:
    rows, cols = np.flatnonzero(cells.any(1)), np.flatnonzero(cells.any(0))
    if not len(rows):
        return None
    height, width = cells.shape[0] * CELL_PX, cells.shape[1] * CELL_PX
    return Part(
        max(int(cols[0]) * CELL_PX - FADE_PX, 0),
        max(int(rows[0]) * CELL_PX - FADE_PX, 0),
        min((int(cols[-1]) + 1) * CELL_PX + FADE_PX, width),
        min((int(rows[-1]) + 1) * CELL_PX + FADE_PX, height),
    )


def lay(shown: Rgba, fresh: Rgba) -> None:
    """Puts a fresh picture where nothing is shown, in place; it fades out over the `FADE_PX` beyond."""
    known = shown[..., 3] > 0
    if not known.any():
        shown[:] = fresh
        return
    far_px = cv2.distanceTransform(known.astype(np.uint8), cv2.DIST_L2, 3)
    share = np.where(fresh[..., 3] > 0, np.clip(far_px / FADE_PX, 0, 1), 1.0)[..., None]
    mixed = np.rint(share * shown[..., :3] + (1 - share) * fresh[..., :3])
    shown[..., :3] = np.where(known[..., None], mixed, fresh[..., :3]).astype(np.uint8)
    shown[..., 3] = np.maximum(shown[..., 3], fresh[..., 3])


def _canvas(grid: MercatorGrid, shown: Mapping[TileKey, Rgba | None]) -> Rgba:
    canvas = np.zeros((grid.height, grid.width, 4), np.uint8)
    for tile, picture in shown.items():
        if picture is not None:
            canvas[_place(grid, tile)] = picture
    return canvas


def _wanted(grid: MercatorGrid, tiles: Iterable[TileKey]) -> Mask:
    pixels = np.zeros((grid.height, grid.width), bool)
    for tile in tiles:
        pixels[_place(grid, tile)] = True
    return pixels[::CELL_PX, ::CELL_PX]


def _touched(
    grid: MercatorGrid, canvas: Rgba, shown: Iterable[TileKey], drawn: Sequence[Part]
) -> dict[TileKey, Encoded | None]:
    fresh = np.zeros(canvas.shape[:2], bool)
    for part in drawn:
        fresh[part.top : part.bottom, part.left : part.right] = True
    places = {tile: _place(grid, tile) for tile in shown}
    changed = [tile for tile, place in places.items() if fresh[place].any()]
    return {tile: encode(np.ascontiguousarray(canvas[places[tile]])) for tile in changed}


def _place(grid: MercatorGrid, tile: TileKey) -> tuple[slice, slice]:
    top, left = tile.y * TILE_PX - grid.row0, tile.x * TILE_PX - grid.col0
    return slice(top, top + TILE_PX), slice(left, left + TILE_PX)
