"""The files that can be had of a map, by name: the API offers them, the workers make them."""

from __future__ import annotations

import re

from pyproj import CRS
from pyproj.exceptions import CRSError

from core.errors import BadCrs

MOSAIC = "mosaic.tif"

MAKING = "making-"
"""Begins the names of the folders in which they are made."""

NAMES: tuple[str, ...] = (
    "mosaic.tif",
    "preview.png",
    "preview.zip",
    "tiles.pmtiles",
    "tiles.mbtiles",
    "tiles.zip",
    "map.kmz",
    "stac.json",
    "footprints.geojson",
    "poses.json",
    "route.csv",
    "report.json",
)

_MOSAIC_IN_CRS = re.compile(r"mosaic\.epsg(\d{4,6})\.tif")


def mosaic_in(crs: str) -> str:
    """The name of the mosaic in that CRS, such as "EPSG:3857". Raises BadCrs unless it is one of maps."""
    try:
        known = CRS.from_epsg(int(crs.removeprefix("EPSG:")))
    except (CRSError, ValueError) as error:
        raise BadCrs(f"{crs!r:.40} is not known. Name the mosaic's CRS like EPSG:32632.") from error
    if not (known.is_projected or known.is_geographic) or len(known.axis_info) != 2:
        raise BadCrs(f"{crs} ({known.name}) is no CRS to draw a map in. Name one such as EPSG:32632.")
    return f"mosaic.epsg{known.to_epsg()}.tif"


def crs_of(name: str) -> str | None:
    """The CRS of a mosaic that `mosaic_in` named, None for every other name."""
    match = _MOSAIC_IN_CRS.fullmatch(name)
    return f"EPSG:{match[1]}" if match else None
