"""A small picture of the whole map with a world file: for a chat, a slide, or any program with layers."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import rasterio
from PIL import Image
from pyproj import CRS
from rasterio.enums import Resampling
from rasterio.transform import array_bounds
from rasterio.warp import reproject, transform_bounds

from core.archives import TileSet, write_zip
from core.grid import EQUATOR_M, TILE_PX, TileKey
from core.pyramid import Rgba, decode

LONG_SIDE_PX = 2048


@dataclass(frozen=True, slots=True)
class Preview:
    """RGBA (H, W, 4) uint8 in a projected CRS. `transform`: pixel corners (column, row) → metres."""

    rgba: Rgba
    transform: rasterio.Affine
    epsg: int

    def png(self) -> bytes:
        """The picture."""
        out = io.BytesIO()
        Image.fromarray(self.rgba, "RGBA").save(out, "PNG", compress_level=3)
        return out.getvalue()

    def world_file(self) -> str:
        """Six lines: the pixel's size and rotation, then the centre of the first pixel."""
        t = self.transform
        values = t.a, t.d, t.b, t.e, t.c + (t.a + t.b) / 2, t.f + (t.d + t.e) / 2
        return "".join(f"{float(v)!r}\n" for v in values)

    def projection(self) -> str:
        """The CRS in the words of .prj files, which world files lack."""
        return str(CRS.from_epsg(self.epsg).to_wkt("WKT1_ESRI"))

    def beside(self) -> str:
        """The CRS where GDAL, and with it QGIS, looks for it: in no .prj file next to a PNG."""
        root = ET.Element("PAMDataset")
        ET.SubElement(root, "SRS").text = str(CRS.from_epsg(self.epsg).to_wkt("WKT2_2019"))
        return ET.tostring(root, "unicode")


def write_preview(path: Path, preview: Preview) -> None:
    """A zip at `path` with preview.png, its world file and its CRS, in the two ways that programs read it."""
    texts = {
        "preview.pgw": preview.world_file(),
        "preview.prj": preview.projection(),
        "preview.png.aux.xml": preview.beside(),
    }
    write_zip(
        path, [("preview.png", preview.png()), *((name, text.encode()) for name, text in texts.items())]
    )


def preview(tiles: TileSet, epsg: int, long_side_px: int = LONG_SIDE_PX) -> Preview:
    """The map `long_side_px` wide or high, in that CRS; smaller where the map itself has no more pixels.

    Sampled from the coarsest tiles that have enough pixels, so the memory depends on `long_side_px` alone.
    """
    canvas, to_mercator = _cropped(*_canvas(tiles, long_side_px))
    height, width = canvas.shape[:2]
    box = array_bounds(height, width, to_mercator)
    west, south, east, north = transform_bounds("EPSG:3857", f"EPSG:{epsg}", *box)
    pixels = min(long_side_px, max(height, width))
    pixel_m = max(east - west, north - south) / pixels
    shape = max(1, round((north - south) / pixel_m)), max(1, round((east - west) / pixel_m))
    to_metres = rasterio.Affine(pixel_m, 0, west, 0, -pixel_m, north)
    drawn = np.zeros((4, *shape), np.uint8)
    reproject(
        np.ascontiguousarray(canvas.transpose(2, 0, 1)),
        drawn,
        src_transform=to_mercator,
        src_crs="EPSG:3857",
        src_alpha=4,
        dst_transform=to_metres,
        dst_crs=f"EPSG:{epsg}",
        dst_alpha=4,
        resampling=Resampling.bilinear,
        num_threads=1,
    )
    rgba, transform = _cropped(np.ascontiguousarray(drawn.transpose(1, 2, 0)), to_metres)
    return Preview(rgba, transform, epsg)


def _canvas(tiles: TileSet, long_side_px: int) -> tuple[Rgba, rasterio.Affine]:
    """The tiles of the coarsest zoom that is fine enough, side by side: at most 2 × as long, and a tile."""
    native = tiles.native()
    low, high = tiles.zooms
    across = max(1 + max(t[k] for t in native) - min(t[k] for t in native) for k in (1, 2))
    up = min(high - low, max(0, math.floor(math.log2(across * TILE_PX / long_side_px))))
    shown = sorted({TileKey(high - up, t.x >> up, t.y >> up) for t in native} & tiles.kinds.keys())
    x0, y0 = min(t.x for t in shown), min(t.y for t in shown)
    columns, rows = 1 + max(t.x for t in shown) - x0, 1 + max(t.y for t in shown) - y0
    canvas = np.zeros((rows * TILE_PX, columns * TILE_PX, 4), np.uint8)
    for tile in shown:
        top, left = (tile.y - y0) * TILE_PX, (tile.x - x0) * TILE_PX
        canvas[top : top + TILE_PX, left : left + TILE_PX] = decode(tiles.read(tile))
    tile_m = EQUATOR_M / 2 ** (high - up)
    pixel_m = tile_m / TILE_PX
    left_m, top_m = x0 * tile_m - EQUATOR_M / 2, EQUATOR_M / 2 - y0 * tile_m
    return canvas, rasterio.Affine(pixel_m, 0, left_m, 0, -pixel_m, top_m)


def _cropped(rgba: Rgba, transform: rasterio.Affine) -> tuple[Rgba, rasterio.Affine]:
    """Without the rows and columns at its borders that show nothing."""
    shown = rgba[..., 3] > 0
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    if not len(rows):
        return rgba, transform
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
    moved = rasterio.Affine.translation(left * transform.a, top * transform.e) @ transform
    return np.ascontiguousarray(rgba[top : top + height, left : left + width]), moved
