"""The whole chain in one process, on one page: the oracle that the distributed result must equal.

Photos → metadata, features → neighbours → matches → poses → exposure → tiles → pyramid.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256

import numpy as np

from core.alignment import marks_of
from core.checkpoints import Checkpoints
from core.coverage import (
    blocks,
    draw_block,
    fusion_of,
    mission_zoom,
    pyramid,
    tiles_under,
    typical_side,
)
from core.decode import Pixels, decode_rgb, decode_to_draw
from core.errors import NotPlaceable, RejectedFrame
from core.exposure import balanced
from core.features import FEATURE_SIDE_PX, Features, extract
from core.fusion import FrameIndex, FusionParams
from core.geometry import Camera, Pose, PosedFrame, World
from core.glance import Glance, glance
from core.grid import TileKey
from core.matching import PairMatch, match_pair
from core.metadata import read_metadata
from core.neighbours import Pair, Sighting
from core.photo import probe
from core.pose_graph import GraphFrame, PoseParams, Solution, solve
from core.pyramid import TileFormat
from core.scale import UNKNOWN, KnownScale, named
from core.submaps import SubmapGraph, submap_graph
from core.ties import Canonical, canonical

MOST_TILES = 4096
"""A frame that would cover more native tiles than this was posed so far off that it would bury the map."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Everything that the tiles are drawn from, besides the photos. `under`: each frame's native tiles.

    `rejected`: frame id → error code of `core.errors`. `waiting`: frames without GPS that tie to nothing that
    has a place, with the pose on their island (None for one that is alone); they are kept, and drawn when a
    photo ties them in. `photo_side`: the longest side of a typical photo, `max_side`: at which photos are
    drawn at most, pixels.
    """

    world: World
    zoom: int | None
    cameras: Mapping[str, Camera]
    frames: Mapping[str, PosedFrame]
    under: Mapping[str, frozenset[TileKey]]
    rejected: Mapping[str, str]
    waiting: Mapping[str, Pose | None] = field(default_factory=dict)
    photo_side: int | None = None
    max_side: int | None = None

    @property
    def fusion(self) -> FusionParams:
        """How its photos are put together."""
        return fusion_of(self.photo_side, self.max_side)

    @property
    def cover(self) -> set[TileKey]:
        """All native tiles."""
        return set[TileKey]().union(*self.under.values())


@dataclass(frozen=True, slots=True)
class Mosaic:
    """A finished map. `tiles`: the encoded picture of every tile, overviews included."""

    solution: Solution
    layout: Layout
    tiles: Mapping[TileKey, bytes]
    rejected: Mapping[str, str]
    submaps: SubmapGraph


def frame_id_of(data: bytes) -> str:
    """What a photo is called everywhere: the first 32 hex digits of its sha256."""
    return sha256(data).hexdigest()[:32]


def lay_out(
    solution: Solution,
    camera_keys: Mapping[str, str],
    look: Callable[[str], Glance],
    max_side: int | None,
    before: Layout | None = None,
    mode: str = "visual",
) -> Layout:
    """Where and how bright every posed frame is drawn. `look`: a frame's glance by its id.

    `before`: what is shown now; its zoom is kept while it fits well enough, and its typical photo.
    """
    bare = [
        PosedFrame(k, solution.cameras[camera_keys[k]], _plain(solution.poses[k]))
        for k in sorted(solution.poses)
    ]
    zoom = mission_zoom(bare, solution.world, max_side, before.zoom if before else None)
    photo_side = (before.photo_side if before else None) or typical_side(bare)
    fusion = fusion_of(photo_side, max_side)
    under = {f.frame_id: tiles_under(f, solution.world, zoom, fusion) if zoom else set() for f in bare}
    # A horizon shot fits nowhere; drawn by its GPS it would paint the sky beside the photos that do fit.
    tied = any(f.pose.source != "gnss" for f in bare)
    sky = {f.frame_id for f in bare if tied and f.pose.source == "gnss" and look(f.frame_id).sky}
    good = [f for f in bare if 0 < len(under[f.frame_id]) <= MOST_TILES and f.frame_id not in sky]
    lit = balanced(good, solution.world, {f.frame_id: look(f.frame_id).colours for f in good})
    frames = {f.frame_id: replace(f, gain=_rgb(f.gain)) for f in lit}
    lost = {f.frame_id: "oblique" for f in bare} | dict(solution.unplaced)
    waiting = waiting_frames(solution, mode)
    return Layout(
        world=solution.world,
        zoom=zoom,
        cameras=dict(solution.cameras) | {camera_keys[k]: f.camera for k, f in frames.items()},
        frames=frames,
        under={k: frozenset(under[k]) for k in frames},
        rejected={k: code for k, code in lost.items() if k not in frames and k not in waiting},
        waiting=waiting,
        photo_side=photo_side,
        max_side=max_side,
    )


def waiting_frames(solution: Solution, mode: str) -> dict[str, Pose | None]:
    """The frames that wait for a tie, by id; in mode gnss nothing could ever tie one."""
    lone = [k for k, code in solution.unplaced.items() if code == NotPlaceable.code]
    return {k: solution.islands.get(k) for k in sorted(lone)} if mode == "visual" else {}


def _plain(pose: Pose) -> Pose:
    """Contiguous arrays: how a product is rounded may depend on how its factors lie in memory."""
    return replace(
        pose,
        world_R_cam=np.array(pose.world_R_cam, np.float64, order="C"),
        center=np.array(pose.center, np.float64),
        ground_h_m=float(pose.ground_h_m),
    )


def _rgb(gain: Sequence[float]) -> tuple[float, float, float]:
    return float(gain[0]), float(gain[1]), float(gain[2])


@dataclass(frozen=True, slots=True)
class _Read:
    """A photo that was understood."""

    frame: GraphFrame
    features: Features
    data: bytes

    @property
    def sighting(self) -> Sighting:
        meta = self.frame.meta
        return Sighting(
            self.frame.frame_id, meta.captured_s, self.frame.name, meta.drone, meta.gps, self.features.words
        )


class _Photos:
    """The photos in memory, decoded at the mission's resolution when asked for."""

    def __init__(self, read: Mapping[str, _Read], max_side: int | None) -> None:
        self._read = read
        self._max_side = max_side
        self._decoded: dict[str, Pixels] = {}

    def photo(self, frame_id: str) -> Pixels:
        if frame_id not in self._decoded:
            self._decoded[frame_id] = decode_to_draw(self._read[frame_id].data, self._max_side)[0]
        return self._decoded[frame_id]

    def thumb(self, frame_id: str) -> Pixels:
        return self._read[frame_id].features.thumb


def build(
    photos: Sequence[tuple[str, bytes]],
    max_side: int | None = None,
    mode: str = "visual",
    scale: KnownScale = UNKNOWN,
    tile_format: TileFormat = "jpeg",
) -> Mosaic:
    """The map of some photos (name, bytes), whatever their order. `mode`: visual or gnss."""
    rejected: dict[str, str] = {}
    read: dict[str, _Read] = {}
    for name, data in photos:
        frame_id = frame_id_of(data)
        try:
            meta = read_metadata(data, probe(data))
            features = extract(decode_rgb(data, FEATURE_SIDE_PX), (meta.width, meta.height))
        except RejectedFrame as error:
            rejected[frame_id] = error.code
        else:
            read[frame_id] = _Read(GraphFrame(frame_id, name, meta), features, data)
    frames = [r.frame for r in read.values()]

    def matched(pairs: Sequence[Pair]) -> list[PairMatch]:
        return [m for a, b in pairs if (m := _matched(read[a], read[b])).accepted]

    wanted = canonical([r.sighting for r in read.values()] if mode == "visual" else [], matched)
    assert wanted is not None  # `matched` never puts off
    solution, submaps = solved(frames, wanted, scale)
    camera_keys = {k: r.frame.meta.camera_key for k, r in read.items()}
    layout = lay_out(solution, camera_keys, lambda k: glance(read[k].features.thumb), max_side, mode=mode)
    tiles = draw(layout, _Photos(read, max_side), tile_format)
    return Mosaic(solution, layout, tiles, rejected | dict(layout.rejected), submaps)


def solved(
    frames: Sequence[GraphFrame],
    pairs: Canonical,
    scale: KnownScale = UNKNOWN,
    points: Checkpoints | None = None,
) -> tuple[Solution, SubmapGraph]:
    """The final poses, and which submaps they were made of; a function of the sets.

    `points`: surveyed, of which those that are used hold the map in place.
    """
    solution = solve(frames, pairs.matches, _scaled(scale, frames), marks=marks_of(points, frames))
    poses = {**solution.islands, **solution.poses}
    return solution, submap_graph(frames, pairs.matches, poses, solution.dropped_pairs, pairs.extra)


def _scaled(scale: KnownScale, frames: Sequence[GraphFrame]) -> PoseParams:
    if scale.marker is None:
        return PoseParams(first_height_m=scale.first_height_m)
    photo = named(scale.marker.image, [f.name for f in frames])
    # a photo that is not there must not pass for the first one
    return PoseParams(ground_px_per_m=scale.marker.ground_px_per_m, scale_image=photo or scale.marker.image)


def draw(layout: Layout, photos: _Photos, tile_format: TileFormat = "jpeg") -> dict[TileKey, bytes]:
    """Every tile that shows something, overviews included."""
    index = FrameIndex(layout.frames.values(), layout.fusion)
    natives: dict[TileKey, bytes] = {}
    for block in blocks(layout.cover):
        drawn = draw_block(block, layout.world, index, photos, layout.fusion, tile_format)
        natives |= {tile: encoded[0] for tile, encoded in drawn.items() if encoded is not None}
    return natives | pyramid(natives, tile_format)


def _matched(low: _Read, high: _Read) -> PairMatch:
    cameras = low.frame.meta.camera(), high.frame.meta.camera()
    return match_pair(low.frame.frame_id, low.features, high.frame.frame_id, high.features, *cameras)
