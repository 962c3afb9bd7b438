"""The mosaic as a cloud-optimised GeoTIFF, drawn by windows so that memory does not grow with the map."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import CRSError
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from core.errors import BadCrs, NothingToMap
from core.fusion import DEFAULT as FUSION_DEFAULT
from core.fusion import FrameIndex, FusionParams, Photos, render
from core.geometry import Array, PosedFrame, World
from core.grid import UtmGrid, utm_epsg
from core.outline import ground_outline


@dataclass(frozen=True, slots=True)
class MosaicParams:
    """How the mosaic file is written.

    `window_px`: side of what is drawn at once; `max_pixels`: a larger map is drawn coarser by powers of two;
    `cache_mb`: GDAL's memory.
    """

    window_px: int = 1024
    block_px: int = 512
    deflate_level: int = 6
    max_pixels: int = 20_000_000_000
    cache_mb: int = 64


DEFAULT = MosaicParams()


LOCAL = "Not georeferenced: no photo has GPS. Place and north are assumed."


def flight_gsd_m(frames: Sequence[PosedFrame]) -> float:
    """The flight's ground sampling distance: the median over its frames, metres. Raises NothingToMap."""
    gsds = [f.pose.gsd_m(f.camera) for f in frames if ground_outline(f) is not None]
    if not gsds:
        raise NothingToMap
    return float(np.median(gsds))


def write_mosaic(
    path: Path,
    world: World,
    frames: Sequence[PosedFrame],
    photos: Photos,
    gsd_m: float | None = None,
    crs: str | None = None,
    params: MosaicParams = DEFAULT,
    fusion: FusionParams = FUSION_DEFAULT,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Draw all frames into a COG at `path`: RGB + alpha, lossless, overviews, the same bytes every time.

    `gsd_m`: metres per pixel, the flight's own by default. `crs`: what to warp the result to, the UTM zone of
    the world's origin by default. `progress` is told the share done, 0 … 1. The file appears whole or not at
    all. Raises NothingToMap, BadCrs.
    """
    target = _checked(crs)
    grid = mosaic_grid(world, frames, gsd_m or flight_gsd_m(frames), params.max_pixels)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        TemporaryDirectory(dir=path.parent, prefix=".mosaic-") as scratch,
        rasterio.Env(GDAL_CACHEMAX=params.cache_mb * 1_000_000, GDAL_TIFF_INTERNAL_MASK=True),
    ):
        drawn, whole = Path(scratch) / "drawn.tif", Path(scratch) / "whole.tif"
        _draw(drawn, grid, world, frames, photos, params, fusion, progress or (lambda _: None))
        _optimise(drawn, whole, target, params)
        os.replace(whole, path)


def mosaic_grid(world: World, frames: Sequence[PosedFrame], gsd_m: float, max_pixels: int) -> UtmGrid:
    """The smallest raster, aligned to multiples of its pixel, that holds every frame's outline.

    Raises NothingToMap.
    """
    epsg = utm_epsg(world.lat_deg, world.lon_deg)
    plane = UtmGrid(epsg, 0.0, 0.0, gsd_m, 0, 0)
    boxes = [box for box in (_box(plane, world, f) for f in frames) if box is not None]
    if not boxes:
        raise NothingToMap
    low = np.floor(np.min([b[0] for b in boxes], axis=0)).astype(int)
    high = np.ceil(np.max([b[1] for b in boxes], axis=0)).astype(int)
    width, height = (int(v) for v in high - low)
    if width * height > max_pixels:
        return mosaic_grid(world, frames, 2 * gsd_m, max_pixels)
    return UtmGrid(epsg, float(low[0]) * gsd_m, -float(low[1]) * gsd_m, gsd_m, width, height)


def _box(grid: UtmGrid, world: World, frame: PosedFrame) -> tuple[Array, Array] | None:
    """Top-left and bottom-right edges (2,) of a frame's outline in the grid's pixels."""
    outline = ground_outline(frame)
    if outline is None:
        return None
    edges = np.column_stack(grid.from_world(world, outline, frame.pose.ground_h_m)) + 0.5
    return edges.min(0), edges.max(0)


def _windows(grid: UtmGrid, side: int) -> Iterator[tuple[int, int, int, int]]:
    for row in range(0, grid.height, side):
        for col in range(0, grid.width, side):
            yield col, row, min(side, grid.width - col), min(side, grid.height - row)


def _draw(
    path: Path,
    grid: UtmGrid,
    world: World,
    frames: Sequence[PosedFrame],
    photos: Photos,
    params: MosaicParams,
    fusion: FusionParams,
    progress: Callable[[float], None],
) -> None:
    index = FrameIndex((f for f in frames if ground_outline(f) is not None), fusion)
    profile = {
        "driver": "GTiff",
        "width": grid.width,
        "height": grid.height,
        "count": 4,
        "dtype": "uint8",
        "crs": f"EPSG:{grid.epsg}",
        "transform": rasterio.Affine(grid.gsd_m, 0, grid.left, 0, -grid.gsd_m, grid.top),
        "photometric": "RGB",
        "alpha": "YES",
        "tiled": True,
        "blockxsize": params.block_px,
        "blockysize": params.block_px,
        "compress": "deflate",
        "zlevel": 1,
        "sparse_ok": True,
        "bigtiff": "YES",
    }
    windows = list(_windows(grid, params.window_px))
    with rasterio.open(path, "w", **profile) as out:
        if any(f.pose.source == "vision-only" for f in frames):
            out.update_tags(TIFFTAG_IMAGEDESCRIPTION=LOCAL, GEOREFERENCED="NO")
        out.colorinterp = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        for done, (col, row, width, height) in enumerate(windows, 1):
            window = grid.window(col, row, width, height)
            near = index.overlapping(window, world)
            if near:
                rgba = render(window, world, near, photos, fusion)
                out.write(rgba.transpose(2, 0, 1), window=Window(col, row, width, height))
            progress(done / len(windows))


def _checked(crs: str | None) -> rasterio.CRS | None:
    if crs is None:
        return None
    try:
        with rasterio.Env():
            return rasterio.CRS.from_user_input(crs)
    except CRSError as error:
        raise BadCrs(
            f"{crs!r:.80} is not a coordinate reference system. Name one such as EPSG:32632."
        ) from error


def _optimise(drawn: Path, whole: Path, crs: rasterio.CRS | None, params: MosaicParams) -> None:
    """The drawn raster rearranged as a COG; one thread, because GDAL's order of blocks must not vary."""
    options = {
        "driver": "COG",
        "compress": "DEFLATE",
        "level": params.deflate_level,
        "predictor": "STANDARD",
        "blocksize": params.block_px,
        "overview_resampling": "AVERAGE",
        "bigtiff": "IF_SAFER",
        "sparse_ok": "YES",
    }
    with rasterio.open(drawn) as source:
        if crs is None or crs == source.crs:
            rasterio.shutil.copy(source, whole, **options)
        else:
            with WarpedVRT(source, crs=crs, resampling=Resampling.bilinear) as warped:
                rasterio.shutil.copy(warped, whole, **options)
