"""A CRS is taken wherever it is in use, and refused on the other side of the world."""

from __future__ import annotations

import pytest
import rasterio

from core.crs import check_reach, transformation
from core.errors import BadCrs


@pytest.mark.parametrize(
    ("crs", "lon_deg", "lat_deg"),
    [
        ("EPSG:25833", 4.6, 59.0),  # what all of Norway uses
        ("EPSG:25833", 31.1, 70.4),
        ("EPSG:32633", 5.9, 47.0),  # the next zone
        ("EPSG:2193", 179.9, -40.0),  # New Zealand's goes across the antimeridian
        ("EPSG:2193", -176.5, -44.0),
        ("EPSG:3857", -179.9, 84.0),
        ("EPSG:4326", 179.9, -89.0),
    ],
)
def test_a_crs_reaches_a_country_from_end_to_end(crs: str, lon_deg: float, lat_deg: float) -> None:
    known = rasterio.CRS.from_string(crs)
    check_reach(known, lon_deg, lat_deg)
    assert "nobody" not in transformation(rasterio.CRS.from_epsg(32633), known, lon_deg, lat_deg)


@pytest.mark.parametrize(
    ("crs", "lon_deg", "lat_deg", "better"),
    [
        ("EPSG:27700", -92.0, 46.8, "EPSG:32615"),  # Britain's in Minnesota
        ("EPSG:27572", -92.0, 46.8, "EPSG:32615"),  # 300 m off there
        ("EPSG:32733", 15.0, 47.0, "EPSG:32633"),  # the southern zone in the north
        ("EPSG:2193", -121.0, -40.0, "EPSG:32710"),
        ("EPSG:2193", 130.0, -30.0, "EPSG:32752"),
    ],
)
def test_a_crs_of_another_part_of_the_world_is_refused(
    crs: str, lon_deg: float, lat_deg: float, better: str
) -> None:
    with pytest.raises(BadCrs, match=better):
        check_reach(rasterio.CRS.from_string(crs), lon_deg, lat_deg)
