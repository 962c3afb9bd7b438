"""How photos of any size are put together: seams and tones run alike over the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from core.coverage import FUSION, USUAL_SIDE_PX, fusion_of, tiles_under, typical_side
from core.geometry import Camera, Pose, PosedFrame, World

DOWN = np.diag([1.0, -1.0, -1.0])
WORLD, ZOOM = World(50.8, -0.1, 30.0), 20


def photo(side: int, frame_id: str = "f") -> PosedFrame:
    camera = Camera(side, side * 3 // 4, float(side), side / 2, side * 3 / 8)
    return PosedFrame(frame_id, camera, Pose(DOWN, np.array([0.0, 0.0, 60.0]), 0.0))


@pytest.mark.parametrize("side", [1200, 1600, 2000, 2200, 4000])
def test_twice_as_large_photos_get_one_more_band(side: int) -> None:
    assert fusion_of(2 * side, None) == replace(fusion_of(side, None), bands=fusion_of(side, None).bands + 1)


@pytest.mark.parametrize("side", [1600, 2200, 3000, 4000, 6000, 8000])
def test_cells_cover_the_same_share_of_any_photo(side: int) -> None:
    usual = FUSION.cell_px / USUAL_SIDE_PX
    assert 0.7 < fusion_of(side, None).cell_px / side / usual < 1.45


def test_what_counts_is_how_large_photos_are_drawn() -> None:
    assert fusion_of(8000, 1600) == fusion_of(1600, None) == FUSION
    assert fusion_of(1600, 8000) == FUSION  # never larger than they are
    assert fusion_of(4000, 8000) == fusion_of(4000, None) != FUSION
    assert fusion_of(None, None) == fusion_of(None, 4000) == FUSION
    assert fusion_of(640, None) == FUSION


def test_the_typical_photo_does_not_depend_on_their_order() -> None:
    fleet = [photo(side, str(side)) for side in (1600, 4000, 4000, 5472, 800)]
    assert typical_side(fleet) == typical_side(fleet[::-1]) == 4000
    assert typical_side([]) is None


def test_with_more_bands_a_frame_reaches_more_tiles() -> None:
    few, many = (tiles_under(photo(1600), WORLD, ZOOM, replace(FUSION, bands=b)) for b in (4, 6))
    assert few < many
