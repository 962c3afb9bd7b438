"""Simulated photos: a `Flight`'s shots seen through the exact camera, and the truth to score maps by."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray

from core.furnishing import CARS, car_parts
from core.geometry import Camera
from core.photo_writer import PhotoTags, write_photo
from core.simulation import Flight, Shot
from core.terrain import TILE_PX

Rgb = NDArray[np.uint8]
MAP_STEP_PX = 8
TRUTH_GSD_M = 0.12


@dataclass(frozen=True, slots=True)
class GroundPicture:
    """The ground below a flight as one raster on disk, painted tile by tile as it is looked at.

    Several processes may share the folder: a tile that two of them paint at once comes out the same.
    `columns`, `rows`: in tiles, from tile (`first_column`, `first_row`) of the terrain on.
    """

    folder: Path
    flight: Flight
    first_column: int
    first_row: int
    columns: int
    rows: int

    @classmethod
    def create(cls, folder: Path, flight: Flight) -> GroundPicture:
        """An unpainted picture of all that the flight can see."""
        west, south, east, north = flight.area
        side_m = TILE_PX * flight.gsd_m
        first = (int(np.floor(west / side_m)), int(np.floor(-north / side_m)))
        last = (int(np.floor(east / side_m)), int(np.floor(-south / side_m)))
        # The shots stay behind: the picture travels to other processes with every photo.
        picture = cls(
            folder, replace(flight, shots=()), *first, last[0] - first[0] + 1, last[1] - first[1] + 1
        )
        folder.mkdir(parents=True, exist_ok=True)
        shape = (picture.rows * TILE_PX, picture.columns * TILE_PX, 3)
        np.lib.format.open_memmap(folder / "ground.npy", "w+", np.uint8, shape)
        np.lib.format.open_memmap(folder / "painted.npy", "w+", np.uint8, (picture.rows, picture.columns))
        return picture

    def paint(self, i: int, j: int) -> None:
        """Makes sure that tile (i, j) of the raster is there."""
        painted = np.load(self.folder / "painted.npy", mmap_mode="r+")
        if not painted[j, i]:
            ground = np.load(self.folder / "ground.npy", mmap_mode="r+")
            tile = self.flight.terrain.tile(self.first_column + i, self.first_row + j, self.flight.gsd_m)
            ground[j * TILE_PX : (j + 1) * TILE_PX, i * TILE_PX : (i + 1) * TILE_PX] = tile
            painted[j, i] = 1

    def window(self, x0: int, y0: int, x1: int, y1: int) -> Rgb:
        """The raster's pixels [y0, y1) × [x0, x1), painted."""
        for j in range(y0 // TILE_PX, (y1 - 1) // TILE_PX + 1):
            for i in range(x0 // TILE_PX, (x1 - 1) // TILE_PX + 1):
                self.paint(i, j)
        return np.array(np.load(self.folder / "ground.npy", mmap_mode="r")[y0:y1, x0:x1])

    def tiles(self) -> list[tuple[int, int]]:
        """Every (i, j) that `paint` takes."""
        return [(i, j) for j in range(self.rows) for i in range(self.columns)]

    def pixels(self, xy_utm: NDArray[np.float64]) -> NDArray[np.float64]:
        """UTM metres (N, 2) → pixels of the raster (N, 2), pixel centres are integers."""
        xy = (xy_utm - self.flight.origin) * (1 / self.flight.gsd_m, -1 / self.flight.gsd_m)
        return xy - (self.first_column * TILE_PX + 0.5, self.first_row * TILE_PX + 0.5)


def render(picture: GroundPicture, shot: Shot) -> bytes:
    """One photo of the flight: the bytes of a JPEG file with its claims as EXIF and XMP."""
    params = picture.flight.params
    tags = PhotoTags(
        shot.captured_s,
        params.nominal_f_px,
        f"SIM{params.seed:04d}{shot.drone:02d}",
        shot.gps,
        shot.relative_alt_m,
        shot.attitude,
        shot.flight_yaw_rad,
        params.xmp,
    )
    return write_photo(develop(picture.flight, shot, expose(picture, shot)), tags)


def expose(picture: GroundPicture, shot: Shot) -> Rgb:
    """What falls on the sensor of `shot`: (H, W, 3) uint8 RGB, cars included, evenly lit, without noise."""
    camera, flight = shot.camera, picture.flight
    step = MAP_STEP_PX
    # Places that cv2.resize with factor `step` interpolates between, one beyond each border.
    u = (np.arange(-1, -(-camera.width // step) + 1) + 0.5) * step - 0.5
    v = (np.arange(-1, -(-camera.height // step) + 1) + 0.5) * step - 0.5
    uv = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    at = picture.pixels(flight.ground(shot, uv)[:, :2])
    low = np.maximum(np.floor(at.min(0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(at.max(0)).astype(int) + 3, (picture.columns * TILE_PX, picture.rows * TILE_PX))
    if not (low < high).all():
        raise ValueError(f"{shot.name} shows no ground of this flight")
    coarse = (at - low).astype(np.float32).reshape(len(v), len(u), 2)
    full = cv2.resize(coarse, (len(u) * step, len(v) * step), interpolation=cv2.INTER_LINEAR)
    maps = full[step : step + camera.height, step : step + camera.width]
    ground = picture.window(low[0], low[1], high[0], high[1])
    seen = cv2.remap(ground, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    rgb = np.asarray(seen, np.uint8)
    _draw_cars(flight, shot, rgb)
    return rgb


def develop(flight: Flight, shot: Shot, rgb: Rgb) -> Rgb:
    """The sensor's answer to `rgb` (H, W, 3): exposure, white balance, vignetting and noise."""
    params = flight.params
    lens = _lens_shade(shot.camera.width, shot.camera.height, params.vignetting)
    light = cv2.merge([lens * np.float32(g) for g in shot.gain])
    seen = cv2.multiply(rgb, light, dtype=cv2.CV_32F)
    if params.sensor_noise:
        rng = np.random.default_rng(shot.noise_seed)
        grain = _grain(shot.camera.width + 64, shot.camera.height + 64)
        x, y = rng.integers(0, 64, 2)
        seen = cv2.scaleAdd(
            grain[y : y + shot.camera.height, x : x + shot.camera.width], params.sensor_noise, seen
        )
    return np.asarray(np.clip(seen + np.float32(0.5), 0, 255).astype(np.uint8))


@lru_cache(maxsize=4)
def _lens_shade(width: int, height: int, loss: float) -> NDArray[np.float32]:
    x, y = np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2
    r2 = (x**2 + y[:, None] ** 2) / (x[0] ** 2 + y[0] ** 2)
    return np.asarray(1 - loss * r2, np.float32)


@lru_cache(maxsize=2)
def _grain(width: int, height: int) -> NDArray[np.float32]:
    return np.random.default_rng(77).standard_normal((height, width, 3), np.float32)


def _draw_cars(flight: Flight, shot: Shot, rgb: Rgb) -> None:
    """Cars that drive along the roads, where they are at this moment; the truth does not know of them."""
    fixed_point = 16
    for xy, angle, colour in cars_at(flight, shot.captured_s):
        height = flight.terrain.height_m(xy[None]) + flight.params.base_alt_m
        body, glass = car_parts(angle)
        for part, paint in (
            (body + np.array([0.5, 0.6]), (48, 50, 54)),
            (body, colour),
            (glass, (44, 50, 58)),
        ):
            ground = np.column_stack((xy + part + flight.origin, np.repeat(height, 4)))
            uv = shot.pose.pixels(shot.camera, ground)
            if (uv > -100).all() and (uv < (shot.camera.width + 100, shot.camera.height + 100)).all():
                points = np.round(uv * fixed_point).astype(np.int32)
                cv2.fillPoly(rgb, [points], paint, cv2.LINE_AA, shift=4)


def cars_at(flight: Flight, time_s: float) -> list[tuple[NDArray[np.float64], float, tuple[int, int, int]]]:
    """Every moving car: place (2,) in terrain metres, heading (rad, anticlockwise from east), colour."""
    lanes = _lanes(flight)
    rng = np.random.default_rng((flight.params.seed, 30))
    found = []
    for _ in range(flight.params.cars if lanes else 0):
        line, width = lanes[int(rng.integers(len(lanes)))]
        length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
        way, speed = (1.0 if rng.random() < 0.5 else -1.0), rng.uniform(6, 16)
        run = (rng.uniform(0, length[-1]) + way * speed * (time_s - flight.params.start_s)) % length[-1]
        colour = CARS[int(rng.integers(len(CARS)))]
        here, ahead = (
            np.array([np.interp(run + s, length, line[:, i]) for i in range(2)]) for s in (-0.5, 0.5)
        )
        heading = (ahead - here) * way
        angle = float(np.arctan2(heading[1], heading[0]))
        keep_right = np.array([np.sin(angle), -np.cos(angle)]) * width / 4
        found.append(((here + ahead) / 2 + keep_right, angle, colour))
    return found


@lru_cache(maxsize=2)
def _lanes_of(flight_key: tuple[Any, tuple[float, float, float, float]]) -> list[tuple[Any, float]]:
    terrain, (west, south, east, north) = flight_key
    lanes = []
    for line, width in terrain.roads():
        inside = (line[:, 0] > west) & (line[:, 0] < east) & (line[:, 1] > south) & (line[:, 1] < north)
        if inside.sum() > 4:
            lanes.append((line[inside], width))
    return lanes


def _lanes(flight: Flight) -> list[tuple[NDArray[np.float64], float]]:
    """The stretches of paved road that the flight sees."""
    return _lanes_of((flight.terrain, flight.area))


def write_truth_raster(picture: GroundPicture, path: Path) -> None:
    """The whole ground as a GeoTIFF in the flight's UTM zone, RGB, near `TRUTH_GSD_M` a pixel."""
    flight = picture.flight
    n = max(1, round(TRUTH_GSD_M / flight.gsd_m))
    (x0, y0), (x1, y1) = _truth_bounds(picture)
    width, height = (x1 - x0) // n, (y1 - y0) // n
    res = n * flight.gsd_m
    left = flight.origin[0] + (picture.first_column * TILE_PX + x0) * flight.gsd_m
    top = flight.origin[1] - (picture.first_row * TILE_PX + y0) * flight.gsd_m
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": 3,
        "dtype": "uint8",
        "crs": f"EPSG:{flight.epsg}",
        "transform": rasterio.Affine(res, 0, left, 0, -res, top),
        "photometric": "RGB",
    }
    profile |= {"tiled": True, "blockxsize": 256, "blockysize": 256}
    profile |= {"compress": "deflate", "zlevel": 1, "predictor": 2}
    with rasterio.open(path, "w", **profile) as out:
        for row in range(0, height, 256):
            rows = min(256, height - row)
            part = picture.window(x0, y0 + row * n, x0 + width * n, y0 + (row + rows) * n)
            small = cv2.resize(part, (width, rows), interpolation=cv2.INTER_AREA)
            out.write(small.transpose(2, 0, 1), window=rasterio.windows.Window(0, row, width, rows))


def _truth_bounds(picture: GroundPicture) -> tuple[tuple[int, int], tuple[int, int]]:
    flight = picture.flight
    west, south, east, north = flight.area
    corners = np.array([[west, north], [east, south]]) + flight.origin
    low, high = np.round(picture.pixels(corners)).astype(int)
    end = (picture.columns * TILE_PX, picture.rows * TILE_PX)
    return (max(int(low[0]), 0), max(int(low[1]), 0)), (min(int(high[0]), end[0]), min(int(high[1]), end[1]))


def truth_document(flight: Flight) -> dict[str, Any]:
    """The true cameras and poses as a JSON object, metres in the CRS of the truth raster.

    `base`: ground height where the land is level; R: camera (x right, y down, z forward) → east, north, up.
    """
    return {
        "crs": f"EPSG:{flight.epsg}",
        "base": flight.params.base_alt_m,
        "relief_m": flight.params.relief_m,
        "gsd_m": flight.gsd_m,
        "seed": flight.params.seed,
        "frames": [_truth_frame(shot, shot.camera) for shot in flight.shots],
    }


def _truth_frame(shot: Shot, camera: Camera) -> dict[str, Any]:
    return {
        "name": shot.name,
        "drone": shot.drone,
        "captured_s": shot.captured_s,
        "size": [camera.width, camera.height],
        "f": camera.f_px,
        "cx": camera.cx,
        "cy": camera.cy,
        "k1": camera.k1,
        "k2": camera.k2,
        "R": shot.pose.world_R_cam.tolist(),
        "center": shot.pose.center.tolist(),
        "ground_height": shot.pose.ground_h_m,
        "gps": shot.gps is not None,
    }


def write_truth_document(flight: Flight, path: Path) -> None:
    """`truth_document` as a file."""
    path.write_text(json.dumps(truth_document(flight), indent=1) + "\n")
