"""Raster targets: where the pixels of tiles and exports lie on the ground.

Pixels have absolute, integer coordinates in one endless plane per zoom (or per export), so that whatever is
computed at a pixel does not depend on the window through which it is looked at. Pixel centres are integers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple, Self

import mercantile
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import Transformer

from core.geometry import WGS84_A_M, WGS84_E2, Array, World

TILE_PX = 512
MAX_ZOOM = 24
EQUATOR_M = 2 * math.pi * WGS84_A_M


class TileKey(NamedTuple):
    """One 512 px web-mercator tile; x counts eastwards and y southwards, as in every web map."""

    z: int
    x: int
    y: int


class Columns(NamedTuple):
    """Plumb lines through pixel centres: the world x, y at world height h is `foot + slope * h` (N, 2)."""

    foot: Array
    slope: Array

    def at(self, h_m: float) -> Array:
        """World x, y (N, 2), metres, where the lines meet the plane at world height `h_m`."""
        return np.asarray(self.foot + self.slope * h_m)


def plumb_lines(world: World, lon_deg: Array, lat_deg: Array) -> Columns:
    """The ellipsoid's normals at longitudes and latitudes, as lines in the world.

    These are (N,) each, or (1, C) and (R, 1): then the lines of all R × C crossings are given, row by row.

    Every operation is elementwise (no matrix product, whose rounding may depend on N), so that a point gets
    the same bits whichever others are asked for along with it.
    """
    sl, cl = math.sin(math.radians(world.lon_deg)), math.cos(math.radians(world.lon_deg))
    sp, cp = math.sin(math.radians(world.lat_deg)), math.cos(math.radians(world.lat_deg))
    n0 = WGS84_A_M / math.sqrt(1 - WGS84_E2 * sp * sp)
    lon, lat = np.radians(np.ascontiguousarray(lon_deg)), np.radians(np.ascontiguousarray(lat_deg))
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    up_x, up_y, up_z = cos_lat * np.cos(lon), cos_lat * np.sin(lon), sin_lat
    n = WGS84_A_M / np.sqrt(1 - WGS84_E2 * sin_lat * sin_lat)
    dx = n * up_x - (n0 + world.alt_m) * cp * cl
    dy = n * up_y - (n0 + world.alt_m) * cp * sl
    dz = n * (1 - WGS84_E2) * up_z - (n0 * (1 - WGS84_E2) + world.alt_m) * sp

    def east(x: Array, y: Array) -> Array:
        return np.asarray(cl * y - sl * x)

    def north(x: Array, y: Array, z: Array) -> Array:
        return np.asarray(cp * z - sp * (cl * x + sl * y))

    height = cp * (cl * dx + sl * dy) + sp * dz
    rise = cp * (cl * up_x + sl * up_y) + sp * up_z
    slope = np.stack((east(up_x, up_y) / rise, north(up_x, up_y, up_z) / rise), -1)
    foot = np.stack((east(dx, dy), north(dx, dy, dz)), -1) - slope * height[..., None]
    return Columns(foot.reshape(-1, 2), slope.reshape(-1, 2))


@dataclass(frozen=True, slots=True)
class _Window:
    """A rectangle of an endless pixel plane."""

    def window(self, col0: int, row0: int, width: int, height: int) -> Self:
        """The rectangle of the same plane with this top-left pixel (absolute) and size."""
        return replace(self, col0=col0, row0=row0, width=width, height=height)  # type: ignore[call-arg]

    def lon_lat(self, cols: ArrayLike, rows: ArrayLike) -> tuple[Array, Array]:
        """Longitudes and latitudes (N,), degrees, of absolute pixel positions (N,)."""
        raise NotImplementedError

    def columns(self, world: World, cols: ArrayLike, rows: ArrayLike) -> Columns:
        """The plumb lines through absolute pixel positions (N,)."""
        return plumb_lines(world, *self.lon_lat(cols, rows))

    def crossings(self, world: World, cols: ArrayLike, rows: ArrayLike) -> Columns:
        """The plumb lines through all crossings of columns (C,) and rows (R,), row by row (R · C)."""
        x, y = np.meshgrid(cols, rows)
        return self.columns(world, x.ravel(), y.ravel())

    def to_world(self, world: World, cols: ArrayLike, rows: ArrayLike, h_m: float) -> Array:
        """Absolute pixel positions (N,) → world x, y (N, 2), metres, on the plane at world height `h_m`."""
        return self.columns(world, cols, rows).at(h_m)


def _world_lon_lat(world: World, xy: ArrayLike, h_m: float) -> tuple[Array, Array]:
    xy = np.asarray(xy, float).reshape(-1, 2)
    geodetic = world.to_geodetic(np.column_stack((xy, np.full(len(xy), h_m))))
    return geodetic[:, 0], geodetic[:, 1]


@dataclass(frozen=True, slots=True)
class MercatorGrid(_Window):
    """`width` × `height` pixels of zoom z's plane (512·2^z pixels square), from pixel (col0, row0) on."""

    z: int
    col0: int
    row0: int
    width: int
    height: int

    def lon_lat(self, cols: ArrayLike, rows: ArrayLike) -> tuple[Array, Array]:
        """Longitudes and latitudes (N,), degrees, of absolute pixel positions (N,)."""
        side = TILE_PX * 2.0**self.z
        x = (np.asarray(cols, float) + 0.5) / side
        y = (np.asarray(rows, float) + 0.5) / side
        return 360 * x - 180, np.degrees(np.arctan(np.sinh(math.pi * (1 - 2 * y))))

    def crossings(self, world: World, cols: ArrayLike, rows: ArrayLike) -> Columns:
        """As for any grid, but here a column is one longitude and a row one latitude."""
        lon, lat = self.lon_lat(cols, rows)
        return plumb_lines(world, lon[None], lat[:, None])

    def from_world(self, world: World, xy: ArrayLike, h_m: float) -> tuple[Array, Array]:
        """World x, y (N, 2), metres, at world height `h_m` → absolute (columns, rows), (N,) each."""
        lon, lat = _world_lon_lat(world, xy, h_m)
        side = TILE_PX * 2.0**self.z
        y = 0.5 - np.arcsinh(np.tan(np.radians(lat))) / (2 * math.pi)
        return (lon + 180) / 360 * side - 0.5, y * side - 0.5

    def resolution_m(self, world: World) -> float:
        """Ground metres per pixel at the world's origin."""
        return zoom_resolution_m(self.z, world.lat_deg)

    def tiles(self) -> list[TileKey]:
        """The tiles that this grid touches, row by row."""
        xs = range(self.col0 // TILE_PX, -(-(self.col0 + self.width) // TILE_PX))
        ys = range(self.row0 // TILE_PX, -(-(self.row0 + self.height) // TILE_PX))
        return [TileKey(self.z, x, y) for y in ys for x in xs]


@dataclass(frozen=True, slots=True)
class UtmGrid(_Window):
    """`width` × `height` pixels of `gsd_m` in a projected CRS, north up, from pixel (col0, row0) on.

    `left`, `top`: the CRS's coordinates of the outer corner of pixel (0, 0). Windows of one export share
    these and differ in `col0`, `row0` (`window`), so that they fit together to the last bit.
    """

    epsg: int
    left: float
    top: float
    gsd_m: float
    width: int
    height: int
    col0: int = 0
    row0: int = 0

    def lon_lat(self, cols: ArrayLike, rows: ArrayLike) -> tuple[Array, Array]:
        """Longitudes and latitudes (N,), degrees, of absolute pixel positions (N,)."""
        east = self.left + (np.asarray(cols, float) + 0.5) * self.gsd_m
        north = self.top - (np.asarray(rows, float) + 0.5) * self.gsd_m
        lon, lat = _from_crs(self.epsg).transform(east, north)
        return np.asarray(lon, float), np.asarray(lat, float)

    def from_world(self, world: World, xy: ArrayLike, h_m: float) -> tuple[Array, Array]:
        """World x, y (N, 2), metres, at world height `h_m` → absolute (columns, rows), (N,) each."""
        east, north = _to_crs(self.epsg).transform(*_world_lon_lat(world, xy, h_m))
        cols = (np.asarray(east, float) - self.left) / self.gsd_m - 0.5
        return cols, (self.top - np.asarray(north, float)) / self.gsd_m - 0.5

    def resolution_m(self, world: World) -> float:
        """Metres per pixel; the CRS's scale factor (within 0.1%) is left out."""
        return self.gsd_m


Grid = MercatorGrid | UtmGrid


@lru_cache(maxsize=16)
def _from_crs(epsg: int) -> Transformer:
    return Transformer.from_crs(epsg, 4326, always_xy=True)


@lru_cache(maxsize=16)
def _to_crs(epsg: int) -> Transformer:
    return Transformer.from_crs(4326, epsg, always_xy=True)


def utm_epsg(lat_deg: float, lon_deg: float) -> int:
    """The EPSG code of the WGS84 UTM zone that holds this place: 6° wide, but around Norway."""
    zone = int((lon_deg + 180) % 360 // 6) + 1
    if 56 <= lat_deg < 64 and 3 <= lon_deg < 12:
        zone = 32
    elif 72 <= lat_deg < 84 and 0 <= lon_deg < 42:  # Svalbard: zones 32, 34 and 36 are not used
        zone = 31 + 2 * int((lon_deg + 3) // 12)
    return (32600 if lat_deg >= 0 else 32700) + zone


def zoom_resolution_m(z: int, lat_deg: float) -> float:
    """Ground metres per pixel of 512 px web-mercator tiles at this latitude."""
    return EQUATOR_M * math.cos(math.radians(lat_deg)) / (TILE_PX * 2.0**z)


def native_zoom(gsd_m: float, lat_deg: float) -> int:
    """The coarsest zoom whose pixels are at most 1.3 × `gsd_m`, so between 0.65 and 1.3 × the photos' own.

    Zooms halve the pixel: the finer of the two that enclose the GSD would cost up to four times the pixels,
    the coarser up to half the detail. 1.3 loses none that bilinear sampling of an optical photo holds.
    """
    z = math.ceil(math.log2(EQUATOR_M * math.cos(math.radians(lat_deg)) / (TILE_PX * 1.3 * gsd_m)) - 1e-9)
    return min(max(z, 0), MAX_ZOOM)


def tile_grid(tile: TileKey) -> MercatorGrid:
    """The 512 × 512 pixels of one tile."""
    return MercatorGrid(tile.z, tile.x * TILE_PX, tile.y * TILE_PX, TILE_PX, TILE_PX)


def tile_bounds_lonlat(tile: TileKey) -> tuple[float, float, float, float]:
    """West, south, east, north of a tile, in degrees."""
    box = mercantile.bounds(tile.x, tile.y, tile.z)
    return (box.west, box.south, box.east, box.north)


def parent(tile: TileKey) -> TileKey:
    """The tile one zoom up that holds this one; ValueError for zoom 0."""
    if tile.z == 0:
        raise ValueError("the zoom 0 tile has no parent")
    return TileKey(tile.z - 1, tile.x // 2, tile.y // 2)


def children(tile: TileKey) -> tuple[TileKey, TileKey, TileKey, TileKey]:
    """The four tiles one zoom down, in the order of `core.pyramid.reduce`: NW, NE, SW, SE."""
    z, x, y = tile.z + 1, tile.x * 2, tile.y * 2
    return (TileKey(z, x, y), TileKey(z, x + 1, y), TileKey(z, x, y + 1), TileKey(z, x + 1, y + 1))


def ancestors(tiles: Iterable[TileKey], min_z: int = 0) -> list[TileKey]:
    """Every tile above these down to zoom `min_z`, each once, deepest zoom first: the order to rebuild in."""
    above: set[TileKey] = set()
    for tile in tiles:
        while tile.z > min_z and (tile := parent(tile)) not in above:
            above.add(tile)
    return sorted(above, key=lambda t: (-t.z, t.x, t.y))


def tiles_of(world: World, footprint: ArrayLike, h_m: float, z: int, margin_px: float = 0.0) -> set[TileKey]:
    """The tiles of zoom z that come within `margin_px` of a convex outline on the ground.

    `footprint`: (N, 2) world metres, in order, at world height `h_m`. By separating axes.
    """
    cols, rows = MercatorGrid(z, 0, 0, 0, 0).from_world(world, footprint, h_m)
    outline = np.column_stack((cols, rows)) + 0.5
    low = np.floor((outline.min(0) - margin_px) / TILE_PX).astype(int)
    high = np.floor((outline.max(0) + margin_px) / TILE_PX).astype(int)
    xs, ys = (a.ravel() for a in np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1)))
    near = _near(outline, np.column_stack((xs, ys)) * float(TILE_PX), margin_px)
    inside = near & (xs >= 0) & (ys >= 0) & (xs < 2**z) & (ys < 2**z)
    return {TileKey(z, int(x), int(y)) for x, y in zip(xs[inside], ys[inside], strict=True)}


def _near(outline: Array, corners: Array, margin_px: float) -> NDArray[np.bool_]:
    """Which squares (M, 2 top-left corners, side `TILE_PX`) no edge of the outline separates from it."""
    edges = np.roll(outline, -1, 0) - outline
    normals = np.column_stack((-edges[:, 1], edges[:, 0]))
    normals = normals[(normals**2).sum(1) > 0]
    normals /= np.hypot(normals[:, 0], normals[:, 1])[:, None]
    reach = outline @ normals.T
    centre = (corners + TILE_PX / 2) @ normals.T
    half = TILE_PX / 2 * np.abs(normals).sum(1) + margin_px
    return np.asarray(((centre + half >= reach.min(0)) & (centre - half <= reach.max(0))).all(1))
