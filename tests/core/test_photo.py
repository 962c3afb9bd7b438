"""Headers are read without decoding, and every bad file is refused with its own reason."""

from __future__ import annotations

import io
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from core.errors import (
    EmptyFile,
    FileTooLarge,
    NotAnImage,
    RejectedFrame,
    TooFewPixels,
    TooManyPixels,
    TruncatedImage,
)
from core.photo import PhotoHeader, PhotoLimits, probe

MODES = {"L": (80, 70), "RGB": (70, 80, 3), "CMYK": (90, 64, 4)}


def encoded(kind: str, width: int = 96, height: int = 72, mode: str = "RGB", **options: object) -> bytes:
    noise = np.random.default_rng(width * height).integers(0, 255, (height, width, 3), np.uint8)
    out = io.BytesIO()
    Image.fromarray(noise).convert(mode).save(out, kind, **options)
    return out.getvalue()


def declaring(width: int, height: int) -> bytes:
    """A JPEG whose header claims a size that its data do not hold."""
    data = bytearray(encoded("JPEG"))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return bytes(data)


@settings(deadline=None)
@given(
    st.sampled_from(["JPEG", "TIFF"]),
    st.sampled_from(sorted(MODES)),
    st.integers(64, 300),
    st.integers(64, 300),
)
def test_the_header_says_what_was_written(kind: str, mode: str, width: int, height: int) -> None:
    header = probe(encoded(kind, width, height, mode))
    assert header == PhotoHeader(kind, width, height, f"image/{kind.lower()}")


def test_a_drones_mpo_is_a_jpeg_of_its_first_picture() -> None:
    second = Image.new("RGB", (64, 64))
    header = probe(encoded("MPO", 200, 100, save_all=True, append_images=[second]))
    assert header == PhotoHeader("JPEG", 200, 100, "image/jpeg")


def test_orientation_does_not_turn_the_size() -> None:
    exif = Image.Exif()
    exif[274] = 6
    for kind in ("JPEG", "TIFF"):
        header = probe(encoded(kind, 200, 100, exif=exif))
        assert (header.width, header.height) == (200, 100)


def test_each_bad_file_has_its_own_reason() -> None:
    good = encoded("JPEG")
    cases = {
        b"": EmptyFile,
        b"%PDF-1.7 not a photo": NotAnImage,
        encoded("PNG"): NotAnImage,
        b"\xff": TruncatedImage,
        good[:40]: TruncatedImage,
        encoded("TIFF", compression="tiff_lzw")[:200]: TruncatedImage,
        encoded("JPEG", 63, 500): TooFewPixels,
        declaring(60_000, 5_000): TooManyPixels,
    }
    for data, reason in cases.items():
        with pytest.raises(reason):
            probe(data)
    with pytest.raises(FileTooLarge, match="limit"):
        probe(good, PhotoLimits(max_bytes=len(good) - 1))


def test_pillows_own_pixel_limit_neither_warns_nor_refuses() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        header = probe(declaring(60_000, 60_000), PhotoLimits(max_pixels=4_000_000_000))
    assert (header.width, header.height) == (60_000, 60_000)


@settings(deadline=None)
@given(st.one_of(st.binary(max_size=400), st.binary(max_size=200).map(lambda b: b"\xff\xd8\xff" + b),
                 st.binary(max_size=200).map(lambda b: b"II*\x00" + b)))  # fmt: skip
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_garbage_is_refused_and_nothing_else_is_raised(data: bytes) -> None:
    try:
        header = probe(data)
    except RejectedFrame:
        return
    assert min(header.width, header.height) >= PhotoLimits().min_side_px


@settings(deadline=None)
@given(st.data())
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_torn_photo_is_never_called_a_foreign_file(data: st.DataObject) -> None:
    whole = encoded(data.draw(st.sampled_from(["JPEG", "TIFF"])))
    torn = whole[: data.draw(st.integers(1, len(whole) - 1))]
    try:
        header = probe(torn)
    except TruncatedImage:
        return
    assert (header.width, header.height) == (96, 72)
