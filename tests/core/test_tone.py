"""Exposing a photo otherwise: undone by the inverse, true to the light, without clipping."""

import numpy as np
import pytest

from core.tone import curves, lit, log_light, relit

LEVELS = np.arange(256, dtype=np.uint8)
WEDGE = np.ascontiguousarray(np.repeat(LEVELS[None, :, None], 3, axis=2))


def test_no_gain_changes_nothing() -> None:
    assert np.array_equal(relit(WEDGE, (1.0, 1.0, 1.0)), WEDGE)


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.3, 2.0])
def test_the_inverse_undoes_it(gain: float) -> None:
    there = lit(LEVELS + 0.5, gain)
    assert lit(there, 1 / gain) == pytest.approx(LEVELS + 0.5, abs=1e-9)
    back = relit(relit(WEDGE, (gain,) * 3), (1 / gain,) * 3)
    assert np.abs(back.astype(int) - WEDGE).max() <= 2


@pytest.mark.parametrize("gain", [0.3, 0.5, 0.8, 1.3, 2.0, 3.0])
def test_nothing_is_clipped_and_no_order_is_turned_round(gain: float) -> None:
    shown = curves((gain, 1.0, 1.0))[0].astype(int)
    assert (np.diff(shown) >= 0).all()
    assert shown[0] <= 1
    assert shown[255] >= 254
    # only what lies within half a level of the ends may end there
    assert (shown[8:248] > 0).all()
    assert (shown[8:248] < 255).all()


def test_the_logarithm_of_the_light_changes_by_the_same_everywhere() -> None:
    colour = np.linspace(1, 255, 50)
    change = log_light(lit(colour, 1.7)) - log_light(colour)
    assert change == pytest.approx(np.log(1.7), abs=1e-9)


def test_dark_ground_follows_the_light_and_white_stays() -> None:
    assert lit(2.0, 1.5) == pytest.approx(3.0, rel=0.01)
    assert lit(255.5, 1.5) == pytest.approx(255.5, abs=0.3)


def test_each_channel_has_its_own_gain_and_a_fourth_is_kept() -> None:
    image = np.full((2, 3, 4), 100, np.uint8)
    shown = relit(image, (0.5, 1.0, 2.0))
    assert [len(np.unique(shown[..., c])) for c in range(4)] == [1, 1, 1, 1]
    assert shown[0, 0, 0] < shown[0, 0, 1] == 100 < shown[0, 0, 2]
    assert shown[0, 0, 3] == 100
    assert (image == 100).all()
