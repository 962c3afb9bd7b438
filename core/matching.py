"""Which points of two photos show the same spot on the ground (Zhao 2020, 3.2), verified or not at all.

Mutual nearest descriptors → vote on relative turn, scale and shift → homographies one after the other →
re-matching of what was left, guided by them. A wrong pair bends the whole map, a missed one costs little:
every doubt is a rejection. Everything is a pure function of the two frames' features.
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from core.features import Features
from core.geometry import Camera

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MAGIC = b"OSM1"
_HEAD = struct.Struct("<4s?6iIHHH")


@dataclass(frozen=True, slots=True)
class MatchParams:
    """Distances in pixels of a copy whose long side is `side_px`.

    `ratio`: a best descriptor distance above this share of the second best is ambiguous. `turn_bins`: bins
    of the full circle in the vote. `inlier_px`: a homography's inlier. `foreground_px`: what departs further
    from every homography moves or stands out (Avola 2019, eq. 2) and is dropped. `window_px`: where guided
    re-matching looks. `planes`: homographies at most. `min_inliers`: of the first homography.
    `min_final`: correspondences of an accepted pair. `max_final`: kept at most, spread over the picture.
    """

    side_px: float = 640.0
    ratio: float = 0.92
    turn_bins: int = 36
    inlier_px: float = 2.5
    foreground_px: float = 2.0
    window_px: float = 5.0
    planes: int = 3
    min_voted: int = 10
    min_inliers: int = 12
    min_final: int = 16
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
        low, high, reason = (data[a:b].decode() for a, b in zip(ends[:-1], ends[1:], strict=True))
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
    planes, on_planes = _planes(a.xy[voted[:, 0]], b.xy[voted[:, 1]], params)
    counts = (len(tentative), len(voted), int(on_planes.sum()), int(on_planes.sum()))
    if not planes or on_planes.sum() < params.min_inliers:
        return verdict("too_few_inliers", none, *counts)
    if not _plausible(planes[0]):
        return verdict("implausible_geometry", none, *counts)
    guided = _guided(a, b, similarity, planes, params)
    if len(guided) < params.min_final:
        return verdict("too_few_inliers", none, *counts, len(guided))
    final = guided[_spread(a.xy[guided[:, 0]], params.max_final)]
    return verdict("ok", final, *counts, len(guided), len(final))


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
    back = similarity.argmax(0)
    rows = np.flatnonzero(back[best] == np.arange(len(best)))
    columns = best[rows]
    top = similarity[rows, columns]
    others = similarity[rows]
    others[np.arange(len(rows)), columns] = -1
    # For unit vectors d² = 2 − 2s.
    clear = (1 - top) < ratio**2 * (1 - others.max(1))
    return np.column_stack((rows[clear], columns[clear]))


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


def _planes(p: Floats, q: Floats, params: MatchParams) -> tuple[list[NDArray[Any]], Mask]:
    """Homographies p → q one after the other, each on what the ones before left; and the union of inliers."""
    left = np.ones(len(p), bool)
    planes: list[NDArray[Any]] = []
    for _ in range(params.planes):
        if left.sum() < params.min_inliers:
            break
        h, inliers = cv2.findHomography(
            p[left], q[left], cv2.USAC_MAGSAC, params.inlier_px, maxIters=1000, confidence=0.999
        )
        if h is None or inliers.sum() < params.min_inliers:
            break
        planes.append(h)
        left[np.flatnonzero(left)[inliers.ravel() > 0]] = False
    return planes, ~left


def _plausible(h: NDArray[Any]) -> bool:
    """No mirror image, no zoom beyond three, no horizon within the picture."""
    corners = np.array([[-320, -240, 1], [320, -240, 1], [320, 240, 1], [-320, 240, 1]], float) @ h.T
    if (corners[:, 2] <= 0.3).any() or (corners[:, 2] > 3).any():
        return False
    u, s, vt = np.linalg.svd(h[:2, :2])
    return bool(np.linalg.det(u @ vt) > 0 and 0.33 < s[1] and s[0] < 3 and s[0] < 2 * s[1])


def _apply(h: NDArray[Any], p: Floats) -> Floats:
    q = np.column_stack((p, np.ones(len(p)))) @ h.T
    return np.asarray(q[:, :2] / q[:, 2:], np.float32)


def _guided(
    a: _View, b: _View, similarity: Floats, planes: list[NDArray[Any]], params: MatchParams
) -> NDArray[np.intp]:
    """Matches anew, looking only where a homography says; what departs from it is foreground."""
    found = np.zeros((0, 2), np.intp)
    for h in planes:
        predicted = _apply(h, a.xy)
        lo, hi = b.xy.min(0) - params.window_px, b.xy.max(0) + params.window_px
        rows = np.flatnonzero(((predicted > lo) & (predicted < hi)).all(1))
        rows = rows[~np.isin(rows, found[:, 0])]
        if not len(rows):
            continue
        d2 = ((predicted[rows][:, None] - b.xy[None]) ** 2).sum(2)
        s = np.where(d2 < params.window_px**2, similarity[rows], -1)
        best, back = s.argmax(1), s.argmax(0)
        k = np.arange(len(rows))
        good = (back[best] == k) & (s[k, best] > 0.75) & (d2[k, best] < params.foreground_px**2)
        good &= ~np.isin(best, found[:, 1])
        found = np.concatenate((found, np.column_stack((rows[good], best[good]))))
    return found


def _spread(xy: Floats, count: int) -> NDArray[np.intp]:
    """Indices of at most `count` points, taken in turn from the cells of a grid."""
    if len(xy) <= count:
        return np.arange(len(xy))
    lo, hi = xy.min(0), xy.max(0)
    cell = ((xy - lo) / np.maximum(hi - lo, 1) * 9.999).astype(int) @ (10, 1)
    order = np.argsort(cell, kind="stable")
    starts = np.searchsorted(cell[order], np.arange(100))
    rank = np.empty(len(xy), int)
    rank[order] = np.arange(len(xy)) - starts[cell[order]]
    return np.sort(np.argsort(rank, kind="stable")[:count])
