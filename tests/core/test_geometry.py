"""Laws of cameras, poses and frames of reference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from core.geometry import Array, Camera, Pose, World

cameras = st.builds(
    lambda w, h, f, dx, dy, k1, k2: Camera(
        48 * w, 12 * h * w, f * 48 * w, 24 * w + dx, 6 * h * w + dy, k1, k2
    ),
    st.integers(8, 125),
    st.integers(2, 4),
    st.floats(0.6, 2.0),
    st.floats(-40, 40),
    st.floats(-40, 40),
    st.floats(-0.05, 0.05),
    st.floats(-0.01, 0.01),
)
worlds = st.builds(World, st.floats(-84, 84), st.floats(-180, 180), st.floats(-100, 4000))


def spots(camera: Camera, seed: int, n: int = 20) -> Array:
    return np.random.default_rng(seed).uniform(0, 1, (n, 2)) * (camera.width - 1, camera.height - 1)


def looking_down(yaw: float, tilt: float, height: float, ground: float = 0.0) -> Pose:
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    rotation = Rotation.from_euler("zx", [yaw, tilt]).as_matrix() @ down
    return Pose(rotation, np.array([3.0, -7.0, ground + height]), ground)


poses = st.builds(
    looking_down, st.floats(-4, 4), st.floats(-0.3, 0.3), st.floats(20, 500), st.floats(-300, 3000)
)
seeds = st.integers(0, 2**32 - 1)


@settings(deadline=None)
@given(cameras, seeds)
def test_projecting_a_pixels_ray_gives_the_pixel(camera: Camera, seed: int) -> None:
    uv = spots(camera, seed)
    depth = np.random.default_rng(seed).uniform(0.5, 900, (len(uv), 1))
    np.testing.assert_allclose(camera.project(camera.rays(uv) * depth), uv, atol=2e-3)


@settings(deadline=None)
@given(cameras)
def test_the_principal_ray_is_the_axis(camera: Camera) -> None:
    np.testing.assert_allclose(camera.rays(np.array([[camera.cx, camera.cy]])), [[0, 0, 1]], atol=1e-12)


@settings(deadline=None)
@given(cameras, st.sampled_from([0.5, 0.25, 2.0, 1 / 3]), seeds)
def test_a_resized_photo_sees_along_the_same_rays(camera: Camera, scale: float, seed: int) -> None:
    width, height = round(camera.width * scale), round(camera.height * scale)
    small = camera.scaled(width, height)
    uv = spots(camera, seed)
    # Areas are kept: pixel centres at integers make the corner of the picture (−0.5, −0.5) at every size.
    moved = (uv + 0.5) * (width / camera.width, height / camera.height) - 0.5
    np.testing.assert_allclose(small.rays(moved), camera.rays(uv), atol=1e-9)
    back = small.scaled(camera.width, camera.height)
    assert (back.f_px, back.cx, back.cy) == pytest.approx((camera.f_px, camera.cx, camera.cy))


@settings(deadline=None)
@given(cameras, poses, seeds)
def test_ground_points_lie_on_the_plane_and_project_back(camera: Camera, pose: Pose, seed: int) -> None:
    uv = spots(camera, seed)
    ground = pose.ground(camera, uv)
    np.testing.assert_allclose(ground[:, 2], pose.ground_h_m, atol=1e-6)
    np.testing.assert_allclose(pose.pixels(camera, ground), uv, atol=2e-3)


def test_the_top_of_a_nadir_photo_points_where_it_heads() -> None:
    camera, pose = Camera(400, 300, 300.0, 199.5, 149.5), looking_down(0.0, 0.0, 100.0)
    top_left, top_right, bottom_right, _ = pose.footprint(camera)
    assert top_left[1] > bottom_right[1]  # north
    assert top_right[0] > top_left[0]  # east
    assert pose.gsd_m(camera) == pytest.approx(1 / 3)
    assert np.hypot(*(top_right - top_left)) == pytest.approx(399 / 3)


@given(worlds, seeds)
@settings(deadline=None)
def test_the_world_agrees_with_proj(world: World, seed: int) -> None:
    xyz = np.random.default_rng(seed).uniform((-2000, -2000, -500), (2000, 2000, 500), (20, 3))
    lon_lat_alt = world.to_geodetic(xyz)
    origin = f"+lat_0={world.lat_deg!r} +lon_0={world.lon_deg!r} +h_0={world.alt_m!r}"
    pipeline = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 {origin}"
    )
    theirs = np.column_stack(pipeline.transform(*lon_lat_alt.T))
    np.testing.assert_allclose(theirs, xyz, atol=1e-5)


@settings(deadline=None)
@given(worlds, seeds)
def test_to_geodetic_and_back(world: World, seed: int) -> None:
    xyz = np.random.default_rng(seed).uniform((-20_000, -20_000, -900), (20_000, 20_000, 9000), (20, 3))
    np.testing.assert_allclose(world.from_geodetic(world.to_geodetic(xyz)), xyz, atol=1e-6)


@settings(deadline=None)
@given(worlds)
def test_the_origin_is_the_origin(world: World) -> None:
    lon, lat, alt = world.to_geodetic(np.zeros((1, 3)))[0]
    assert lat == pytest.approx(world.lat_deg, abs=1e-11)
    assert np.cos(np.radians(lon - world.lon_deg)) == pytest.approx(1)
    assert alt == pytest.approx(world.alt_m, abs=1e-7)


@settings(deadline=None)
@given(worlds, st.floats(-1, 1), st.floats(-1, 1))
def test_axes_are_east_north_up(world: World, x: float, y: float) -> None:
    here, there = world.to_geodetic(np.array([[0.0, 0.0, 0.0], [x, y, 2.0]]))
    degree_m = 111_320.0
    assert (there[1] - here[1]) * degree_m == pytest.approx(y, abs=0.02)
    turn = (there[0] - here[0] + 180) % 360 - 180
    assert turn * degree_m * np.cos(np.radians(here[1])) == pytest.approx(x, abs=0.02)
    assert there[2] - here[2] == pytest.approx(2, abs=1e-3)
