"""Where the poses put the ground of a simulated flight: what `score_mosaic.py` measures, before any picture.

The ground is sampled as that tool samples it, a patch of 8 m every 14 m wherever a photo looks. A patch lies
where the pose of the photo that sees it nearest to its middle, which is the one that a mosaic would show,
puts it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from core.geometry import Array, Camera, Pose
from core.simulation import Flight, FlightParams, Shot, plan_flight
from workers.simulate import parser

PATCH_M, STEP_M, SEARCH_M = 8.0, 14.0, 6.0


def flown(options: Sequence[str]) -> Flight:
    """The flight that `orthostream simulate` makes of these options."""
    given = vars(parser().parse_args(["--out", "unused", *options]))
    return plan_flight(FlightParams(**{k: v for k, v in given.items() if k in FlightParams.__slots__}))


def pose_errors(flight: Flight, truth: Path, poses: Path) -> dict[str, Any]:
    """Displacements of the ground as the poses have it, metres, named like the tool's."""
    document = json.loads(poses.read_text())
    cameras = [_camera(c) for c in document["cameras"]]
    found = {f["name"]: (_pose(f), cameras[f["camera"]]) for f in document["frames"]}
    shots = [s for s in flight.shots if s.name in found]
    ground = _patches(flight, truth)
    off, apart = np.zeros((len(ground), 2)), np.full(len(ground), np.inf)
    for shot in shots:
        uv = shot.pose.pixels(shot.camera, ground)
        away = np.hypot(*(uv - (shot.camera.cx, shot.camera.cy)).T)
        nearer = _sees(shot, ground) & (away < apart)
        pose, camera = found[shot.name]
        off[nearer] = pose.ground(camera, uv[nearer])[:, :2] - ground[nearer, :2]
        apart[nearer] = away[nearer]
    off = off[np.isfinite(apart)]
    size = np.hypot(*off.T)
    return {
        "patches": len(off),
        "median_m": _round(np.median(size)),
        "rmse_m": _round(np.sqrt((size**2).mean())),
        "p95_m": _round(np.percentile(size, 95)),
        "bias_m": [_round(v) for v in off.mean(0)],
        "rmse_debiased_m": _round(np.sqrt(((off - np.median(off, axis=0)) ** 2).sum(1).mean())),
    }


def _patches(flight: Flight, truth: Path) -> Array:
    """The middles of the tool's patches that some photo sees as a whole, (N, 3) metres."""
    with rasterio.open(truth) as raster:
        left, bottom, right, top = raster.bounds
    xs = np.arange(left + SEARCH_M, right - PATCH_M - SEARCH_M, STEP_M) + PATCH_M / 2
    ys = np.arange(top - SEARCH_M, bottom + PATCH_M + SEARCH_M, -STEP_M) - PATCH_M / 2
    xy = np.column_stack([a.ravel() for a in np.meshgrid(xs, ys)])
    half = PATCH_M / 2
    corners = [_on_ground(flight, xy + np.array([dx, dy])) for dx in (-half, half) for dy in (-half, half)]
    seen = np.zeros(len(xy), bool)
    for shot in flight.shots:
        seen |= np.all([_sees(shot, c) for c in corners], axis=0)
    return _on_ground(flight, xy[seen])


def _on_ground(flight: Flight, xy: Array) -> Array:
    height = flight.params.base_alt_m + flight.terrain.height_m(xy - flight.origin)
    return np.column_stack((xy, height))


def _sees(shot: Shot, ground: Array) -> Any:
    """Which points (N, 3) are in the picture, (N,) bool."""
    corners, middle = shot.pose.footprint(shot.camera), shot.pose.center[:2]
    reach = 1.1 * np.hypot(*(corners - middle).T).max()  # a bent lens maps what lies far outside back inside
    uv = shot.pose.pixels(shot.camera, ground)
    inside = ((uv >= 0) & (uv <= (shot.camera.width - 1, shot.camera.height - 1))).all(1)
    return inside & (np.hypot(*(ground[:, :2] - middle).T) < reach)


def _camera(entry: dict[str, Any]) -> Camera:
    return Camera(**{k: entry[k] for k in ("width", "height", "f_px", "cx", "cy", "k1", "k2")})


def _pose(entry: dict[str, Any]) -> Pose:
    return Pose(np.array(entry["R"]), np.array(entry["center"]), entry["ground_height"])


def _round(value: float) -> float:
    return float(f"{value:.4g}")
