"""What the bench calls a step: known ones are told to a tenth of a grey level, things and slopes are none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.bench.seams import SAME_GROUND, Piece, line_of, piece_of, pieces

Picture = NDArray[np.float32]
HEIGHT, WIDTH, SEAM = 64, 100, 47


def ground(seed: int) -> Picture:
    """Things, and a ground that gets brighter to the right by half a grey level a pixel; opaque."""
    rng = np.random.default_rng(seed)
    rgb = 90 + rng.normal(0, 15, (HEIGHT, WIDTH, 3)) + 0.5 * np.arange(WIDTH)[:, None]
    return np.concatenate((rgb, np.full((HEIGHT, WIDTH, 1), 255)), axis=2).astype(np.float32)


def measured(left: Picture, right: Picture, drawn: Picture) -> Piece:
    """The one piece between two photos, the left one shown up to the seam."""
    whose = np.where(np.arange(WIDTH) < SEAM, 0, 1)[None].repeat(HEIGHT, 0).astype(np.int16)
    ((low, high, at),) = pieces(whose)
    found = piece_of(low, high, at, whose, drawn, [left, right])
    assert found is not None
    return found


@pytest.mark.parametrize("step", [-7.0, 0.0, 3.0])
def test_a_step_of_tone_is_told(step: float) -> None:
    one, other = ground(1), ground(1)
    other[..., :3] += step
    drawn = np.where((np.arange(WIDTH) < SEAM)[:, None], one, other)
    found = measured(one, other, drawn)
    assert found.step == pytest.approx(step, abs=0.1)
    assert found.floor == pytest.approx(0, abs=0.1)
    assert found.alike > SAME_GROUND


def test_a_slope_of_the_ground_is_no_step() -> None:
    one = ground(2)
    found = measured(one, one, one)
    assert (found.step, found.floor) == pytest.approx((0, 0), abs=1e-4)


def test_other_things_are_told_apart_from_tone() -> None:
    """Photos of different things: what the measure sees is what it sees where there is no seam at all."""
    found = []
    for seed in range(40):
        one, other = ground(10 + seed), ground(100 + seed)
        drawn = np.where((np.arange(WIDTH) < SEAM)[:, None], one, other)
        found.append(measured(one, other, drawn))
    line = line_of(found)
    assert line["floor"] > 0.1
    assert line["step"] < 4 * line["floor"]
    assert (line["pieces_same_ground"], line["step_same_ground"]) == (0, None)
    # with their signs, things cancel out along a seam
    assert line["step_whole_seams"] < line["step"]


def test_too_little_on_one_side_is_no_piece() -> None:
    one, hidden = ground(3), ground(3)
    hidden[:, SEAM:, 3] = 0
    whose = np.where(np.arange(WIDTH) < SEAM, 0, 1)[None].repeat(HEIGHT, 0).astype(np.int16)
    ((low, high, at),) = pieces(whose)
    assert piece_of(low, high, at, whose, one, [one, hidden]) is None
