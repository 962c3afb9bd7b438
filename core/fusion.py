"""Drawing the mosaic: the pixels of a raster as a pure function of frames, poses and photos (Zhao 2020, 3.4).

Which photo shows which ground is decided on a coarse lattice, so that only photos that win somewhere are read
and warped, and only where they win. Everything is anchored to the raster's absolute pixels: tiles rendered
apart are equal, to the last bit, to the same tiles cut from one large block.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from core.blend import (
    NOBODY,
    Labels,
    Layer,
    Tones,
    blend_finest,
    blend_level,
    label_level,
    retone,
)
from core.geometry import Array, PosedFrame, World
from core.grid import Grid
from core.layers import Canvas
from core.parts import Photos as Photos
from core.parts import Share, likely
from core.seams import REACH_CELLS, heaviest, settle
from core.sharpness import give_way
from core.tone import Gain, relit
from core.warp import Int32, Lattice, Rgb, Views, look

PAD_CELLS = 2
"""The pyramid looks this many cells beyond a pixel, however many bands there are."""
SKIRT_CELLS = 2
"""So far beyond a photo's edge its colour still counts a little, lest tone jump at the mosaic's border."""


@dataclass(frozen=True, slots=True)
class FusionParams:
    """What the look of the mosaic depends on.

    `bands`: Laplacian bands above the lowest; cells are 2^bands pixels. `tone_side_px`: photos are shrunk to
    this before their tones are averaged; photos whose detail differs by more than `tone_tolerance` grey
    levels are left out, lest they leave ghosts. `max_view_deg`: rays flatter than this from the vertical are
    not drawn. `gnss_importance`: weight of frames without a visual pose; `loose_px`: sigma of a
    position, in the photo's pixels, that halves its weight. `seams`: whether they are led around
    what photos disagree about; where not, the heaviest photo wins.
    """

    bands: int = 4
    tone_side_px: int = 64
    tone_tolerance: float = 12.0
    max_view_deg: float = 75.0
    gnss_importance: float = 0.25
    loose_px: float = 200.0
    sampling: Literal["linear", "cubic"] = "linear"
    seams: bool = True

    @property
    def cell_px(self) -> int:
        """The side of a lattice cell."""
        return 1 << self.bands

    @property
    def min_cos_view(self) -> float:
        """The cosine of the angle between a ray that is just drawn and the vertical."""
        return math.cos(math.radians(self.max_view_deg))

    @property
    def rim_cells(self) -> int:
        """So many cells more are looked at, to know where seams run."""
        return REACH_CELLS + 2 if self.seams else 0

    @property
    def touch_px(self) -> int:
        """No frame is mixed into pixels farther than this outside of its footprint."""
        return (PAD_CELLS + SKIRT_CELLS + 1) * self.cell_px

    @property
    def rim_px(self) -> int:
        """By moving others' seams a frame may change pixels so much farther outside of it."""
        return self.rim_cells * self.cell_px

    @property
    def reach_px(self) -> int:
        """No frame changes a pixel, not even by moving others' seams, farther than this outside of it."""
        return self.touch_px + self.rim_px


DEFAULT = FusionParams()


class FrameIndex:
    """Posed frames with the boxes of their footprints, to find quickly those that a raster needs."""

    def __init__(self, frames: Iterable[PosedFrame], params: FusionParams = DEFAULT) -> None:
        self.frames: tuple[PosedFrame, ...] = tuple(sorted(frames, key=lambda f: f.frame_id))
        boxes = [_box(frame, params.max_view_deg) for frame in self.frames]
        self._boxes = np.array(boxes, float).reshape(-1, 5)
        self._reach_px = params.reach_px

    def __getitem__(self, frame_id: str) -> PosedFrame:
        return self.frames[self._place(frame_id)]

    def _place(self, frame_id: str) -> int:
        return bisect_left(self.frames, frame_id, key=lambda f: f.frame_id)

    def rivals(self, frame: PosedFrame) -> list[PosedFrame]:
        """The other frames that may show some of the ground that this one shows."""
        k = self._place(frame.frame_id)
        west, south, east, north = self._boxes[k, :4]
        hit = (self._boxes[:, :2] <= (east, north)).all(1) & (self._boxes[:, 2:4] >= (west, south)).all(1)
        return [self.frames[n] for n in np.flatnonzero(hit) if n != k]

    def overlapping(self, grid: Grid, world: World) -> list[PosedFrame]:
        """The frames that may change a pixel of the grid, by ascending id."""
        if not self.frames:
            return []
        cols = np.array([0, grid.width, grid.width, 0]) + grid.col0 - 0.5
        rows = np.array([0, 0, grid.height, grid.height]) + grid.row0 - 0.5
        lines = grid.columns(world, cols, rows)
        heights = self._boxes[:, 4]
        ends = np.array([lines.at(h) for h in (heights.min(), heights.max())]).reshape(-1, 2)
        margin = 1.1 * self._reach_px * grid.resolution_m(world)
        low, high = ends.min(0) - margin, ends.max(0) + margin
        hit = (self._boxes[:, :2] <= high).all(1) & (self._boxes[:, 2:4] >= low).all(1)
        return [self.frames[k] for k in np.flatnonzero(hit)]


class Territory:
    """Which part of each frame of an index a map of this resolution will probably show."""

    def __init__(self, frames: FrameIndex, resolution_m: float, params: FusionParams = DEFAULT) -> None:
        self._frames, self._resolution_m, self._params = frames, resolution_m, params
        self._found: dict[str, Share] = {}

    def share(self, frame_id: str) -> Share:
        """Of a frame, worked out when it is first asked for."""
        if frame_id not in self._found:
            frame = self._frames[frame_id]
            rivals = [(f, self._importance(f)) for f in self._frames.rivals(frame)]
            self._found[frame_id] = likely(frame, self._importance(frame), rivals)
        return self._found[frame_id]

    def _importance(self, frame: PosedFrame) -> float:
        return _importance(frame, self._resolution_m, self._params)


def overlapping(
    grid: Grid, world: World, frames: Iterable[PosedFrame], params: FusionParams = DEFAULT
) -> list[PosedFrame]:
    """The frames that may change a pixel of the grid, by ascending id; for many grids keep a `FrameIndex`."""
    return FrameIndex(frames, params).overlapping(grid, world)


def render(
    grid: Grid,
    world: World,
    frames: Sequence[PosedFrame],
    photos: Photos,
    params: FusionParams = DEFAULT,
    only: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """The mosaic on a grid: RGBA (height, width, 4) uint8, alpha 0 where no frame sees the ground.

    `frames`: at least those of `overlapping`; their order does not matter. Pure: equal input, equal bytes.
    `only`: (height / cell, width / cell) of a grid of whole cells: what is drawn; elsewhere anything may be.
    """
    frames = sorted(frames, key=lambda f: f.frame_id)
    wide = Lattice.covering(grid, world, params.cell_px, PAD_CELLS + params.rim_cells)
    scene = _Scene.of(wide, grid.resolution_m(world), frames, photos, params, _kept(only))
    if scene is None:
        return np.zeros((grid.height, grid.width, 4), np.uint8)
    lattice = wide.inner(params.rim_cells)
    drawn = _draw(scene, lattice, grid.resolution_m(world), photos, params)
    top, left = grid.row0 - lattice.row0, grid.col0 - lattice.col0
    return drawn[top : top + grid.height, left : left + grid.width]


def _kept(only: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
    """The lattice's cells without which the pixels of those in `only` would be others."""
    if only is None:
        return None
    wide = cv2.dilate(np.pad(only, PAD_CELLS).astype(np.uint8), np.ones((2 * PAD_CELLS + 1,) * 2, np.uint8))
    return np.asarray(wide, bool)


@dataclass(frozen=True, slots=True)
class _Scene:
    """Who wins where on a lattice's inner knots. `frames`: the winners only, which the rest index into."""

    frames: list[PosedFrame]
    labels: Labels
    weights: Int32
    retone: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        lattice: Lattice,
        resolution_m: float,
        frames: Sequence[PosedFrame],
        photos: Photos,
        params: FusionParams,
        kept: NDArray[np.bool_] | None = None,
    ) -> _Scene | None:
        """The winners among frames by ascending id (ties go to the lower); None when nobody sees it."""
        rim = params.rim_cells
        frames, views = _seen(lattice, resolution_m, frames, photos, params)
        give_way(views.weight, views.sharp)
        inner = np.s_[:, rim : lattice.rows - rim, rim : lattice.cols - rim]
        given = np.ascontiguousarray(views.weight[inner])
        drawn = np.asarray(given.any(0) if kept is None else given.any(0) & kept)
        if not drawn.any():
            return None
        settled = settle(views.weight, views.spot)[inner] if params.seams else given
        weights = np.ascontiguousarray(settled)
        labels = heaviest(weights, drawn)
        winners = np.unique(labels[labels != NOBODY])
        place = np.full(len(frames) + 1, NOBODY, np.int16)
        place[winners] = np.arange(len(winners))
        return cls(
            frames=[frames[k] for k in winners],
            labels=place[labels],
            weights=weights[winners],
            retone=retone(labels, given, Tones(views.own, views.even, views.detail), params.tone_tolerance),
        )


def _importance(frame: PosedFrame, resolution_m: float, params: FusionParams) -> float:
    gsd_m = abs(frame.pose.gsd_m(frame.camera))
    importance = min(1.0, resolution_m / gsd_m)
    if frame.pose.source == "gnss":
        importance *= params.gnss_importance
    if frame.pose.sigma_m is not None:
        loose_px = math.hypot(*frame.pose.sigma_m[:2]) / gsd_m
        importance *= params.loose_px / (params.loose_px + loose_px)
    return importance


def _seen(
    lattice: Lattice,
    resolution_m: float,
    frames: Sequence[PosedFrame],
    photos: Photos,
    params: FusionParams,
) -> tuple[list[PosedFrame], Views]:
    """The frames that see any of the lattice, in their order, and what they see."""
    views, seen = Views.empty(len(frames), lattice, params.rim_cells), list[PosedFrame]()
    for frame in frames:
        gsd_m = abs(frame.pose.gsd_m(frame.camera))
        importance = _importance(frame, resolution_m, params)
        skirt_px = SKIRT_CELLS * params.cell_px * resolution_m / gsd_m
        tones = _toned(frame, photos.thumb(frame.frame_id), params.tone_side_px)
        if look(lattice, frame, tones, importance, params.min_cos_view, skirt_px, views, len(seen)):
            seen.append(frame)
    return seen, views.first(len(seen))


_toned_last: dict[tuple[str, Gain, int], tuple[Rgb, tuple[Rgb, Rgb, Rgb]]] = {}
TONED = 96
"""So many photos' tones are kept: neighbouring rasters ask for the same ones again and again."""


def _toned(frame: PosedFrame, thumb: Rgb, side_px: int) -> tuple[Rgb, Rgb, Rgb]:
    """A thumbnail as its photo will be drawn, and how it looks from afar and from farther still."""
    key = (frame.frame_id, frame.gain, side_px)
    of, tones = _toned_last.get(key, (None, None))
    if tones is None or of is not thumb:
        drawn = relit(thumb, frame.gain)
        tone = _shrunk(np.ascontiguousarray(drawn[..., :3]), side_px)
        tones = (drawn, tone, _shrunk(tone, side_px // 8))
        for oldest in list(_toned_last)[: 1 - TONED]:
            _toned_last.pop(oldest, None)
        _toned_last[key] = (thumb, tones)
    return tones


def _shrunk(image: Rgb, side_px: int) -> Rgb:
    scale = min(1.0, side_px / max(image.shape[:2]))
    size = (max(2, round(image.shape[1] * scale)), max(2, round(image.shape[0] * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _draw(
    scene: _Scene, lattice: Lattice, resolution_m: float, photos: Photos, params: FusionParams
) -> NDArray[np.uint8]:
    canvas = Canvas(lattice, resolution_m, params.min_cos_view, params.bands, params.sampling == "cubic")
    layers, places, sizes = [], np.empty((*scene.weights.shape, 2), np.int32), []
    for k, frame in enumerate(scene.frames):
        layer, size = canvas.layer(k, frame, scene.labels, photos, places[k])
        layers.append(layer)
        sizes.append(size)
    return _blend(scene, layers, places, np.array(sizes, np.int32), params)


def _blend(
    scene: _Scene, layers: list[Layer], places: Int32, sizes: Int32, params: FusionParams
) -> NDArray[np.uint8]:
    labels, colours = scene.labels, scene.retone.copy()
    for layer in layers:
        mean = layer.levels[-1]
        part = np.s_[layer.row : layer.row + mean.shape[0], layer.col : layer.col + mean.shape[1]]
        mine = scene.labels[part] == layer.label
        colours[part][mine] += mean[mine]
    for level in range(params.bands - 1, 0, -1):
        finer = label_level(scene.labels, scene.weights, params.cell_px >> level, None, sizes)
        colours = blend_level(colours, labels, layers, level, finer, params.cell_px)
        labels = finer
    finest = label_level(scene.labels, scene.weights, params.cell_px, places, sizes)
    return blend_finest(colours, labels, layers, finest, params.cell_px)


def _box(frame: PosedFrame, max_view_deg: float) -> tuple[float, float, float, float, float]:
    """West, south, east, north (world metres) of what the frame can show, and its ground height."""
    camera, pose = frame.camera, frame.pose
    xs, ys = np.meshgrid(np.linspace(0, camera.width - 1, 5), np.linspace(0, camera.height - 1, 5))
    rays: Array = camera.rays(np.column_stack((xs.ravel(), ys.ravel()))) @ pose.world_R_cam.T
    flat = np.hypot(rays[:, 0], rays[:, 1])
    steep = np.maximum(-rays[:, 2], flat / math.tan(math.radians(max_view_deg)))
    ground = pose.center[:2] + rays[:, :2] * ((pose.center[2] - pose.ground_h_m) / steep)[:, None]
    west, south = ground.min(0)
    east, north = ground.max(0)
    return (float(west), float(south), float(east), float(north), pose.ground_h_m)
