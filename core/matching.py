"""Which points of two photos show the same spot on the ground (Zhao 2020, 3.2), verified or not at all.

Mutual nearest descriptors → vote on relative turn and scale → fundamental matrix → homographies one after
the other → re-matching of what was left, guided by them. The strongest keypoints are looked at first: where
they agree on the ground, the rest needs to be compared in windows only. A wrong pair bends the whole map, a
missed one costs little: every doubt is a rejection. All is a pure function of the two frames' features.
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass, replace
from functools import lru_cache
from itertools import pairwise
from math import sqrt
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from core.features import Features, rank_in_cell
from core.geometry import Camera
from core.nearest import (
    Doubles,
    Floats,
    Indices,
    Keypoints,
    Limits,
    agreeing,
    around,
    in_common,
    in_windows,
    mutual,
    supporting,
)

Mask = NDArray[np.bool_]

_MAGIC = b"OSM1"
_HEAD = struct.Struct("<4s?6iIHHH")
_NONE = np.zeros((0, 2), np.int64)


@dataclass(frozen=True, slots=True)
class MatchParams:
    """Distances in pixels of a copy whose long side is `side_px`.

    Descriptors: a best distance above `ratio` times the second best is ambiguous; `min_similarity`: cosine
    of a guided match. Vote: `turn_bins` to the full circle, `min_voted` survivors. Geometry: `epipolar_px`
    from the epipolar line; `inlier_px` of a homography; `foreground_px`: what departs further from every
    homography moves or stands out (Avola 2019, eq. 2) and is dropped; `window_px`: where guided re-matching
    looks. At most `planes` homographies; one after the first is ground only if it departs from the first by
    less than `slope_departure_px` and is broader than `slope_breadth_px` (standard deviation).
    First look: at the `strongest` keypoints only, enough if a homography has `certain` inliers; the others'
    matches are then sought within `slope_departure_px` of it, where `local_ratio` says what is ambiguous.
    Acceptance: `min_inliers` of each homography, `min_final` correspondences, and in the common part of the
    pictures `min_vote_share` of the voted matches and `min_keypoint_share` of the keypoints. `max_final`
    correspondences are kept at most, spread over the picture.
    """

    side_px: float = 640.0
    ratio: float = 0.92
    turn_bins: int = 36
    epipolar_px: float = 2.0
    inlier_px: float = 2.5
    foreground_px: float = 2.0
    window_px: float = 5.0
    planes: int = 3
    slope_departure_px: float = 25.0
    slope_breadth_px: float = 30.0
    min_similarity: float = 0.75
    min_voted: int = 10
    min_inliers: int = 10
    min_final: int = 15
    min_vote_share: float = 0.5
    min_keypoint_share: float = 0.05
    max_final: int = 120
    strongest: int = 450
    certain: int = 18
    local_ratio: float = 0.8


@dataclass(frozen=True, slots=True)
class MatchCounts:
    """How many correspondences were left after each stage; 0 for stages not reached."""

    tentative: int = 0
    voted: int = 0
    epipolar: int = 0
    homography: int = 0
    guided: int = 0
    final: int = 0


@dataclass(frozen=True, slots=True)
class PairMatch:
    """The verdict on a pair of frames, low id < high id.

    `uv_low`, `uv_high`: (M, 2) float32 pixels of the ORIGINAL photos that show the same ground; empty unless
    `accepted`. `reason`: "ok", or why not: "too_few_keypoints", "too_few_matches", "no_common_turn",
    "too_few_inliers", "implausible_geometry", "too_ambiguous".
    """

    low: str
    high: str
    accepted: bool
    reason: str
    uv_low: Floats
    uv_high: Floats
    counts: MatchCounts

    def to_bytes(self) -> bytes:
        """All of it, little-endian; the same match gives the same bytes."""
        texts = [t.encode() for t in (self.low, self.high, self.reason)]
        head = _HEAD.pack(
            _MAGIC, self.accepted, *astuple(self.counts), len(self.uv_low), *(len(t) for t in texts)
        )
        uv = np.concatenate((self.uv_low, self.uv_high)).astype("<f4").tobytes()
        return b"".join((head, *texts, uv))

    @classmethod
    def from_bytes(cls, data: bytes) -> PairMatch:
        """The inverse of `to_bytes`. Raises ValueError when the bytes are not a whole match."""
        if len(data) < _HEAD.size or data[:4] != _MAGIC:
            raise ValueError("not a match")
        _, accepted, *numbers = _HEAD.unpack_from(data)
        counts, m, lengths = MatchCounts(*numbers[:6]), numbers[6], numbers[7:]
        if len(data) != _HEAD.size + sum(lengths) + 16 * m:
            raise ValueError("this match is cut off")
        ends = np.cumsum((_HEAD.size, *lengths))
        low, high, reason = (data[a:b].decode() for a, b in pairwise(ends))
        uv = np.frombuffer(data, "<f4", 4 * m, int(ends[-1])).astype(np.float32).reshape(2, m, 2)
        return cls(low, high, accepted, reason, uv[0], uv[1], counts)


@dataclass(frozen=True, slots=True)
class _Look:
    """What looking at two frames came to: `pairs` (M, 2) indices of keypoints, none unless `reason` is ok."""

    reason: str
    counts: MatchCounts
    pairs: Indices


class _View(NamedTuple):
    """One frame ready to be matched; `unit` (K, 128): its descriptors with length 1."""

    points: Keypoints
    unit: Floats

    def strongest(self, count: int) -> _View:
        """The same with only so many keypoints."""
        return _View(Keypoints(*(column[:count] for column in self.points)), self.unit[:count])  # type: ignore[arg-type]


def match_pair(
    low_id: str,
    low: Features,
    high_id: str,
    high: Features,
    low_cam: Camera,
    high_cam: Camera,
    params: MatchParams | None = None,
) -> PairMatch:
    """Matches two frames, low id < high id; cameras only undistort, so rough ones will do. About 2 ms."""
    params = params or MatchParams()
    if min(len(low.keypoints), len(high.keypoints)) < params.min_final:
        look = _Look("too_few_keypoints", MatchCounts(), _NONE)
    else:
        a, b = _view(low, low_cam, params), _view(high, high_cam, params)
        first = _first_look(a, b, params)
        look = first if first is not None and first.reason == "ok" else _whole_look(a, b, params)
    uv = (low.keypoints[look.pairs[:, 0]], high.keypoints[look.pairs[:, 1]])
    return PairMatch(low_id, high_id, look.reason == "ok", look.reason, *uv, look.counts)


def _first_look(a: _View, b: _View, params: MatchParams) -> _Look | None:
    """At the strongest keypoints; None when they do not tell."""
    if max(len(a.unit), len(b.unit)) <= params.strongest:
        return None
    tentative, voted = _voted(a.strongest(params.strongest), b.strongest(params.strongest), params)
    if len(voted) < params.certain:
        return None
    ground, on_ground = _homography(a.points.xy[voted[:, 0]], b.points.xy[voted[:, 1]], params)
    if ground is None or np.count_nonzero(on_ground) < params.certain:
        return None
    i, j = voted[on_ground].T
    turn = float(np.angle(np.exp(1j * (b.points.turn[j] - a.points.turn[i])).sum()))
    matches = around(ground, params.slope_departure_px, params.local_ratio, turn, a.points, b.points)
    return _verdict(a, b, tentative, voted, matches, params)


def _whole_look(a: _View, b: _View, params: MatchParams) -> _Look:
    tentative, voted = _voted(a, b, params)
    if len(tentative) < params.min_voted:
        return _Look("too_few_matches", MatchCounts(len(tentative)), _NONE)
    if len(voted) < params.min_voted:
        return _Look("no_common_turn", MatchCounts(len(tentative), len(voted)), _NONE)
    return _verdict(a, b, tentative, voted, voted, params)


def _voted(a: _View, b: _View, params: MatchParams) -> tuple[Indices, Indices]:
    """Mutual nearest descriptors (P, 2), and those that agree on how the pictures are turned (Q, 2)."""
    tentative = mutual(a.unit @ b.unit.T, params.ratio)
    return tentative, tentative[agreeing(tentative, a.points, b.points, params.turn_bins)]


def _verdict(
    a: _View, b: _View, tentative: Indices, voted: Indices, matches: Indices, params: MatchParams
) -> _Look:
    """What the geometry of some matches (P, 2) says, and how far the `voted` ones (Q, 2) bear it out."""
    p, q = a.points.xy[matches[:, 0]], b.points.xy[matches[:, 1]]
    lines, on_lines = _epipolar(p, q, params)
    planes = _planes(p[on_lines], q[on_lines], params)
    limits = Limits(params.window_px, params.inlier_px, params.epipolar_px, params.min_similarity)
    homographies = np.array(planes).reshape(-1, 3, 3)
    support = supporting(voted, homographies, lines, a.points, b.points, limits)
    counts = MatchCounts(len(tentative), len(voted), *support)
    if not planes:
        return _Look("too_few_inliers", counts, _NONE)
    if not _plausible(planes[0]):
        return _Look("implausible_geometry", counts, _NONE)
    # What departs from every homography by more is foreground and stays out.
    limits = limits._replace(plane=params.foreground_px)
    guided = in_windows(homographies, lines, a.points, b.points, limits)
    counts = replace(counts, guided=len(guided))
    if len(guided) < params.min_final:
        return _Look("too_few_inliers", counts, _NONE)
    if _is_ambiguous(a, b, planes[0], voted, counts, params):
        return _Look("too_ambiguous", counts, _NONE)
    final = guided[_spread(a.points.xy[guided[:, 0]], params.max_final)]
    return _Look("ok", replace(counts, final=len(final)), final)


# A photo is matched with its neighbours one after the other; a view is 0.7 MB.
@lru_cache(maxsize=24)
def _view(features: Features, camera: Camera, params: MatchParams) -> _View:
    scale = params.side_px / max(camera.width, camera.height)
    xy = camera.rays(features.keypoints.astype(np.float64))[:, :2] * (camera.f_px * scale)
    unit = features.descriptors.astype(np.float32)
    length = np.maximum(np.sqrt(np.einsum("ij,ij->i", unit, unit)), np.float32(1e-9))
    unit /= length[:, None]
    points = Keypoints(
        xy=xy.astype(np.float32),
        turn=np.array(features.angle_rad, np.float32),
        size=features.scale_px * np.float32(scale),
        looks=np.array(features.descriptors, np.uint8),
        length=length,
    )
    return _View(points, unit)


def _epipolar(p: Floats, q: Floats, params: MatchParams) -> tuple[Doubles, Mask]:
    """The fundamental matrix (3, 3) of p → q and the matches that it explains.

    Over flat ground it is not unique, but OpenCV's USAC then completes one from the dominant plane
    (DEGENSAC), so that no point of the ground is lost. Zeros when there is none: then every match goes on.
    """
    nothing = np.zeros((3, 3)), np.ones(len(p), bool)
    try:
        f, inliers = cv2.findFundamentalMat(p, q, cv2.USAC_FAST, params.epipolar_px, 0.99, 500)
    except cv2.error:  # its DEGENSAC now and then completes an empty model and trips over it
        return nothing
    if f is None or f.shape != (3, 3) or np.count_nonzero(inliers) < params.min_inliers:
        return nothing
    return np.ascontiguousarray(f, np.float64), inliers.ravel() > 0


def _planes(p: Floats, q: Floats, params: MatchParams) -> list[Doubles]:
    """Homographies p → q one after the other, each on what the ones before left.

    The first is the ground. A later one has to be ground too, on another slope: broad, and not far from where
    the first puts its points. What is small and far off is a roof or a car.
    """
    left = np.ones(len(p), bool)
    planes: list[Doubles] = []
    for _ in range(params.planes):
        if left.sum() < params.min_inliers:
            break
        h, inliers = _homography(p[left], q[left], params)
        if h is None or inliers.sum() < params.min_inliers:
            break
        members = np.flatnonzero(left)[inliers]
        left[members] = False
        if not planes or _is_slope(planes[0], h, p[members], params):
            planes.append(h)
    return planes


def _homography(p: Floats, q: Floats, params: MatchParams) -> tuple[Doubles | None, Mask]:
    """The plane (3, 3) that most of the matches p → q lie on, if any, and which do."""
    h, inliers = cv2.findHomography(p, q, cv2.USAC_MAGSAC, params.inlier_px, maxIters=1000, confidence=0.999)
    if h is None:
        return None, np.zeros(len(p), bool)
    return np.ascontiguousarray(h, np.float64), inliers.ravel() > 0


def _is_slope(ground: Doubles, h: Doubles, p: Floats, params: MatchParams) -> bool:
    """Whether the plane h, seen at p, is broad and near the ground."""
    departure = np.linalg.norm(_apply(h, p) - _apply(ground, p), axis=1)
    narrow = np.sqrt(max(0.0, float(np.linalg.eigvalsh(np.cov(p.T))[0])))
    return bool(np.median(departure) < params.slope_departure_px and narrow > params.slope_breadth_px)


def _plausible(h: Doubles) -> bool:
    """No mirror image, no zoom beyond three, no horizon within the picture."""
    corners = np.array([[-320, -240, 1], [320, -240, 1], [320, 240, 1], [-320, 240, 1]], np.float64) @ h.T
    if (corners[:, 2] <= 0.3).any() or (corners[:, 2] > 3).any():
        return False
    (p, q), (r, t) = h[:2, :2].tolist()
    squares, area = p * p + q * q + r * r + t * t, p * t - q * r
    longest = sqrt((squares + sqrt(max(0.0, squares * squares - 4 * area * area))) / 2)
    return area > 0 and longest < 3 and area > 0.33 * longest and longest * longest < 2 * area


def _apply(h: Doubles, p: Floats) -> Floats:
    q = np.column_stack((p, np.ones(len(p)))).astype(np.float64) @ h.T
    return np.asarray(q[:, :2] / q[:, 2:], np.float32)


def _is_ambiguous(
    a: _View, b: _View, ground: Doubles, voted: Indices, counts: MatchCounts, params: MatchParams
) -> bool:
    """Whether too little of what both frames should see agrees: rows of crops fit a wrong place at times.

    Of the voted matches inside the overlap that `ground` implies, most must lie on it; and of the keypoints
    there a fair share must have found its partner (Brown & Lowe 2007, section 3.2, counted both ways).
    """
    votes, keypoints = in_common(
        ground, np.asarray(np.linalg.inv(ground), np.float64), a.points, b.points, voted
    )
    too_few_voted = counts.homography < params.min_vote_share * votes
    return bool(too_few_voted or counts.guided < params.min_keypoint_share * keypoints)


def _spread(xy: Floats, count: int) -> Indices:
    """Indices of at most `count` points, taken in turn from the cells of a grid."""
    if len(xy) <= count:
        return np.arange(len(xy))
    lo, hi = xy.min(0), xy.max(0)
    cell = ((xy - lo) / np.maximum(hi - lo, 1) * 9.999).astype(int) @ (10, 1)
    return np.sort(np.argsort(rank_in_cell(cell), kind="stable")[:count])
