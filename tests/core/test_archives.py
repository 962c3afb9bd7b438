"""Whatever the map is packed into, out come the published tiles, where they belong."""

from __future__ import annotations

import hashlib
import io
import json
import random
import sqlite3
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree as ET

import numpy as np
import psutil
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from pmtiles.reader import MmapSource, Reader, all_tiles
from pmtiles.tile import Compression, TileType
from pyproj import Transformer

from core import pyramid
from core.archives import TileSet, write_folder, write_mbtiles, write_pmtiles
from core.coverage import pyramid as overviews
from core.errors import NothingToMap
from core.grid import TILE_PX, TileKey, tile_bounds_lonlat
from core.preview import preview, write_preview
from core.superoverlay import KML, write_kmz

Write = Callable[[Path, TileSet], None]
WRITERS: Mapping[str, Write] = {
    "tiles.pmtiles": write_pmtiles,
    "tiles.mbtiles": write_mbtiles,
    "tiles.zip": write_folder,
    "map.kmz": write_kmz,
}
ZOOM, X0, Y0 = 19, 274240, 184260
EPSG = 32632


def of_bytes(tiles: Mapping[TileKey, bytes], title: str = "A flood") -> TileSet:
    """A tile set whose media types are seen from the bytes."""
    by_magic = {b"\xff\xd8": pyramid.JPEG, b"\x89P": pyramid.PNG}
    kinds = {t: by_magic.get(data[:2], pyramid.WEBP) for t, data in tiles.items()}
    return TileSet(title, kinds, lambda t: tiles[t])


def colour(tile: TileKey) -> list[int]:
    digest = hashlib.sha256(repr(tuple(tile)).encode()).digest()
    return [40 + v % 180 for v in digest[:3]]


def native(tile: TileKey, opaque: bool) -> bytes:
    """A tile of one colour that only it has; transparent in its south-west quarter unless opaque."""
    rgba = np.full((TILE_PX, TILE_PX, 4), [*colour(tile), 255], np.uint8)
    if not opaque:
        rgba[TILE_PX // 2 :, : TILE_PX // 2, 3] = 0
    encoded = pyramid.encode(rgba)
    assert encoded
    return encoded[0]


@pytest.fixture(scope="module")
def tiles() -> dict[TileKey, bytes]:
    """5 × 3 native tiles with a hole, opaque inside only, and all their overviews."""
    at = [(x, y) for x in range(5) for y in range(3) if (x, y) != (3, 1)]
    natives = {(t := TileKey(ZOOM, X0 + x, Y0 + y)): native(t, opaque=y == 1 and 0 < x < 4) for x, y in at}
    return natives | overviews(natives)


def read_mbtiles(path: Path) -> dict[TileKey, bytes]:
    with sqlite3.connect(path) as db:
        rows = db.execute("SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles").fetchall()
    return {TileKey(z, x, 2**z - 1 - row): data for z, x, row, data in rows}


def read_pmtiles(path: Path) -> dict[TileKey, bytes]:
    with path.open("rb") as file:
        return {TileKey(*zxy): bytes(data) for zxy, data in all_tiles(MmapSource(file))}


def read_folder(path: Path) -> dict[TileKey, bytes]:
    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
        names = [n for n in file.namelist() if n != "tilejson.json"]
        return {TileKey(*map(int, n.split(".")[0].split("/"))): file.read(n) for n in names}


@st.composite
def tile_sets(draw: st.DrawFn) -> dict[TileKey, bytes]:
    keys = draw(
        st.sets(
            st.integers(0, 24).flatmap(
                lambda z: st.builds(TileKey, st.just(z), *[st.integers(0, 2**z - 1)] * 2)
            ),
            min_size=1,
            max_size=40,
        )
    )
    pictures = st.builds(
        bytes.__add__, st.sampled_from([b"\xff\xd8", b"RIFF", b"\x89PNG"]), st.binary(max_size=6)
    )
    return {key: draw(pictures) for key in keys}


@given(tile_sets())
@settings(deadline=None)
def test_archives_hold_exactly_the_published_tiles(published: dict[TileKey, bytes]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "archive"
        for write, read in (
            (write_pmtiles, read_pmtiles),
            (write_mbtiles, read_mbtiles),
            (write_folder, read_folder),
        ):
            write(path, of_bytes(published))
            assert read(path) == published
        assert [p.name for p in Path(folder).iterdir()] == ["archive"]


@pytest.mark.parametrize("name", WRITERS)
def test_equal_tiles_give_equal_archives(name: str, tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    written = []
    for k in range(3):
        shuffled = list(tiles.items())
        random.Random(k).shuffle(shuffled)
        path = tmp_path / f"{k}-{name}"
        WRITERS[name](path, of_bytes(dict(shuffled)))
        written.append(path.read_bytes())
    assert written[0] == written[1] == written[2]


def test_a_map_of_png_tiles_says_so_and_goes_to_google_earth_as_it_is(
    tmp_path: Path, tiles: dict[TileKey, bytes]
) -> None:
    lossless = {
        t: encoded[0] for t, d in tiles.items() if (encoded := pyramid.encode(pyramid.decode(d), "png"))
    }
    for name, write in WRITERS.items():
        write(tmp_path / name, of_bytes(lossless))
    with (tmp_path / "tiles.pmtiles").open("rb") as file:
        assert Reader(MmapSource(file)).header()["tile_type"] == TileType.PNG
    with sqlite3.connect(tmp_path / "tiles.mbtiles") as db:
        assert db.execute("SELECT value FROM metadata WHERE name = 'format'").fetchone() == ("png",)
    with zipfile.ZipFile(tmp_path / "tiles.zip") as folder, zipfile.ZipFile(tmp_path / "map.kmz") as kmz:
        for tile, data in lossless.items():
            name = f"{tile.z}/{tile.x}/{tile.y}.png"
            assert folder.read(name) == kmz.read(name) == data


@pytest.mark.parametrize("name", WRITERS)
def test_no_tile_is_no_archive(name: str, tmp_path: Path) -> None:
    with pytest.raises(NothingToMap):
        WRITERS[name](tmp_path / name, of_bytes({}))


@pytest.mark.parametrize("name", ["tiles.pmtiles", "tiles.mbtiles", "tiles.zip", "map.kmz"])
def test_memory_does_not_grow_with_the_map(name: str, tmp_path: Path) -> None:
    """160 MB of tiles go through 40 MB more than there was before."""
    size, process = 400_000, psutil.Process()
    keys = [TileKey(16, 30_000 + k % 20, 20_000 + k // 20) for k in range(400)]
    before, most = process.memory_info().rss, 0

    def read(tile: TileKey) -> bytes:
        nonlocal most
        most = max(most, process.memory_info().rss)
        return b"\xff\xd8" + random.Random(repr(tile)).randbytes(size)

    WRITERS[name](tmp_path / name, TileSet("large", dict.fromkeys(keys, pyramid.JPEG), read))
    assert (tmp_path / name).stat().st_size > len(keys) * size
    assert most - before < 40_000_000


def test_pmtiles_says_where_and_what_it_is(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    write_pmtiles(tmp_path / "tiles.pmtiles", of_bytes(tiles))
    with (tmp_path / "tiles.pmtiles").open("rb") as file:
        reader = Reader(MmapSource(file))
        header = reader.header()
        west, south = (header[f"min_{k}_e7"] / 1e7 for k in ("lon", "lat"))
        east, north = (header[f"max_{k}_e7"] / 1e7 for k in ("lon", "lat"))
        corners = tile_bounds_lonlat(TileKey(ZOOM, X0, Y0 + 2)), tile_bounds_lonlat(TileKey(ZOOM, X0 + 4, Y0))
        assert (west, south) == pytest.approx(corners[0][:2], abs=1e-7)
        assert (east, north) == pytest.approx(corners[1][2:], abs=1e-7)
        assert (header["min_zoom"], header["max_zoom"]) == (min(t.z for t in tiles), ZOOM)
        assert header["min_zoom"] <= header["center_zoom"] <= ZOOM
        assert header["clustered"] is True
        assert (header["tile_type"], header["tile_compression"]) == (TileType.WEBP, Compression.NONE)
        assert header["addressed_tiles_count"] == len(tiles)
        assert reader.metadata()["name"] == "A flood"
        for tile, data in tiles.items():
            assert bytes(reader.get(*tile)) == data
        assert reader.get(ZOOM, X0 + 3, Y0 + 1) is None


def test_who_knows_only_jpeg_is_promised_only_jpeg(tmp_path: Path) -> None:
    tile = TileKey(ZOOM, X0, Y0)
    plain = of_bytes({tile: native(tile, opaque=True)})
    write_pmtiles(tmp_path / "a", plain)
    with (tmp_path / "a").open("rb") as file:
        assert Reader(MmapSource(file)).header()["tile_type"] is TileType.JPEG
    write_folder(tmp_path / "b", plain)
    assert zipfile.ZipFile(tmp_path / "b").namelist()[1] == f"{ZOOM}/{X0}/{Y0}.jpg"


def test_mbtiles_metadata_is_what_the_format_asks_for(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    write_mbtiles(tmp_path / "tiles.mbtiles", of_bytes(tiles))
    with sqlite3.connect(tmp_path / "tiles.mbtiles") as db:
        known = dict(db.execute("SELECT name, value FROM metadata"))
        assert db.execute("PRAGMA application_id").fetchone() == (0x4D504258,)
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert {"name", "format", "bounds", "center", "minzoom", "maxzoom", "type"} <= known.keys()
    assert (known["format"], known["type"], known["maxzoom"]) == ("webp", "overlay", str(ZOOM))
    west, south, east, north = map(float, known["bounds"].split(","))
    lon, lat, zoom = map(float, known["center"].split(","))
    assert (west < lon < east, south < lat < north) == (True, True)
    assert int(known["minzoom"]) <= zoom <= ZOOM


def test_gdal_sees_the_mbtiles_where_the_map_is(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    """A reader that is not ours puts every tile, whichever its format, at the tile's place."""
    write_mbtiles(tmp_path / "tiles.mbtiles", of_bytes(tiles))
    to_mercator = Transformer.from_crs(4326, 3857, always_xy=True)
    with rasterio.open(tmp_path / "tiles.mbtiles") as raster:
        for tile in (t for t in tiles if t.z == ZOOM):
            west, south, east, north = tile_bounds_lonlat(tile)
            place = to_mercator.transform(0.3 * west + 0.7 * east, 0.3 * south + 0.7 * north)
            (seen,) = raster.sample([place])
            np.testing.assert_allclose(seen, [*colour(tile), 255], atol=6)


def test_the_folder_tells_how_to_address_it(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    write_folder(tmp_path / "tiles.zip", of_bytes(tiles))
    with zipfile.ZipFile(tmp_path / "tiles.zip") as file:
        known = json.loads(file.read("tilejson.json"))
        (pattern,) = known["tiles"]
        for tile, data in tiles.items():
            assert file.read(pattern.format(z=tile.z, x=tile.x, y=tile.y)) == data
    assert (known["minzoom"], known["maxzoom"]) == (min(t.z for t in tiles), ZOOM)


def test_google_earth_finds_every_tile_in_its_region(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    """From doc.kml on, links lead to each tile once; regions hold what they lead to; no link is dead."""
    write_kmz(tmp_path / "map.kmz", of_bytes(tiles, "Fluß & <Brücke>\x07"))
    kmz = zipfile.ZipFile(tmp_path / "map.kmz")
    assert kmz.namelist()[0] == "doc.kml"
    found: set[TileKey] = set()
    _follow(kmz, "doc.kml", (-180.0, -90.0, 180.0, 90.0), found)
    assert found == set(tiles)
    for tile, data in tiles.items():
        base = f"{tile.z}/{tile.x}/{tile.y}"
        if data[:2] == b"\xff\xd8":
            assert kmz.read(f"{base}.jpg") == data
        else:
            picture = np.asarray(Image.open(io.BytesIO(kmz.read(f"{base}.png"))))
            np.testing.assert_array_equal(picture, pyramid.decode(data))
    assert len(kmz.namelist()) == 1 + 2 * len(tiles)
    assert ET.fromstring(kmz.read("doc.kml")).findtext(f".//{{{KML}}}name") == "Fluß & <Brücke>"


def _follow(
    kmz: zipfile.ZipFile, name: str, region: tuple[float, float, float, float], found: set[TileKey]
) -> None:
    page = ET.fromstring(kmz.read(name))
    folder = name.rpartition("/")[0]
    for overlay in page.iter(f"{{{KML}}}GroundOverlay"):
        tile = TileKey(*map(int, name.removesuffix(".kml").split("/")))
        assert tile not in found
        found.add(tile)
        assert _sides(overlay, "LatLonBox") == tile_bounds_lonlat(tile)
        assert _covers(region, tile_bounds_lonlat(tile))
        href = overlay.findtext(f"{{{KML}}}Icon/{{{KML}}}href") or ""
        assert f"{folder}/{href}" in kmz.namelist()
    for link in page.iter(f"{{{KML}}}NetworkLink"):
        inner = _sides(link, "LatLonAltBox")
        assert _covers(region, inner)
        href = link.findtext(f"{{{KML}}}Link/{{{KML}}}href") or ""
        _follow(kmz, str(Path("/", folder, href).resolve().relative_to("/")), inner, found)


def _sides(element: ET.Element, box: str) -> tuple[float, float, float, float]:
    found = next(element.iter(f"{{{KML}}}{box}"))
    west, south, east, north = (
        float(found.findtext(f"{{{KML}}}{side}") or "") for side in ("west", "south", "east", "north")
    )
    return west, south, east, north


def _covers(outer: tuple[float, ...], inner: tuple[float, ...]) -> bool:
    return outer[0] <= inner[0] and outer[1] <= inner[1] and outer[2] >= inner[2] and outer[3] >= inner[3]


def test_gdal_sees_the_kmz_where_the_map_is(tmp_path: Path, tiles: dict[TileKey, bytes]) -> None:
    """QGIS opens it by GDAL: every tile at its place, and nothing where there is none."""
    write_kmz(tmp_path / "map.kmz", of_bytes(tiles))
    hole = TileKey(ZOOM, X0 + 3, Y0 + 1)
    with rasterio.open(tmp_path / "map.kmz") as raster:
        assert raster.crs.to_epsg() == 4326
        for tile in [hole, *(t for t in tiles if t.z == ZOOM)]:
            west, south, east, north = tile_bounds_lonlat(tile)
            (seen,) = raster.sample([(0.3 * west + 0.7 * east, 0.3 * south + 0.7 * north)])
            if tile in tiles:
                np.testing.assert_allclose(seen, [*colour(tile), 255], atol=6)
            else:
                assert seen[3] == 0


@pytest.mark.parametrize("long_side_px", [2048, 700, 100])
def test_the_world_file_puts_the_preview_where_the_tiles_are(
    tmp_path: Path, tiles: dict[TileKey, bytes], long_side_px: int
) -> None:
    write_preview(tmp_path / "preview.zip", preview(of_bytes(tiles), EPSG, long_side_px))
    with zipfile.ZipFile(tmp_path / "preview.zip") as file:
        picture = np.asarray(Image.open(io.BytesIO(file.read("preview.png"))))
        a, d, b, e, c, f = (float(line) for line in file.read("preview.pgw").split())
        crs = rasterio.CRS.from_wkt(file.read("preview.prj").decode())
    assert max(picture.shape[:2]) == pytest.approx(long_side_px, rel=0.03)
    assert max(picture.shape[:2]) <= long_side_px
    assert (b, d, a) == (0, 0, -e)
    assert crs.to_epsg() == EPSG
    to_utm = Transformer.from_crs(4326, EPSG, always_xy=True)
    for tile in (t for t in tiles if t.z == ZOOM):
        west, south, east, north = tile_bounds_lonlat(tile)
        for along, up, alpha in ((0.7, 0.7, 255), (0.3, 0.7, 255), (0.3, 0.3, 0), (0.7, 0.3, 255)):
            x, y = to_utm.transform(west + along * (east - west), south + up * (north - south))
            seen = picture[round((y - f) / e), round((x - c) / a)]
            expected = alpha if tiles[tile][:2] != b"\xff\xd8" else 255
            assert seen[3] == expected
            if expected:
                np.testing.assert_allclose(seen[:3], colour(tile), atol=12)
    hole = tile_bounds_lonlat(TileKey(ZOOM, X0 + 3, Y0 + 1))
    x, y = to_utm.transform((hole[0] + hole[2]) / 2, (hole[1] + hole[3]) / 2)
    assert picture[round((y - f) / e), round((x - c) / a), 3] == 0


def test_gdal_sees_the_preview_where_the_world_file_puts_it(
    tmp_path: Path, tiles: dict[TileKey, bytes]
) -> None:
    """Unpacked, it needs nobody to say which CRS it is in."""
    shown = preview(of_bytes(tiles), EPSG)
    write_preview(tmp_path / "preview.zip", shown)
    with zipfile.ZipFile(tmp_path / "preview.zip") as file:
        file.extractall(tmp_path)
    with rasterio.open(tmp_path / "preview.png") as raster:
        assert raster.crs.to_epsg() == EPSG
        assert raster.transform.almost_equals(shown.transform, 1e-6)
        np.testing.assert_array_equal(raster.read(), shown.rgba.transpose(2, 0, 1))


def test_a_preview_is_never_larger_than_the_map_has_pixels() -> None:
    tile = TileKey(ZOOM, X0, Y0)
    shown = preview(of_bytes({tile: native(tile, opaque=True)}), EPSG)
    assert max(shown.rgba.shape[:2]) <= TILE_PX + 8
    assert shown.png() == preview(of_bytes({tile: native(tile, opaque=True)}), EPSG).png()
