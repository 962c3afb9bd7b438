"""How much mean colour jumps where one photo of the mosaic ends and another begins.

python -m tests.bench.seams DIR [DIR …]  prints one line of JSON a folder of photos.

The network of seams is that of the map that is drawn: wherever two neighbouring pixels come from different
photos at the finest level. It is cut into pieces; each has a strip on either side. The ground changes its
colour along a strip's width anyway, and much so where a seam follows the border of a wood: so the mosaic is
held against each of both photos drawn alone, which shows the same ground on both sides, and only what the
mosaic's difference to it changes by is counted (`step`, the median over all pieces).

Where two photos show different things at the same place, the crowns of trees from two sides, this still
counts things as tone. How much tells `floor`: the same measure on the same pieces if one photo alone were
drawn on both sides, where there is no seam at all. And two more figures are nearly free of it:
`step_same_ground`, over those pieces where both photos show the same; `step_whole_seams`, where the steps of
all pieces between the same two photos are averaged with their signs: exposure errs alike along a seam, things
do not.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import core.mosaic as oracle
from core import fusion
from core.coverage import block_grid
from core.fusion import FrameIndex, render

LENGTH_PX, NEAR_PX, FAR_PX = 64, 2, 18
"""A piece of seam lies in one square of this side; its two strips reach from near to far."""
SAME_GROUND = 0.6
"""Correlation of the two photos from which on they show the same."""
LEAST_PX = 400
"""Strips with fewer pixels that both photos show tell nothing."""
MAX_SIDE = 1600

Sources = NDArray[np.int16]
Picture = NDArray[np.float32]


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


class Piece(NamedTuple):
    """`step`, `floor` in grey levels, from the photo `low` to `high`; `alike`: their correlation."""

    low: int
    high: int
    length_px: int
    step: float
    floor: float
    alike: float


def measure(layout: oracle.Layout, photos: Any) -> Iterator[Piece]:
    """All pieces whose strips both photos show."""
    grid, ids, index = (
        block_grid(sorted(layout.cover)),
        sorted(layout.frames),
        FrameIndex(layout.frames.values()),
    )
    with Watched() as watched:
        drawn = render(grid, layout.world, list(index.frames), photos, layout.fusion)
        sources = watched.sources(grid, ids)
    sources[drawn[..., 3] == 0] = -1
    found = list(pieces(sources))
    boxes = [_box(at, sources.shape) for _, _, at in found]

    @lru_cache(maxsize=24)
    def alone(k: int) -> tuple[int, int, NDArray[np.uint8]]:
        """What the photo shows around all of its pieces, and where that begins."""
        mine = np.array([box for box, piece in zip(boxes, found, strict=True) if k in piece[:2]])
        (top, left), (bottom, right) = mine[:, :2].min(0).tolist(), mine[:, 2:].max(0).tolist()
        window = grid.window(grid.col0 + left, grid.row0 + top, right - left, bottom - top)
        return top, left, render(window, layout.world, [layout.frames[ids[k]]], photos, layout.fusion)

    for (low, high, at), (y0, x0, y1, x1) in zip(found, boxes, strict=True):
        singles = []
        for top, left, picture in (alone(low), alone(high)):
            singles.append(picture[y0 - top : y1 - top, x0 - left : x1 - left].astype(np.float32))
        part = np.s_[y0:y1, x0:x1]
        piece = piece_of(low, high, at - (y0, x0), sources[part], drawn[part].astype(np.float32), singles)
        if piece is not None:
            yield piece


def _box(at: NDArray[np.int64], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    low, high = np.maximum(at.min(0) - FAR_PX - 2, 0), np.minimum(at.max(0) + FAR_PX + 3, shape)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def piece_of(
    low: int, high: int, at: NDArray[np.int64], whose: Sources, picture: Picture, singles: list[Picture]
) -> Piece | None:
    away = np.ones(whose.shape, np.uint8)
    away[at[:, 0], at[:, 1]] = 0
    far_px = cv2.distanceTransform(away, cv2.DIST_L2, 3)
    strip = (far_px >= NEAR_PX) & (far_px <= FAR_PX)
    both = strip & (singles[0][..., 3] > 0) & (singles[1][..., 3] > 0)
    sides = [both & (whose == k) for k in (low, high)]
    if min(side.sum() for side in sides) < LEAST_PX:
        return None

    def change(rest: Picture) -> float:
        return float((rest[sides[1]].mean(0) - rest[sides[0]].mean(0))[:3].mean())

    step = (change(picture - singles[0]) + change(picture - singles[1])) / 2
    grey = [single[..., :3].mean(2)[both] for single in singles]
    floor = change(singles[1] - singles[0]) / 2
    return Piece(low, high, len(at), step, abs(floor), float(np.corrcoef(*grey)[0, 1]))


def line_of(found: list[Piece]) -> dict[str, float | None]:
    """The medians, in grey levels; None where there is nothing to take one of."""
    same = [p for p in found if p.alike > SAME_GROUND]
    seams: dict[tuple[int, int], list[Piece]] = {}
    for p in found:
        seams.setdefault((p.low, p.high), []).append(p)
    whole = [np.average([p.step for p in s], weights=[p.length_px for p in s]) for s in seams.values()]
    return {
        "pieces": len(found),
        "step": _median([p.step for p in found]),
        "floor": _median([p.floor for p in found]),
        "pieces_same_ground": len(same),
        "step_same_ground": _median([p.step for p in same]),
        "floor_same_ground": _median([p.floor for p in same]),
        "seams": len(seams),
        "step_whole_seams": _median(whole),
    }


def _median(values: Sequence[float]) -> float | None:
    return round(float(np.median(np.abs(values))), 2) if values else None


def main() -> None:
    """Prints the figures of each folder."""
    kept: list[tuple[oracle.Layout, Any]] = []
    draw = oracle.draw
    oracle.draw = lambda layout, photos: (kept.append((layout, photos)), draw(layout, photos))[1]  # type: ignore[func-returns-value]
    for folder in map(Path, sys.argv[1:]):
        images = folder / "images" if (folder / "images").is_dir() else folder
        oracle.build([(p.name, p.read_bytes()) for p in sorted(images.iterdir())], MAX_SIDE)
        print(json.dumps({"flight": folder.name} | line_of(list(measure(*kept.pop())))), flush=True)


if __name__ == "__main__":
    main()
