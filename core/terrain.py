"""Procedural ground seen from above: a `Landscape` painted at any resolution, and the hills it lies on.

Ground metres: x east, y north, origin in the middle. Pixels of resolution g: column i covers x from i·g to
(i + 1)·g, row j covers y from −j·g down to −(j + 1)·g; both may be negative: windows of one resolution fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from core.furnishing import furniture, verge_trees
from core.landscape import Array, Furniture, Landscape, LandscapeParams, landscape
from core.noise import value_noise_at
from core.paintwork import Layers, light, paint_house, paint_patch, paint_road, paint_stream, stamp_trees
from core.palette import STYLES, Style, tree_colour

HILL_CELL_M = 95.0
REACH_M = 14.0  # the longest shadow plus the widest crown
TILE_PX = 1024


@dataclass(frozen=True, slots=True)
class TerrainParams:
    """`relief_m`: height from the deepest valley to the highest top, within some hundred metres."""

    seed: int = 0
    relief_m: float = 0.0
    monotony: float = 0.0


@dataclass(frozen=True, slots=True)
class Terrain:
    """The ground of one simulated mission."""

    params: TerrainParams

    def height_m(self, xy_m: Array) -> Array:
        """Ground points (N, 2) metres → heights (N,) metres about the level 0, smooth, within ±relief/2."""
        if self.params.relief_m == 0:
            return np.zeros(len(xy_m))
        seed = self.params.seed * 31 + 7
        hills = 0.8 * value_noise_at(seed, HILL_CELL_M, xy_m)
        hills += 0.45 * value_noise_at(seed + 1, HILL_CELL_M * 2.3, xy_m)
        return np.asarray(self.params.relief_m / 2 * np.tanh(1.5 * hills))

    def raster(self, column: int, row: int, width: int, height: int, gsd_m: float) -> NDArray[np.uint8]:
        """The ground's picture, (height, width, 3) uint8 RGB, from pixel (column, row) on."""
        picture = np.empty((height, width, 3), np.uint8)
        for i in range(column // TILE_PX, (column + width - 1) // TILE_PX + 1):
            for j in range(row // TILE_PX, (row + height - 1) // TILE_PX + 1):
                x0, x1 = max(i * TILE_PX, column), min((i + 1) * TILE_PX, column + width)
                y0, y1 = max(j * TILE_PX, row), min((j + 1) * TILE_PX, row + height)
                part = self.tile(i, j, gsd_m)[
                    y0 - j * TILE_PX : y1 - j * TILE_PX, x0 - i * TILE_PX : x1 - i * TILE_PX
                ]
                picture[y0 - row : y1 - row, x0 - column : x1 - column] = part
        return picture

    def tile(self, i: int, j: int, gsd_m: float) -> NDArray[np.uint8]:
        """The square of TILE_PX pixels from pixel (i, j)·TILE_PX on, (TILE_PX, TILE_PX, 3) uint8 RGB."""
        # Shadows fall to the north-east, so that what stands outside reaches in from the south-west.
        reach = -(-int(REACH_M / gsd_m) // 8) * 8 + 8
        left, top, side = i * TILE_PX - reach, j * TILE_PX - 8, TILE_PX + reach + 8
        layers = Layers.blank(left, top, side, side, gsd_m)
        paint(self._plan(), layers, self.params.seed)
        return np.ascontiguousarray(light(layers)[8 : 8 + TILE_PX, reach : reach + TILE_PX])

    def roads(self) -> list[tuple[Array, float]]:
        """The paved ways, where cars drive: middle lines (K, 2) ground metres and widths in metres."""
        return [(r.line, r.width_m) for r in self._plan().roads if r.kind in ("main", "lane")]

    def _plan(self) -> Landscape:
        return landscape(LandscapeParams(self.params.seed, monotony=self.params.monotony))


def paint(plan: Landscape, layers: Layers, seed: int) -> None:
    """Everything of `plan` that is in the window, bottom to top."""
    layers.add_noise(seed)
    _paint_fields(plan, layers)
    visible = [i for i, road in enumerate(plan.roads) if layers.sees(_box(plan, "road", i), 14)]
    soft = ("margin", "hedge")
    for i in visible:
        paint_road(layers, plan.roads[i], verge=True)
    paint_stream(layers, *plan.stream())
    for i in sorted(visible, key=lambda i: (plan.roads[i].kind not in soft, plan.roads[i].width_m, i)):
        paint_road(layers, plan.roads[i])
    items = [furniture(plan, p) for p in plan.parcels if layers.sees(_box(plan, "parcel", p.index), 14)]
    for item in items:
        _paint_furniture(layers, item)
    trees = np.concatenate(
        [f.trees for f in items] + [verge_trees(plan, i) for i in visible] + [np.empty((0, 5))]
    )
    stamp_trees(layers, trees[np.lexsort((trees[:, 0], trees[:, 3]))], tree_colour)


def _paint_furniture(layers: Layers, item: Furniture) -> None:
    for patch in item.patches:
        paint_patch(layers, patch)
    for house in item.houses:
        paint_house(layers, house)


@lru_cache(maxsize=20_000)
def _box(plan: Landscape, what: str, index: int) -> tuple[float, float, float, float]:
    """West, south, east, north of a parcel or road, ground metres."""
    points = plan.roads[index].line if what == "road" else plan.parcels[index].outline
    (west, south), (east, north) = points.min(0), points.max(0)
    return float(west), float(south), float(east), float(north)


def _paint_fields(plan: Landscape, layers: Layers) -> None:
    """Parcels with their crop rows; borders are frayed by noise as growing things are."""
    seen = [p for p in plan.parcels if layers.sees(_box(plan, "parcel", p.index), 8)]
    label: NDArray[np.int16] = np.zeros(layers.height_m.shape, np.int16)
    for k, parcel in enumerate(seen, start=1):
        cv2.fillPoly(label, [layers.fixed(parcel.outline)], k, cv2.LINE_8, shift=4)
    x, y = layers.pixel_grids()
    frayed = 0.55 / layers.gsd_m
    labels = cv2.remap(
        label,
        x + layers.noise["mid"] * frayed,
        y + layers.noise["patch"] * frayed,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )
    styles = [Style.bare(), *(STYLES[p.kind].of(plan.params.seed, p.index, p.monotone) for p in seen)]
    _fill(layers, labels.astype(np.int16), styles, np.array([0.0] + [p.row_rad for p in seen]))


def _fill(layers: Layers, label: NDArray[np.int16], styles: list[Style], row_rad: Array) -> None:
    def of(values: list[float]) -> NDArray[np.float32]:
        return _look_up(np.array(values, np.float32), label)

    # Rows run along the parcel, so that their phase grows across it.
    across = of(list(-np.sin(row_rad))) * layers.x_m + of(list(np.cos(row_rad))) * layers.y_m[:, None]
    life = of([s.life for s in styles])
    across += life * np.float32(0.13) * layers.noise["mid"]
    tone = np.sin(across * of([2 * np.pi / s.row_m for s in styles]))
    tone *= of([s.row_depth * layers.resolves(s.row_m) for s in styles])
    tone *= 1 + np.float32(0.6) * life * layers.noise["patch"]
    tone += 1
    across -= np.float32(18) * np.round(across * np.float32(1 / 18))
    tone -= (np.abs(np.abs(across) - np.float32(0.9)) < 0.22) * of([s.tram for s in styles])
    mix = np.clip(np.float32(0.5) + np.float32(0.75) * layers.noise["low"], 0, 1) * life
    mixed = []
    for c in range(3):
        change = of([s.other[c] - s.colour[c] for s in styles])
        change *= mix
        change += of([s.colour[c] for s in styles])
        change *= tone
        mixed.append(cv2.convertScaleAbs(change))
    cv2.merge(mixed, layers.albedo)
    layers.rough[:] = of([s.rough for s in styles])


def _look_up(table: NDArray[np.float32], label: NDArray[np.int16]) -> NDArray[np.float32]:
    if len(table) > 256:
        return np.take(table, label)
    full = np.zeros(256, np.float32)
    full[: len(table)] = table
    return np.asarray(cv2.LUT(label.astype(np.uint8), full), np.float32)
