"""Where pixels lie on the ground."""

import subprocess
import sys

import mercantile
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from core.geometry import World
from core.grid import (
    MercatorGrid,
    TileKey,
    UtmGrid,
    ancestors,
    children,
    native_zoom,
    parent,
    tile_bounds_lonlat,
    tile_grid,
    tiles_of,
    utm_epsg,
    zoom_resolution_m,
)

SOUTH = World(-33.9, 151.2, 40.0)
NORTH = World(50.8, -0.1, 30.0)
PLACES = st.builds(World, st.floats(-75, 75), st.floats(-179, 179), st.floats(-100, 4000))
OFFSETS = st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000))


def utm(world: World) -> UtmGrid:
    from pyproj import Transformer

    epsg = utm_epsg(world.lat_deg, world.lon_deg)
    east, north = Transformer.from_crs(4326, epsg, always_xy=True).transform(world.lon_deg, world.lat_deg)
    return UtmGrid(epsg, round(east) - 500.0, round(north) + 500.0, 0.05, 100, 100)


@given(PLACES, OFFSETS, st.floats(-200, 200), st.integers(14, 23))
@settings(deadline=None)
def test_ground_to_pixel_and_back(world: World, xy: tuple[float, float], h_m: float, z: int) -> None:
    for grid in (MercatorGrid(z, 0, 0, 1, 1), utm(world)):
        cols, rows = grid.from_world(world, [xy], h_m)
        np.testing.assert_allclose(grid.to_world(world, cols, rows, h_m), [xy], atol=2e-5)


@given(PLACES, st.integers(14, 23), st.integers(1, 70), st.integers(1, 70), st.integers(1, 64))
@settings(deadline=None, max_examples=50)
def test_a_lattice_has_the_plumb_lines_of_its_points(
    world: World, z: int, width: int, height: int, step: int
) -> None:
    cols, rows = 16.5 + step * np.arange(width), 7.5 + step * np.arange(height)
    for grid in (MercatorGrid(z, 0, 0, 1, 1), utm(world)):
        left, top = (np.floor(v[0]) for v in grid.from_world(world, [[0.0, 0.0]], 0.0))
        x, y = (v.ravel() for v in np.meshgrid(left + cols, top + rows))
        lattice, points = grid.crossings(world, left + cols, top + rows), grid.columns(world, x, y)
        assert np.array_equal(lattice.foot, points.foot)
        assert np.array_equal(lattice.slope, points.slope)


@pytest.mark.parametrize("world", [NORTH, SOUTH])
def test_pixels_lie_where_the_geodesy_says(world: World) -> None:
    grid = utm(world)
    cols, rows = np.array([0.0, 12000.0]), np.array([3000.0, 17000.0])
    lon, lat = grid.lon_lat(cols, rows)
    xy = grid.to_world(world, cols, rows, 25.0)
    # The point of the same longitude and latitude whose world z is 25 m, found by moving along the normal.
    alt = np.full(2, world.alt_m + 25.0)
    for _ in range(5):
        xyz = world.from_geodetic(np.column_stack((lon, lat, alt)))
        alt = alt + 25.0 - xyz[:, 2]
    np.testing.assert_allclose(xy, xyz[:, :2], atol=1e-6)


def test_tiles_are_those_of_every_web_map() -> None:
    lon, lat = 151.2, -33.9
    tile = mercantile.tile(lon, lat, 18)
    grid = tile_grid(TileKey(18, tile.x, tile.y))
    cols, rows = grid.from_world(SOUTH, [[0.0, 0.0]], 0.0)
    assert 0 <= cols[0] - grid.col0 < 512
    assert 0 <= rows[0] - grid.row0 < 512
    west, south, east, north = tile_bounds_lonlat(TileKey(18, tile.x, tile.y))
    assert west < lon < east
    assert south < lat < north
    edge_lon, edge_lat = grid.lon_lat([grid.col0 - 0.5], [grid.row0 - 0.5])
    np.testing.assert_allclose([edge_lon[0], edge_lat[0]], [west, north], atol=1e-9)


def test_a_pixel_does_not_depend_on_its_window() -> None:
    for grid in (MercatorGrid(20, 268286400, 180000000, 1, 1), utm(NORTH)):
        cols = grid.col0 + np.arange(1000.0)
        rows = grid.row0 + np.arange(1000.0) * 3
        whole = grid.to_world(NORTH, cols, rows, 12.5)
        for part in (slice(0, 1), slice(7, 8), slice(3, 50), slice(501, 1000)):
            assert np.array_equal(grid.to_world(NORTH, cols[part], rows[part], 12.5), whole[part])


def test_resolution_is_metres_on_the_ground() -> None:
    for world in (NORTH, SOUTH):
        grid = MercatorGrid(20, 0, 0, 1, 1)
        cols, rows = grid.from_world(world, [[0.0, 0.0]], 0.0)
        step = grid.to_world(world, [cols[0], cols[0] + 100], [rows[0], rows[0]], 0.0)
        assert np.hypot(*(step[1] - step[0])) / 100 == pytest.approx(grid.resolution_m(world), rel=5e-3)


@given(st.floats(0.004, 2.0), st.floats(-70, 70))
def test_native_zoom_keeps_the_detail_of_the_photos(gsd_m: float, lat_deg: float) -> None:
    ratio = zoom_resolution_m(native_zoom(gsd_m, lat_deg), lat_deg) / gsd_m
    assert ratio <= 1.3 * (1 + 1e-6)
    assert ratio > 0.64


def test_family_of_tiles() -> None:
    tile = TileKey(12, 2045, 1361)
    assert all(parent(child) == tile for child in children(tile))
    north_west, north_east, south_west, _ = children(tile)
    assert north_east == (13, north_west.x + 1, north_west.y)
    assert south_west == (13, north_west.x, north_west.y + 1)
    with pytest.raises(ValueError, match="no parent"):
        parent(TileKey(0, 0, 0))


def test_ancestors_come_once_and_children_first() -> None:
    above = ancestors([TileKey(5, 9, 9), TileKey(5, 8, 9), TileKey(5, 30, 2)], min_z=2)
    assert len(set(above)) == len(above)
    assert [t.z for t in above] == sorted((t.z for t in above), reverse=True)
    assert min(t.z for t in above) == 2
    assert {TileKey(4, 4, 4), TileKey(4, 15, 1)} <= set(above)
    assert ancestors([], 0) == []


@given(st.lists(OFFSETS, min_size=1, max_size=1), st.floats(0, 6.2), st.floats(20, 400), st.floats(20, 400))
@settings(deadline=None, max_examples=40)
def test_tiles_of_holds_just_the_tiles_that_the_outline_touches(
    middle: list[tuple[float, float]], turn: float, width: float, height: float
) -> None:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (width / 2, height / 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    outline = corners @ rotation.T + middle[0]
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60)))
    inside = outline[0] + np.outer(u, outline[1] - outline[0]) + np.outer(v, outline[3] - outline[0])
    cols, rows = MercatorGrid(19, 0, 0, 0, 0).from_world(NORTH, inside, 5.0)
    touched = {TileKey(19, int(c // 512), int(r // 512)) for c, r in zip(cols + 0.5, rows + 0.5, strict=True)}
    tiles = tiles_of(NORTH, outline, 5.0, 19)
    assert touched <= tiles
    # What sampling missed can only be slivers at the outline's rim.
    wider = MercatorGrid(19, 0, 0, 0, 0).from_world(NORTH, outline, 5.0)
    for tile in tiles - touched:
        assert tile in tiles_of(NORTH, outline, 5.0, 19, margin_px=1)
        assert abs(tile.x * 512 + 256 - np.mean(wider[0])) < 256 + np.ptp(wider[0])
    assert tiles <= tiles_of(NORTH, outline, 5.0, 19, margin_px=64)


def test_margin_reaches_the_next_tile() -> None:
    grid = MercatorGrid(19, 0, 0, 0, 0)
    cols, rows = grid.from_world(NORTH, [[0.0, 0.0]], 0.0)
    tile = TileKey(19, int(cols[0] // 512), int(rows[0] // 512))
    place = tile_grid(tile)
    corner = grid.to_world(
        NORTH,
        place.col0 + np.array([20, 60, 60, 20.0]),
        place.row0 + np.array([200, 200, 260, 260.0]),
        0.0,
    )
    assert tiles_of(NORTH, corner, 0.0, 19) == {tile}
    assert tiles_of(NORTH, corner, 0.0, 19, margin_px=30) == {tile, TileKey(19, tile.x - 1, tile.y)}


def test_utm_zones() -> None:
    assert utm_epsg(51.5, -0.1) == 32630
    assert utm_epsg(-33.9, 151.2) == 32756
    assert utm_epsg(10.0, 180.0) == 32601
    assert utm_epsg(0.0, 179.9) == 32660


def test_norway_and_svalbard_have_the_zones_that_their_surveyors_use() -> None:
    bergen, stavanger, oslo, shetland = (60.39, 5.32), (58.97, 5.73), (59.91, 10.75), (60.15, -1.15)
    assert [utm_epsg(*place) for place in (bergen, stavanger, oslo, shetland)] == [32632, 32632, 32632, 32630]
    assert [
        utm_epsg(78.2, lon) for lon in (-0.1, 0.0, 8.9, 9.0, 15.6, 20.9, 21.0, 32.9, 33.0, 41.9, 42.0)
    ] == [32600 + zone for zone in (30, 31, 31, 33, 33, 33, 35, 35, 37, 37, 38)]
    assert utm_epsg(64.0, 5.0) == utm_epsg(55.9, 5.0) == 32631
    assert utm_epsg(-60.39, 5.32) == 32731


def test_grid_stays_small() -> None:
    code = "import sys, core.grid; print(sorted({'cv2', 'gtsam', 'numba', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
