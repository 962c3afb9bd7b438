"""What keypoints would be found in a simulated photo, without drawing it: landmarks on the ground, projected.

Descriptors, turns and sizes are those of the landmarks with noise, so that the whole of `core.matching` can
be put to work in a millisecond a pair, with known truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.features import DESCRIPTOR_SCALE, Features
from core.geometry import Array
from core.photography import cars_at
from core.simulation import Flight, Shot
from core.vocabulary import appearance

CAR_LENGTH_M, CAR_WIDTH_M, CAR_HEIGHT_M = 4.4, 1.8, 1.5
THUMB = np.full((8, 8, 3), 128, np.uint8)


@dataclass(frozen=True, slots=True)
class LandmarkParams:
    """How well landmarks are seen.

    `keypoints`: of one photo, about. `repeat`: the chance that a photo finds a landmark it could see.
    `noise_px`: of their places, one sigma per axis, original pixels. `descriptor_noise`: relative to the
    descriptor's length. `turn_noise_rad`; `odd_turns`: share whose turn is any; `size_noise`: log sigma.
    `twins`: share of landmarks that look like one of a dozen others everywhere (a meadow's). `on_a_car`:
    landmarks that drive along on each moving car.
    """

    keypoints: int = 400
    repeat: float = 0.5
    noise_px: float = 0.7
    descriptor_noise: float = 0.35
    turn_noise_rad: float = 0.1
    odd_turns: float = 0.1
    size_noise: float = 0.1
    twins: float = 0.0
    on_a_car: int = 10


@dataclass(frozen=True, slots=True)
class Landmarks:
    """`xyz` (L, 3) UTM metres, `turn_rad` (L,) anticlockwise from east, `size_m` (L,), `looks` (L, 128)."""

    xyz: Array
    turn_rad: Array
    size_m: Array
    looks: Array


def _looks(rng: np.random.Generator, count: int) -> Array:
    """Random RootSIFT-like directions: few strong entries, none negative, of length 1."""
    shares = rng.gamma(0.6, 1.0, (count, 128))
    return np.asarray(np.sqrt(shares / shares.sum(1, keepdims=True)))


def on_the_ground(flight: Flight, params: LandmarkParams) -> Landmarks:
    """As many landmarks as give each photo its keypoints."""
    rng = np.random.default_rng((flight.params.seed, 40))
    west, south, east, north = flight.area
    footprint_m2 = flight.params.width_px * flight.params.height_px * flight.gsd_m**2
    count = int(params.keypoints / params.repeat * (east - west) * (north - south) / footprint_m2)
    xy = rng.uniform((west, south), (east, north), (count, 2))
    height = flight.params.base_alt_m + flight.terrain.height_m(xy)
    looks = _looks(rng, count)
    common = rng.random(count) < params.twins
    looks[common] = _looks(rng, 12)[rng.integers(0, 12, int(common.sum()))]
    turn, size = rng.uniform(-np.pi, np.pi, count), flight.gsd_m * np.exp(rng.uniform(1.2, 3.5, count))
    return Landmarks(np.column_stack((xy + flight.origin, height)), turn, size, looks)


def on_cars(flight: Flight, time_s: float, params: LandmarkParams) -> Landmarks:
    """Those of the moving cars at one moment; each car keeps its own."""
    cars = cars_at(flight, time_s)
    rng, each = np.random.default_rng((flight.params.seed, 41)), params.on_a_car
    n = len(cars) * each
    along, across = rng.uniform(-0.5, 0.5, (2, n)) * np.array([[CAR_LENGTH_M], [CAR_WIDTH_M]])
    turn, looks = rng.uniform(-np.pi, np.pi, n), _looks(rng, n)
    size = flight.gsd_m * np.exp(rng.uniform(1.2, 2.5, n))
    place = np.array([xy for xy, _, _ in cars]).reshape(-1, 2).repeat(each, axis=0)
    heading = np.array([a for _, a, _ in cars]).repeat(each)
    at = (along + 1j * across) * np.exp(1j * heading)
    height = flight.params.base_alt_m + flight.terrain.height_m(place) + CAR_HEIGHT_M
    xy = place + np.column_stack((at.real, at.imag)) + flight.origin
    return Landmarks(np.column_stack((xy, height)), turn + heading, size, looks)


def features(flight: Flight, params: LandmarkParams | None = None) -> list[Features]:
    """What `core.features.extract` would find in the photo of each shot."""
    params = params or LandmarkParams()
    ground = on_the_ground(flight, params)
    return [_features(flight, shot, ground, params) for shot in flight.shots]


def _features(flight: Flight, shot: Shot, ground: Landmarks, params: LandmarkParams) -> Features:
    rng = np.random.default_rng((shot.noise_seed, 42))
    sets = [ground, on_cars(flight, shot.captured_s, params)] if flight.params.cars else [ground]
    found = [_seen(shot, landmarks, params, rng) for landmarks in sets]
    uv, turn, size, looks = (np.concatenate(parts) for parts in zip(*found, strict=True))
    looks = looks + params.descriptor_noise / np.sqrt(128) * rng.normal(0, 1, looks.shape)
    looks = looks.clip(0) / np.linalg.norm(looks.clip(0), axis=1, keepdims=True)
    descriptors = np.minimum(looks * DESCRIPTOR_SCALE + 0.5, 255).astype(np.uint8)
    return Features(
        keypoints=uv.astype(np.float32),
        angle_rad=turn.astype(np.float32),
        scale_px=size.astype(np.float32),
        descriptors=descriptors,
        words=appearance(descriptors),
        thumb=THUMB,
    )


def _seen(
    shot: Shot, landmarks: Landmarks, params: LandmarkParams, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Places (K, 2), turns (K,) clockwise, diameters (K,) in pixels and looks (K, 128)."""
    uv = shot.pose.pixels(shot.camera, landmarks.xyz)
    size = np.array((shot.camera.width, shot.camera.height))
    inside = ((uv > 3) & (uv < size - 4)).all(1) & (rng.random(len(uv)) < params.repeat)
    k = np.flatnonzero(inside)
    ahead = 0.1 * np.column_stack(
        (np.cos(landmarks.turn_rad[k]), np.sin(landmarks.turn_rad[k]), np.zeros(len(k)))
    )
    tip = shot.pose.pixels(shot.camera, landmarks.xyz[k] + ahead) - uv[k]
    turn = np.arctan2(tip[:, 1], tip[:, 0]) + params.turn_noise_rad * rng.normal(0, 1, len(k))
    odd = rng.random(len(k)) < params.odd_turns
    turn = np.where(odd, rng.uniform(-np.pi, np.pi, len(k)), turn) % (2 * np.pi)
    diameter = (
        landmarks.size_m[k] * 10 * np.hypot(*tip.T) * np.exp(params.size_noise * rng.normal(0, 1, len(k)))
    )
    return uv[k] + params.noise_px * rng.normal(0, 1, (len(k), 2)), turn, diameter, landmarks.looks[k]
