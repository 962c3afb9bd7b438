"""The CRS that somebody wants the mosaic in: whether it is one, whether it reaches there, how exactly."""

from __future__ import annotations

import warnings

import rasterio
from pyproj import CRS
from pyproj.transformer import AreaOfInterest, TransformerGroup
from rasterio.errors import CRSError

from core.errors import BadCrs
from core.grid import utm_epsg

FAR_DEG = 20.0
"""One zone for a whole country is in use, far beyond its borders; another continent's is a mistake."""


def checked_crs(crs: str | None) -> rasterio.CRS | None:
    """What GDAL makes of it. Raises BadCrs."""
    if crs is None:
        return None
    try:
        with rasterio.Env():
            return rasterio.CRS.from_user_input(crs)
    except CRSError as error:
        raise BadCrs(
            f"{crs!r:.80} is not a coordinate reference system. Name one such as EPSG:32632."
        ) from error


def check_reach(crs: rasterio.CRS, lon_deg: float, lat_deg: float) -> None:
    """Raises BadCrs where the place is in another part of the world than the CRS is made for.

    Its datum does not hold there: the map would lie hundreds of metres beside its place.
    """
    known = crs.to_authority()
    area = CRS.from_authority(*known).area_of_use if known else None
    if area is None:
        return
    across, wide = (lon_deg - area.west) % 360, (area.east - area.west) % 360 or 360.0
    beside = 0.0 if across <= wide else min(across - wide, 360 - across)
    above = max(area.south - lat_deg, lat_deg - area.north, 0.0)
    if max(beside, above) > FAR_DEG:
        raise BadCrs(
            f"{crs.to_string()} is made for another part of the world ({area.name.rstrip('.')}). "
            f"The map lies at latitude {lat_deg:.2f}, longitude {lon_deg:.2f}: name one for there, "
            f"such as EPSG:{utm_epsg(lat_deg, lon_deg)}."
        )


def transformation(source: rasterio.CRS, target: rasterio.CRS, lon_deg: float, lat_deg: float) -> str:
    """How coordinates get from one CRS to the other there, and to within how many metres.

    The grids of national surveys are not part of PROJ: without them it may be metres on a map of centimetres.
    """
    near = AreaOfInterest(lon_deg - 0.01, lat_deg - 0.01, lon_deg + 0.01, lat_deg + 0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that a grid is missing is what we tell
        group = TransformerGroup(source, target, always_xy=True, area_of_interest=near)
    if not group.transformers:
        return "unknown"
    best = group.transformers[0]
    within = f"within {best.accuracy:g} m" if best.accuracy >= 0 else "nobody knows how exactly"
    return f"{best.description}: {within}"
