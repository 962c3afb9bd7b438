"""Pixels come out as the sensor wrote them, at exactly the asked size, or not at all."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from core.decode import decode_gray, decode_rgb, scaled_size
from core.errors import NotAnImage, RejectedFrame, TruncatedImage

Pixels = NDArray[np.uint8]


def scene(width: int, height: int) -> Pixels:
    """Smooth colours with a bright blob: survives JPEG, and every shift shows."""
    y, x = np.mgrid[:height, :width]
    red = 90 + 60 * np.sin(x / 23) * np.cos(y / 31)
    green = 60 + 120 * np.exp(-((x - 0.7 * width) ** 2 + (y - 0.3 * height) ** 2) / (0.003 * width**2))
    blue = 80 + 70 * x / width
    return np.stack((red, green, blue), axis=-1).astype(np.uint8)


def encoded(
    picture: NDArray[np.generic], kind: str = "JPEG", mode: str | None = None, **options: object
) -> bytes:
    image = Image.fromarray(picture)
    out = io.BytesIO()
    if kind == "JPEG":
        options = {"quality": 95, **options}
    (image.convert(mode) if mode else image).save(out, kind, **options)
    return out.getvalue()


def centroid(channel: NDArray[np.generic]) -> tuple[float, float]:
    weight = np.clip(channel.astype(float) - 100, 0, None)
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum())


@settings(deadline=None)
@given(st.integers(1, 20_000), st.integers(1, 20_000), st.one_of(st.none(), st.integers(16, 8_000)))
def test_scaled_size_keeps_the_shape_and_never_enlarges(
    width: int, height: int, max_side: int | None
) -> None:
    w, h = scaled_size(width, height, max_side)
    assert 1 <= w <= width
    assert 1 <= h <= height
    if max_side is None or max(width, height) <= max_side:
        assert (w, h) == (width, height)
    else:
        assert max(w, h) == max_side
        assert abs(w / width - h / height) <= 1 / min(width, height)


def test_a_jpeg_decodes_to_what_every_other_reader_sees() -> None:
    data = encoded(scene(320, 240))
    np.testing.assert_array_equal(decode_rgb(data), np.asarray(Image.open(io.BytesIO(data))))


@settings(max_examples=40, deadline=None)
@given(st.integers(200, 900), st.integers(150, 700), st.integers(64, 500), st.sampled_from(["JPEG", "TIFF"]))
def test_a_smaller_picture_has_the_exact_size_and_stays_in_place(
    width: int, height: int, max_side: int, kind: str
) -> None:
    picture = scene(width, height)
    small = decode_rgb(encoded(picture, kind), max_side)
    w, h = scaled_size(width, height, max_side)
    assert small.shape == (h, w, 3)
    assert small.flags.c_contiguous
    x, y = centroid(picture[..., 1])
    sx, sy = centroid(small[..., 1])
    assert sx == pytest.approx((x + 0.5) * w / width - 0.5, abs=0.1)
    assert sy == pytest.approx((y + 0.5) * h / height - 0.5, abs=0.1)


def test_scaling_in_the_dct_looks_like_averaging_areas() -> None:
    picture = scene(1600, 1200)
    for side in (800, 400, 200, 500):
        small = decode_rgb(encoded(picture), side).astype(float)
        fair = np.asarray(Image.fromarray(picture).resize(small.shape[1::-1], Image.Resampling.BOX), float)
        assert np.abs(small - fair).mean() < 1.5


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("kind", ["JPEG", "TIFF"])
def test_exif_orientation_is_ignored(kind: str, orientation: int) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    picture = scene(200, 120)
    turned, plain = encoded(picture, kind, exif=exif), encoded(picture, kind)
    np.testing.assert_array_equal(decode_rgb(turned), decode_rgb(plain))


def test_gray_is_the_luma_of_the_colours() -> None:
    picture = scene(400, 300)
    for kind in ("JPEG", "TIFF"):
        data = encoded(picture, kind)
        luma = decode_rgb(data).astype(float) @ (0.299, 0.587, 0.114)
        assert np.abs(decode_gray(data) - luma).max() < 2.5


def test_grey_and_cmyk_photos_become_rgb() -> None:
    picture = scene(400, 300)
    grey = decode_rgb(encoded(picture[..., 1]))
    assert (np.ptp(grey, axis=2) == 0).all()
    assert np.abs(grey[..., 0].astype(float) - picture[..., 1]).mean() < 2
    assert np.abs(decode_rgb(encoded(picture, mode="CMYK")).astype(float) - picture).mean() < 4


def test_mpo_shows_its_first_picture() -> None:
    picture = scene(400, 300)
    second = Image.new("RGB", (400, 300), (255, 0, 0))
    data = encoded(picture, "MPO", save_all=True, append_images=[second], quality=95)
    assert np.abs(decode_rgb(data).astype(float) - picture).mean() < 3


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_deflate", "packbits"])
def test_tiffs_are_lossless_and_lose_their_alpha(compression: str | None) -> None:
    picture = scene(200, 150)
    alpha = np.full((150, 200, 1), 40, np.uint8)
    for with_alpha in (picture, np.concatenate((picture, alpha), axis=2)):
        np.testing.assert_array_equal(
            decode_rgb(encoded(with_alpha, "TIFF", compression=compression)), picture
        )


def test_deep_grey_is_stretched_so_that_something_can_be_seen() -> None:
    kelvin = (29_000 + scene(200, 150)[..., 1].astype(np.uint16)).astype(np.uint16)
    for thermal in (kelvin, kelvin.astype(np.float32) / 100):
        grey = decode_gray(encoded(thermal, "TIFF"))
        assert grey.dtype == np.uint8
        assert (grey.min(), grey.max()) == (0, 255)
        assert (np.diff(grey.ravel()[np.argsort(kelvin.ravel(), kind="stable")].astype(int)) >= 0).all()
        assert len(np.unique(grey)) > 50


@given(st.data())
@settings(deadline=None)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_torn_photo_is_never_shown_half(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(["JPEG", "TIFF"]))
    whole = encoded(scene(160, 120), kind)
    torn = whole[: data.draw(st.integers(4, len(whole) - 2))]
    for decode in (decode_rgb, decode_gray):
        for side in (None, 40):
            with pytest.raises(TruncatedImage):
                decode(torn, side)


def test_stray_bytes_of_a_careless_camera_do_no_harm_but_a_missing_half_does() -> None:
    whole = encoded(scene(640, 480))
    np.testing.assert_array_equal(decode_rgb(whole[:-2] + b"\x00" * 12 + b"\xff\xd9"), decode_rgb(whole))
    np.testing.assert_array_equal(decode_rgb(whole + b"trailer" * 99), decode_rgb(whole))
    half = len(whole) // 2
    with pytest.raises(TruncatedImage):
        decode_rgb(whole[:half] + bytes(half - 2) + b"\xff\xd9")


@settings(deadline=None)
@given(st.binary(max_size=300), st.sampled_from([b"", b"\xff\xd8\xff", b"II*\x00", b"MM\x00*"]))
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_garbage_is_rejected_and_nothing_else_is_raised(tail: bytes, magic: bytes) -> None:
    with pytest.raises(RejectedFrame):
        decode_rgb(magic + tail)


def test_another_format_is_not_an_image_of_ours() -> None:
    with pytest.raises(NotAnImage):
        decode_gray(encoded(scene(100, 100), "PNG"))
