"""The map as a STAC item: where and when it is of, how fine, and which files there are of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely
from pystac import Asset, Item
from pystac.extensions.projection import ProjectionExtension

from core.errors import NothingToMap
from core.exports import NamedFrame
from core.geometry import World
from core.grid import UtmGrid
from core.outline import ground_outline

_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_ASSETS = (
    ("mosaic", "mosaic.tif", "Orthophoto", _COG, ("data", "visual")),
    ("thumbnail", "preview.png", "Preview", "image/png", ("thumbnail", "overview")),
    ("tiles", "tiles.pmtiles", "Map tiles", "application/vnd.pmtiles", ("visual", "tiles")),
    ("footprints", "footprints.geojson", "Photo footprints", "application/geo+json", ("metadata",)),
    ("route", "route.csv", "Flight route", "text/csv", ("metadata",)),
    ("poses", "poses.json", "Camera poses", "application/json", ("metadata",)),
    ("report", "report.json", "Report", "application/json", ("metadata",)),
)


def stac_item(
    item_id: str, title: str, world: World, frames: Sequence[NamedFrame], grid: UtmGrid, otherwise_s: float
) -> dict[str, Any]:
    """A STAC 1.1 item with the projection extension, next to whose file the other exports lie.

    `grid`: the mosaic's raster. `otherwise_s`: the time (s since 1970) of photos that do not tell theirs.
    Raises NothingToMap.
    """
    shape = ground_covered(world, frames, tolerance_m=grid.gsd_m)
    times = sorted(f.captured_s for f in frames if f.captured_s is not None) or [otherwise_s]
    start, end = (datetime.fromtimestamp(round(s, 3), UTC) for s in (times[0], times[-1]))
    item = Item(
        id=item_id,
        geometry=json.loads(shapely.to_geojson(shape)),
        bbox=list(shape.bounds),
        datetime=start,
        properties={"title": title, "gsd": round(grid.gsd_m, 5)},
        start_datetime=start,
        end_datetime=end,
    )
    for key, name, label, media_type, roles in _ASSETS:
        item.add_asset(key, Asset(f"./{name}", label, media_type=media_type, roles=list(roles)))
    right, bottom = grid.left + grid.width * grid.gsd_m, grid.top - grid.height * grid.gsd_m
    ProjectionExtension.ext(item, add_if_missing=True).apply(
        code=f"EPSG:{grid.epsg}",
        bbox=[grid.left, bottom, right, grid.top],
        shape=[grid.height, grid.width],
        transform=[grid.gsd_m, 0.0, grid.left, 0.0, -grid.gsd_m, grid.top],
    )
    return item.to_dict(include_self_link=False)


def ground_covered(world: World, frames: Sequence[NamedFrame], tolerance_m: float) -> Any:
    """The union of what the frames show, a (multi)polygon in degrees. Raises NothingToMap."""
    outlines = []
    for frame in sorted(frames, key=lambda f: f.posed.frame_id):
        outline = ground_outline(frame.posed)
        if outline is not None:
            points = np.column_stack((outline, np.full(len(outline), frame.posed.pose.ground_h_m)))
            outlines.append(shapely.Polygon(world.to_geodetic(points)[:, :2]).buffer(0))
    if not outlines:
        raise NothingToMap
    covered = shapely.union_all(outlines).simplify(tolerance_m / 111_000)
    return shapely.orient_polygons(shapely.set_precision(covered, 1e-8))
