"""What a growing layout shows of each native tile: kept up to date with every photo that is added."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from core.coverage import block_grid
from core.geometry import PosedFrame
from core.grid import TILE_PX, Columns, TileKey
from core.mosaic import Layout
from core.patching import CELL_PX, cells_of, surely_shows
from services.catalog.tiles import GROWN, NEW, Key

Cells = NDArray[np.intp]
"""Places of cells among those of a tile, row by row."""
_ALL = np.arange((TILE_PX // CELL_PX) ** 2)


class Shown:
    """The tiles of one layout, and which of their cells are open; both are worked out when they are asked.

    A cell is open that no frame surely shows: live drawing fills just those that one does. The frames of
    that layout stay as they are; `grow` takes in further ones.
    """

    def __init__(self, layout: Layout) -> None:
        """All that the layout has by now."""
        self.layout = layout
        self._open: dict[TileKey, Cells] = {}
        self._to_look_at: dict[TileKey, list[PosedFrame]] = {}
        for frame_id in layout.frames:
            self._add(layout.frames[frame_id], layout.under[frame_id])

    def has(self, tile: TileKey) -> bool:
        """Whether any frame lies on the tile."""
        return tile in self._open or tile in self._to_look_at

    def is_full(self, tile: TileKey) -> bool:
        """Whether the frames leave nothing of the tile open."""
        return self.has(tile) and not len(self.open(tile))

    def open(self, tile: TileKey) -> Cells:
        """The tile's cells that are open."""
        cells = self._open.get(tile, _ALL)
        frames = self._to_look_at.pop(tile, None)
        if frames is None:
            return cells
        grid, world = block_grid([tile]), self.layout.world
        foot, slope = cells_of(grid, world)
        for frame in frames:
            if len(cells):
                lines = Columns(foot[cells], slope[cells])
                cells = cells[~surely_shows(frame, lines, grid.resolution_m(world))]
        self._open[tile] = cells
        return cells

    def fills_any(self, tile: TileKey, cells: Cells) -> bool:
        """Whether any of these cells of the tile is not open."""
        return not np.isin(cells, self.open(tile)).all()

    def grow(self, layout: Layout, new_ids: Collection[str]) -> dict[Key, int]:
        """Take in the frames `new_ids` of the layout; the tiles that look different now, with priorities.

        Where a photo shows no new ground nothing does: see `workers.posing.changed`.
        """
        new = sorted(set(new_ids) & layout.frames.keys())
        tiles = set[TileKey]().union(*(layout.under[k] for k in new))
        there = {tile for tile in tiles if self.has(tile)}
        full = {tile for tile in there if self.is_full(tile)}
        for frame_id in new:
            self._add(layout.frames[frame_id], layout.under[frame_id])
        self.layout = layout
        return {tile: GROWN if tile in there else NEW for tile in sorted(tiles - full)}

    def _add(self, frame: PosedFrame, tiles: Iterable[TileKey]) -> None:
        for tile in tiles:
            self._to_look_at.setdefault(tile, []).append(frame)
