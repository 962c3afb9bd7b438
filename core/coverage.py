"""Which tiles a posed frame is drawn on, how fine the map's tiles are, and how far up its pyramid goes."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from core.fusion import FrameIndex, FusionParams, Photos, render
from core.geometry import Array, PosedFrame, World
from core.grid import (
    TILE_PX,
    MercatorGrid,
    TileKey,
    ancestors,
    children,
    native_zoom,
    tiles_of,
    zoom_resolution_m,
)
from core.outline import ground_outline
from core.pyramid import Rgba, TileFormat, decode, encode, halve

FUSION = FusionParams()
USUAL_SIDE_PX, MOST_BANDS = 1600, 6
"""Photos drawn about so large suit `FUSION`; with more bands than that, blocks would be mostly margin."""
SPARE_ZOOMS = 2
"""The pyramid goes on so far above the zoom at which one tile shows the whole mission."""

Encoded = tuple[bytes, str]


def typical_side(frames: Iterable[PosedFrame]) -> int | None:
    """The longest side, in pixels, of a typical photo: the median over the frames; None without any."""
    sides = [max(f.camera.width, f.camera.height) for f in frames]
    return int(np.median(sides)) if sides else None


def fusion_of(photo_side: int | None, max_side: int | None) -> FusionParams:
    """How photos of that longest side, drawn at `max_side` pixels at most, are put together.

    A band more whenever they are twice as large: so cells cover about the same share of a photo, and
    seams and tones run alike over the ground, whatever the resolution (Zhao 2020, 3.4).
    """
    drawn_px = min(photo_side or USUAL_SIDE_PX, max_side or photo_side or USUAL_SIDE_PX)
    more = max(0, round(math.log2(drawn_px / USUAL_SIDE_PX)))
    return replace(FUSION, bands=min(FUSION.bands + more, MOST_BANDS))


def shown_gsd_m(frame: PosedFrame, max_side: int | None) -> float:
    """Ground metres per pixel of the frame's photo at the mission's resolution."""
    long_side = max(frame.camera.width, frame.camera.height)
    return frame.pose.gsd_m(frame.camera) * long_side / min(long_side, max_side or long_side)


def mission_gsd_m(frames: Iterable[PosedFrame], max_side: int | None) -> float | None:
    """The median over the frames that show ground, None when none does."""
    found = [shown_gsd_m(f, max_side) for f in frames if ground_outline(f) is not None]
    return float(np.median(found)) if found else None


def mission_zoom(
    frames: Iterable[PosedFrame], world: World, max_side: int | None, zoom_now: int | None = None
) -> int | None:
    """The zoom of the native tiles, None when no frame shows ground.

    `zoom_now` is kept while it is nearly right: another zoom means that every tile is drawn anew.
    """
    gsd_m = mission_gsd_m(frames, max_side)
    if gsd_m is None:
        return zoom_now
    if zoom_now is not None and 0.55 < zoom_resolution_m(zoom_now, world.lat_deg) / gsd_m < 1.5:
        return zoom_now
    return native_zoom(gsd_m, world.lat_deg)


def tiles_under(frame: PosedFrame, world: World, zoom: int, params: FusionParams = FUSION) -> set[TileKey]:
    """Every tile of that zoom of which the frame may change a pixel."""
    outline = ground_outline(frame)
    if outline is None:
        return set()
    return tiles_of(world, outline, frame.pose.ground_h_m, zoom, params.touch_px)


def outline_px(frame: PosedFrame, world: World, zoom: int) -> Array | None:
    """The frame's outline (4, 2) in the pixels of that zoom, None when it shows no ground."""
    outline = ground_outline(frame)
    if outline is None:
        return None
    grid = MercatorGrid(zoom, 0, 0, 0, 0)
    return np.column_stack(grid.from_world(world, outline, frame.pose.ground_h_m))


def blocks(tiles: Iterable[TileKey], side: int = 2) -> list[list[TileKey]]:
    """The tiles in groups that share one square of `side` × `side` tiles, in a fixed order."""
    groups: dict[tuple[int, int, int], list[TileKey]] = {}
    for tile in sorted(set(tiles)):
        groups.setdefault((tile.z, tile.x // side, tile.y // side), []).append(tile)
    return [groups[key] for key in sorted(groups)]


def block_grid(tiles: Sequence[TileKey]) -> MercatorGrid:
    """The smallest raster that holds these tiles of one zoom."""
    xs, ys = [t.x for t in tiles], [t.y for t in tiles]
    width, height = max(xs) - min(xs) + 1, max(ys) - min(ys) + 1
    return MercatorGrid(tiles[0].z, min(xs) * TILE_PX, min(ys) * TILE_PX, width * TILE_PX, height * TILE_PX)


def pass_pixels(tiles: Iterable[TileKey]) -> int:
    """How many pixels drawing all these tiles once takes."""
    grids = [block_grid(block) for block in blocks(tiles)]
    return sum(grid.width * grid.height for grid in grids)


def draw_block(
    tiles: Sequence[TileKey],
    world: World,
    frames: Sequence[PosedFrame] | FrameIndex,
    photos: Photos,
    params: FusionParams = FUSION,
    tile_format: TileFormat = "jpeg",
) -> dict[TileKey, Encoded | None]:
    """The tiles' encoded pictures, drawn together; None for those on which nothing is known."""
    grid = block_grid(tiles)
    near = frames.overlapping(grid, world) if isinstance(frames, FrameIndex) else frames
    picture = render(grid, world, near, photos, params)
    drawn: dict[TileKey, Encoded | None] = {}
    for tile in tiles:
        top, left = tile.y * TILE_PX - grid.row0, tile.x * TILE_PX - grid.col0
        pixels = np.ascontiguousarray(picture[top : top + TILE_PX, left : left + TILE_PX])
        drawn[tile] = encode(pixels, tile_format)
    return drawn


def top_zoom(tiles: Collection[TileKey]) -> int:
    """The zoom of the pyramid's uppermost tiles over these native ones (of one zoom, at least one)."""
    zoom = next(iter(tiles)).z
    xs, ys = [t.x for t in tiles], [t.y for t in tiles]
    spread = max(min(xs) ^ max(xs), min(ys) ^ max(ys))
    return max(0, zoom - spread.bit_length() - SPARE_ZOOMS)


def quarter(data: bytes) -> Rgba:
    """A tile's share of its parent: its encoded picture at half the size, (256, 256, 4) uint8."""
    return halve(decode(data))


def overview(quarters: Sequence[Rgba | None], tile_format: TileFormat = "jpeg") -> Encoded | None:
    """An overview's encoded picture from its children's quarters (NW, NE, SW, SE; None = nothing known).

    The same as `core.pyramid.reduce` of the children, but children that did not change need no work.
    """
    if all(q is None for q in quarters):
        return None
    canvas = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
    for k, picture in enumerate(quarters):
        if picture is not None:
            row, col = divmod(k, 2)
            canvas[row * TILE_PX // 2 :, col * TILE_PX // 2 :][: TILE_PX // 2, : TILE_PX // 2] = picture
    return encode(canvas, tile_format)


def pyramid(natives: Mapping[TileKey, bytes], tile_format: TileFormat = "jpeg") -> dict[TileKey, bytes]:
    """All overviews of native tiles (of one zoom), from their encoded pictures."""
    tiles = dict(natives)
    if not tiles:
        return {}
    above: dict[TileKey, bytes] = {}
    for tile in ancestors(tiles, top_zoom(tiles)):
        quarters = [quarter(tiles[c]) if c in tiles else None for c in children(tile)]
        encoded = overview(quarters, tile_format)
        if encoded is not None:
            tiles[tile] = above[tile] = encoded[0]
    return above


def moved_px(before: Array | None, after: Array | None) -> float:
    """How far the corner that moved most has moved; inf when only one of the outlines is there."""
    if before is None or after is None:
        return 0.0 if before is after else math.inf
    return float(np.hypot(*(after - before).T).max())
