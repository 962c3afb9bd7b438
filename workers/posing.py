"""The map as one sequencer knows it: what is placed where, and which tiles another solution changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from core import errors
from core.coverage import mission_zoom, moved_px, outline_px, tiles_under
from core.exposure import fitted, light_apart
from core.frame import FrameMeta
from core.geometry import Pose, PosedFrame
from core.glance import Glance
from core.grid import TileKey, ancestors
from core.matching import PairMatch
from core.mosaic import MOST_TILES, Layout, waiting_frames
from core.pose_graph import GraphFrame, Solution
from core.pose_graph.survey import usable_fix
from services.catalog.frames import Seen
from services.catalog.pairs import Key as PairKey
from services.catalog.poses import Placed, Poses, PoseUpdate
from services.catalog.tiles import GROWN, HEAL, NEW, Key, TileBox
from services.tables import Frame
from workers.homes import Homes
from workers.shown import Shown

SHOWN_MOVE_PX = 0.5
SHOWN_LIGHT = 0.02
EXPOSED_BY = 3
"""By so many others a new frame's exposure is told."""


@dataclass
class Known:
    """What the sequencer remembers of a mission between two batches; good as long as `generation` is.

    `solved_located`: frames with GPS in the last solve. `untried`: frames that have not looked for ties with
    other maps yet; `tries`: pairs that were asked for in order to tie maps and are still being matched.
    `tied`: maps were found to hang together since the last solve; `scale`: what that had for it.
    `located`: the frames that have GPS; `shown`: what `grown` goes by.
    """

    generation: int
    layout: Layout | None
    solved_frames: int
    reprojection_rms_px: float = 0.0
    seen: dict[str, GraphFrame] = field(default_factory=dict)
    solved_located: int = 0
    untried: set[str] = field(default_factory=set)
    tries: set[PairKey] = field(default_factory=set)
    tied: bool = False
    scale: Mapping[str, Any] | None = None
    located: set[str] = field(init=False)
    shown: Shown | None = None
    _homes: Homes | None = None

    def __post_init__(self) -> None:
        """Looks through the frames once."""
        self.located = {k for k, f in self.seen.items() if _is_located(f)}

    @classmethod
    def read(cls, poses: Poses, sightings: Iterable[Seen], rms_px: float | None) -> Known:
        """From the rows alone, as another sequencer left them."""
        seen = {s.frame_id: GraphFrame(s.frame_id, s.name, s.meta) for s in sightings}
        known = cls(poses.generation, _layout(poses), poses.solved_frames, rms_px or 0.0, seen)
        known.solved_located = sum(k in known.located for k in poses.placed)
        return known

    def learn(self, new: Iterable[Frame]) -> None:
        """Take in the rows of frames that were matched."""
        fresh = (f for f in new if f.id not in self.seen)
        graph = {f.id: GraphFrame(f.id, f.name, FrameMeta.from_json(f.meta or {})) for f in fresh}
        self.seen |= graph
        self.located |= {k for k, f in graph.items() if _is_located(f)}

    def grown(self, after: Layout, new_ids: set[str]) -> dict[Key, int]:
        """The tiles that look different when the layout becomes that one, which has new frames besides."""
        assert self.layout is not None
        self.homes.grow(after, new_ids)
        if new_ids & self.layout.frames.keys():
            return changed(self.layout, after).dirty(0)
        if self.shown is None or self.shown.layout is not self.layout:
            self.shown = Shown(self.layout)
        return self.shown.grow(after, new_ids)

    @property
    def solution(self) -> Solution | None:
        """What new frames are placed against; None before anything is placed."""
        if self.layout is None or not self.layout.frames:
            return None
        return Solution(
            world=self.layout.world,
            cameras=self.layout.cameras,
            poses=_PosesOf(self.layout.frames),
            unplaced={},
            reprojection_rms_px=self.reprojection_rms_px,
        )

    @property
    def waiting(self) -> Mapping[str, Pose | None]:
        """The frames that wait for a tie."""
        return self.layout.waiting if self.layout else {}

    @property
    def homes(self) -> Homes:
        """Which connected map each frame is part of."""
        if self._homes is None or self._homes.layout is not self.layout:
            self._homes = Homes(self.layout, self.located)
        return self._homes

    @property
    def camera_keys(self) -> dict[str, str]:
        """Frame id → camera key."""
        return {k: f.meta.camera_key for k, f in self.seen.items()}


class _PosesOf(Mapping[str, Pose]):
    """The poses of some frames, without a copy of all."""

    def __init__(self, frames: Mapping[str, PosedFrame]) -> None:
        self._frames = frames

    def __getitem__(self, frame_id: str) -> Pose:
        return self._frames[frame_id].pose

    def __iter__(self) -> Iterator[str]:
        return iter(self._frames)

    def __len__(self) -> int:
        return len(self._frames)


def _is_located(frame: GraphFrame) -> bool:
    return usable_fix(frame.meta.gps) is not None


def _layout(poses: Poses) -> Layout | None:
    if poses.world is None:
        return None
    frames = {k: p.posed(poses.cameras) for k, p in poses.placed.items()}
    sides = (poses.photo_side, poses.max_side)
    bare = Layout(poses.world, poses.zoom, poses.cameras, frames, {}, {}, poses.waiting, *sides)
    return bare if poses.zoom is None else _on_tiles(bare, poses.zoom)


def _on_tiles(layout: Layout, zoom: int) -> Layout:
    """The same frames on the tiles of this zoom."""
    fusion = layout.fusion
    under = {k: frozenset(tiles_under(f, layout.world, zoom, fusion)) for k, f in layout.frames.items()}
    return replace(layout, zoom=zoom, under=under)


def joined(
    layout: Layout, solution: Solution, new_ids: Collection[str], keys: Mapping[str, str], mode: str
) -> Layout:
    """The layout with new frames in it; those that are there stay as they are."""
    assert layout.zoom is not None
    cameras = dict(layout.cameras) | {k: c for k, c in solution.cameras.items() if k not in layout.cameras}
    frames, under = dict(layout.frames), dict(layout.under)
    late = {k: pose for k, pose in waiting_frames(solution, mode).items() if k in new_ids}
    lost = sorted(k for k in new_ids if k not in solution.poses and k not in late)
    rejected = {k: solution.unplaced.get(k, errors.NotPlaceable.code) for k in lost}
    for frame_id in sorted(k for k in new_ids if k in solution.poses):
        camera = cameras[keys[frame_id]]
        frame = PosedFrame(frame_id, camera, solution.poses[frame_id])
        tiles = frozenset(tiles_under(frame, layout.world, layout.zoom, layout.fusion))
        if 0 < len(tiles) <= MOST_TILES:
            frames[frame_id], under[frame_id] = frame, tiles
        else:
            rejected[frame_id] = "oblique"
    waiting = {k: p for k, p in layout.waiting.items() if k not in new_ids} | late
    return replace(layout, cameras=cameras, frames=frames, under=under, rejected=rejected, waiting=waiting)


def exposed(
    layout: Layout, new_ids: Collection[str], matches: Sequence[PairMatch], look: Callable[[str], Glance]
) -> Layout:
    """The layout with its new frames as bright as what they overlap, until the next balance of all."""
    new = [layout.frames[k] for k in sorted(set(new_ids) & layout.frames.keys())]
    ties = _ties(layout.frames.keys() & set(new_ids), matches)
    near = {k for frame in new for k in _alike(frame, layout.frames, set(new_ids), ties[frame.frame_id])}
    colours = {k: look(k).colours for k in sorted(near | {f.frame_id for f in new})}
    lit = fitted(new, [layout.frames[k] for k in sorted(near)], colours)
    return replace(layout, frames={**layout.frames, **{f.frame_id: f for f in lit}})


def _ties(ids: Collection[str], matches: Iterable[PairMatch]) -> dict[str, list[tuple[int, str]]]:
    """Whom each of these frames is matched with, and how well: the best has the lowest rank."""
    ties: dict[str, list[tuple[int, str]]] = {k: [] for k in ids}
    for m in matches:
        for one, other in ((m.low, m.high), (m.high, m.low)) if m.accepted else ():
            if one in ties:
                ties[one].append((-len(m.uv_low), other))
    return ties


def _alike(
    frame: PosedFrame, frames: Mapping[str, PosedFrame], new_ids: set[str], ties: Iterable[tuple[int, str]]
) -> list[str]:
    """A few of those that are not new and show the same ground: the best matched, or else the nearest."""
    found = [(rank, k) for rank, k in ties if k in frames and k not in new_ids]
    if found:
        return [k for _, k in sorted(found)[:EXPOSED_BY]]
    others = sorted(frames.keys() - new_ids)
    centers = np.array([frames[k].pose.center for k in others]).reshape(-1, 3)
    away_m = np.linalg.norm(centers - frame.pose.center, axis=1)
    return [others[k] for k in np.argsort(away_m, kind="stable")[:EXPOSED_BY]]


@dataclass(frozen=True, slots=True)
class Changes:
    """What another layout changes. `new`: tiles with ground that is not shown yet, each with its priority;
    `off_px`: of the other tiles, how far from its place what they show is, in their pixels.
    """

    new: Mapping[Key, int]
    off_px: Mapping[Key, float]

    def dirty(self, most_healed: int) -> dict[Key, int]:
        """The tiles to draw now: all that are new, and as many as that of those that are farthest off."""
        worst = sorted(self.off_px, key=lambda tile: (-self.off_px[tile], tile))
        return dict(self.new) | dict.fromkeys(worst[:most_healed], HEAL)


def changed(before: Layout | None, after: Layout) -> Changes:
    """The native tiles that look different now. Where a photo shows no new ground, nothing does: what it
    shows better waits for the next pass over all tiles.

    A photo that moved may see ground that none has seen: that is new, however little else may be healed. So
    all that the photos of a layout see is shown, or is to be drawn next, at every time.
    """
    if before is None or before.zoom is None:
        return Changes(dict.fromkeys(after.cover, NEW), {})
    shown = before.cover
    off_px: dict[Key, float] = {}
    news: set[TileKey] = set()
    for frame_id in sorted(before.frames.keys() | after.frames.keys()):
        old, new = before.frames.get(frame_id), after.frames.get(frame_id)
        if new is not None and old is None:
            news |= after.under[frame_id]
        elif old is not None and (off := _off_px(old, new, before, after)) > SHOWN_MOVE_PX:
            for tile in before.under[frame_id] | after.under.get(frame_id, frozenset()):
                off_px[tile] = max(off_px.get(tile, 0.0), off)
    moved = {TileKey(*tile) for tile in off_px}
    there, now = Shown(before), Shown(after)
    grown = {tile for tile in news & shown if not there.is_full(tile)}
    grown |= {tile for tile in moved & shown if now.fills_any(tile, there.open(tile))}
    new_tiles: dict[Key, int] = {
        tile: GROWN if tile in shown else NEW for tile in (news | moved) - shown | grown
    }
    return Changes(new_tiles, {tile: off for tile, off in off_px.items() if tile not in new_tiles})


def _off_px(old: PosedFrame, new: PosedFrame | None, before: Layout, after: Layout) -> float:
    """How far the frame has moved; another light counts as if it had."""
    if old is new:
        return 0.0
    if new is None:
        return math.inf
    assert after.zoom is not None
    move = moved_px(outline_px(old, before.world, after.zoom), outline_px(new, after.world, after.zoom))
    return max(move, light_apart(old, new) / SHOWN_LIGHT * SHOWN_MOVE_PX)


def lifts(known: Known, new_ids: set[str], matches: Iterable[PairMatch]) -> bool:
    """Whether new frames tie what has no place to a frame that GPS alone has placed so far."""
    homes, located = known.homes, known.located

    def stuck(k: str) -> bool:
        return k not in located and (k in new_ids or k in known.waiting)

    def fixed(k: str) -> bool:
        return k in located and (k in new_ids or homes.get(k) == k)

    ends = [(m.low, m.high) for m in matches if m.accepted and new_ids & {m.low, m.high}]
    return any((stuck(a) and fixed(b)) or (stuck(b) and fixed(a)) for a, b in ends)


def everything(layout: Layout, published: Iterable[Key]) -> dict[Key, int]:
    """All tiles of the layout, and those shown that it does not lead to: they are rendered empty."""
    cover = layout.cover
    led_to = cover | set(ancestors(cover))
    return dict.fromkeys(cover, NEW) | {k: NEW for k in published if TileKey(*k) not in led_to}


def sharper(layout: Layout) -> Layout:
    """The same frames, drawn in full, on the tiles of the zoom that fits that."""
    zoom = mission_zoom(layout.frames.values(), layout.world, None)
    return layout if zoom is None else _on_tiles(replace(layout, max_side=None), zoom)


def update_of(layout: Layout, keys: Mapping[str, str], new_ids: Collection[str] | None = None) -> PoseUpdate:
    """The rows that say so, of all frames or of those that are new."""
    assert layout.zoom is not None or not layout.frames
    some = layout.frames.keys() | layout.waiting.keys() if new_ids is None else set(new_ids)
    return PoseUpdate(
        placed=[_placed(layout, keys, k) for k in sorted(some & layout.frames.keys())],
        unplaced={k: (code, sentence(code)) for k, code in layout.rejected.items()},
        waiting={k: layout.waiting[k] for k in sorted(some & layout.waiting.keys())},
        cameras=layout.cameras,
        world=layout.world,
        zoom=layout.zoom,
        photo_side=layout.photo_side,
    )


def _placed(layout: Layout, keys: Mapping[str, str], frame_id: str) -> Placed:
    frame, tiles = layout.frames[frame_id], layout.under[frame_id]
    xs, ys = [t.x for t in tiles], [t.y for t in tiles]
    assert layout.zoom is not None
    box = TileBox(layout.zoom, min(xs), min(ys), max(xs), max(ys))
    return Placed(frame_id, keys[frame_id], frame.pose, box, frame.gain)


def sentence(code: str) -> str:
    """What a person is told about an error code of `core.errors`."""
    kinds: Sequence[type[errors.RejectedFrame]] = errors.RejectedFrame.__subclasses__()
    return next((str(kind()) for kind in kinds if kind.code == code), str(errors.NotPlaceable()))
