"""Simulated flights: photos show what their true poses say, and claim what their parameters say."""

import hashlib
import io
import json
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from pyproj import Geod, Transformer
from shapely.geometry import Polygon

from core.decode import decode_rgb
from core.metadata import read_metadata
from core.photo import PhotoLimits, probe
from core.photography import (
    GroundPicture,
    cars_at,
    develop,
    expose,
    render,
    truth_document,
    write_truth_raster,
)
from core.simulation import FlightParams, look_down, plan_flight

SMALL = FlightParams(frames=12, drones=2, width_px=480, height_px=360, height_m=40, seed=2)


def meta_of(data):
    return read_metadata(data, probe(data, PhotoLimits()))


@pytest.fixture(scope="module")
def hilly(tmp_path_factory):
    """A flight with everything that bends a picture: relief, tilt, distortion."""
    params = replace(SMALL, relief_m=12, tilt_deg=5, k1=-0.06, frames=4, drones=1)
    return GroundPicture.create(tmp_path_factory.mktemp("hilly"), plan_flight(params)), plan_flight(params)


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    flight = plan_flight(SMALL)
    return GroundPicture.create(tmp_path_factory.mktemp("level"), flight), flight


def displacement_px(patch, around, reach):
    """Where `patch` lies in `around`, to a fraction of a pixel; NaN where nothing is to see."""
    if patch.std() < 6:
        return np.array([np.nan, np.nan])
    score = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
    _, _, _, (x, y) = cv2.minMaxLoc(score)
    if not (0 < x < score.shape[1] - 1 and 0 < y < score.shape[0] - 1):
        return np.array([x - reach, y - reach], float)

    def peak(a, b, c):
        return (a - c) / (2 * (a - 2 * b + c))

    dx = peak(*score[y, x - 1 : x + 2].astype(float))
    dy = peak(*score[y - 1 : y + 2, x].astype(float))
    return np.array([x + dx - reach, y + dy - reach])


def test_photos_show_the_ground_where_their_poses_say(hilly):
    """Ground patches found by `Pose.pixels` (forward) in photos made by `Camera.rays` (backward)."""
    picture, flight = hilly
    half, reach, errors = 16, 5, []
    for shot in flight.shots:
        photo = cv2.cvtColor(expose(picture, shot), cv2.COLOR_RGB2GRAY)
        grid = np.stack(np.meshgrid(np.linspace(45, 435, 7), np.linspace(45, 315, 6)), -1).reshape(-1, 2)
        for center in np.round(picture.pixels(flight.ground(shot, grid)[:, :2])).astype(int):
            side = np.arange(-half - reach, half + reach + 1)
            px, py = np.meshgrid(center[0] + side, center[1] + side)
            xy = np.column_stack((px.ravel(), py.ravel()))
            offset = (picture.first_column * 1024 + 0.5, picture.first_row * 1024 + 0.5)
            local = (xy + offset) * (flight.gsd_m, -flight.gsd_m)
            height = flight.terrain.height_m(local) + flight.params.base_alt_m
            uv = shot.pose.pixels(shot.camera, np.column_stack((local + flight.origin, height)))
            maps = uv.astype(np.float32).reshape(len(side), len(side), 2)
            seen = cv2.remap(photo, maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)
            x, y = center - half
            truth = cv2.cvtColor(picture.window(x, y, x + 2 * half + 1, y + 2 * half + 1), cv2.COLOR_RGB2GRAY)
            errors.append(displacement_px(truth, seen, reach))
    found = np.array(errors)[~np.isnan(errors).any(1)]
    assert len(found) > 100
    assert np.percentile(np.hypot(*found.T), 95) < 0.3
    assert np.abs(found.mean(0)).max() < 0.03


def test_truth_raster_and_photos_agree_in_utm(level, tmp_path):
    picture, flight = level
    write_truth_raster(picture, tmp_path / "truth.tif")
    frame = truth_document(flight)["frames"][5]
    base = truth_document(flight)["base"]
    with rasterio.open(tmp_path / "truth.tif") as truth:
        assert truth.crs.to_epsg() == flight.epsg == 32633
        assert 0.08 <= truth.res[0] <= 0.16
        ground = cv2.cvtColor(truth.read().transpose(1, 2, 0), cv2.COLOR_RGB2GRAY)
        to_pixel, res = ~truth.transform, truth.res[0]
    # A copy of the photo drawn onto the truth's own grid, by nothing but truth.json.
    c, r = (int(t) for t in to_pixel @ tuple(frame["center"][:2]))
    side, reach = np.arange(-60, 61), 6
    px, py = np.meshgrid(c + side, r + side)
    east, north = (~to_pixel) @ (px.ravel() + 0.5, py.ravel() + 0.5)
    cam = (np.column_stack((east, north, np.full(px.size, base))) - frame["center"]) @ np.array(frame["R"])
    xy = cam[:, :2] / cam[:, 2:]
    xy *= 1 + frame["k1"] * (xy**2).sum(1, keepdims=True)
    uv = (xy * frame["f"] + (frame["cx"], frame["cy"])).astype(np.float32).reshape(121, 121, 2)
    photo = cv2.cvtColor(expose(picture, flight.shots[5]), cv2.COLOR_RGB2GRAY)
    photo = cv2.GaussianBlur(photo, (0, 0), res / flight.gsd_m / 2.5)
    seen = cv2.remap(photo, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR)
    patch = ground[r - 60 + reach : r + 61 - reach, c - 60 + reach : c + 61 - reach]
    assert np.hypot(*displacement_px(patch, seen, reach)) < 0.25
    assert cv2.matchTemplate(seen, patch, cv2.TM_CCOEFF_NORMED).max() > 0.9


def test_same_seed_same_bytes_whatever_came_before(tmp_path):
    def digest(folder, order):
        picture = GroundPicture.create(tmp_path / folder, plan_flight(SMALL))
        photos = {k: render(picture, plan_flight(SMALL).shots[k]) for k in order}
        return [hashlib.sha256(photos[k]).hexdigest() for k in sorted(order)]

    first = digest("a", [0, 7])
    assert first == digest("b", [7, 0])
    other = replace(SMALL, seed=9)
    assert (
        hashlib.sha256(
            render(GroundPicture.create(tmp_path / "c", plan_flight(other)), plan_flight(other).shots[0])
        ).hexdigest()
        not in first
    )


def test_metadata_reads_back(level):
    picture, flight = level
    shot = flight.shots[3]
    data = render(picture, shot)
    meta = meta_of(data)
    assert (meta.width, meta.height) == (480, 360)
    assert meta.f_px == pytest.approx(flight.params.nominal_f_px, rel=1e-4)
    assert meta.captured_s == pytest.approx(shot.captured_s, abs=1e-3)
    assert meta.gps.lat_deg == pytest.approx(shot.gps.lat_deg, abs=2e-9)
    assert meta.gps.lon_deg == pytest.approx(shot.gps.lon_deg, abs=2e-9)
    assert meta.gps.alt_m == pytest.approx(shot.gps.alt_m, abs=0.01)
    assert meta.gps.sigma_h_m is None
    assert meta.relative_alt_m == pytest.approx(shot.relative_alt_m, abs=0.01)
    assert np.degrees(meta.attitude.yaw_rad) == pytest.approx(np.degrees(shot.attitude.yaw_rad), abs=0.01)
    assert np.degrees(meta.attitude.pitch_rad) == pytest.approx(-90)
    other = meta_of(render(picture, next(s for s in flight.shots if s.drone != shot.drone)))
    assert meta.drone != other.drone
    exif = Image.open(io.BytesIO(data)).getexif()
    assert exif[0x010F] == "DJI"
    assert exif.get_ifd(0x8769)[0xA405] == 24
    assert exif.get_ifd(0x8769)[0x920A] == pytest.approx(meta.f_px / 480 * 13.2, abs=1e-3)
    assert decode_rgb(data, None).shape == (360, 480, 3)


def test_a_photo_without_gps_or_xmp_says_so(level):
    picture, flight = level
    params = replace(SMALL, no_gps=1, xmp=False)
    blind = plan_flight(params)
    meta = meta_of(render(replace(picture, flight=replace(flight, params=params)), blind.shots[0]))
    assert meta.gps is None
    assert meta.relative_alt_m is None
    assert meta.attitude.yaw_rad is None
    assert meta.f_px == pytest.approx(params.nominal_f_px, rel=1e-3)


def test_southern_and_western_places_keep_their_signs(level):
    picture, _ = level
    params = replace(SMALL, lat_deg=-33.4, lon_deg=-70.6, rtk=True, gps_noise_m=0.02)
    south = plan_flight(params)
    meta = meta_of(render(replace(picture, flight=replace(south, shots=())), south.shots[0]))
    assert south.epsg == 32719
    assert meta.gps.lat_deg == pytest.approx(-33.4, abs=0.01)
    assert meta.gps.lon_deg == pytest.approx(-70.6, abs=0.01)
    assert meta.gps.sigma_h_m == pytest.approx(0.02)


@pytest.mark.parametrize(("ahead", "aside"), [(0.75, 0.65), (0.4, 0.3)])
def test_overlap_is_as_asked(ahead, aside):
    params = FlightParams(
        frames=60,
        drones=2,
        forward_overlap=ahead,
        side_overlap=aside,
        k1=0,
        track_noise_m=0,
        yaw_noise_deg=0,
        tilt_deg=0,
    )
    flight = plan_flight(params)
    outline = {s.name: Polygon(s.pose.footprint(s.camera)) for s in flight.shots}
    mine = [outline[s.name] for s in flight.shots if s.drone == 1]
    shared = [a.intersection(b).area / a.area for a, b in pairwise(mine)]
    assert np.median(shared) == pytest.approx(ahead, abs=0.01)
    turns = [s for s in shared if abs(s - ahead) > 0.02]
    assert turns == pytest.approx([aside] * len(turns), abs=0.01)
    between = max(
        a.intersection(b).area / a.area for a in mine for n, b in outline.items() if n.startswith("D2")
    )
    assert between == pytest.approx(aside, abs=0.05)


def test_drones_that_meet_at_a_corner_share_little():
    flight = plan_flight(FlightParams(frames=60, drones=2, layout="corner"))
    outline = {s.name: Polygon(s.pose.footprint(s.camera)) for s in flight.shots}
    pairs = sum(
        a.intersection(b).area > 0.2 * a.area
        for m, a in outline.items()
        for n, b in outline.items()
        if m.startswith("D1") and n.startswith("D2")
    )
    assert 1 <= pairs <= 12


def test_fixes_err_as_much_as_asked():
    params = FlightParams(frames=600, drones=1, gps_noise_m=2.0, gps_lag_s=0.5, speed_m_s=10)
    flight = plan_flight(params)
    to_utm = Transformer.from_crs(4326, flight.epsg, always_xy=True)
    east, north = to_utm.transform(
        [s.gps.lon_deg for s in flight.shots], [s.gps.lat_deg for s in flight.shots]
    )
    error = np.column_stack((east, north)) - [s.pose.center[:2] for s in flight.shots]
    heading = np.array([s.pose.world_R_cam[:2, 1] for s in flight.shots]) * -1
    heading /= np.hypot(*heading.T)[:, None]
    along = (error * heading).sum(1)
    assert along.mean() == pytest.approx(-5, abs=0.4)
    assert along.std() == pytest.approx(2, abs=0.25)
    biased = plan_flight(replace(params, gps_bias_m=5))
    moved = np.diff(
        [(b.gps.lat_deg - a.gps.lat_deg) * 111_200 for a, b in zip(flight.shots, biased.shots, strict=True)]
    )
    assert 0 < np.abs(moved).max() < 6  # it drifts, it does not jump
    assert [s.pose.center.tolist() for s in biased.shots] == [s.pose.center.tolist() for s in flight.shots]


@pytest.mark.parametrize("offset_deg", [0.0, 35.0])
def test_stated_yaw_is_about_true_north(offset_deg):
    params = FlightParams(frames=40, drones=1, compass_noise_deg=0, tilt_deg=0, yaw_offset_deg=offset_deg)
    flight = plan_flight(params)
    to_geodetic = Transformer.from_crs(flight.epsg, 4326, always_xy=True)
    for shot in flight.shots:
        middle, top = shot.pose.ground(shot.camera, np.array([[499.5, 374.5], [499.5, 0]]))[:, :2]
        azimuth, _, _ = Geod(ellps="WGS84").inv(*to_geodetic.transform(*middle), *to_geodetic.transform(*top))
        wrong = np.degrees(shot.attitude.yaw_rad) - azimuth - offset_deg
        assert (wrong + 180) % 360 - 180 == pytest.approx(0, abs=0.02)


def test_cameras_turn_hold_or_lie_at_the_end_of_a_strip():
    base = FlightParams(frames=40, drones=1, yaw_noise_deg=0, compass_noise_deg=0)

    def yaws(**changed):
        flight = plan_flight(replace(base, **changed))
        true = np.array([np.arctan2(*-s.pose.world_R_cam[:2, 1]) for s in flight.shots])
        said = np.array([s.attitude.yaw_rad for s in flight.shots])
        return np.abs(np.exp(1j * true).sum()) / len(true), np.cos(said - true)

    together, honest = yaws()
    assert together < 0.3
    assert honest.min() > 0.99
    together, honest = yaws(turn="hold")
    assert together > 0.99
    assert honest.min() > 0.99
    together, honest = yaws(yaw_flip=True)
    assert together < 0.3
    assert honest.min() < -0.99
    assert honest.max() > 0.99


def test_losses_are_as_asked():
    base = FlightParams(frames=120, drones=2)
    assert len(plan_flight(base).shots) == 120
    assert len(plan_flight(replace(base, drop=0.2)).shots) == 96
    kept = [s.name for s in plan_flight(replace(base, gaps=3, gap_frames=5)).shots if s.drone == 1]
    numbers = np.array([int(n[3:7]) for n in kept])
    assert len(kept) == 45
    assert (np.diff(numbers) == 6).sum() == 3
    half = [s.gps is None for s in plan_flight(replace(base, gps_outage=(0.25, 0.75))).shots if s.drone == 2]
    assert half == [False] * 15 + [True] * 30 + [False] * 15
    assert sum(s.gps is None for s in plan_flight(replace(base, no_gps=0.1)).shots) == 12
    rows = plan_flight(replace(base, lines=3, per_line=7))
    assert len(rows.shots) == 42


def test_captures_come_in_order_and_drones_take_turns():
    shots = plan_flight(FlightParams(frames=30, drones=3)).shots
    assert [s.captured_s for s in shots] == sorted(s.captured_s for s in shots)
    assert {s.drone for s in shots[:3]} == {1, 2, 3}
    assert len({s.name for s in shots}) == 30


def test_light_changes_from_photo_to_photo_and_towards_corners(level):
    _, flight = level
    shot = flight.shots[0]
    gray = np.full((360, 480, 3), 128, np.uint8)
    seen = develop(flight, replace(shot, gain=(1.2, 1.0, 0.9)), gray).astype(float)
    assert seen[170:190, 230:250].mean((0, 1)) == pytest.approx([153.6, 128, 115.2], abs=1.0)
    assert seen[:12, :12].mean() / seen[170:190, 230:250].mean() == pytest.approx(0.83, abs=0.02)
    assert 1.0 < (seen[170:190, 230:250] - seen[170:190, 230:250].mean((0, 1))).std() < 2.5
    gains = np.log([s.gain for s in plan_flight(replace(SMALL, frames=300, exposure=0.2)).shots])
    assert gains[:, 1].std() == pytest.approx(0.2, rel=0.3)


def test_cars_drive_in_photos_and_not_in_the_truth(level):
    picture, flight = level
    busy = plan_flight(replace(SMALL, cars=40, frames=12))
    traffic = replace(picture, flight=replace(busy, shots=()))
    changed = [
        (np.abs(expose(traffic, b).astype(int) - expose(picture, a)).max(-1) > 20).sum()
        for a, b in zip(flight.shots, busy.shots, strict=True)
    ]
    assert max(changed) > 200
    before, after = (
        np.array([xy for xy, _, _ in cars_at(busy, busy.shots[0].captured_s + t)]) for t in (0, 1)
    )
    moved = np.hypot(*(after - before).T)
    assert np.median(moved) == pytest.approx(11, abs=5)


def test_the_camera_tilts_the_way_it_says():
    forward = look_down(np.radians(90), forward_rad=0.1)
    assert forward[:, 2] == pytest.approx([np.sin(0.1), 0, -np.cos(0.1)])
    side = look_down(np.radians(90), side_rad=0.1)
    assert side[:, 2] == pytest.approx([0, -np.sin(0.1), -np.cos(0.1)])
    assert np.linalg.det(look_down(1.0, 0.2, 0.3)) == pytest.approx(1)


@pytest.mark.parametrize(
    "wrong", [{"drones": 0}, {"frames": 0}, {"forward_overlap": 1.0}, {"pitch_deg": -20}, {"relief_m": 90}]
)
def test_what_cannot_be_flown_is_refused(wrong):
    with pytest.raises(ValueError, match=r"."):
        FlightParams(**wrong)


def test_truth_document_is_plain_json(level):
    document = json.loads(json.dumps(truth_document(level[1])))
    assert document["base"] == 120
    assert len(document["frames"]) == 12
    assert np.array(document["frames"][0]["R"]).shape == (3, 3)
