"""The published tiles in one file: PMTiles, MBTiles, or a folder in a zip. One tile in memory at a time.

Every archive holds the tiles byte for byte as they are served, and equal tiles give equal archives.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from core.errors import NothingToMap
from core.grid import TILE_PX, TileKey, tile_bounds_lonlat
from core.pyramid import JPEG, PNG, WEBP

SUFFIX = {JPEG: "jpg", WEBP: "webp", PNG: "png"}
_PMTILES = {JPEG: TileType.JPEG, WEBP: TileType.WEBP, PNG: TileType.PNG}

# What a zip can say at the least: no date may depend on when it was written.
_EPOCH = (1980, 1, 1, 0, 0, 0)
_COMPRESSED = (".jpg", ".webp", ".png")
_REGULAR_FILE = 0o100644 << 16

_MBTILES = """
PRAGMA page_size = 4096;
PRAGMA journal_mode = OFF;
PRAGMA synchronous = OFF;
PRAGMA application_id = 0x4d504258;
CREATE TABLE metadata (name TEXT NOT NULL, value TEXT);
CREATE TABLE tiles (
    zoom_level INTEGER NOT NULL, tile_column INTEGER NOT NULL, tile_row INTEGER NOT NULL,
    tile_data BLOB NOT NULL
);
"""


@dataclass(frozen=True, slots=True)
class TileSet:
    """A map's tiles, overviews included: each one's media type, and how to get its bytes."""

    title: str
    kinds: Mapping[TileKey, str]
    read: Callable[[TileKey], bytes]

    def __post_init__(self) -> None:
        """Raises NothingToMap when there is no tile."""
        if not self.kinds:
            raise NothingToMap("There is no tile on the map yet.")

    @property
    def zooms(self) -> tuple[int, int]:
        """The coarsest and the finest zoom."""
        zooms = {tile.z for tile in self.kinds}
        return min(zooms), max(zooms)

    @property
    def kind(self) -> str:
        """The one media type to announce: who can show WebP can show the others, the reverse is not sure."""
        found = set(self.kinds.values())
        return next(kind for kind in (WEBP, PNG, JPEG) if kind in found)

    def native(self) -> list[TileKey]:
        """The tiles of the finest zoom, sorted."""
        finest = self.zooms[1]
        return sorted(tile for tile in self.kinds if tile.z == finest)

    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north of the finest tiles, in degrees."""
        west, south, east, north = zip(*map(tile_bounds_lonlat, self.native()), strict=True)
        return min(west), min(south), max(east), max(north)

    def center(self) -> tuple[float, float, int]:
        """Longitude and latitude of the map's middle, and a zoom that shows most of it at once."""
        west, south, east, north = self.bounds()
        low, high = self.zooms
        return (west + east) / 2, (south + north) / 2, min(low + 2, high)


def write_pmtiles(path: Path, tiles: TileSet) -> None:
    """A PMTiles v3 archive, clustered, at `path`."""
    west, south, east, north = tiles.bounds()
    lon, lat, zoom = tiles.center()
    header = {
        "tile_type": _PMTILES[tiles.kind],
        "tile_compression": Compression.NONE,
        "min_lon_e7": _e7(west),
        "min_lat_e7": _e7(south),
        "max_lon_e7": _e7(east),
        "max_lat_e7": _e7(north),
        "center_zoom": zoom,
        "center_lon_e7": _e7(lon),
        "center_lat_e7": _e7(lat),
    }
    # Collected next to the result: the system's folder for temporary files may be memory.
    with path.open("wb") as file, TemporaryFile(dir=path.parent) as collected:
        writer = Writer(file)
        writer.tile_f.close()
        writer.tile_f = collected
        for number, tile in sorted((zxy_to_tileid(*tile), tile) for tile in tiles.kinds):
            writer.write_tile(number, tiles.read(tile))
        writer.finalize(header, {"name": tiles.title, "type": "overlay", "tileSize": TILE_PX})


def write_mbtiles(path: Path, tiles: TileSet) -> None:
    """An MBTiles 1.3 database at `path`; its rows count from the south."""
    path.unlink(missing_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.executescript(_MBTILES)
        db.execute("BEGIN")
        db.executemany("INSERT INTO metadata VALUES (?, ?)", _mbtiles_metadata(tiles).items())
        rows = ((z, x, 2**z - 1 - y, tiles.read(TileKey(z, x, y))) for z, x, y in sorted(tiles.kinds))
        db.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
        db.execute("CREATE UNIQUE INDEX tile_index ON tiles (zoom_level, tile_column, tile_row)")
        db.execute("CREATE UNIQUE INDEX name ON metadata (name)")
        db.execute("COMMIT")


def _mbtiles_metadata(tiles: TileSet) -> dict[str, str]:
    low, high = tiles.zooms
    return {
        "name": tiles.title,
        "format": SUFFIX[tiles.kind],
        "bounds": ",".join(map(repr, tiles.bounds())),
        "center": ",".join(map(repr, tiles.center())),
        "minzoom": str(low),
        "maxzoom": str(high),
        "type": "overlay",
        "version": "1",
        "description": "Orthophoto map",
        "tileSize": str(TILE_PX),
    }


def write_folder(path: Path, tiles: TileSet) -> None:
    """A zip with `{z}/{x}/{y}` as web maps ask for them and a tilejson.json that says so.

    All files have one suffix, so that a single pattern addresses them; who shows pictures looks inside.
    """
    suffix = SUFFIX[tiles.kind]
    low, high = tiles.zooms
    tilejson: dict[str, Any] = {
        "tilejson": "3.0.0",
        "name": tiles.title,
        "scheme": "xyz",
        "tiles": [f"{{z}}/{{x}}/{{y}}.{suffix}"],
        "tileSize": TILE_PX,
        "minzoom": low,
        "maxzoom": high,
        "bounds": list(tiles.bounds()),
        "center": list(tiles.center()),
    }

    def entries() -> Iterable[tuple[str, bytes]]:
        yield "tilejson.json", json.dumps(tilejson, indent=1, ensure_ascii=False).encode()
        for tile in sorted(tiles.kinds):
            yield f"{tile.z}/{tile.x}/{tile.y}.{suffix}", tiles.read(tile)

    write_zip(path, entries())


def write_zip(path: Path, entries: Iterable[tuple[str, bytes]]) -> None:
    """A zip of (name, bytes) in the given order, without dates; pictures are stored as they are."""
    with ZipFile(path, "w") as file:
        for name, data in entries:
            info = ZipInfo(name, _EPOCH)
            info.create_system, info.external_attr = 3, _REGULAR_FILE
            info.compress_type = ZIP_STORED if name.endswith(_COMPRESSED) else ZIP_DEFLATED
            file.writestr(info, data)


def _e7(degrees: float) -> int:
    return round(degrees * 1e7)
