"""What other programs read is what orthostream means, to the centimetre and to the pixel."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pyproj import Transformer
from rio_cogeo.cogeo import cog_validate
from scipy.spatial.transform import Rotation

from core.checkpoints import checkpoint_errors, parse_gcp_list
from core.errors import BadCheckpoints, BadCrs, NothingToMap
from core.exports import (
    MosaicParams,
    NamedFrame,
    flight_gsd_m,
    footprints_geojson,
    in_capture_order,
    json_bytes,
    poses_document,
    route_csv,
    write_mosaic,
)
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.outline import ground_outline
from core.pyramid import halve

CAMERA = Camera(400, 300, 300.0, 199.5, 149.5, k1=-0.02, k2=0.004)
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
kilometre = st.floats(-1000, 1000)
flights = st.tuples(
    kilometre, kilometre, st.floats(20, 100), st.floats(-4, 4), st.floats(-0.1, 0.1), st.floats(-50, 100)
)
places = st.tuples(st.floats(-70, 70), st.floats(-179, 179), st.floats(-50, 3000))


def frame(
    x: float,
    y: float,
    height: float,
    yaw: float = 0.3,
    tilt: float = 0.02,
    ground: float = 0.0,
    name: str = "",
) -> NamedFrame:
    rotation = Rotation.from_euler("zx", [yaw, tilt]).as_matrix() @ DOWN
    pose = Pose(rotation, np.array([x, y, ground + height]), ground, "visual", 0, (0.5, 0.6, 1.25))
    frame_id = hashlib.sha256(f"{x} {y} {height} {yaw}".encode()).hexdigest()[:32]
    return NamedFrame(name or frame_id, PosedFrame(frame_id, CAMERA, pose), 1.7e9 + x)


def read_back(document: Mapping[str, Any], entry: Mapping[str, Any], uv: Array) -> Array:
    """Pixels → ground in the document's CRS, written from the format's description alone."""
    camera = document["cameras"][entry["camera"]]
    distorted = (uv - [camera["cx"], camera["cy"]]) / camera["f_px"]
    x = distorted.copy()
    for _ in range(10):
        r2 = (x**2).sum(1, keepdims=True)
        x = distorted / (1 + camera["k1"] * r2 + camera["k2"] * r2**2)
    ray = np.c_[x, np.ones(len(x))] @ np.array(entry["R"]).T
    center = np.array(entry["center"])
    return np.asarray(center + ray * ((entry["ground_height"] - center[2]) / ray[:, 2])[:, None])


@given(places, st.lists(flights, min_size=1, max_size=6, unique_by=lambda f: f[:2]))
@settings(deadline=None)
def test_poses_read_back_to_the_same_ground(
    place: tuple[float, float, float], flown: list[tuple[float, float, float, float, float, float]]
) -> None:
    """Over a mission 2 km across, anywhere, through convergence, scale and curvature: within 2 cm."""
    world = World(*place)
    frames = [frame(*f) for f in flown]
    document = json.loads(json_bytes(poses_document(world, frames)))
    to_crs = Transformer.from_crs(4326, document["crs"], always_xy=True)
    uv = np.random.default_rng(0).uniform(0, 1, (30, 2)) * (CAMERA.width - 1, CAMERA.height - 1)
    entries = {entry["name"]: entry for entry in document["frames"]}
    for named in frames:
        lon, lat, alt = world.to_geodetic(named.posed.pose.ground(CAMERA, uv)).T
        theirs = read_back(document, entries[named.name], uv)
        assert np.hypot(*(theirs[:, :2] - np.column_stack(to_crs.transform(lon, lat))).T).max() < 0.02
        assert np.abs(theirs[:, 2] - alt).max() < 0.15
        rotation = np.array(entries[named.name]["R"])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_the_poses_documents_shape() -> None:
    world = World(47.0, 9.0, 400.0)
    gnss = NamedFrame("b.jpg", PosedFrame("f" * 32, CAMERA, Pose(DOWN, np.array([0, 0, 50.0]), 0.0, "gnss")))
    document = poses_document(world, [gnss, frame(5, 0, 50, name="a.jpg")])
    assert document["crs"] == "EPSG:32632"
    size = {"model": "RADIAL", "width": 400, "height": 300}
    assert document["cameras"] == [size | {"f_px": 300.0, "cx": 199.5, "cy": 149.5, "k1": -0.02, "k2": 0.004}]
    first, last = document["frames"]
    assert (first["name"], first["source"], first["sigma_m"], first["camera"]) == (
        "a.jpg",
        "visual",
        [0.5, 0.6, 1.25],
        0,
    )
    assert (last["name"], last["source"], last["sigma_m"], last["submap"]) == ("b.jpg", "gnss", None, 0)


def test_exports_do_not_depend_on_the_order_of_arrival() -> None:
    world = World(47.0, 9.0, 400.0)
    frames = [frame(x, y, 60, name=f"{x}-{y}") for x in (0, 20) for y in (0, 20)]
    for export in (poses_document, footprints_geojson, route_csv):
        assert export(world, frames) == export(world, frames[::-1])
    undated = NamedFrame("0", frames[0].posed)
    assert in_capture_order([undated, *frames])[-1] == undated


def test_footprints_are_counter_clockwise_rings_of_what_is_seen() -> None:
    world = World(-33.0, 151.0, 20.0)
    named = frame(30, 40, 80, yaw=1.0)
    feature = footprints_geojson(world, [named])["features"][0]
    (ring,) = feature["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    corners = np.array(ring[:-1])
    x, y = (corners - corners[0]).T
    assert (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0
    outline = world.from_geodetic(np.column_stack((corners, np.full(4, 20.0))))[:, :2]
    truth = named.posed.pose.footprint(CAMERA)
    distance = np.linalg.norm(outline[:, None] - truth[None], axis=2)
    assert distance.min(0).max() < 0.01
    assert feature["properties"]["gsd_m"] == pytest.approx(80 / 300, abs=1e-4)


@settings(deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(1, 500))
def test_no_outline_is_endless(tilt: float, height: float) -> None:
    outline = ground_outline(frame(0, 0, height, tilt=tilt).posed)
    if outline is None:
        assert abs(tilt) > math.pi / 2 - 0.01
    else:
        assert np.hypot(*outline.T).max() <= height * math.tan(math.radians(75)) + 1e-6
        if abs(tilt) < 0.3:
            np.testing.assert_allclose(outline, frame(0, 0, height, tilt=tilt).posed.pose.footprint(CAMERA))
    below = frame(0, 0, -height).posed
    assert ground_outline(below) is None


def test_the_route_tells_heights_above_ground() -> None:
    world = World(47.0, 9.0, 400.0)
    rows = list(csv.DictReader(io.StringIO(route_csv(world, [frame(0, 0, 62, ground=3, name='a,"b".jpg')]))))
    (row,) = rows
    assert row["name"] == 'a,"b".jpg'
    assert datetime.fromisoformat(row["time"]) == datetime.fromtimestamp(1.7e9, UTC)
    assert float(row["height_above_ground"]) == pytest.approx(62)
    assert float(row["alt"]) == pytest.approx(465, abs=1e-3)
    assert (float(row["lon"]), float(row["lat"])) == pytest.approx((9.0, 47.0))
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(9.0, 47.0)
    assert (float(row["easting"]), float(row["northing"])) == pytest.approx((east, north), abs=1e-3)
    assert (row["sigma_e"], row["sigma_n"], row["sigma_u"]) == ("0.500", "0.600", "1.250")


# ---- the mosaic


def ground_colour(xy: Array) -> NDArray[np.float64]:
    """A landscape whose colour says where one is: slow waves, none twice."""
    x, y = np.asarray(xy).T
    return np.stack(
        (128 + 90 * np.sin(x / 17), 128 + 90 * np.sin(y / 13), 128 + 90 * np.cos((x + y) / 29)), axis=1
    )


class FlatLand:
    """Photos of `ground_colour`, as a perfect camera would take them."""

    def __init__(self, frames: list[NamedFrame]) -> None:
        self._photos = {f.posed.frame_id: self._taken(f.posed) for f in frames}

    @staticmethod
    def _taken(posed: PosedFrame) -> NDArray[np.uint8]:
        rows, cols = np.mgrid[: CAMERA.height, : CAMERA.width]
        xy = posed.pose.ground(CAMERA, np.column_stack((cols.ravel(), rows.ravel())).astype(float))[:, :2]
        return np.rint(ground_colour(xy)).astype(np.uint8).reshape(CAMERA.height, CAMERA.width, 3)

    def photo(self, frame_id: str) -> NDArray[np.uint8]:
        return self._photos[frame_id]

    def thumb(self, frame_id: str) -> NDArray[np.uint8]:
        return np.ascontiguousarray(self._photos[frame_id][::4, ::4])


WORLD = World(47.0, 10.4, 400.0)
FLIGHT = [frame(25.0 * i, 20.0 * j, 60 + i, yaw=0.3 + j) for i in range(4) for j in range(3)]
LAND = FlatLand(FLIGHT)


def write(path: Path, frames: list[NamedFrame] = FLIGHT, **options: Any) -> Path:
    write_mosaic(path, WORLD, [f.posed for f in frames], LAND, **options)
    return path


@pytest.fixture(scope="module")
def mosaic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("mosaic") / "mosaic.tif")


def pixels_of(path: Path, xy: Array) -> NDArray[np.uint8]:
    """The mosaic's RGBA (N, 4) at world points, through nothing but the file's own georeference."""
    with rasterio.open(path) as file:
        to_crs = Transformer.from_crs(4326, file.crs, always_xy=True)
        lon, lat, _ = WORLD.to_geodetic(np.column_stack((xy, np.zeros(len(xy))))).T
        col, row = (~file.transform) @ to_crs.transform(lon, lat)
        data = file.read()
    return np.asarray(data[:, np.floor(row).astype(int), np.floor(col).astype(int)].T)


def test_the_mosaic_shows_the_ground_where_it_is(mosaic: Path) -> None:
    xy = np.random.default_rng(1).uniform((0, 0), (75, 40), (400, 2))
    rgba = pixels_of(mosaic, xy)
    assert (rgba[:, 3] == 255).all()
    # Colours change by at most 7 a metre: 3 levels are less than half a metre, two pixels.
    assert np.abs(rgba[:, :3] - ground_colour(xy)).mean() < 1.5
    assert np.percentile(np.abs(rgba[:, :3] - ground_colour(xy)), 95) < 4


def test_the_mosaic_is_a_valid_cog_at_the_flights_gsd(mosaic: Path) -> None:
    valid, errors, warnings = cog_validate(mosaic, strict=True)
    assert (valid, errors, warnings) == (True, [], [])
    with rasterio.open(mosaic) as file:
        assert file.count == 4
        assert file.colorinterp[3] == rasterio.enums.ColorInterp.alpha
        assert file.crs.to_epsg() == 32632
        assert file.res == pytest.approx([flight_gsd_m([f.posed for f in FLIGHT])] * 2)
        alpha = file.read(4)
    assert alpha[0, 0] == 0
    assert 0.4 < (alpha == 255).mean() < 1


def test_the_same_map_is_the_same_bytes_however_it_is_cut(mosaic: Path, tmp_path: Path) -> None:
    again = write(tmp_path / "again.tif", FLIGHT[::-1])
    assert again.read_bytes() == mosaic.read_bytes()
    cut = write(tmp_path / "cut.tif", params=MosaicParams(window_px=256, piece_px=512, threads=3))
    assert cut.read_bytes() == mosaic.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.tif", "cut.tif"]


def test_every_overview_of_the_mosaic_is_the_level_below_it_halved(tmp_path: Path) -> None:
    path = write(tmp_path / "m.tif", params=MosaicParams(piece_px=128, block_px=128))
    with rasterio.open(path) as file:
        factors = file.overviews(1)
        finer = file.read()
    assert factors == [2**k for k in range(1, len(factors) + 1)]
    assert max(finer.shape) > 256
    for level in range(len(factors)):
        with rasterio.open(path, overview_level=level) as file:
            shown = file.read()
        height, width = shown.shape[1:]
        whole = np.zeros((2 * height, 2 * width, 4), np.uint8)
        whole[: finer.shape[1], : finer.shape[2]] = finer.transpose(1, 2, 0)
        np.testing.assert_array_equal(shown.transpose(1, 2, 0), halve(whole))
        finer = shown
    assert max(finer.shape) <= 128


def test_another_crs_shows_the_same_places(tmp_path: Path) -> None:
    warped = write(tmp_path / "warped.tif", crs="EPSG:3857")
    assert cog_validate(warped, strict=True)[0]
    with rasterio.open(warped) as file:
        assert file.crs.to_epsg() == 3857
        assert file.read(4).max() == 255
    xy = np.random.default_rng(2).uniform((5, 5), (70, 35), (200, 2))
    assert np.abs(pixels_of(warped, xy)[:, :3] - ground_colour(xy)).mean() < 2


def test_another_crs_says_how_it_was_reached_and_keeps_what_else_was_said(tmp_path: Path) -> None:
    """A map that lies nowhere lies nowhere in every CRS."""
    with rasterio.open(write(tmp_path / "utm.tif")) as file:
        assert {"TRANSFORMATION", "GEOREFERENCED"}.isdisjoint(file.tags())
    with rasterio.open(write(tmp_path / "warped.tif", crs="EPSG:31254")) as file:
        assert re.search("MGI .*: within [1-9].* m$", file.tags()["TRANSFORMATION"])
    nowhere = [
        replace(f, posed=replace(f.posed, pose=replace(f.posed.pose, source="vision-only"))) for f in FLIGHT
    ]
    for crs in (None, "EPSG:3857", "EPSG:2154"):
        with rasterio.open(write(tmp_path / "local.tif", nowhere, crs=crs)) as file:
            assert file.tags()["GEOREFERENCED"] == "NO"
            assert "no photo has GPS" in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]


def test_progress_is_told_and_too_large_a_map_is_drawn_coarser(tmp_path: Path) -> None:
    told: list[float] = []
    path = write(
        tmp_path / "small.tif", params=MosaicParams(max_pixels=60_000, window_px=64), progress=told.append
    )
    assert told == sorted(told)
    assert told[-1] == 1
    with rasterio.open(path) as file:
        assert file.width * file.height <= 60_000
        assert file.res[0] / flight_gsd_m([f.posed for f in FLIGHT]) in (2, 4, 8)


def test_what_cannot_be_drawn_says_so(tmp_path: Path) -> None:
    with pytest.raises(BadCrs, match="EPSG:99999"):
        write(tmp_path / "x.tif", crs="EPSG:99999")
    with pytest.raises(BadCrs, match=r"New Zealand.*EPSG:32632"):
        write(tmp_path / "x.tif", crs="EPSG:2193")
    assert not list(tmp_path.iterdir())
    with pytest.raises(NothingToMap):
        write(tmp_path / "x.tif", [])
    with pytest.raises(NothingToMap):
        write(tmp_path / "x.tif", [frame(0, 0, 50, tilt=3.0)])
    assert not list(tmp_path.iterdir())


# ---- checkpoints


def gcp_list(header: str, epsg: int, shift: tuple[float, float] = (0.0, 0.0), height: float = 0.0) -> str:
    """Points on the ground as each frame really sees them, their survey shifted by metres."""
    to_crs = Transformer.from_crs(4326, epsg, always_xy=True)
    lines = [header]
    for k, (x, y) in enumerate(((10.0, 5.0), (40.0, 30.0), (70.0, 10.0), (5.0, 35.0))):
        lon, lat, alt = WORLD.to_geodetic(np.array([[x, y, height]]))[0]
        east, north = to_crs.transform(lon, lat)
        for f in FLIGHT:
            u, v = f.posed.pose.pixels(CAMERA, np.array([[x, y, height]]))[0]
            if 0 < u < 399 and 0 < v < 299:
                lines.append(
                    f"{east + shift[0]:.4f} {north + shift[1]:.4f} {alt:.4f} {u:.4f} {v:.4f} {f.name} p{k}"
                )
    return "\n".join([*lines, f"{east} {north} {alt} 5 5 not-in-the-mission.jpg p9", ""])


@pytest.mark.parametrize(
    ("header", "epsg"),
    [
        ("EPSG:32632", 32632),
        ("WGS84 UTM 32N", 32632),
        ("+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", 32632),
        ("EPSG:3035", 3035),
    ],
)
def test_true_poses_have_no_checkpoint_error(header: str, epsg: int) -> None:
    errors = checkpoint_errors(
        parse_gcp_list(gcp_list(header, epsg)), WORLD, {f.name: f.posed for f in FLIGHT}
    )
    assert errors is not None
    assert errors.points == 4
    assert errors.sightings > 12
    assert max(errors.raw_m, errors.spread_m, errors.similarity_m, errors.plane_raw_m) < 2e-3
    assert json.loads(json.dumps(errors.to_json()))["points"] == 4


def test_a_shifted_survey_is_a_bias_and_a_raised_point_is_an_error_of_the_plane() -> None:
    frames = {f.name: f.posed for f in FLIGHT}
    shifted = checkpoint_errors(parse_gcp_list(gcp_list("EPSG:32632", 32632, (3.0, 4.0))), WORLD, frames)
    assert shifted is not None
    assert shifted.raw_m == pytest.approx(5, abs=0.01)
    assert shifted.debiased_m < 0.01
    raised = checkpoint_errors(parse_gcp_list(gcp_list("EPSG:32632", 32632, height=6.0)), WORLD, frames)
    assert raised is not None
    assert raised.raw_m < 2e-3
    assert raised.plane_raw_m > 0.5


def test_frames_on_gnss_alone_do_not_count() -> None:
    gnss = {
        f.name: PosedFrame(
            f.posed.frame_id, CAMERA, Pose(f.posed.pose.world_R_cam, f.posed.pose.center, 0.0, "gnss")
        )
        for f in FLIGHT
    }
    assert checkpoint_errors(parse_gcp_list(gcp_list("EPSG:32632", 32632)), WORLD, gnss) is None


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("", "empty"),
        ("a field near Bonn\n1 2 3 4 5 a.jpg", "CRS"),
        ("WGS84 UTM 99N\n1 2 3 4 5 a.jpg", "CRS"),
        ("EPSG:32632\n# fine\n1 2 3 4 5 a.jpg\n1 2 3 4 a.jpg", "Line 4"),
        ("EPSG:32632\n1 2 nan 4 5 a.jpg", "Line 2"),
    ],
)
def test_a_bad_checkpoint_file_says_where(content: str, word: str) -> None:
    with pytest.raises(BadCheckpoints, match=word):
        parse_gcp_list(content)
