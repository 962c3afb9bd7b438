"""How a landscape becomes pixels: layers of colour, roughness and height that one sun then lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from core.landscape import Array, Colour, House, Patch, Road
from core.noise import Float32, value_noise

SUN_EAST, SUN_NORTH, SUN_SLOPE = -0.62, -0.785, 1.12  # towards the sun in plan; tangent of its elevation
TALLEST_M = 12.0
OCTAVES = {
    "fine": (0.06, 0.13, 0.27, 0.55),
    "mid": (1.1, 2.3),
    "patch": (0.9, 4.7),
    "low": (9.0, 21.0, 55.0),
}


@dataclass(eq=False)
class Layers:
    """A window being painted, first pixel (`left`, `top`). All (H, W): albedo uint8 RGB, height metres."""

    left: int
    top: int
    gsd_m: float
    albedo: NDArray[np.uint8]
    rough: Float32
    height_m: Float32
    x_m: Float32
    y_m: Float32
    noise: dict[str, Float32] = field(default_factory=dict)

    @classmethod
    def blank(cls, left: int, top: int, width: int, height: int, gsd_m: float) -> Layers:
        """A window of (height, width) pixels of `gsd_m` metres."""
        return cls(
            left,
            top,
            gsd_m,
            np.zeros((height, width, 3), np.uint8),
            np.zeros((height, width), np.float32),
            np.zeros((height, width), np.float32),
            ((np.arange(left, left + width) + 0.5) * gsd_m).astype(np.float32),
            (-(np.arange(top, top + height) + 0.5) * gsd_m).astype(np.float32),
        )

    def add_noise(self, seed: int) -> None:
        """The noise fields that all painting shares; octaves finer than a pixel are left out."""
        height, width = self.height_m.shape
        x = (np.arange(self.left, self.left + width) + 0.5) * self.gsd_m
        y = -(np.arange(self.top, self.top + height) + 0.5) * self.gsd_m
        for k, (name, cells) in enumerate(OCTAVES.items()):
            total = np.zeros((height, width), np.float32)
            for j, cell_m in enumerate(cells):
                if cell_m > 0.9 * self.gsd_m:
                    total += value_noise(seed * 64 + 8 * k + j, cell_m, x, y)
            self.noise[name] = total

    def resolves(self, period_m: float) -> float:
        """How much of a wave of this period a pixel of this size still shows, 0–1."""
        return float(np.sinc(min(self.gsd_m / period_m, 1.0)))

    def sees(self, box_m: tuple[float, float, float, float], reach_m: float) -> bool:
        """Whether something within `reach_m` of the box (west, south, east, north) can touch the window."""
        west, south, east, north = box_m
        return bool(
            east + reach_m > self.x_m[0]
            and west - reach_m < self.x_m[-1]
            and north + reach_m > self.y_m[-1]
            and south - reach_m < self.y_m[0]
        )

    def pixels(self, xy_m: Array) -> Array:
        """Ground metres (N, 2) → pixels of this window (N, 2), pixel centres are integers."""
        return xy_m * (1 / self.gsd_m, -1 / self.gsd_m) - (self.left + 0.5, self.top + 0.5)

    def fixed(self, xy_m: Array) -> NDArray[np.int32]:
        """Ground metres (N, 2) → pixels in sixteenths, as cv2's drawing with shift=4 wants them."""
        return np.round(self.pixels(xy_m) * 16).astype(np.int32)

    def pixel_grids(self) -> tuple[Float32, Float32]:
        """Column and row of every pixel, both (H, W) float32."""
        height, width = self.height_m.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        return x, y

    def fill(self, xy_m: Array, colour: Colour, rough: float) -> None:
        """A polygon (K, 2) ground metres of one colour on the ground."""
        points = [self.fixed(xy_m)]
        cv2.fillPoly(self.albedo, points, colour, cv2.LINE_AA, shift=4)
        cv2.fillPoly(self.rough, points, rough, cv2.LINE_8, shift=4)


def ribbon(line: Array, half_width_m: float | Array, shift_m: float = 0.0) -> Array:
    """The outline (2K, 2) of a band along `line` (K, 2), its middle moved `shift_m` to the left."""
    ahead = np.gradient(line, axis=0)
    normal = np.column_stack((-ahead[:, 1], ahead[:, 0])) / np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    half = np.broadcast_to(half_width_m, (len(line),))[:, None]
    return np.concatenate((line + normal * (shift_m + half), (line + normal * (shift_m - half))[::-1]))


def near(layers: Layers, line: Array, reach_m: float) -> Array:
    """The part of a line that touches the window, with one point more on either side."""
    inside = (
        (line[:, 0] > layers.x_m[0] - reach_m)
        & (line[:, 0] < layers.x_m[-1] + reach_m)
        & (line[:, 1] < layers.y_m[0] + reach_m)
        & (line[:, 1] > layers.y_m[-1] - reach_m)
    )
    if not inside.any():
        return line[:0]
    first, last = int(np.argmax(inside)), len(line) - int(np.argmax(inside[::-1]))
    return line[max(first - 2, 0) : last + 2]


def paint_road(layers: Layers, road: Road, verge: bool = False) -> None:
    """A way, or (first, for all ways) the grass beside it."""
    line, half = near(layers, road.line, 14), road.width_m / 2
    if len(line) < 3:
        return
    if verge or road.kind in ("margin", "hedge"):
        layers.fill(ribbon(line, half if verge is False else half + 1.6), (116, 132, 78), 1.0)
    elif road.kind == "track":
        layers.fill(ribbon(line, half), (132, 134, 88), 1.0)
        for side in (-0.8, 0.8):
            layers.fill(ribbon(line, 0.34, side), (182, 164, 132), 0.7)
    else:
        grey = 128 if road.kind == "main" else 146
        layers.fill(ribbon(line, half + 0.5), (166, 156, 134), 0.9)
        layers.fill(ribbon(line, half), (grey, grey - 1, grey - 3), 0.45)
        for side in (-1.0, 1.0):
            layers.fill(ribbon(line, 0.35, side * half * 0.48), (grey - 14, grey - 14, grey - 15), 0.45)
        if road.kind == "main":
            _road_marks(layers, road, half)


def _road_marks(layers: Layers, road: Road, half_m: float) -> None:
    line = near(layers, road.line, 14)
    for side in (-1.0, 1.0):
        layers.fill(ribbon(line, 0.08, side * (half_m - 0.3)), (218, 218, 212), 0.2)
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(road.line, axis=0).T))))
    for start in np.arange(0, length[-1] - 3.4, 9.0):
        at = np.column_stack(
            [np.interp((start, start + 1.7, start + 3.4), length, road.line[:, i]) for i in range(2)]
        )
        if layers.sees((at[0, 0], at[0, 1], at[0, 0], at[0, 1]), 8):
            layers.fill(ribbon(at, 0.09), (222, 222, 216), 0.2)


def paint_stream(layers: Layers, line: Array, width_m: Array) -> None:
    """Rough banks, a pale shore, water that darkens towards its middle."""
    inside = layers.sees((line[:, 0].min(), line[:, 1].min(), line[:, 0].max(), line[:, 1].max()), 20)
    seen = near(layers, np.column_stack((line, width_m)), 20) if inside else line[:0]
    if len(seen) < 3:
        return
    line, width_m = seen[:, :2], seen[:, 2]
    for extra, colour, rough in (
        (7.0, (112, 126, 72), 1.0),
        (1.4, (150, 142, 108), 0.9),
        (0.0, (98, 116, 104), 0.35),
        (-1.2, (78, 102, 98), 0.3),
        (-3.0, (64, 90, 92), 0.25),
    ):
        layers.fill(ribbon(line, (width_m + extra) / 2), colour, rough)


def paint_patch(layers: Layers, patch: Patch) -> None:
    """A flat thing, with its height if it stands above the ground."""
    layers.fill(patch.outline, patch.colour, patch.rough)
    if patch.height_m:
        cv2.fillPoly(layers.height_m, [layers.fixed(patch.outline)], patch.height_m, cv2.LINE_8, shift=4)


def paint_house(layers: Layers, house: House) -> None:
    """A gabled roof with rows of tiles, a ridge and perhaps solar panels."""
    reach = house.length_m / 2 + house.width_m / 2 + 1
    (px, py), r = layers.pixels(np.array([house.center]))[0], reach / layers.gsd_m
    rows, columns = layers.height_m.shape
    x0, x1 = max(int(px - r), 0), min(int(px + r) + 2, columns)
    y0, y1 = max(int(py - r), 0), min(int(py + r) + 2, rows)
    if x0 >= x1 or y0 >= y1:
        return
    dx, dy = layers.x_m[None, x0:x1] - house.center[0], layers.y_m[y0:y1, None] - house.center[1]
    c, s = np.cos(house.angle_rad), np.sin(house.angle_rad)
    along, across = dx * c + dy * s, -dx * s + dy * c
    roof = (np.abs(along) < house.length_m / 2) & (np.abs(across) < house.width_m / 2)
    height = house.eave_m + (house.width_m / 2 - np.abs(across)) * 0.62
    tone = 1 + 0.09 * layers.resolves(0.34) * np.sin(across * (2 * np.pi / 0.34))
    tone += 0.05 * layers.resolves(0.42) * np.sin(along * (2 * np.pi / 0.42))
    tone += 0.05 * layers.noise["mid"][y0:y1, x0:x1] + 0.22 * (np.abs(across) < 0.16)
    colour = np.asarray(house.roof, np.float32) * tone[..., None]
    if house.panels:
        panel = (
            (np.abs(along) < 0.34 * house.length_m) & (across < -0.8) & (across > -0.82 * house.width_m / 2)
        )
        frame = (np.mod(along, 1.05) < 0.07) | (np.mod(across, 1.7) < 0.07)
        colour = np.where(panel[..., None], np.where(frame[..., None], (120, 126, 134), (36, 44, 66)), colour)
    chimney = house.chimney & (np.abs(along - house.length_m * 0.28) < 0.42) & (np.abs(across - 0.9) < 0.42)
    colour = np.where(chimney[..., None], (124, 104, 92), colour)
    height = np.where(chimney, house.eave_m + house.width_m * 0.31 + 1.0, height)
    layers.albedo[y0:y1, x0:x1][roof] = np.clip(colour, 0, 255)[roof].astype(np.uint8)
    layers.rough[y0:y1, x0:x1][roof] = 0.3
    layers.height_m[y0:y1, x0:x1][roof] = height[roof]


@lru_cache(maxsize=1)
def _crowns() -> tuple[Float32, ...]:
    """Crown shapes, (64, 64) float32 of height 0–1 over a radius of 26 pixels."""
    axis = (np.arange(64) - 31.5) / 26
    x, y = np.meshgrid(axis, axis)
    angle, radius = np.arctan2(y, x), np.hypot(x, y)
    shapes = []
    for k in range(16):
        rng = np.random.default_rng((k, 8))
        edge = 1 + sum(
            rng.uniform(0.02, 0.11) * np.sin(n * angle + rng.uniform(0, 6.3)) for n in (2, 3, 5, 7, 11)
        )
        dome = np.sqrt(np.clip(1 - (radius / edge) ** 2, 0, 1))
        dents = value_noise(k + 900, 0.34, axis, axis) * 0.16 + value_noise(k + 950, 0.16, axis, axis) * 0.08
        shapes.append(np.where(dome > 0, np.clip(dome + dents * dome, 0.05, 1.2), 0).astype(np.float32))
    return tuple(shapes)


def stamp_trees(layers: Layers, trees: Array, colour: Callable[[float], Colour]) -> None:
    """Trees (N, 5) x, y, radius, height (metres), tone: each rises above whatever is lower."""
    rows, columns = layers.height_m.shape
    at = layers.pixels(trees[:, :2])
    for k, (_, _, radius_m, height_m, tone) in enumerate(trees):
        scale = radius_m / layers.gsd_m / 26
        x0, y0 = np.floor(at[k] - 32 * scale).astype(int)
        side = int(64 * scale) + 2
        left, top, right, bottom = max(x0, 0), max(y0, 0), min(x0 + side, columns), min(y0 + side, rows)
        if left >= right or top >= bottom:
            continue
        shift = at[k] - (x0, y0) - 31.5 * scale
        warp = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        crown = cv2.warpAffine(_crowns()[int(tone * 1e4) % 16], warp, (side, side), flags=cv2.INTER_LINEAR)
        crown = crown[top - y0 : bottom - y0, left - x0 : right - x0] * np.float32(height_m)
        window = (slice(top, bottom), slice(left, right))
        higher = crown > np.maximum(layers.height_m[window], 0.25 * height_m)
        layers.height_m[window][higher] = crown[higher]
        layers.albedo[window][higher] = colour(tone)
        layers.rough[window][higher] = 1.3


# Air and a real sensor take a quarter of the colour away and add a little blue haze: RGB → RGB, affine.
_AIR = np.array([[0.86, 0.17, 0.03, 3], [0.09, 0.94, 0.03, 5], [0.09, 0.17, 0.8, 9]], np.float32)


def light(layers: Layers) -> NDArray[np.uint8]:
    """The painted window in the sun: relief, cast shadows and fine grain → (H, W, 3) uint8 RGB."""
    noise = layers.noise
    leafy = layers.rough > 1.1
    relief = layers.height_m + leafy * (0.16 * noise["fine"] + 0.25 * noise["patch"])
    gx = cv2.Sobel(relief, cv2.CV_32F, 1, 0, ksize=3, scale=1 / (8 * layers.gsd_m))
    gy = cv2.Sobel(relief, cv2.CV_32F, 0, 1, ksize=3, scale=1 / (8 * layers.gsd_m))
    facing = (np.float32(SUN_SLOPE) - gx * np.float32(SUN_EAST) + gy * np.float32(SUN_NORTH)) / np.sqrt(
        1 + gx * gx + gy * gy
    )
    shade = np.clip(np.float32(0.3) + facing * np.float32(0.7 / SUN_SLOPE), 0.42, 1.4)
    shade *= 1 + layers.rough * (0.11 * noise["fine"] + 0.05 * noise["mid"]) + 0.03 * noise["low"]
    dark = shadow(layers.height_m, layers.gsd_m)
    lit = [shade * (1 - dark * np.float32(1 - kept)) for kept in (0.44, 0.49, 0.6)]
    tint = cv2.merge(lit) * layers.albedo
    return np.asarray(cv2.convertScaleAbs(cv2.transform(tint, _AIR)))


def shadow(height_m: Float32, gsd_m: float) -> Float32:
    """How much of the sun is taken from each pixel, 0–1 (H, W): a ray towards the sun in doubling steps."""
    rows, columns = height_m.shape
    half = cv2.resize(
        height_m[: rows // 2 * 2, : columns // 2 * 2], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    roof, step_m = half.copy(), 2 * gsd_m
    plan = np.hypot(SUN_EAST, SUN_NORTH)
    while step_m < TALLEST_M / SUN_SLOPE * 1.01:
        dx, dy = SUN_EAST / plan * step_m / (2 * gsd_m), -SUN_NORTH / plan * step_m / (2 * gsd_m)
        moved = cv2.warpAffine(
            roof,
            np.array([[1, 0, dx], [0, 1, dy]]),
            roof.shape[::-1],
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        np.maximum(roof, moved - step_m * SUN_SLOPE, out=roof)
        step_m *= 2
    full = cv2.resize(roof, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip((full - height_m - 0.1) / 0.5, 0, 1), np.float32)
