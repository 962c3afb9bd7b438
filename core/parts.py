"""Parts of photos: a map shows little of each, so that little of each need be kept once it is decoded.

Which part that will be is guessed before anything is drawn. What is drawn does not depend on the guess: who
finds that a part does not hold what it needs asks again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from core.compiled import compiled
from core.geometry import Array, PosedFrame
from core.warp import INSIDE, Int32, Rgb, intrinsics, project, weight_at

POINTS_ALONG = 16
"""The photo is asked at so many places along its longer side who else shows that ground."""
RIVAL = 0.8
"""Seams seldom give a photo ground that it shows less than so well as another one."""
WORTH_CUTTING = 0.8
"""A part of more than this share of a photo is not cut out of it: that would cost more than it saves."""


class Window(NamedTuple):
    """A rectangle of pixels; `right` and `bottom` are the first column and row beyond it."""

    left: int
    top: int
    right: int
    bottom: int

    def joined(self, other: Window) -> Window:
        """The smallest one that holds both."""
        return Window(
            min(self.left, other.left),
            min(self.top, other.top),
            max(self.right, other.right),
            max(self.bottom, other.bottom),
        )


class Share(NamedTuple):
    """A rectangle of a photo at whatever size: shares (0 … 1) of its width and height."""

    left: float
    top: float
    right: float
    bottom: float

    def window(self, width: int, height: int) -> Window:
        """The pixels of a photo of this size that it touches."""
        return Window(
            math.floor(self.left * width),
            math.floor(self.top * height),
            math.ceil(self.right * width),
            math.ceil(self.bottom * height),
        )


WHOLE = Share(0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Part:
    """What is there of a photo of `width` × `height` px: `pixels` (h, w, 3) uint8 from (left, top) on."""

    pixels: Rgb
    left: int
    top: int
    width: int
    height: int

    @classmethod
    def whole(cls, photo: Rgb) -> Part:
        """All of a photo (h, w, 3)."""
        return cls(photo, 0, 0, photo.shape[1], photo.shape[0])

    def holds(self, window: Window) -> bool:
        """Whether these pixels of the photo are there."""
        held = self.window
        inside = held.left <= window.left and held.top <= window.top
        return inside and held.right >= window.right and held.bottom >= window.bottom

    @property
    def window(self) -> Window:
        """The pixels that are there."""
        height, width = self.pixels.shape[:2]
        return Window(self.left, self.top, self.left + width, self.top + height)

    def cut(self, window: Window) -> Part:
        """Only these pixels, which it must hold, in memory of their own; itself when that saves little."""
        width, height = window.right - window.left, window.bottom - window.top
        if width * height > WORTH_CUTTING * self.width * self.height:
            return self
        left, top = window.left - self.left, window.top - self.top
        pixels = self.pixels[top : top + height, left : left + width].copy()
        return Part(pixels, window.left, window.top, self.width, self.height)


WindowOf = Callable[[int, int], Window]
"""What is needed of a photo of that many pixels across and down: its size is known once it is decoded."""


class Photos(Protocol):
    """Where pixels come from; both must return the same pixels whenever they are asked."""

    def photo(self, frame_id: str) -> Rgb:
        """The photo at the mission's resolution, (h, w, 3) uint8 RGB, C-contiguous."""
        ...

    def thumb(self, frame_id: str) -> Rgb:
        """The whole photo at about 128 px, (h, w, 3) uint8 RGB, or (h, w, 4) with its `core.sharpness`."""
        ...


@runtime_checkable
class Parts(Photos, Protocol):
    """Photos of which not all need be kept."""

    def part(self, frame_id: str, window_of: WindowOf) -> Part:
        """Of the same photo a part that holds the window."""
        ...


def part_of(photos: Photos, frame_id: str, window_of: WindowOf) -> Part:
    """A photo, or a part that holds the window where such can be had."""
    if isinstance(photos, Parts):
        return photos.part(frame_id, window_of)
    return Part.whole(photos.photo(frame_id))


def looked_at(places: Int32, width: int, height: int) -> Window:
    """The pixels that a photo is sampled at between these knots (N, 2), x and y in 1/256 px.

    Beyond its edges a photo is continued by its mirror image.
    """
    # Bilinear sampling takes one more pixel, bicubic two; one more is for the rounding.
    low = (places.min(0) >> 8) - 2
    high = (places.max(0) >> 8) + 4
    spans = [_mirrored(int(low[k]), int(high[k]), size) for k, size in enumerate((width, height))]
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def _mirrored(low: int, high: int, size: int) -> tuple[int, int]:
    if low < -size or high > 2 * size:
        return 0, size
    first = min(low, 2 * size - high) if high > size else low
    last = max(high, -low) if low < 0 else high
    return max(first, 0), min(last, size)


def likely(frame: PosedFrame, importance: float, rivals: Sequence[tuple[PosedFrame, float]]) -> Share:
    """The part of a frame that a map will probably show, `WHOLE` when nothing can be said.

    `rivals`: the frames that overlap it; each comes with its importance, as `core.warp.look` has it.
    """
    camera = frame.camera
    step = max(camera.width, camera.height) / POINTS_ALONG
    cols, rows = max(2, round(camera.width / step)), max(2, round(camera.height / step))
    us, vs = np.linspace(0, camera.width - 1, cols + 1), np.linspace(0, camera.height - 1, rows + 1)
    u, v = np.meshgrid(us, vs)
    ground = frame.pose.ground(camera, np.column_stack((u.ravel(), v.ravel())))[:, :2]
    own = _best(ground, [(frame, importance)])
    best = _best(ground, rivals) if rivals else np.zeros(len(ground), np.int64)
    kept = ((own >= INSIDE) & (own >= RIVAL * best)).reshape(u.shape)
    if not kept.any():
        return WHOLE
    spans = []
    for axis, count in ((0, cols), (1, rows)):
        at = np.flatnonzero(kept.any(axis))
        spans.append((max(0.0, (at[0] - 1) / count), min(1.0, (at[-1] + 1) / count)))
    return Share(spans[0][0], spans[1][0], spans[0][1], spans[1][1])


def _best(ground: Array, frames: Sequence[tuple[PosedFrame, float]]) -> NDArray[np.int64]:
    """The largest weight of any of these frames at places (N, 2) of the ground."""
    poses = [frame.pose for frame, _ in frames]
    return _largest(
        np.ascontiguousarray(ground),
        np.array([p.world_R_cam for p in poses], np.float64),
        np.array([p.center for p in poses], np.float64),
        np.array([p.ground_h_m for p in poses], np.float64),
        np.array([intrinsics(frame.camera) for frame, _ in frames]),
        np.array([importance for _, importance in frames], np.float64),
    )


@compiled
def _largest(
    ground: Array, world_R_cam: Array, center: Array, h_m: Array, lens: Array, importance: Array
) -> NDArray[np.int64]:
    out = np.full(len(ground), -1, np.int64)
    for k in range(len(h_m)):
        for i in range(len(ground)):
            u, v, cos_view = project(ground[i, 0], ground[i, 1], h_m[k], world_R_cam[k], center[k], lens[k])
            if cos_view > 0.1:
                w = weight_at(u, v, cos_view, lens[k, 6], lens[k, 7], importance[k], 1.0)
                out[i] = max(out[i], w)
    return out
