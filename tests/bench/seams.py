"""How much mean colour jumps where one photo of the mosaic ends and another begins.

python -m tests.bench.seams DIR [DIR …]  prints one line of JSON a folder of photos.
The ground changes its colour anyway: so the mosaic is held against each of both photos drawn alone, which
shows the same ground on both sides, and only what the mosaic's difference to it changes by is counted.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import core.mosaic as oracle
from core import fusion
from core.coverage import FUSION, block_grid
from core.fusion import FrameIndex, render

LENGTH_PX, NEAR_PX, FAR_PX = 64, 2, 18
"""A piece of seam lies in one square of this side; its two strips reach from near to far."""
SAME_GROUND = 0.6
"""Correlation of the two photos from which on they show the same."""
MAX_SIDE = 1600

Sources = NDArray[np.int16]


class Watched:
    """Remembers, while it is entered, which frame each pixel of the last render came from."""

    def __enter__(self) -> Watched:
        self._finest, self._draw = fusion.blend_finest, fusion._draw

        def finest(*given: Any) -> Any:
            self.labels = given[3]
            return self._finest(*given)

        def draw(scene: Any, lattice: Any, *rest: Any) -> Any:
            self.frames, self.lattice = [f.frame_id for f in scene.frames], lattice
            return self._draw(scene, lattice, *rest)

        fusion.blend_finest, fusion._draw = finest, draw
        return self

    def __exit__(self, *_: object) -> None:
        fusion.blend_finest, fusion._draw = self._finest, self._draw

    def sources(self, grid: Any, ids: list[str]) -> Sources:
        top, left = grid.row0 - self.lattice.row0, grid.col0 - self.lattice.col0
        names = np.array([*(ids.index(f) for f in self.frames), -1], np.int16)
        return np.asarray(names[self.labels[top:, left:][: grid.height, : grid.width]])


def pieces(sources: Sources) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """The two photos and the pixels (N, 2) of every piece of seam."""
    found = []
    for a, b in ((sources[:-1], sources[1:]), (sources[:, :-1], sources[:, 1:])):
        y, x = np.nonzero((a != b) & (a >= 0) & (b >= 0))
        low, high = np.minimum(a[y, x], b[y, x]), np.maximum(a[y, x], b[y, x])
        found.append(np.column_stack((y, x, y // LENGTH_PX, x // LENGTH_PX, low, high)))
    points = np.concatenate(found)
    kinds, kind, count = np.unique(points[:, 2:], axis=0, return_inverse=True, return_counts=True)
    for k in np.flatnonzero(count >= LENGTH_PX // 2):
        yield int(kinds[k, 2]), int(kinds[k, 3]), points[kind.ravel() == k, :2]


def measure(layout: oracle.Layout, photos: Any) -> Iterator[tuple[float, float]]:
    """Step in grey levels, and correlation of the two photos, of every piece."""
    grid, ids, index = (
        block_grid(sorted(layout.cover)),
        sorted(layout.frames),
        FrameIndex(layout.frames.values()),
    )
    with Watched() as watched:
        drawn = render(grid, layout.world, list(index.frames), photos, FUSION)
        sources = watched.sources(grid, ids)
    sources[drawn[..., 3] == 0] = -1
    for low, high, at in pieces(sources):
        y0, x0 = np.maximum(at.min(0) - FAR_PX - 2, 0)
        y1, x1 = at.max(0) + FAR_PX + 3
        whose, picture = sources[y0:y1, x0:x1], drawn[y0:y1, x0:x1, :3].astype(np.float32)
        away = np.ones(whose.shape, np.uint8)
        away[at[:, 0] - y0, at[:, 1] - x0] = 0
        far_px = cv2.distanceTransform(away, cv2.DIST_L2, 3)
        strip = (far_px >= NEAR_PX) & (far_px <= FAR_PX)
        window = grid.window(grid.col0 + int(x0), grid.row0 + int(y0), whose.shape[1], whose.shape[0])
        alone = [render(window, layout.world, [layout.frames[ids[k]]], photos, FUSION) for k in (low, high)]
        both = strip & (alone[0][..., 3] > 0) & (alone[1][..., 3] > 0)
        sides = [both & (whose == k) for k in (low, high)]
        if min(side.sum() for side in sides) < 400:
            continue
        left = [picture - a[..., :3] for a in alone]
        steps = [float((rest[sides[1]].mean(0) - rest[sides[0]].mean(0)).mean()) for rest in left]
        grey = [a[..., :3].mean(2)[both] for a in alone]
        yield abs(sum(steps) / 2), float(np.corrcoef(*grey)[0, 1])


def main() -> None:
    """Prints the median step over all seams, and over those where both photos show the same ground."""
    kept: list[tuple[oracle.Layout, Any]] = []
    draw = oracle.draw
    oracle.draw = lambda layout, photos: (kept.append((layout, photos)), draw(layout, photos))[1]  # type: ignore[func-returns-value]
    for folder in map(Path, sys.argv[1:]):
        images = folder / "images" if (folder / "images").is_dir() else folder
        oracle.build([(p.name, p.read_bytes()) for p in sorted(images.iterdir())], MAX_SIDE)
        found = np.array(list(measure(*kept.pop())))
        same = found[found[:, 1] > SAME_GROUND, 0]
        line = {"flight": folder.name, "seams": len(found), "step": round(float(np.median(found[:, 0])), 2)}
        line |= {"same_ground": len(same), "step_same_ground": round(float(np.median(same)), 2)}
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
