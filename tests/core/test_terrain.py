"""The made-up ground: the same from everywhere, uneven enough to be matched, smooth in height."""

import cv2
import numpy as np
import pytest

from core.noise import value_noise, value_noise_at
from core.terrain import TILE_PX, Terrain, TerrainParams

GSD_M = 0.12


@pytest.fixture(scope="module")
def picture():
    return Terrain(TerrainParams(seed=3)).raster(-700, -400, 900, 700, GSD_M)


def test_any_window_shows_the_same_ground(picture):
    window = Terrain(TerrainParams(seed=3)).raster(-210, -60, 300, 170, GSD_M)
    assert np.array_equal(window, picture[340:510, 490:790])


def test_tiles_meet_without_a_seam(monkeypatch, picture):
    assert -700 < 0 < 200  # the window crosses the border between tiles
    monkeypatch.setattr("core.terrain.TILE_PX", TILE_PX - 224)
    other = Terrain(TerrainParams(seed=3)).raster(-700, -400, 900, 700, GSD_M)
    assert (np.abs(other.astype(int) - picture).max(-1) > 2).mean() < 1e-4


def test_another_seed_is_another_country(picture):
    other = Terrain(TerrainParams(seed=4)).raster(-700, -400, 900, 700, GSD_M)
    assert np.abs(other.astype(int) - picture).mean() > 10


def test_a_coarser_picture_shows_the_same_things(picture):
    coarse = Terrain(TerrainParams(seed=3)).raster(-350, -200, 450, 350, 2 * GSD_M)
    shrunk = cv2.resize(picture, (450, 350), interpolation=cv2.INTER_AREA)
    gray = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).astype(float).ravel() for p in (coarse, shrunk)]
    assert np.corrcoef(*gray)[0, 1] > 0.9


def test_there_is_enough_to_match(picture):
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    found = cv2.SIFT_create(contrastThreshold=0.02).detect(gray, None)
    cells = {(int(k.pt[0]) // 100, int(k.pt[1]) // 100) for k in found}
    assert len(found) > 1500
    assert len(cells) == 63  # not one hectometre-square without a keypoint


def test_monotony_makes_fields_poorer():
    lively, dull = (
        cv2.SIFT_create().detect(
            cv2.cvtColor(
                Terrain(TerrainParams(3, monotony=m)).raster(-2600, -400, 500, 600, GSD_M),
                cv2.COLOR_RGB2GRAY,
            ),
            None,
        )
        for m in (0.0, 1.0)
    )
    assert len(dull) < 0.6 * len(lively)


@pytest.mark.parametrize("relief_m", [2.0, 30.0])
def test_hills_are_as_high_as_asked_and_smooth(relief_m):
    terrain = Terrain(TerrainParams(seed=1, relief_m=relief_m))
    x, y = np.meshgrid(np.arange(-400.0, 400.0, 5), np.arange(-400.0, 400.0, 5))
    height = terrain.height_m(np.column_stack((x.ravel(), y.ravel()))).reshape(x.shape)
    assert 0.85 * relief_m < np.ptp(height) <= relief_m
    slope = np.hypot(*np.gradient(height, 5.0))
    assert slope.max() < 0.05 * relief_m
    assert Terrain(TerrainParams(1)).height_m(np.zeros((3, 2))).tolist() == [0, 0, 0]


def test_noise_on_a_raster_and_at_points_are_one_field():
    x, y = np.linspace(-20, 33, 40), np.linspace(11, -9, 30)
    raster = value_noise(5, 1.7, x, y)
    points = np.array([[x[i], y[j]] for j in range(30) for i in range(40)])
    assert np.allclose(raster.ravel(), value_noise_at(5, 1.7, points), atol=1e-5)
    assert np.abs(raster).max() <= 1
    assert raster.std() > 0.3
