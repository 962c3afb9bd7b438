"""Features: where keypoints lie, how they are spread, that bytes bring them back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from core.features import FeatureParams, Features, extract
from core.neighbours import peculiar
from core.vocabulary import LOOKS, looks

Rgb = np.ndarray


def ground(height: int = 480, width: int = 640, seed: int = 1) -> Rgb:
    """Feature-rich procedural ground, uint8 (height, width, 3): noise of many sizes."""
    rng = np.random.default_rng(seed)
    picture = np.zeros((height, width, 3), np.float32)
    for sigma in (1.2, 2.5, 5, 11, 23):
        layer = cv2.GaussianBlur(rng.normal(size=picture.shape).astype(np.float32), (0, 0), sigma)
        picture += layer / layer.std()
    return (128 + 28 * picture).clip(0, 255).astype(np.uint8)


def same(a: Features, b: Features) -> bool:
    fields = ("keypoints", "angle_rad", "scale_px", "descriptors", "words", "thumb")
    return all(np.array_equal(getattr(a, f), getattr(b, f)) for f in fields)


def blobs(width: int, height: int, centres: np.ndarray, sigma: float) -> Rgb:
    """Dark discs with soft edges on grey, at exact sub-pixel centres; (height, width, 3) uint8."""
    y, x = np.mgrid[0:height, 0:width]
    picture = np.full((height, width), 200.0)
    for u, v in centres:
        picture -= 150 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * sigma**2))
    return np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize("shrink", [1, 2, 4])
def test_keypoints_are_in_pixels_of_the_original_with_integers_at_pixel_centres(shrink: int) -> None:
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(6)), -1).reshape(-1, 2)
    centres = grid * 130 + 110 + rng.uniform(-20, 20, (48, 2))
    photo = blobs(1152, 864, centres, sigma=14)
    copy = cv2.resize(photo, (1152 // shrink, 864 // shrink), interpolation=cv2.INTER_AREA)
    found = extract(copy, (1152, 864)).keypoints
    nearest = found[np.linalg.norm(found[:, None] - centres[None], axis=2).argmin(0)] - centres
    hit = np.linalg.norm(nearest, axis=1) < 2
    assert hit.mean() > 0.8
    assert np.linalg.norm(nearest[hit], axis=1).max() < 0.5
    assert np.abs(nearest[hit].mean(0)).max() < 0.05  # without precise upscaling: a quarter pixel of the copy


def test_scale_is_in_pixels_of_the_original() -> None:
    centre = np.array([[576.0, 432.0]])
    at = [
        extract(cv2.resize(blobs(1152, 864, centre, 14), size, interpolation=cv2.INTER_AREA), (1152, 864))
        for size in ((1152, 864), (576, 432), (288, 216))
    ]
    scales = [f.scale_px[np.linalg.norm(f.keypoints - centre, axis=1).argmin()] for f in at]
    # SIFT answers to a Gaussian blob at its own sigma and states the diameter.
    assert np.allclose(scales, 2 * 14, rtol=0.12)


def test_keypoints_are_spread_over_the_picture() -> None:
    photo = ground()
    photo[:, 320:] = (photo[:, 320:].astype(float) * 0.15 + 100).astype(np.uint8)  # a dull half
    found = extract(photo, (640, 480)).keypoints
    assert 900 <= len(found) <= 1000
    assert 0.4 < (found[:, 0] > 320).mean() < 0.6


def test_at_most_so_many_keypoints_and_all_inside() -> None:
    features = extract(ground(), (1280, 960), FeatureParams(keypoints=300))
    assert len(features.keypoints) == 300
    assert (features.keypoints > -0.5).all()
    assert (features.keypoints < (1279.5, 959.5)).all()


def test_the_same_picture_gives_the_same_bytes() -> None:
    photo = ground()
    assert extract(photo, (640, 480)).to_bytes() == extract(photo.copy(), (640, 480)).to_bytes()


def test_brightness_and_contrast_do_not_change_the_descriptors_much() -> None:
    photo = ground()
    a = extract(photo, (640, 480))
    b = extract((photo * 0.6 + 20).astype(np.uint8), (640, 480))
    distance = np.linalg.norm(a.keypoints[:, None] - b.keypoints[None], axis=2)
    i = np.flatnonzero(distance.min(1) < 0.3)
    j = distance.argmin(1)[i]
    turned = np.abs((a.angle_rad[i] - b.angle_rad[j] + np.pi) % (2 * np.pi) - np.pi)
    i, j = i[turned < 0.1], j[turned < 0.1]
    assert len(i) > 400
    x, y = a.descriptors[i].astype(float), b.descriptors[j].astype(float)
    cosine = (x * y).sum(1) / np.linalg.norm(x, axis=1) / np.linalg.norm(y, axis=1)
    assert np.median(cosine) > 0.97
    assert a.words @ b.words > 0.8


def test_descriptors_are_root_sift() -> None:
    descriptors = extract(ground(), (640, 480)).descriptors.astype(float) / 512
    assert np.abs(np.linalg.norm(descriptors, axis=1) - 1).max() < 0.03


def test_appearance_is_a_unit_vector_and_tells_places_apart() -> None:
    photo, other = ground(seed=1), ground(seed=2)
    half = np.roll(photo, 160, axis=1)
    a, b, c = (extract(p, (640, 480)).words for p in (photo, half, other))
    assert abs(np.linalg.norm(a) - 1) < 1e-5
    assert a @ b > a @ c + 0.1


def test_looks_tell_as_much_as_all_words_in_a_quarter_of_the_bytes() -> None:
    photo = ground(seed=1)
    places = [photo, *(np.roll(photo, k, axis=1) for k in (40, 80, 160)), ground(seed=2), ground(seed=3)]
    words = np.stack([extract(p, (640, 480)).words for p in places])
    short = np.stack([looks(w) for w in words])
    assert short.shape == (6, LOOKS)
    assert 4 * short.nbytes == words.nbytes
    whole, part = (peculiar(np.float32(w)) for w in (words, short))
    assert np.abs(whole @ whole.T - part @ part.T).max() < 0.2
    assert (part[0] @ part[1:4].T).min() > (part[0] @ part[4:].T).max() + 0.2


def test_a_picture_without_anything_has_no_features_but_a_thumbnail() -> None:
    features = extract(np.full((300, 400, 3), 90, np.uint8), (4000, 3000))
    assert len(features.keypoints) == len(features.descriptors) == 0
    assert not features.words.any()
    assert features.thumb.shape == (96, 128, 4)
    assert (features.thumb[..., :3] == 90).all()
    assert not features.thumb[..., 3].any()  # nor can it be said to be sharp
    assert same(Features.from_bytes(features.to_bytes()), features)


def test_thumbnail_averages_areas() -> None:
    photo = ground(960, 1280)
    thumb = extract(photo, (1280, 960)).thumb[..., :3]
    assert thumb.shape == (96, 128, 3)
    means = photo.reshape(96, 10, 128, 10, 3).mean((1, 3))
    assert np.abs(thumb - means).mean() < 1.5  # averaged twice, so that a few pixels differ by more


def test_from_bytes_undoes_to_bytes() -> None:
    features = extract(ground(), (2000, 1500))
    again = Features.from_bytes(features.to_bytes())
    assert same(again, features)
    assert again.keypoints.dtype == again.words.dtype == np.float32
    assert again.descriptors.dtype == again.thumb.dtype == np.uint8


def test_from_bytes_refuses_what_is_not_whole() -> None:
    data = extract(ground(120, 160), (160, 120)).to_bytes()
    for spoilt in (b"", data[:-1], data[:10], data + b"x", b"JPEG" + data[4:]):
        with pytest.raises(ValueError, match="photo"):
            Features.from_bytes(spoilt)
