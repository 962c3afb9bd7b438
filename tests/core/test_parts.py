"""What is kept of a photo never changes what is drawn, and is little where many photos show one place."""

from __future__ import annotations

import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.decode import decode_to_draw
from core.fusion import FrameIndex, FusionParams, Territory, render
from core.geometry import Camera, Pose, PosedFrame, World
from core.grid import MercatorGrid
from core.parts import WHOLE, Part, WindowOf, looked_at

WORLD = World(47.0, 8.0, 400.0)
CAMERA = Camera(360, 270, 300.0, 181.0, 133.0, -0.06, 0.02)
DOWN = np.diag([1.0, -1.0, -1.0])
STEP_M, HEIGHT_M = 12.0, 40.0


class Album:
    """Photos of noise, whole."""

    def photo(self, frame_id: str) -> NDArray[np.uint8]:
        rng = np.random.default_rng(int(frame_id))
        return rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3)).astype(np.uint8)

    def thumb(self, frame_id: str) -> NDArray[np.uint8]:
        return np.ascontiguousarray(self.photo(frame_id)[::4, ::4])


class Cuttings(Album):
    """Of the same photos no more than what is asked for; the rest of each is lost."""

    def __init__(self) -> None:
        self.kept_px: list[int] = []

    def part(self, frame_id: str, window_of: WindowOf) -> Part:
        part = Part.whole(self.photo(frame_id)).cut(window_of(CAMERA.width, CAMERA.height))
        self.kept_px.append(part.pixels.shape[0] * part.pixels.shape[1])
        return part


def flight() -> list[PosedFrame]:
    """Five by five photos that overlap by two thirds, tilted a little."""
    rng = np.random.default_rng(3)
    frames = []
    for k in range(25):
        roll = rng.normal(0, 0.05)
        turn = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
        center = np.array([STEP_M * (k % 5 - 2), STEP_M * (k // 5 - 2), HEIGHT_M])
        frames.append(PosedFrame(f"{k:02d}", CAMERA, Pose(turn @ DOWN, center, 0.0), (1.0, 1.1, 0.9)))
    return frames


def grid(zoom: int) -> MercatorGrid:
    cols, rows = MercatorGrid(zoom, 0, 0, 1, 1).from_world(WORLD, np.zeros((1, 2)), 0.0)
    return MercatorGrid(zoom, int(cols[0]) - 300, int(rows[0]) - 300, 600, 600)


@pytest.mark.parametrize("sampling", ["linear", "cubic"])
@pytest.mark.parametrize("zoom", [19, 17])  # as fine as the photos, and coarser than half of that
def test_a_part_is_as_good_as_the_whole(sampling: str, zoom: int) -> None:
    params = FusionParams(sampling="cubic" if sampling == "cubic" else "linear")
    frames, cuttings = flight(), Cuttings()
    whole = render(grid(zoom), WORLD, frames, Album(), params)
    assert whole[..., 3].any()
    assert np.array_equal(render(grid(zoom), WORLD, frames, cuttings, params), whole)
    if zoom == 19:
        assert np.mean(cuttings.kept_px) < 0.7 * CAMERA.width * CAMERA.height


@given(st.integers(-40, 60), st.integers(0, 30), st.integers(3, 30))
def test_beyond_its_edges_a_photo_is_its_mirror_image(first: int, length: int, size: int) -> None:
    places = np.array([[first, 0], [first + length, 0]], np.int32) * 256
    window = looked_at(places, size, 10)
    assert 0 <= window.left < window.right <= size
    for x in range(first, first + length + 2):
        inside = x % (2 * size)
        assert window.left <= min(inside, 2 * size - 1 - inside) < window.right or abs(x) > 2 * size


def test_what_a_photo_will_show_is_guessed_from_who_else_is_there() -> None:
    frames = flight()
    alone = Territory(FrameIndex([frames[12]]), 0.1)
    assert alone.share("12") == WHOLE
    among = Territory(FrameIndex(frames), 0.1)
    middle = among.share("12")
    assert (middle.right - middle.left) * (middle.bottom - middle.top) < 0.6
    assert middle.left < 0.5 < middle.right
    assert middle.top < 0.5 < middle.bottom
    corner = among.share("20")  # the north-western one: nobody else shows what lies north and west of it
    assert corner.left == corner.top == 0.0
    assert corner.right < 1.0


@pytest.mark.parametrize("sampling", ["444", "422", "420", "440", "Gray"])
@pytest.mark.parametrize(("size", "max_side"), [((320, 480), None), ((397, 531), 500), ((640, 960), 400)])
def test_the_top_of_a_photo_is_decoded_alone(
    sampling: str, size: tuple[int, int], max_side: int | None
) -> None:
    grey = np.random.default_rng(1).integers(0, 256, (size[0] // 4 + 1, size[1] // 4 + 1, 3)).astype(np.uint8)
    picture = np.ascontiguousarray(grey.repeat(4, 0).repeat(4, 1)[: size[0], : size[1]])
    if sampling == "Gray":
        data = simplejpeg.encode_jpeg(picture[..., :1].copy(), 90, "GRAY", "Gray")
    else:
        data = simplejpeg.encode_jpeg(picture, 90, "RGB", sampling)
    whole, height = decode_to_draw(data, max_side)
    assert len(whole) == height
    shorter = 0
    for share in (0.1, 0.5, 0.8, 1.0):
        top, told = decode_to_draw(data, max_side, lambda _, rows, share=share: int(share * rows))
        assert told == height
        rows = int(share * height)
        assert np.array_equal(top[:rows], whole[:rows])
        shorter += len(top) < height
    assert shorter or sampling == "Gray"
