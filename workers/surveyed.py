"""A mission's surveyed points, and where its mosaic shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.checkpoints import Checkpoints, by_name, observations
from core.cog import DEFAULT as MOSAIC
from core.cog import mosaic_grid
from core.coverage import mission_gsd_m
from core.exports import NamedFrame
from core.fusion import FrameIndex, render
from core.geometry import World
from core.grid import UtmGrid
from core.mosaic_points import look_up, mosaic_document, mosaic_errors, mosaic_points
from core.outline import ground_outline
from services.catalog import surveys
from services.tables import Mission
from workers.app import db
from workers.photos import MissionPhotos, shelf


def points_of(mission_id: str) -> Checkpoints | None:
    """The mission's surveyed points."""
    with db.read() as tx:
        return surveys.checkpoints(tx, mission_id)


def in_mosaic(
    mission: Mission, points: Checkpoints, world: World, named: Sequence[NamedFrame]
) -> dict[str, Any]:
    """Where the mosaic shows the points.

    Only the windows of the mosaic around them are drawn: pixel by pixel they are those of mosaic.tif.
    """
    frames = by_name((n.name, n.posed) for n in named)
    seen = observations(points, world, frames)
    gsd_m = mission_gsd_m((n.posed for n in named), mission.drawn_side)
    if gsd_m is None or not seen:
        return mosaic_document({}, None)
    grid = mosaic_grid(world, [n.posed for n in named], gsd_m, MOSAIC.max_pixels)
    photos = MissionPhotos(shelf, mission.id, mission.drawn_side)
    index = FrameIndex(n.posed for n in named if ground_outline(n.posed) is not None)

    def picture(window: UtmGrid) -> NDArray[np.uint8]:
        return render(window, world, index.overlapping(window, world), photos)

    shown = mosaic_points(points, look_up(seen, world, grid, picture, photos.photo), grid.epsg)
    return mosaic_document(shown, mosaic_errors(points, shown, grid.epsg))
