"""The STAC item is one, by the standard's own schemas, and says of the mosaic what the mosaic says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pystac
import pytest
import rasterio
import shapely
from numpy.typing import NDArray
from pystac.extensions.projection import ProjectionExtension
from pystac.validation.stac_validator import JsonSchemaSTACValidator
from scipy.spatial.transform import Rotation

from core.cog import MosaicParams, flight_gsd_m, mosaic_grid, write_mosaic
from core.errors import NothingToMap
from core.exports import NamedFrame, footprints_geojson
from core.geometry import Camera, Pose, PosedFrame, World
from core.stac import stac_item

CAMERA = Camera(400, 300, 300.0, 199.5, 149.5)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
WORLD = World(-33.0, 151.0, 20.0)


def frame(x: float, y: float, captured_s: float | None = None, tilt: float = 0.0) -> NamedFrame:
    pose = Pose(Rotation.from_euler("zx", [0.4, tilt]).as_matrix() @ DOWN, np.array([x, y, 60.0]), 0.0)
    return NamedFrame(f"{x}.jpg", PosedFrame(f"{int(x):016x}{int(y):016x}", CAMERA, pose), captured_s)


class Grey:
    """Photos that are grey all over."""

    def photo(self, frame_id: str) -> NDArray[np.uint8]:
        return np.full((300, 400, 3), 90, np.uint8)

    def thumb(self, frame_id: str) -> NDArray[np.uint8]:
        return np.full((96, 128, 3), 90, np.uint8)


def item_of(frames: list[NamedFrame]) -> dict[str, Any]:
    drawn = [f.posed for f in frames]
    grid = mosaic_grid(WORLD, drawn, flight_gsd_m(drawn), 10**9)
    return stac_item("abc", "A flood", WORLD, frames, grid, otherwise_s=1.7e9)


# Two strips that meet, and a third that lies apart.
FLIGHT = [frame(x, y, 1.8e9 + 2.5 * x + y) for y in (0.0, 40.0, 400.0) for x in (0.0, 30.0, 60.0)]


def test_it_is_valid() -> None:
    item = pystac.Item.from_dict(item_of(FLIGHT))
    kind, version = pystac.STACObjectType.ITEM, pystac.get_stac_version()
    assert JsonSchemaSTACValidator().validate_core(item.to_dict(), kind, version)
    assert item.to_dict()["stac_version"] == version
    assert item.common_metadata.gsd == pytest.approx(0.2, rel=1e-3)


def test_it_covers_what_the_photos_show_and_no_more() -> None:
    document = item_of(FLIGHT)
    covered = shapely.geometry.shape(document["geometry"])
    assert covered.is_valid
    assert isinstance(covered, shapely.MultiPolygon)
    assert tuple(document["bbox"]) == covered.bounds
    shown = [shapely.geometry.shape(f["geometry"]) for f in footprints_geojson(WORLD, FLIGHT)["features"]]
    union = shapely.union_all(shown)
    assert covered.symmetric_difference(union).area < 1e-3 * union.area
    for polygon in covered.geoms:
        assert polygon.exterior.is_ccw


def test_it_says_when() -> None:
    known = item_of(FLIGHT)["properties"]
    assert known["datetime"] == known["start_datetime"] == "2027-01-15T08:00:00Z"
    assert known["end_datetime"] == "2027-01-15T08:09:10Z"
    assert item_of([frame(0, 0)])["properties"]["datetime"] == "2023-11-14T22:13:20Z"


def test_it_knows_the_mosaic(tmp_path: Path) -> None:
    frames = FLIGHT[:3]
    item = pystac.Item.from_dict(item_of(frames))
    assert item.assets["mosaic"].href == "./mosaic.tif"
    drawn = [f.posed for f in frames]
    write_mosaic(tmp_path / "mosaic.tif", WORLD, drawn, Grey(), params=MosaicParams(deflate_level=1))
    projection = ProjectionExtension.ext(item)
    with rasterio.open(tmp_path / "mosaic.tif") as mosaic:
        assert projection.code == f"EPSG:{mosaic.crs.to_epsg()}"
        assert projection.shape == [mosaic.height, mosaic.width]
        assert projection.bbox == pytest.approx(list(mosaic.bounds))
        assert projection.transform == pytest.approx(list(mosaic.transform)[:6])


def test_it_does_not_depend_on_the_order_of_arrival() -> None:
    assert item_of(FLIGHT) == item_of(FLIGHT[::-1])


def test_no_ground_is_no_item() -> None:
    grid = mosaic_grid(WORLD, [FLIGHT[0].posed], 0.2, 10**9)
    with pytest.raises(NothingToMap):
        stac_item("abc", "Sky", WORLD, [frame(0, 0, tilt=2.0)], grid, otherwise_s=0.0)
