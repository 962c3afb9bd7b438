"""What is known of the scale: written, read back, and refused where it makes no sense."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.errors import BadScale
from core.scale import KnownScale, Marker, named, parse_marker

PIXELS = st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
LENGTHS = st.floats(1e-3, 9e4)
MARKER = {"photo": "a.jpg", "pixels": [[0, 0], [30, 40]], "length_m": 2.5}


@given(st.text(min_size=1), PIXELS, st.floats(3, 1e4), LENGTHS)
def test_json_and_back_is_the_same(
    photo: str, start: tuple[float, float], px: float, length_m: float
) -> None:
    marker = Marker(photo, start, (start[0] + px, start[1]), length_m)
    for known in (KnownScale(), KnownScale(length_m), KnownScale(None, marker)):
        assert KnownScale.from_json(known.to_json()) == known
    assert marker.ground_px_per_m == pytest.approx(px / length_m, rel=1e-6)


@pytest.mark.parametrize("photo", ["a.jpg", "C:\\card\\a.jpg", "with:colon.jpg", "two words.jpg"])
def test_a_marker_is_written_as_photo_pixels_and_length(photo: str) -> None:
    assert parse_marker(f"{photo}:10,20,40,60.5:2.5") == Marker(photo, (10.0, 20.0), (40.0, 60.5), 2.5)


@pytest.mark.parametrize(
    "text", ["", "a.jpg", "a.jpg:1,2,3:4", "a.jpg:1,2,3,x:4", "a.jpg:1,2,9,9:zero", "a.jpg:1,2,9,9:0"]
)
def test_what_is_no_marker_says_what_one_is(text: str) -> None:
    with pytest.raises(BadScale, match=r"PHOTO:u1,v1,u2,v2:LENGTH_M|above 0"):
        parse_marker(text)


@pytest.mark.parametrize(
    "wrong",
    [
        {"first_height_m": 0},
        {"first_height_m": -3.0},
        {"first_height_m": float("nan")},
        {"first_height_m": 60.0, "marker": MARKER},
        {"marker": MARKER | {"length_m": 0}},
        {"marker": MARKER | {"pixels": [[5, 5], [5, 5]]}},
        {"marker": MARKER | {"pixels": [[5, 5], [float("inf"), 5]]}},
    ],
)
def test_nonsense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(BadScale):
        KnownScale.from_json(wrong)


def test_a_photo_is_named_by_its_name_or_its_only_file_name() -> None:
    names = ["a/1.jpg", "b/1.jpg", "b/2.JPG"]
    assert named("b/1.jpg", names) == "b/1.jpg"
    assert named("card\\2.jpg", names) == "b/2.JPG"
    assert named("1.jpg", names) is None
    assert named("3.jpg", names) is None
