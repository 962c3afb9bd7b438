"""Which points of two photos show the same spot on the ground (Zhao 2020, 3.2), verified or not at all.

Mutual nearest descriptors → vote on relative turn, scale and shift → homographies one after the other →
re-matching of what was left, guided by them. A wrong pair bends the whole map, a missed one costs little:
every doubt is a rejection. Everything is a pure function of the two frames' features.
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.features import Features, rank_in_cell
from core.geometry import Camera

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MAGIC = b"OSM1"
_HEAD = struct.Struct("<4s?6iIHHH")


@dataclass(frozen=True, slots=True)
class MatchParams:
    """Distances in pixels of a copy whose long side is `side_px`.

    Descriptors: a best distance above `ratio` times the second best is ambiguous; `min_similarity`: cosine
    of a guided match. Vote: `turn_bins` to the full circle, `min_voted` survivors. Geometry: `epipolar_px`
    from the epipolar line; `inlier_px` of a homography; `foreground_px`: what departs further from every
    homography moves or stands out (Avola 2019, eq. 2) and is dropped; `window_px`: where guided re-matching
    looks. At most `planes` homographies; one after the first is ground only if it departs from the first by
    less than `slope_departure_px` and is broader than `slope_breadth_px` (standard deviation).
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
class _View:
    """One frame ready to be matched: `xy` (K, 2) undistorted pixels of the copy, centred on the axis."""

    xy: Floats
    turn: Floats
    size: Floats
    descriptors: Floats


def match_pair(
    low_id: str,
    low: Features,
    high_id: str,
    high: Features,
    low_cam: Camera,
    high_cam: Camera,
    params: MatchParams | None = None,
) -> PairMatch:
    """Matches two frames, low id < high id; cameras only undistort, so rough ones will do. About 4 ms."""
    params = params or MatchParams()

    def verdict(reason: str, pairs: NDArray[np.intp], *counts: int) -> PairMatch:
        kept = pairs if reason == "ok" else pairs[:0]
        uv = (low.keypoints[kept[:, 0]], high.keypoints[kept[:, 1]])
        return PairMatch(low_id, high_id, reason == "ok", reason, *uv, MatchCounts(*counts))

    none = np.zeros((0, 2), np.intp)
    if min(len(low.keypoints), len(high.keypoints)) < params.min_final:
        return verdict("too_few_keypoints", none)
    a, b = _view(low, low_cam, params), _view(high, high_cam, params)
    similarity = a.descriptors @ b.descriptors.T
    tentative = _mutual(similarity, params.ratio)
    if len(tentative) < params.min_voted:
        return verdict("too_few_matches", none, len(tentative))
    voted = tentative[_vote(a, b, tentative, params)]
    if len(voted) < params.min_voted:
        return verdict("no_common_turn", none, len(tentative), len(voted))
    lines, on_lines = _epipolar(a.xy[voted[:, 0]], b.xy[voted[:, 1]], params)
    epipolar = voted[on_lines]
    planes, on_planes = _planes(a.xy[epipolar[:, 0]], b.xy[epipolar[:, 1]], params)
    counts = (len(tentative), len(voted), len(epipolar), int(on_planes.sum()))
    if not planes:
        return verdict("too_few_inliers", none, *counts)
    if not _plausible(planes[0]):
        return verdict("implausible_geometry", none, *counts)
    guided = _guided(a, b, similarity, planes, lines, params)
    if len(guided) < params.min_final:
        return verdict("too_few_inliers", none, *counts, len(guided))
    if _is_ambiguous(a, b, planes[0], voted, int(on_planes.sum()), len(guided), params):
        return verdict("too_ambiguous", none, *counts, len(guided))
    final = guided[_spread(a.xy[guided[:, 0]], params.max_final)]
    return verdict("ok", final, *counts, len(guided), len(final))


# A photo is matched with its neighbours one after the other; a view is half a megabyte.
@lru_cache(maxsize=24)
def _view(features: Features, camera: Camera, params: MatchParams) -> _View:
    scale = params.side_px / max(camera.width, camera.height)
    xy = camera.rays(features.keypoints.astype(np.float64))[:, :2] * (camera.f_px * scale)
    descriptors = features.descriptors.astype(np.float32)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    return _View(
        xy.astype(np.float32), features.angle_rad, features.scale_px * np.float32(scale), descriptors
    )


def _mutual(similarity: Floats, ratio: float) -> NDArray[np.intp]:
    """(M, 2) indices of descriptors that are each other's nearest and clearly nearer than the second."""
    best = similarity.argmax(1)
    top = similarity[np.arange(len(best)), best]
    # The maximum of a column is found five times faster than its place, and says as much here.
    rows = np.flatnonzero(top == similarity.max(0)[best])
    others = similarity[rows]
    others[np.arange(len(rows)), best[rows]] = -1
    # For unit vectors d² = 2 − 2s.
    clear = (1 - top[rows]) < ratio**2 * (1 - others.max(1))
    return np.column_stack((rows[clear], best[rows[clear]]))


def _vote(a: _View, b: _View, pairs: NDArray[np.intp], params: MatchParams) -> Mask:
    """Matches of one flight agree on the turn and the zoom between the pictures: those near the peak."""
    i, j = pairs.T
    turn = (b.turn[j] - a.turn[i]) / (2 * np.pi) % 1
    zoom = np.log2(b.size[j] / a.size[i])
    histogram = np.bincount((turn * params.turn_bins).astype(int), minlength=params.turn_bins)
    smooth = histogram + np.roll(histogram, 1) + np.roll(histogram, -1)
    peak = (smooth.argmax() + 0.5) / params.turn_bins
    agree: Mask = np.abs((turn - peak + 0.5) % 1 - 0.5) < 2.0 / params.turn_bins
    if agree.any():
        agree &= np.abs(zoom - np.median(zoom[agree])) < 0.8
    return agree


def _epipolar(p: Floats, q: Floats, params: MatchParams) -> tuple[Floats | None, Mask]:
    """The fundamental matrix (3, 3) of p → q and the matches that it explains.

    Over flat ground it is not unique, but OpenCV's USAC then completes one from the dominant plane
    (DEGENSAC), so that no point of the ground is lost. None when there is none: then every match goes on.
    """
    everything = np.ones(len(p), bool)
    try:
        f, inliers = cv2.findFundamentalMat(p, q, cv2.USAC_FAST, params.epipolar_px, 0.99, 500)
    except cv2.error:  # its DEGENSAC now and then completes an empty model and trips over it
        return None, everything
    if f is None or f.shape != (3, 3) or np.count_nonzero(inliers) < params.min_inliers:
        return None, everything
    return f.astype(np.float32), inliers.ravel() > 0


def _line_distance(f: Floats, p: Floats, q: Floats) -> Floats:
    """How far q (N, 2) lies from the epipolar line of p (N, 2), in pixels."""
    line = np.column_stack((p, np.ones(len(p), np.float32))) @ f.T
    off = line[:, 0] * q[:, 0] + line[:, 1] * q[:, 1] + line[:, 2]
    return np.asarray(np.abs(off) / np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-12), np.float32)


def _planes(p: Floats, q: Floats, params: MatchParams) -> tuple[list[NDArray[Any]], Mask]:
    """Homographies p → q one after the other, each on what the ones before left; and the union of inliers.

    The first is the ground. A later one has to be ground too, on another slope: broad, and not far from where
    the first puts its points. What is small and far off is a roof or a car.
    """
    left = np.ones(len(p), bool)
    planes: list[NDArray[Any]] = []
    on_planes = np.zeros(len(p), bool)
    for _ in range(params.planes):
        if left.sum() < params.min_inliers:
            break
        h, inliers = cv2.findHomography(
            p[left], q[left], cv2.USAC_MAGSAC, params.inlier_px, maxIters=1000, confidence=0.999
        )
        if h is None or inliers.sum() < params.min_inliers:
            break
        members = np.flatnonzero(left)[inliers.ravel() > 0]
        left[members] = False
        if not planes or _is_slope(planes[0], h, p[members], params):
            planes.append(h)
            on_planes[members] = True
    return planes, on_planes


def _is_slope(ground: NDArray[Any], h: NDArray[Any], p: Floats, params: MatchParams) -> bool:
    """Whether the plane h, seen at p, is broad and near the ground."""
    departure = np.linalg.norm(_apply(h, p) - _apply(ground, p), axis=1)
    narrow = np.sqrt(max(0.0, float(np.linalg.eigvalsh(np.cov(p.T))[0])))
    return bool(np.median(departure) < params.slope_departure_px and narrow > params.slope_breadth_px)


def _plausible(h: NDArray[Any]) -> bool:
    """No mirror image, no zoom beyond three, no horizon within the picture."""
    corners = np.array([[-320, -240, 1], [320, -240, 1], [320, 240, 1], [-320, 240, 1]], float) @ h.T
    if (corners[:, 2] <= 0.3).any() or (corners[:, 2] > 3).any():
        return False
    u, s, vt = np.linalg.svd(h[:2, :2])
    return bool(np.linalg.det(u @ vt) > 0 and s[1] > 0.33 and s[0] < 3 and s[0] < 2 * s[1])


def _apply(h: NDArray[Any], p: Floats) -> Floats:
    q = np.column_stack((p, np.ones(len(p)))) @ h.T
    return np.asarray(q[:, :2] / q[:, 2:], np.float32)


def _is_ambiguous(
    a: _View,
    b: _View,
    ground: NDArray[Any],
    voted: NDArray[np.intp],
    on_planes: int,
    guided: int,
    params: MatchParams,
) -> bool:
    """Whether too little of what both frames should see agrees: rows of crops fit a wrong place at times.

    Of the voted matches inside the overlap that `ground` implies, most must lie on it; and of the keypoints
    there a fair share must have found its partner (Brown & Lowe 2007, section 3.2, counted both ways).
    """
    seen_by_b = _inside(_apply(ground, a.xy), b.xy)
    seen_by_a = _inside(_apply(np.linalg.inv(ground), b.xy), a.xy)
    votes = np.count_nonzero(seen_by_b[voted[:, 0]] & seen_by_a[voted[:, 1]])
    keypoints = min(np.count_nonzero(seen_by_b), np.count_nonzero(seen_by_a))
    return bool(on_planes < params.min_vote_share * votes or guided < params.min_keypoint_share * keypoints)


def _inside(p: Floats, frame: Floats) -> Mask:
    """Which of the points p (N, 2) lie in the bounding box of the points of a frame (M, 2)."""
    return np.asarray(((p >= frame.min(0)) & (p <= frame.max(0))).all(1))


def _guided(
    a: _View,
    b: _View,
    similarity: Floats,
    planes: list[NDArray[Any]],
    lines: Floats | None,
    params: MatchParams,
) -> NDArray[np.intp]:
    """Matches anew, (M, 2) indices, looking only where a homography says.

    What departs from every homography by more than `foreground_px` is foreground and stays out.
    """
    tree = cKDTree(b.xy)
    found = np.zeros((0, 2), np.intp)
    for h in planes:
        rows = np.setdiff1d(np.arange(len(a.xy)), found[:, 0], assume_unique=True)
        distance, near = tree.query(_apply(h, a.xy[rows]), k=3, distance_upper_bound=params.window_px)
        seen = np.isfinite(distance[:, 0])
        rows, distance, near = rows[seen], distance[seen], near[seen]
        if not len(rows):
            continue
        alike = similarity[rows[:, None], near.clip(0, len(b.xy) - 1)]
        alike[~np.isfinite(distance) | np.isin(near, found[:, 1])] = -1
        every, pick = np.arange(len(rows)), alike.argmax(1)
        best, top = near[every, pick], alike[every, pick]
        good = (top > params.min_similarity) & (distance[every, pick] < params.foreground_px)
        if lines is not None:
            good &= _line_distance(lines, a.xy[rows], b.xy[best.clip(0, len(b.xy) - 1)]) < params.epipolar_px
        found = np.concatenate((found, _best_of_each(rows[good], best[good], top[good])))
    return found


def _best_of_each(rows: NDArray[np.intp], columns: NDArray[np.intp], score: Floats) -> NDArray[np.intp]:
    """(M, 2): for each column the row with the highest score, in the order of rows."""
    order = np.lexsort((rows, -score, columns))
    _, first = np.unique(columns[order], return_index=True)
    keep = np.sort(order[first])
    return np.column_stack((rows[keep], columns[keep]))


def _spread(xy: Floats, count: int) -> NDArray[np.intp]:
    """Indices of at most `count` points, taken in turn from the cells of a grid."""
    if len(xy) <= count:
        return np.arange(len(xy))
    lo, hi = xy.min(0), xy.max(0)
    cell = ((xy - lo) / np.maximum(hi - lo, 1) * 9.999).astype(int) @ (10, 1)
    return np.sort(np.argsort(rank_in_cell(cell), kind="stable")[:count])
