"""What a growing layout shows of each native tile: kept up to date with every photo that is added."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from core.coverage import inside, outline_px, samples
from core.geometry import Array, PosedFrame
from core.grid import TileKey
from core.mosaic import Layout
from services.catalog.tiles import GROWN, NEW, Key


class Shown:
    """The tiles of one layout, and what of each no frame shows yet; both are worked out when they are asked.

    The frames of that layout stay as they are; `grow` takes in further ones.
    """

    def __init__(self, layout: Layout) -> None:
        """All that the layout has by now."""
        self.layout = layout
        self._outlines: dict[str, Array | None] = {}
        self._unseen: dict[TileKey, Array] = {}
        self._to_look_at: dict[TileKey, list[PosedFrame]] = {}
        for frame_id in layout.frames:
            self._add(layout.frames[frame_id], layout.under[frame_id])

    def has(self, tile: TileKey) -> bool:
        """Whether any frame lies on the tile."""
        return tile in self._unseen or tile in self._to_look_at

    def is_full(self, tile: TileKey) -> bool:
        """Whether the frames leave nothing of the tile uncovered."""
        return self.has(tile) and not len(self.unseen(tile))

    def unseen(self, tile: TileKey) -> Array:
        """Those of the tile's `samples` that no frame sees."""
        if not self.has(tile):
            return samples(tile)
        unseen = self._unseen[tile] if tile in self._unseen else samples(tile)
        for frame in self._to_look_at.pop(tile, ()):
            outline = self._outline(frame)
            if len(unseen) and outline is not None:
                unseen = unseen[~inside(outline, unseen)]
        self._unseen[tile] = unseen
        return unseen

    def sees_any(self, tile: TileKey, points: Array) -> bool:
        """Whether a frame sees any of these of the tile's `samples`."""
        return len(points) > 0 and not {(x, y) for x, y in points} <= {(x, y) for x, y in self.unseen(tile)}

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

    def _outline(self, frame: PosedFrame) -> Array | None:
        if frame.frame_id not in self._outlines:
            assert self.layout.zoom is not None
            self._outlines[frame.frame_id] = outline_px(frame, self.layout.world, self.layout.zoom)
        return self._outlines[frame.frame_id]
