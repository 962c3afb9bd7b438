"""The whole chain on drawn photos, from JPEG bytes to the map, against the truth they were drawn from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from core.metadata import read_metadata
from core.mosaic import Mosaic, build, frame_id_of
from core.photo import probe
from core.photography import GroundPicture, render
from core.pose_graph import GraphFrame
from core.scale import KnownScale
from core.simulation import FlightParams, plan_flight
from tests.flights.missions import (
    Mission,
    fitted,
    ground,
    ground_errors_m,
    height_errors,
    posed,
    rms,
    route_fit,
    route_length_m,
)

SMALL = FlightParams(
    frames=16, drones=1, lines=2, per_line=8, width_px=480, height_px=360, gps_noise_m=1.0, seed=6
)
PIXEL_M = 60.0 / SMALL.nominal_f_px  # 0.18 m on the ground


@dataclass(frozen=True)
class Drawn:
    """A simulated flight as photos, and its truth by their ids."""

    truth: Mission
    photos: tuple[tuple[str, bytes], ...]

    def map(self, scale: KnownScale | None = None) -> Mosaic:
        return build(self.photos, scale=scale or KnownScale())


@cache
def drawn(params: FlightParams) -> Drawn:
    flight = plan_flight(params)
    with TemporaryDirectory() as folder:
        picture = GroundPicture.create(Path(folder), flight)
        photos = tuple((s.name, render(picture, s)) for s in flight.shots)
    shots = {frame_id_of(data): s for s, (_, data) in zip(flight.shots, photos, strict=True)}
    frames = tuple(
        GraphFrame(frame_id_of(data), name, read_metadata(data, probe(data))) for name, data in photos
    )
    return Drawn(Mission(flight, shots, frames, {}), photos)


@pytest.mark.parametrize(
    ("name", "params", "limit_m"),
    [
        ("flat, in traffic, photos lost", replace(SMALL, cars=60, k1=-0.04, drop=0.12), 0.15 * PIXEL_M),
        ("hills of 8 m, headings that lie", replace(SMALL, relief_m=8.0, yaw_flip=True), 1.5 * PIXEL_M),
    ],
)
def test_drawn_photos_are_mapped_to_the_truth(name: str, params: FlightParams, limit_m: float) -> None:
    flight = drawn(params)
    made = flight.map()
    assert not made.rejected
    assert len(posed(flight.truth, made.solution)) == len(flight.photos)
    assert {p.submap for p in made.solution.poses.values()} == {0}
    assert fitted(*ground(flight.truth, made.solution)).rms_m < limit_m
    # 16 fixes of 1 m: shift, turn and scale are known to half a metre or so
    assert rms(ground_errors_m(flight.truth, made.solution)) < 2.0
    assert made.tiles


def test_drawn_photos_without_gps_and_a_first_height_give_the_route() -> None:
    flight = drawn(replace(SMALL, no_gps=1.0, xmp=False))
    first = flight.truth.shots[next(iter(flight.truth.shots))].pose
    made = flight.map(KnownScale(first_height_m=float(first.center[2] - first.ground_h_m)))
    assert {p.source for p in made.solution.poses.values()} == {"vision-only"}
    assert len(made.solution.poses) == len(flight.photos)
    assert route_fit(flight.truth, made.solution).rms_m < 0.01 * route_length_m(flight.truth)
    assert np.sqrt((height_errors(flight.truth, made.solution) ** 2).mean()) < 0.03
