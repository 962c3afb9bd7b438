"""Simulated flights: where each drone really was, and what its metadata claims. The tests' ground truth.

Poses are in the mission's UTM grid: metres east, north and up, so that a `Pose`'s world is that grid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Proj, Transformer

from core.frame import Attitude, GpsFix
from core.geometry import Array, Camera, Pose
from core.terrain import Terrain, TerrainParams

FOCAL_35MM = 24.0
FULL_FRAME_DIAGONAL_MM = 43.2666
TURN_S = 4.0
SLOW_S = 40.0  # how long a GPS bias, a light and a height error last


@dataclass(frozen=True, slots=True)
class FlightParams:
    """How the drones fly, what goes wrong, and what their photos say of it.

    `frames`: of all drones together, before any are dropped. `lines`, `per_line`: the strips of each drone
    and the photos on a strip, instead of `frames`. Overlaps are shares of the picture's side on level ground.
    `layout`: the drones' blocks side by side with a common side overlap ("row"), or touching only at their
    corners ("corner"). `turn`: on the way back the camera turns with the drone ("follow") or keeps looking
    the same way up ("hold"). `bearing_deg`: of the strips, clockwise from grid north.

    Truth: `track_noise_m` how far a drone strays from its plan, `yaw_noise_deg` and `tilt_deg` how far its
    camera does (one sigma per axis), `pitch_deg` where the camera looks on average (−90: straight down).
    `focal_error`: true focal length over the stated one, less 1. `relief_m`: valley to hill top.

    Claims: `gps_noise_m` per photo (one sigma per axis, ×1.5 upwards), `gps_bias_m` slow drift per drone,
    `gps_lag_s` how old a fix is, `compass_noise_deg` and the constant `yaw_offset_deg` of the stated yaw,
    `yaw_flip`: the stated yaw of every second strip is wrong by 180°. `no_gps`: share of photos without a
    fix; `gps_outage`: from which to which share of each drone's flight there is none. `rtk`: the fix states
    its sigma. `xmp`, `barometer`: whether photos carry XMP at all, and a height above take-off in it.

    Losses: `drop` share of photos at random, `gaps` runs of `gap_frames` photos per drone.
    Picture: `exposure` (sigma of log gain), `vignetting` (loss in the corner), `sensor_noise` (grey levels),
    `cars` that move, `monotony` share of fields that look the same everywhere.
    """

    frames: int = 75
    lines: int | None = None
    per_line: int | None = None
    drones: int = 3
    forward_overlap: float = 0.75
    side_overlap: float = 0.65
    height_m: float = 60.0
    speed_m_s: float = 8.0
    bearing_deg: float = 8.0
    layout: Literal["row", "corner"] = "row"
    turn: Literal["follow", "hold"] = "follow"
    width_px: int = 1000
    height_px: int = 750
    k1: float = -0.01
    focal_error: float = 0.0
    track_noise_m: float = 0.6
    yaw_noise_deg: float = 2.0
    tilt_deg: float = 1.0
    pitch_deg: float = -90.0
    relief_m: float = 0.0
    gps_noise_m: float = 1.0
    gps_bias_m: float = 0.0
    gps_lag_s: float = 0.0
    compass_noise_deg: float = 1.0
    yaw_offset_deg: float = 0.0
    yaw_flip: bool = False
    no_gps: float = 0.0
    gps_outage: tuple[float, float] = (0.0, 0.0)
    rtk: bool = False
    xmp: bool = True
    barometer: bool = True
    drop: float = 0.0
    gaps: int = 0
    gap_frames: int = 6
    exposure: float = 0.06
    vignetting: float = 0.18
    sensor_noise: float = 1.6
    cars: int = 0
    monotony: float = 0.0
    seed: int = 0
    lat_deg: float = 47.26
    lon_deg: float = 17.35
    base_alt_m: float = 120.0
    start_s: float = 1_718_442_000.0

    def __post_init__(self) -> None:
        """Raises ValueError on what cannot be flown."""
        if self.drones < 1 or self.frames < 1 or self.height_m <= 0 or self.speed_m_s <= 0:
            raise ValueError("a flight needs at least one drone and one frame, a height and a speed above 0")
        if min(self.width_px, self.height_px) < 64:
            raise ValueError("photos need at least 64 pixels a side")
        if not (0 <= self.forward_overlap < 1 and 0 <= self.side_overlap < 1):
            raise ValueError("overlaps are shares: from 0 to below 1")
        if not -90 <= self.pitch_deg <= -55:
            raise ValueError("the camera must look down: a pitch from -90 to -55 degrees")
        if self.relief_m >= self.height_m:
            raise ValueError("the hills must stay below the flight height")

    @property
    def nominal_f_px(self) -> float:
        """The stated focal length: a 35 mm equivalent of 24 mm, by the picture's diagonal."""
        return FOCAL_35MM / FULL_FRAME_DIAGONAL_MM * float(np.hypot(self.width_px, self.height_px))

    def camera(self) -> Camera:
        """The true camera."""
        w, h = self.width_px, self.height_px
        f_px = self.nominal_f_px * (1 + self.focal_error)
        return Camera(w, h, f_px, (w - 1) / 2, (h - 1) / 2, self.k1)


@dataclass(frozen=True, slots=True)
class Shot:
    """One photo to be: the truth (`camera`, `pose`, `gain` per RGB channel) and the claims (all the rest).

    `drone`: from 1. `flight_yaw_rad`: the stated heading of the drone, clockwise from true north, or None.
    """

    name: str
    drone: int
    camera: Camera
    pose: Pose
    gain: tuple[float, float, float]
    noise_seed: int
    captured_s: float
    gps: GpsFix | None
    relative_alt_m: float | None
    attitude: Attitude
    flight_yaw_rad: float | None


@dataclass(frozen=True, slots=True)
class Flight:
    """A whole simulated mission; `shots` in capture order.

    `origin`: UTM east and north of the terrain's middle. `area`: west, south, east, north of all that the
    photos can show, terrain metres. `gsd_m`: that of the photos on level ground.
    """

    params: FlightParams
    shots: tuple[Shot, ...]
    epsg: int
    origin: tuple[float, float]
    area: tuple[float, float, float, float]
    gsd_m: float

    @property
    def terrain(self) -> Terrain:
        """The ground under the flight."""
        return _terrain(self.params)

    def ground(self, shot: Shot, uv: Array, rounds: int = 12) -> Array:
        """Pixels (N, 2) of a shot → the points (N, 3) of the relief that they show, UTM metres."""
        rays = shot.camera.rays(uv) @ shot.pose.world_R_cam.T
        height = np.full(len(rays), self.params.base_alt_m)
        for _ in range(rounds if self.params.relief_m else 1):
            points = shot.pose.center + rays * ((height - shot.pose.center[2]) / rays[:, 2])[:, None]
            height = self.params.base_alt_m + self.terrain.height_m(points[:, :2] - self.origin)
        return np.column_stack((points[:, :2], height))


@dataclass(frozen=True, slots=True)
class _Waypoint:
    drone: int
    number: int
    strip: int
    xy_m: tuple[float, float]
    course_rad: float
    time_s: float


def plan_flight(params: FlightParams) -> Flight:
    """The flight that belongs to `params`; the same for the same parameters, to the last bit."""
    zone = min(int((params.lon_deg + 180) // 6) + 1, 60)
    epsg = (32600 if params.lat_deg >= 0 else 32700) + zone
    to_geodetic = Transformer.from_crs(epsg, 4326, always_xy=True)
    to_utm = Transformer.from_crs(4326, epsg, always_xy=True)
    east, north = to_utm.transform(params.lon_deg, params.lat_deg)
    origin = (float(round(east)), float(round(north)))
    convergence = Proj(CRS.from_epsg(epsg)).get_factors(params.lon_deg, params.lat_deg).meridian_convergence
    shots: list[Shot] = []
    waypoints = list(_waypoints(params))
    for drone in range(1, params.drones + 1):
        own = [w for w in waypoints if w.drone == drone]
        if own:
            shots.extend(_fly(params, own, origin, to_geodetic, float(np.radians(convergence))))
    ordered = tuple(sorted(shots, key=lambda s: (s.captured_s, s.name)))
    gsd_m = float(f"{params.height_m / params.nominal_f_px:.4g}")
    flight = Flight(params, ordered, epsg, origin, (0, 0, 0, 0), gsd_m)
    return replace(flight, area=_area(flight))


def _terrain(params: FlightParams) -> Terrain:
    return Terrain(TerrainParams(params.seed, params.relief_m, params.monotony))


def _shape(params: FlightParams) -> tuple[int, int, list[int]]:
    """Strips per drone, photos per strip, photos of each drone."""
    if params.lines and params.per_line:
        return params.lines, params.per_line, [params.lines * params.per_line] * params.drones
    counts = [
        params.frames // params.drones + (d < params.frames % params.drones) for d in range(params.drones)
    ]
    ahead = params.height_px * (1 - params.forward_overlap)
    aside = params.width_px * (1 - params.side_overlap)
    lines = params.lines or max(2 if counts[0] > 5 else 1, round(float(np.sqrt(counts[0] * ahead / aside))))
    return lines, params.per_line or -(-counts[0] // lines), counts


def _waypoints(params: FlightParams) -> Iterator[_Waypoint]:
    """The plan without error: each drone's block is a serpentine, all together centred on the terrain."""
    gsd_m = params.height_m / params.nominal_f_px
    ahead = params.height_px * (1 - params.forward_overlap) * gsd_m
    aside = params.width_px * (1 - params.side_overlap) * gsd_m
    lines, per_line, counts = _shape(params)
    bearing = np.radians(params.bearing_deg)
    forward, right = (
        np.array([np.sin(bearing), np.cos(bearing)]),
        np.array([np.cos(bearing), -np.sin(bearing)]),
    )
    for drone in range(params.drones):
        middle = drone - (params.drones - 1) / 2
        block = right * middle * lines * aside
        if params.layout == "corner":
            block = block + forward * middle * (per_line - 1) * ahead
        time_s = params.start_s + 0.31 * drone
        for k in range(counts[drone]):
            strip, place = divmod(k, per_line)
            back = strip % 2 == 1
            along = (place - (per_line - 1) / 2) * (-1 if back else 1) * ahead
            xy = block + right * (strip - (lines - 1) / 2) * aside + forward * along
            yield _Waypoint(
                drone + 1, k + 1, strip, (float(xy[0]), float(xy[1])), bearing + np.pi * back, time_s
            )
            time_s += (ahead if place + 1 < per_line else aside) / params.speed_m_s
            time_s += TURN_S * (place + 1 == per_line)


def _fly(
    params: FlightParams,
    own: list[_Waypoint],
    origin: tuple[float, float],
    to_geodetic: Transformer,
    convergence_rad: float,
) -> Iterator[Shot]:
    """One drone's photos: truth and claims are drawn for all of them, then some photos are lost."""
    n, drone = len(own), own[0].drone
    times, course = np.array([w.time_s for w in own]), np.array([w.course_rad for w in own])
    true, yaw, tilt = _truth(params, own)
    fix = _fixes(params, true, course, times, drone)
    lon, lat = to_geodetic.transform(fix[:, 0] + origin[0], fix[:, 1] + origin[1])
    odd = np.array([w.strip % 2 for w in own])
    claimed = yaw + convergence_rad + np.radians(params.yaw_offset_deg) + np.pi * (params.yaw_flip * odd)
    claimed += np.radians(params.compass_noise_deg) * _draws(params, drone, "compass").normal(0, 1, n)
    drift = _draws(params, drone, "barometer")
    barometer = true[:, 2] + 0.25 * _slow(times, drift) + 0.05 * drift.normal(0, 1, n)
    gain = _gains(params, times, drone)
    seeds = _draws(params, drone, "sensor").integers(0, 2**31, n)
    ground = _terrain(params).height_m(true[:, :2]) + params.base_alt_m
    blind = _blind(params, n, drone)
    sigma = max(params.gps_noise_m, 0.005)
    for k in np.flatnonzero(~_lost(params, n, drone)):
        center = true[k] + (*origin, params.base_alt_m)
        pitch_rad = np.radians(params.pitch_deg + 90) + tilt[k, 0]
        alt_m = float(fix[k, 2] + params.base_alt_m)
        yield Shot(
            name=f"D{drone}_{own[k].number:04d}.jpg",
            drone=drone,
            camera=params.camera(),
            pose=Pose(look_down(yaw[k], pitch_rad, tilt[k, 1]), center, float(ground[k])),
            gain=(float(gain[k, 0]), float(gain[k, 1]), float(gain[k, 2])),
            noise_seed=int(seeds[k]),
            captured_s=round(float(times[k]), 3),
            gps=None
            if blind[k]
            else GpsFix(
                float(lat[k]), float(lon[k]), alt_m, *((sigma, 1.5 * sigma) if params.rtk else (None, None))
            ),
            relative_alt_m=float(barometer[k]) if params.barometer else None,
            attitude=_stated(params, float(claimed[k])) if params.xmp else Attitude(),
            flight_yaw_rad=_wrapped(course[k] + convergence_rad) if params.xmp else None,
        )


def _draws(params: FlightParams, drone: int, what: str) -> np.random.Generator:
    """A generator of its own for each kind of error, so that changing one error leaves the others alone."""
    return np.random.default_rng((params.seed, 20, drone, *what.encode()))


def _truth(params: FlightParams, own: list[_Waypoint]) -> tuple[Array, Array, Array]:
    """Where the drone is, (N, 3) metres about the terrain's middle; yaw (N,) and tilts (N, 2), radians."""
    rng, n = _draws(params, own[0].drone, "truth"), len(own)
    plan = np.array([(*w.xy_m, params.height_m) for w in own])
    true = plan + params.track_noise_m * rng.normal(0, (1, 1, 0.8), (n, 3))
    held = np.array([params.turn == "hold" and w.strip % 2 == 1 for w in own])
    yaw = np.array([w.course_rad for w in own]) - np.pi * held
    yaw = yaw + np.radians(params.yaw_noise_deg) * rng.normal(0, 1, n)
    return true, yaw, np.radians(params.tilt_deg) * rng.normal(0, 1, (n, 2))


def _fixes(params: FlightParams, true: Array, course: Array, times: Array, drone: int) -> Array:
    """Where the drone says it is: (N, 3) metres from the terrain's middle."""
    rng = _draws(params, drone, "gps")
    velocity = params.speed_m_s * np.column_stack((np.sin(course), np.cos(course), 0 * course))
    noise = params.gps_noise_m * rng.normal(0, (1, 1, 1.5), true.shape)
    bias = params.gps_bias_m * np.column_stack([_slow(times, rng) for _ in range(3)]) * (1, 1, 1.5)
    return np.asarray(true - params.gps_lag_s * velocity + noise + bias)


def _gains(params: FlightParams, times: Array, drone: int) -> Array:
    """Exposure and white balance: (N, 3) factors of R, G, B."""
    rng, n = _draws(params, drone, "light"), len(times)
    light = params.exposure * (0.8 * _slow(times, rng) + 0.6 * rng.normal(0, 1, n))
    return np.asarray(np.exp(light[:, None] + 0.35 * params.exposure * rng.normal(0, (1, 0, 1), (n, 3))))


def _blind(params: FlightParams, n: int, drone: int) -> NDArray[np.bool_]:
    """Which of a drone's n photos have no fix."""
    first, last = params.gps_outage
    k = np.arange(n)
    chosen = np.zeros(n, bool)
    chosen[_draws(params, drone, "blind").permutation(n)[: round(params.no_gps * n)]] = True
    return np.asarray(chosen | ((k >= first * n) & (k < last * n)))


def _stated(params: FlightParams, yaw_rad: float) -> Attitude:
    """What a gimbal says: its nominal pitch, no roll; of a tilt that it cannot hold it knows nothing."""
    return Attitude(_wrapped(yaw_rad), float(np.radians(params.pitch_deg)), 0.0)


def look_down(heading_rad: float, forward_rad: float = 0.0, side_rad: float = 0.0) -> Array:
    """grid_R_cam (3, 3) of a camera whose picture's top looks along `heading_rad` (clockwise from north).

    `forward_rad` lifts the view from straight down towards that heading, `side_rad` towards its right.
    """
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    nadir = np.array([[c, -s, 0], [-s, -c, 0], [0, 0, -1.0]])
    a, b = forward_rad, side_rad
    pitch = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    roll = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return np.asarray(nadir.T @ pitch @ roll)


def _lost(params: FlightParams, n: int, drone: int) -> NDArray[np.bool_]:
    """Which of a drone's n photos never arrive."""
    lost = np.zeros(n, bool)
    lost[_draws(params, drone, "lost").permutation(n)[: round(params.drop * n)]] = True
    for g in range(params.gaps):
        start = round((g + 1) * n / (params.gaps + 1) - params.gap_frames / 2)
        lost[max(start, 1) : max(start, 1) + params.gap_frames] = True
    return lost


def _slow(times_s: Array, rng: np.random.Generator) -> Array:
    """A drift of unit variance over the times (N,): an Ornstein–Uhlenbeck process."""
    values = rng.normal(0, 1, len(times_s))
    for k in range(1, len(values)):
        keep = float(np.exp(-(times_s[k] - times_s[k - 1]) / SLOW_S))
        values[k] = keep * values[k - 1] + np.sqrt(1 - keep**2) * values[k]
    return np.asarray(values)


def _wrapped(angle_rad: float) -> float:
    return float((angle_rad + np.pi) % (2 * np.pi) - np.pi)


def _area(flight: Flight) -> tuple[float, float, float, float]:
    """The bounds of every footprint, with a little to spare."""
    outlines = [_border(shot.camera) for shot in flight.shots[:1]]
    points = [flight.ground(shot, outlines[0])[:, :2] - flight.origin for shot in flight.shots]
    if not points:
        return (-50.0, -50.0, 50.0, 50.0)
    (west, south), (east, north) = np.concatenate(points).min(0), np.concatenate(points).max(0)
    return float(west) - 3, float(south) - 3, float(east) + 3, float(north) + 3


def _border(camera: Camera) -> Array:
    t = np.linspace(0, 1, 9)[:-1, None]
    corners = camera.corners() + np.array([[-8, -8], [8, -8], [8, 8], [-8, 8]])
    return np.concatenate([corners[i] + t * (corners[(i + 1) % 4] - corners[i]) for i in range(4)])
