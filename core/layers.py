"""The photos that win somewhere, each drawn onto the lattice as far as it is needed and no farther."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from core.blend import Labels, Layer, gaussian_levels
from core.geometry import PosedFrame
from core.parts import Part, Photos, Window, looked_at, part_of
from core.warp import KNOT_BITS, Int32, Lattice, knots, warp

_AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Canvas:
    """What photos are drawn onto, and how. `cubic`: how they are sampled, else linearly."""

    lattice: Lattice
    resolution_m: float
    min_cos_view: float
    bands: int
    cubic: bool

    def layer(
        self, label: int, frame: PosedFrame, labels: Labels, photos: Photos, places: Int32
    ) -> tuple[Layer, tuple[int, int]]:
        """A winner where it wins, and one cell around, as far as the blending of its pixels looks.

        Its pixels lie within half a cell of its knots' cells, and at each level look one pixel farther at
        most. Fills `places` (rows, cols, 2) there: 1/256 px of a photo of the (width, height) returned.
        """
        needed = cv2.dilate((labels == label).astype(np.uint8), _AROUND)
        left, top, cols, rows = cv2.boundingRect(needed)
        needed = needed[top : top + rows, left : left + cols]
        asked = cv2.dilate(np.pad(needed, 1), _AROUND).astype(bool)

        def around(width: int, height: int) -> Int32:
            camera = frame.camera.scaled(width, height)
            return knots(self.lattice, frame, camera, self.min_cos_view, (top, left, rows, cols))

        def window(width: int, height: int) -> Window:
            if self._shrinks(frame, width) > 1:
                return Window(0, 0, width, height)
            return looked_at(around(width, height)[asked], width, height)

        part = self._at_scale(part_of(photos, frame.frame_id, window), frame)
        found = around(part.width, part.height)
        places[top : top + rows, left : left + cols] = found[1:-1, 1:-1]
        found -= np.array((part.left, part.top), np.int32) << KNOT_BITS
        warped = warp(part.pixels, found, needed.astype(bool), self.lattice.cell_px, self.cubic, frame.gain)
        return Layer(label, top, left, gaussian_levels(warped, self.bands)), (part.width, part.height)

    def _shrinks(self, frame: PosedFrame, width: int) -> int:
        """How many times a photo is made smaller, lest it alias: until it is less than twice as fine."""
        gsd_m = abs(frame.pose.gsd_m(frame.camera)) * frame.camera.width / width
        return 1 << max(0, math.floor(math.log2(self.resolution_m / gsd_m)))

    def _at_scale(self, part: Part, frame: PosedFrame) -> Part:
        factor = self._shrinks(frame, part.width)
        if factor == 1:
            return part
        size = (max(2, part.width // factor), max(2, part.height // factor))
        shrunk = cv2.resize(part.pixels, size, interpolation=cv2.INTER_AREA)
        return Part.whole(np.asarray(shrunk, np.uint8))
