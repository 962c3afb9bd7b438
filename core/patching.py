"""Live drawing in parts: what a map does not show yet is drawn and laid beside what it shows.

While photos come in, redrawing all that each of them touches would draw every place many times over. Only
holes are filled; where a filled part meets what was drawn before, the two fade into each other. The final
map is never made of parts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from core.coverage import FUSION, Encoded, block_grid
from core.fusion import FrameIndex, FusionParams, Photos, render
from core.geometry import PosedFrame, World
from core.grid import TILE_PX, Columns, MercatorGrid, TileKey
from core.pyramid import Rgba, TileFormat, encode

CELL_PX = 16
FADE_PX = 16
"""What is drawn overlaps what is shown by so much, and fades into it."""

Mask = NDArray[np.bool_]

LIVE = replace(FUSION, seams=False)
"""Parts are on their way only: what they cut in two is whole again in the final map."""


@dataclass(frozen=True, slots=True)
class Patched:
    """`changed`: the tiles that look different now; `pixels`: how many were rendered for that."""

    changed: Mapping[TileKey, Encoded | None]
    pixels: int


def fill_block(
    shown: Mapping[TileKey, Rgba | None],
    world: World,
    frames: FrameIndex,
    photos: Photos,
    params: FusionParams = LIVE,
    tile_format: TileFormat = "jpeg",
) -> Patched:
    """Draws what these neighbouring tiles of one zoom do not show yet. `shown`: their pictures so far."""
    grid = block_grid(list(shown))
    canvas = _canvas(grid, shown)
    near = frames.overlapping(grid, world)
    wanted = _wanted(grid, shown)
    drawn = holes(grid, world, near, canvas[..., 3], wanted, params)
    if not drawn.any():
        return Patched({}, 0)
    # One cell more all round: there it fades, and there end the photos that surely show the hole.
    drawn = np.asarray(cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & wanted)
    _draw(canvas, grid, world, frames, photos, drawn, params)
    places = {tile: _place(grid, tile) for tile in shown}
    fresh = _pixels(drawn)
    changed = [tile for tile, place in places.items() if fresh[place].any()]
    encoded = {tile: encode(np.ascontiguousarray(canvas[places[tile]]), tile_format) for tile in changed}
    return Patched(encoded, int(drawn.sum()) * CELL_PX**2)


def _draw(
    canvas: Rgba,
    grid: MercatorGrid,
    world: World,
    frames: FrameIndex,
    photos: Photos,
    drawn: Mask,
    params: FusionParams,
) -> None:
    """Draws these cells onto the canvas, beside what it shows."""
    rows, cols = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    cells = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
    place = (
        slice(cells[0].start * CELL_PX, cells[0].stop * CELL_PX),
        slice(cells[1].start * CELL_PX, cells[1].stop * CELL_PX),
    )
    corner = grid.col0 + place[1].start, grid.row0 + place[0].start
    window = grid.window(*corner, place[1].stop - place[1].start, place[0].stop - place[0].start)
    fresh = render(window, world, frames.overlapping(window, world), photos, params, drawn[cells])
    fresh[~_pixels(drawn[cells])] = 0
    lay(canvas[place], fresh)


def cells_of(grid: MercatorGrid, world: World) -> Columns:
    """The plumb lines through the middles of a raster's cells, row by row."""
    middle = (CELL_PX - 1) / 2
    cols = grid.col0 + np.arange(0, grid.width, CELL_PX) + middle
    rows = grid.row0 + np.arange(0, grid.height, CELL_PX) + middle
    return grid.crossings(world, cols, rows)


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
    places = np.flatnonzero(empty)
    foot, slope = cells_of(grid, world)
    lines = Columns(foot[places], slope[places])
    seen = np.zeros(len(places), bool)
    for frame in frames if len(places) else ():
        seen |= surely_shows(frame, lines, grid.resolution_m(world), params)
    found = np.zeros_like(empty)
    found.flat[places[seen]] = True
    return found


def surely_shows(
    frame: PosedFrame, cells: Columns, resolution_m: float, params: FusionParams = FUSION
) -> Mask:
    """Whether the frame shows all of each of these cells (N,), given by the lines through their middles."""
    camera, pose = frame.camera, frame.pose
    ground = cells.at(pose.ground_h_m)
    rays = np.column_stack((ground, np.full(len(ground), pose.ground_h_m))) - pose.center
    steep = -rays[:, 2] > np.hypot(rays[:, 0], rays[:, 1]) / math.tan(math.radians(params.max_view_deg))
    xyz_cam = rays @ pose.world_R_cam
    ahead = steep & (xyz_cam[:, 2] > 0)
    xyz_cam[~ahead] = (0.0, 0.0, 1.0)
    uv = camera.project(xyz_cam)
    margin = 1.5 * CELL_PX * resolution_m / abs(pose.gsd_m(camera))
    size = np.array([camera.width, camera.height])
    return np.asarray(ahead & ((uv >= margin) & (uv <= size - 1 - margin)).all(1))


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


def _pixels(cells: Mask) -> Mask:
    return np.asarray(np.kron(cells, np.ones((CELL_PX, CELL_PX), bool)))


def _place(grid: MercatorGrid, tile: TileKey) -> tuple[slice, slice]:
    top, left = tile.y * TILE_PX - grid.row0, tile.x * TILE_PX - grid.col0
    return slice(top, top + TILE_PX), slice(left, left + TILE_PX)
