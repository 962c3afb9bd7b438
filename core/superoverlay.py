"""The published tiles as a KMZ super-overlay: Google Earth loads what is in view, as fine as it is seen."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree as ET

from PIL import Image

from core.archives import TileSet, write_zip
from core.grid import EQUATOR_M, TILE_PX, TileKey, children, tile_bounds_lonlat
from core.pyramid import JPEG, WEBP, decode

KML = "http://www.opengis.net/kml/2.2"
_SIDES = ("north", "south", "east", "west")
_LOD_PX = TILE_PX // 2
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_kmz(path: Path, tiles: TileSet) -> None:
    """A KMZ at `path`: one small KML and one picture a tile, each naming the finer ones below it.

    JPEG and PNG tiles are in it byte for byte. Google Earth knows no WebP: those are PNG of the same pixels.
    Between its parallels a picture is shown as if degrees, not mercator metres, were even: 0.1 px off where a
    tile is 10 km high, less below.
    """
    write_zip(path, _files(tiles))


def _files(tiles: TileSet) -> Iterable[tuple[str, bytes]]:
    yield "doc.kml", _root(tiles)
    for tile in sorted(tiles.kinds):
        yield f"{_name(tile)}.kml", _page(tiles, tile)
        yield _picture_name(tiles, tile), _picture(tiles, tile)


def _name(tile: TileKey) -> str:
    return f"{tile.z}/{tile.x}/{tile.y}"


def _picture_name(tiles: TileSet, tile: TileKey) -> str:
    return f"{_name(tile)}.{'jpg' if tiles.kinds[tile] == JPEG else 'png'}"


def _picture(tiles: TileSet, tile: TileKey) -> bytes:
    data = tiles.read(tile)
    if tiles.kinds[tile] != WEBP:
        return data
    out = io.BytesIO()
    # A third of the time of the default level for a seventh more bytes.
    Image.fromarray(decode(data), "RGBA").save(out, "PNG", compress_level=1)
    return out.getvalue()


def _root(tiles: TileSet) -> bytes:
    """What is opened: where to look, and the coarsest tiles, which are shown from any distance."""
    kml, document = _document(tiles.title)
    lon, lat, _ = tiles.center()
    look = ET.SubElement(document, "LookAt")
    _values(look, longitude=repr(lon), latitude=repr(lat), tilt="0", range=repr(_range_m(tiles)))
    top = tiles.zooms[0]
    for tile in sorted(t for t in tiles.kinds if t.z == top):
        _link(document, tile, f"{_name(tile)}.kml", min_lod_px=0)
    return _bytes(kml)


def _range_m(tiles: TileSet) -> float:
    west, south, east, north = tiles.bounds()
    return round(1.2 * EQUATOR_M / 360 * max(east - west, north - south), 1)


def _page(tiles: TileSet, tile: TileKey) -> bytes:
    """One tile's picture, over coarser ones, and links to those of its children that there are.

    It says its region itself, as the link to it does: GDAL, and with it QGIS, reads a page only so.
    """
    kml, document = _document(_name(tile))
    _region(document, tile, 0 if tile.z == tiles.zooms[0] else _LOD_PX)
    overlay = ET.SubElement(document, "GroundOverlay")
    _values(overlay, drawOrder=str(tile.z))
    icon = ET.SubElement(overlay, "Icon")
    _values(icon, href=_picture_name(tiles, tile).rsplit("/", 1)[1])
    _box(ET.SubElement(overlay, "LatLonBox"), tile)
    for child in children(tile):
        if child in tiles.kinds:
            _link(document, child, f"../../{_name(child)}.kml", min_lod_px=_LOD_PX)
    return _bytes(kml)


def _document(name: str) -> tuple[ET.Element, ET.Element]:
    kml = ET.Element("kml", xmlns=KML)
    document = ET.SubElement(kml, "Document")
    _values(document, name=_NOT_XML.sub("", name))
    return kml, document


def _link(document: ET.Element, tile: TileKey, href: str, min_lod_px: int) -> None:
    """Have `href` loaded once the tile's ground is `min_lod_px` wide on the screen."""
    link = ET.SubElement(document, "NetworkLink")
    _values(link, name=_name(tile))
    _region(link, tile, min_lod_px)
    _values(ET.SubElement(link, "Link"), href=href, viewRefreshMode="onRegion")


def _region(element: ET.Element, tile: TileKey, min_lod_px: int) -> None:
    region = ET.SubElement(element, "Region")
    _box(ET.SubElement(region, "LatLonAltBox"), tile)
    # Without an upper end: what is coarser stays below, where finer tiles are missing or not there yet.
    _values(ET.SubElement(region, "Lod"), minLodPixels=str(min_lod_px), maxLodPixels="-1")


def _box(element: ET.Element, tile: TileKey) -> None:
    west, south, east, north = tile_bounds_lonlat(tile)
    sides = dict(zip(_SIDES, (north, south, east, west), strict=True))
    _values(element, **{side: repr(degrees) for side, degrees in sides.items()})


def _values(element: ET.Element, **texts: str) -> None:
    for name, text in texts.items():
        ET.SubElement(element, name).text = text


def _bytes(kml: ET.Element) -> bytes:
    return bytes(ET.tostring(kml, "utf-8", xml_declaration=True))
