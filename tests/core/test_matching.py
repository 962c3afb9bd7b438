"""Matching against pictures whose true correspondence is known because we warped them ourselves."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest

from core.features import Features, extract
from core.geometry import Camera
from core.matching import MatchCounts, MatchParams, PairMatch, match_pair

LOW, HIGH = "0" * 32, "f" * 32
SIZE = (640, 480)
Picture = np.ndarray
Homography = np.ndarray


@cache
def ground(seed: int = 1, height: int = 1400, width: int = 1400) -> Picture:
    """Feature-rich procedural ground, uint8 (height, width, 3): noise of many sizes."""
    rng = np.random.default_rng(seed)
    gray = np.zeros((height, width), np.float32)
    for sigma in (1.2, 2.5, 5, 11, 23):
        layer = cv2.GaussianBlur(rng.normal(size=gray.shape).astype(np.float32), (0, 0), sigma)
        gray += layer / layer.std()
    return np.repeat((128 + 28 * gray).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


def camera(size: tuple[int, int] = SIZE) -> Camera:
    width, height = size
    return Camera(width, height, 0.7 * width, (width - 1) / 2, (height - 1) / 2)


def view(
    east: float, north: float, turn_deg: float = 0, zoom: float = 1, tilt: tuple[float, float] = (0, 0)
) -> Homography:
    """Ground pixels → picture pixels: a camera over (east, north), turned, zoomed, tilted."""
    c, s = zoom * np.cos(np.radians(turn_deg)), zoom * np.sin(np.radians(turn_deg))
    to_centre = np.array([[1, 0, -east], [0, 1, -north], [0, 0, 1]], float)
    similarity = np.array([[c, -s, 0], [s, c, 0], [tilt[0], tilt[1], 1]])
    to_corner = np.array([[1, 0, (SIZE[0] - 1) / 2], [0, 1, (SIZE[1] - 1) / 2], [0, 0, 1]])
    return np.asarray(to_corner @ similarity @ to_centre)


def picture(h: Homography, of: Picture | None = None, noise: float = 2.0) -> Picture:
    drawn = cv2.warpPerspective(ground() if of is None else of, h, SIZE, flags=cv2.INTER_LINEAR)
    grain = np.random.default_rng(7).normal(scale=noise, size=drawn.shape)
    return np.asarray((drawn + grain).clip(0, 255).astype(np.uint8))


def features(rgb: Picture, original: tuple[int, int] = SIZE) -> Features:
    return extract(rgb, original)


def apply(h: Homography, uv: np.ndarray) -> np.ndarray:
    q = np.column_stack((uv, np.ones(len(uv)))) @ h.T
    return np.asarray(q[:, :2] / q[:, 2:])


def match(a: Features, b: Features, params: MatchParams | None = None) -> PairMatch:
    return match_pair(LOW, a, HIGH, b, camera(), camera(), params)


def errors(m: PairMatch, low_h_high: Homography) -> np.ndarray:
    """How far each match lies from where it must be, pixels of the second picture."""
    return np.asarray(np.linalg.norm(apply(low_h_high, m.uv_low.astype(float)) - m.uv_high, axis=1))


BASE = view(650, 650)
SECOND = {
    "half the overlap": view(970, 660),
    "side step": view(640, 890, turn_deg=4),
    "turned by 90": view(740, 700, turn_deg=90),
    "turned by 180": view(750, 600, turn_deg=180),
    "higher": view(700, 690, turn_deg=33, zoom=0.7),
    "lower": view(660, 640, turn_deg=-70, zoom=1.5),
    "tilted": view(720, 600, turn_deg=160, tilt=(3e-4, -2e-4)),
}


@pytest.mark.parametrize("name", SECOND)
def test_recovers_a_known_homography(name: str) -> None:
    m = match(features(picture(BASE)), features(picture(SECOND[name])))
    e = errors(m, SECOND[name] @ np.linalg.inv(BASE))
    assert (m.accepted, m.reason) == (True, "ok")
    assert len(m.uv_low) >= 60
    assert np.median(e) < 0.5
    assert (e < 2.5).all()


def test_same_answer_with_roles_swapped() -> None:
    a, b = features(picture(BASE)), features(picture(SECOND["higher"]))
    everything = MatchParams(max_final=10_000)
    there, back = match(a, b, everything), match(b, a, everything)
    pairs = {(*map(float, p), *map(float, q)) for p, q in zip(there.uv_low, there.uv_high, strict=True)}
    swapped = {(*map(float, q), *map(float, p)) for p, q in zip(back.uv_low, back.uv_high, strict=True)}
    assert len(pairs & swapped) > 0.9 * max(len(pairs), len(swapped))


def test_same_input_same_bytes() -> None:
    a, b = features(picture(BASE)), features(picture(SECOND["tilted"]))
    assert match(a, b).to_bytes() == match(a, b).to_bytes()


def test_exposure_and_contrast_may_change() -> None:
    darker = (picture(SECOND["half the overlap"]) * 0.45 + 10).astype(np.uint8)
    m = match(features(picture(BASE)), features(darker))
    assert m.accepted
    assert np.median(errors(m, SECOND["half the overlap"] @ np.linalg.inv(BASE))) < 0.5


def test_frames_of_different_size_are_matched_in_their_own_pixels() -> None:
    low, high = features(picture(BASE), (1920, 1440)), features(picture(SECOND["side step"]), SIZE)
    m = match_pair(LOW, low, HIGH, high, camera((1920, 1440)), camera())
    assert m.accepted
    copy = (m.uv_low.astype(float) + 0.5) / 3 - 0.5
    e = np.linalg.norm(apply(SECOND["side step"] @ np.linalg.inv(BASE), copy) - m.uv_high, axis=1)
    assert np.median(e) < 0.5
    assert m.uv_low.max() > 700


def test_lens_distortion_known_to_the_camera_is_no_obstacle() -> None:
    lens = Camera(640, 480, 448.0, 319.5, 239.5, k1=-0.25)
    y, x = np.mgrid[0:480, 0:640].astype(np.float32)
    flat = lens.rays(np.column_stack((x.ravel(), y.ravel())))[:, :2] * 448 + (319.5, 239.5)
    to_flat = flat.astype(np.float32).reshape(480, 640, 2)

    def bent(h: Homography) -> Picture:
        where = apply(np.linalg.inv(h), to_flat.reshape(-1, 2)).astype(np.float32).reshape(480, 640, 2)
        return np.asarray(cv2.remap(ground(), where[..., 0], where[..., 1], cv2.INTER_LINEAR))

    a, b = features(bent(BASE)), features(bent(SECOND["side step"]))
    known = match_pair(LOW, a, HIGH, b, lens, lens)
    unknown = match(a, b)
    assert known.accepted
    assert known.counts.guided > 1.1 * unknown.counts.guided
    flat_low, flat_high = (
        lens.rays(uv.astype(float))[:, :2] * 448 + 319.5 for uv in (known.uv_low, known.uv_high)
    )
    flat_low[:, 1], flat_high[:, 1] = flat_low[:, 1] - 80, flat_high[:, 1] - 80
    e = np.linalg.norm(apply(SECOND["side step"] @ np.linalg.inv(BASE), flat_low) - flat_high, axis=1)
    assert np.median(e) < 0.6


@pytest.mark.parametrize("seed", range(2, 8))
def test_unrelated_pictures_do_not_match(seed: int) -> None:
    m = match(features(picture(BASE)), features(picture(BASE, of=ground(seed, 900, 1000))))
    assert not m.accepted
    assert m.reason != "ok"
    assert len(m.uv_low) == len(m.uv_high) == m.counts.final == 0


def test_places_of_one_ground_that_do_not_overlap_do_not_match() -> None:
    assert not match(features(picture(view(340, 300))), features(picture(view(1000, 1100)))).accepted


def test_a_pattern_that_repeats_is_not_trusted() -> None:
    tile = ground(3, 60, 60)
    orchard = np.tile(tile, (24, 24, 1))
    a = features(picture(view(400, 400), of=orchard))
    b = features(picture(view(900, 850), of=orchard, noise=4))
    assert not match(a, b).accepted


def test_a_moving_patch_is_left_out_and_the_ground_kept() -> None:
    low, high = picture(BASE, noise=0), picture(SECOND["half the overlap"], noise=0)
    truth = SECOND["half the overlap"] @ np.linalg.inv(BASE)
    lorry = ground(9, 70, 110)
    low[200:270, 400:510] = lorry
    column, row = apply(truth, np.array([[400.0 + 14, 200.0 - 11]]))[0].round().astype(int)
    high[row : row + 70, column : column + 110] = lorry
    m = match(features(low), features(high))
    assert m.accepted
    u, v = m.uv_low.T
    on_lorry = (u > 406) & (u < 504) & (v > 206) & (v < 264)  # its edge is half ground
    assert (errors(m, truth) < 2.5).all()
    assert not on_lorry.any()


def test_ground_of_two_slopes_is_matched_on_both() -> None:
    flat = SECOND["side step"] @ np.linalg.inv(BASE)
    # Right of the middle the ground rises: seen from the second place it is displaced up to 16 pixels more.
    y, x = np.mgrid[0:480, 0:640].astype(np.float64)
    low = picture(BASE, noise=0)
    rise = np.column_stack((np.zeros(640 * 480), 0.05 * np.maximum(0, x.ravel() - 320)))
    seen = np.column_stack((x.ravel(), y.ravel()))
    source = apply(np.linalg.inv(flat), seen - rise).astype(np.float32).reshape(480, 640, 2)
    ground_of_low = apply(np.linalg.inv(BASE), source.reshape(-1, 2)).astype(np.float32).reshape(480, 640, 2)
    high = cv2.remap(ground(), ground_of_low[..., 0], ground_of_low[..., 1], cv2.INTER_LINEAR)
    m = match(features(low), features(high), MatchParams(max_final=10_000))
    p = apply(flat, m.uv_low.astype(float))
    e = np.linalg.norm(
        p + np.column_stack((0 * p[:, 0], 0.05 * np.maximum(0, p[:, 0] - 320))) - m.uv_high, axis=1
    )
    assert m.accepted
    assert np.median(e) < 0.6
    assert min((p[:, 0] < 300).sum(), (p[:, 0] > 360).sum()) > 50


def test_matches_are_spread_when_they_are_capped() -> None:
    a, b = features(picture(BASE)), features(picture(view(700, 670)))
    few = match(a, b, MatchParams(max_final=60))
    assert len(few.uv_low) == few.counts.final == 60
    cells = {(int(u // 107), int(v // 107)) for u, v in few.uv_low}
    assert len(cells) >= 22


def test_counts_fall_and_are_given_for_each_stage() -> None:
    c = match(features(picture(BASE)), features(picture(SECOND["half the overlap"]))).counts
    assert c.tentative >= c.voted >= c.epipolar >= c.homography > 0
    assert c.guided >= c.homography * 0.9
    assert c.final == min(c.guided, MatchParams().max_final)


def test_a_blank_photo_is_rejected_with_a_reason() -> None:
    blank = features(np.full((480, 640, 3), 128, np.uint8))
    m = match(blank, features(picture(BASE)))
    assert (m.accepted, m.reason, m.counts) == (False, "too_few_keypoints", MatchCounts())


def test_a_photo_matches_itself_exactly() -> None:
    a = features(picture(BASE))
    m = match(a, a)
    assert m.accepted
    assert np.array_equal(m.uv_low, m.uv_high)


def test_from_bytes_undoes_to_bytes() -> None:
    a = features(picture(BASE))
    for m in (match(a, features(picture(SECOND["lower"]))), match(a, features(picture(BASE, of=ground(2))))):
        again = PairMatch.from_bytes(m.to_bytes())
        assert again.to_bytes() == m.to_bytes()
        assert (again.low, again.high, again.accepted, again.reason, again.counts) == (
            m.low, m.high, m.accepted, m.reason, m.counts,
        )  # fmt: skip
        assert np.array_equal(again.uv_low, m.uv_low)
        assert np.array_equal(again.uv_high, m.uv_high)
        assert again.uv_low.dtype == np.float32


def test_from_bytes_refuses_what_is_not_whole() -> None:
    a = features(picture(BASE))
    data = match(a, a).to_bytes()
    for spoilt in (b"", data[:-1], data[:8], data + b"x", b"PNG." + data[4:]):
        with pytest.raises(ValueError, match="match"):
            PairMatch.from_bytes(spoilt)
