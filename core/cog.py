"""The mosaic as a cloud-optimised GeoTIFF, drawn in pieces so that memory does not grow with the map.

A piece is drawn once, halved down to the top of the pyramid there and then, and kept as a small file a level:
whoever has the photos may draw any of them. GDAL puts them together.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from core.crs import check_reach, checked_crs, transformation
from core.errors import NothingToMap
from core.fusion import DEFAULT as FUSION_DEFAULT
from core.fusion import FrameIndex, FusionParams, Photos, render
from core.geometry import Array, PosedFrame, World
from core.grid import UtmGrid, utm_epsg
from core.inputs import LOOK, frame_digest
from core.outline import ground_outline
from core.pyramid import halve
from core.virtual_raster import Patch, Virtual, keep_tags, write_virtual


@dataclass(frozen=True, slots=True)
class MosaicParams:
    """How the mosaic file is written.

    `piece_px`: side of what is kept in one file until all is drawn, a power of two; `window_px`: of what is
    drawn at once; `max_pixels`: a larger map is drawn coarser by powers of two; `cache_mb`: GDAL's memory;
    `threads` pack the file, whose bytes do not depend on how many they are.
    """

    piece_px: int = 2048
    window_px: int = 1024
    block_px: int = 512
    deflate_level: int = 1
    max_pixels: int = 20_000_000_000
    cache_mb: int = 32
    threads: int = 1


DEFAULT = MosaicParams()


LOCAL = "Not georeferenced: no photo has GPS. Place and north are assumed."

SHOWS = b"shows"
"""Content of the mark of a piece that is not empty."""

Box = tuple[int, int, int, int]
"""Column, row, width, height in the mosaic's pixels."""


def flight_gsd_m(frames: Sequence[PosedFrame]) -> float:
    """The flight's ground sampling distance: the median over its frames, metres. Raises NothingToMap."""
    gsds = [f.pose.gsd_m(f.camera) for f in frames if ground_outline(f) is not None]
    if not gsds:
        raise NothingToMap
    return float(np.median(gsds))


@dataclass(frozen=True, slots=True)
class MosaicPlan:
    """All that a mosaic is drawn from besides the photos, and the pieces that it falls into."""

    world: World
    grid: UtmGrid
    index: FrameIndex
    params: MosaicParams
    fusion: FusionParams

    @classmethod
    def of(
        cls,
        world: World,
        frames: Sequence[PosedFrame],
        gsd_m: float | None = None,
        params: MosaicParams = DEFAULT,
        fusion: FusionParams = FUSION_DEFAULT,
    ) -> MosaicPlan:
        """`gsd_m`: metres per pixel, the flight's own by default. Raises NothingToMap."""
        grid = mosaic_grid(world, frames, gsd_m or flight_gsd_m(frames), params.max_pixels)
        shown = FrameIndex((f for f in frames if ground_outline(f) is not None), fusion)
        return cls(world, grid, shown, params, fusion)

    def digest(self) -> str:
        """32 hex digits, the same for two plans whose pieces are."""
        said = (LOOK, self.world, self.grid, self.params.piece_px, self.params.block_px, self.fusion)
        digest = sha256(repr(said).encode())
        for frame in self.index.frames:
            digest.update(frame_digest(frame))
        return digest.hexdigest()[:32]

    def pieces(self) -> list[Box]:
        """Row by row."""
        return list(_cut((0, 0, self.grid.width, self.grid.height), self.params.piece_px))

    @property
    def levels(self) -> int:
        """The full resolution and so many overviews that the last one is a single block."""
        side, levels = max(self.grid.width, self.grid.height), 1
        while side > self.params.block_px and 1 << levels <= self.params.piece_px:
            side, levels = -(-side // 2), levels + 1
        return levels

    def draw(self, piece: Box, photos: Photos, folder: Path) -> None:
        """Leave the piece in `folder`; one at a time may draw the same one there."""
        rgba = np.zeros((self.params.piece_px, self.params.piece_px, 4), np.uint8)
        for col, row, width, height in _cut(piece, self.params.window_px):
            window = self.grid.window(col, row, width, height)
            if near := self.index.overlapping(window, self.world):
                shown = render(window, self.world, near, photos, self.fusion)
                rgba[row - piece[1] :, col - piece[0] :][:height, :width] = shown
        shows = bool(rgba[..., 3].any())
        for level in range(self.levels if shows else 0):
            rgba = halve(rgba) if level else rgba
            box = _scaled(piece, level)
            with rasterio.open(folder / _file(piece, level), "w", **self._profile(box, level)) as out:
                out.write(rgba[: box[3], : box[2]].transpose(2, 0, 1))
        (folder / _mark(piece)).write_bytes(SHOWS if shows else b"")

    def is_drawn(self, piece: Box, folder: Path) -> bool:
        """Whether all of the piece lies in `folder`."""
        return (folder / _mark(piece)).exists()

    def _profile(self, box: Box, level: int) -> dict[str, Any]:
        kind = {"driver": "GTiff", "photometric": "RGB", "alpha": "YES"}
        place = {"transform": self._to_crs(level) @ rasterio.Affine.translation(*box[:2])}
        size = {"width": box[2], "height": box[3], "count": 4, "dtype": "uint8"}
        blocks = {"tiled": True, "blockxsize": self.params.block_px, "blockysize": self.params.block_px}
        # Only GDAL will read it: Zstandard is faster than deflate, and bands apart than together.
        packing = {"compress": "zstd", "zstd_level": 1, "predictor": 2, "interleave": "band"}
        return kind | place | size | blocks | packing

    def assemble(self, folder: Path, path: Path, crs: str | None = None) -> None:
        """The COG at `path` of the pieces in `folder`: RGB + alpha, lossless, overviews, equal bytes always.

        `crs`: what to warp it to, the UTM zone of the world's origin by default. The file appears whole or
        not at all. Raises BadCrs.
        """
        target = self.checked_crs(crs)
        with (
            TemporaryDirectory(dir=path.parent, prefix=".mosaic-") as scratch,
            rasterio.Env(GDAL_CACHEMAX=self.params.cache_mb * 1_000_000),
        ):
            whole, drawn = Path(scratch) / "whole.tif", self._virtual(folder)
            if target is not None and target != (own := rasterio.CRS.from_epsg(self.grid.epsg)):
                place = self.world.lon_deg, self.world.lat_deg
                drawn = _warped(drawn, target, {"TRANSFORMATION": transformation(own, target, *place)})
            _pack(drawn, whole, self.params)
            os.replace(whole, path)

    def checked_crs(self, crs: str | None) -> rasterio.CRS | None:
        """The CRS as GDAL knows it. Raises BadCrs where there is none, or none for where the map lies."""
        target = checked_crs(crs)
        if target is not None and not self.is_local:
            check_reach(target, self.world.lon_deg, self.world.lat_deg)
        return target

    @property
    def is_local(self) -> bool:
        """Whether nobody knows where the map lies."""
        return any(f.pose.source == "vision-only" for f in self.index.frames)

    def _virtual(self, folder: Path) -> Path:
        """The pieces in `folder` as one raster with overviews."""
        tags = {"TIFFTAG_IMAGEDESCRIPTION": LOCAL, "GEOREFERENCED": "NO"} if self.is_local else {}
        shown = [p for p in self.pieces() if (folder / _mark(p)).read_bytes() == SHOWS]
        rasters = []
        for level in range(self.levels):
            size = _scaled((0, 0, self.grid.width, self.grid.height), level)[2:]
            patches = [Patch(_file(p, level), *_scaled(p, level)) for p in shown]
            rasters.append(Virtual(*size, self._to_crs(level), f"EPSG:{self.grid.epsg}", patches, tags))
        return write_virtual(folder, rasters)

    def _to_crs(self, level: int) -> rasterio.Affine:
        """Pixel corners of an overview → metres."""
        gsd_m = self.grid.gsd_m * (1 << level)
        return rasterio.Affine(gsd_m, 0, self.grid.left, 0, -gsd_m, self.grid.top)


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
    """Draw all frames into a COG at `path`, in one process; see `MosaicPlan`.

    `progress` is told the share drawn, 0 … 1. Raises NothingToMap, BadCrs.
    """
    plan = MosaicPlan.of(world, frames, gsd_m, params, fusion)
    plan.checked_crs(crs)  # before hours of work
    path.parent.mkdir(parents=True, exist_ok=True)
    pieces = plan.pieces()
    with TemporaryDirectory(dir=path.parent, prefix=".pieces-") as folder:
        for done, piece in enumerate(pieces, 1):
            plan.draw(piece, photos, Path(folder))
            if progress:
                progress(done / len(pieces))
        plan.assemble(Path(folder), path, crs)


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


def _cut(box: Box, side: int) -> Iterator[Box]:
    """The box in squares of `side`, row by row, smaller at its right and its bottom."""
    col0, row0, width, height = box
    for row in range(0, height, side):
        for col in range(0, width, side):
            yield col0 + col, row0 + row, min(side, width - col), min(side, height - row)


def _scaled(box: Box, level: int) -> Box:
    """The same place in an overview."""
    col, row, width, height = box
    return col >> level, row >> level, -(-width // (1 << level)), -(-height // (1 << level))


def _mark(piece: Box) -> str:
    return f"{piece[0]}-{piece[1]}.drawn"


def _file(piece: Box, level: int) -> str:
    return f"{piece[0]}-{piece[1]}.{level}.tif"


def _warped(drawn: Path, crs: rasterio.CRS, tags: Mapping[str, str]) -> Path:
    """Next to the drawn raster the same in another CRS, pixel by pixel when it is read."""
    path = drawn.with_name("warped.vrt")
    with (
        rasterio.open(drawn) as source,
        WarpedVRT(source, crs=crs, resampling=Resampling.bilinear) as warped,
    ):
        rasterio.shutil.copy(warped, path, driver="VRT")
        keep_tags(path, source.tags() | tags)
    return path


def _pack(drawn: Path, whole: Path, params: MosaicParams) -> None:
    """The drawn raster rearranged as a COG; GDAL's threads keep the order of the blocks."""
    options = {
        "driver": "COG",
        "compress": "DEFLATE",
        "level": params.deflate_level,
        "predictor": "STANDARD",
        "blocksize": params.block_px,
        "overview_resampling": "AVERAGE",
        "bigtiff": "IF_SAFER",
        "sparse_ok": "YES",
        "num_threads": str(params.threads),
    }
    with rasterio.open(drawn) as source:
        rasterio.shutil.copy(source, whole, **options)
