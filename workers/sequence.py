"""The one owner of a mission: poses its new frames, says which tiles to render, and finishes it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from core.coverage import pass_pixels
from core.grid import TILE_PX
from core.matching import PairMatch
from core.mosaic import Layout, solved
from core.pose_graph import GraphFrame, place
from core.scale import KnownScale
from core.submaps import joins
from services.catalog import backlog, frames, missions, poses, sharpening, surveys, tiles
from services.catalog.backlog import Backlog
from services.catalog.pairs import Key as PairKey
from services.catalog.poses import PoseUpdate
from services.catalog.tiles import Key as TileId
from services.queue import send
from services.tables import Frame, Mission
from workers import solving, surveyed, tying, wanted, warmup
from workers.app import CLAIM_TTL_S, Stopwatch, app, before_the_fork, db, log, settings, stage
from workers.dealing import AHEAD_TILES, BEGIN, LIVE_TILES, LiveBatch, Spent, live_runs, runs, tasks
from workers.lease import held
from workers.posing import Known, changed, everything, exposed, joined, lifts, sharper, update_of

GROWTH = 2.0
"""All poses are solved again when the mission, or its frames with GPS, grew so many times since the last."""
MERGE_GROWTH = 1.02
"""When maps that were apart are tied, so much is enough, or a moment in which there is nothing else to do."""
SPARE = 6
"""The priority of what only spare workers do: after all that any mission waits for."""
LIVE_SHARE = 0.85
"""What may be rendered before the final pass, as a share of that pass."""
FEW = 8
WORTH_A_LOOK = 24
"""While so many photos still wait to be read, a mission that is being finished grows live as well."""
_REMEMBERED = 8
IDLE = Backlog(0, 0, 0, 0, 0)

_known: dict[str, Known] = {}
_come_back: dict[str, float] = {}
_batches: dict[str, LiveBatch] = {}


before_the_fork(warmup.solving)


@stage("sequence")
def sequence(mission_id: str) -> None:
    """Frames matched → posed, dirty tiles → fuse tasks, finalising → final."""
    if not _waits(mission_id):
        return
    with held(db, mission_id, settings.lease_ttl_s) as epoch:
        if epoch is None:
            _come_back_later(mission_id)
            return
        while _step(mission_id, epoch):
            pass
    # A wake-up that came while the lease was held found it taken and went away.
    with db.read() as tx:
        missed = backlog.of(tx, mission_id, CLAIM_TTL_S).matched > 0
    if missed:
        send("sequence", mission_id)


def _waits(mission_id: str) -> bool:
    """Whether there may be something to do: most wake-ups come while photos are still being read."""
    with db.read() as tx:
        mission = missions.get(tx, mission_id)
        desk = backlog.of(tx, mission_id, CLAIM_TTL_S)
    if mission.state == "finalising" and 0 < desk.unread < WORTH_A_LOOK:
        if desk.unread <= settings.workers:  # fewer than there are workers for
            _ask(mission_id, wanted.ahead(mission))
        return False  # the last of them wakes us
    if mission.state == "finalising" and not desk.unread and wanted.missing(mission_id):
        return False
    if mission.state == "open" and not (desk.matched or desk.to_render or desk.to_publish):
        return _may_tie(mission) or (desk == IDLE and _rests(mission))
    last = _batches.get(mission_id, BEGIN)
    return desk.unread <= settings.workers or last.over(time.monotonic(), settings.workers)


def _may_tie(mission: Mission) -> bool:
    """Whether ties are looked for, or found, that nobody has drawn a conclusion from yet."""
    known = _known.get(mission.id)
    return known is not None and bool(
        known.untried or known.tries or known.tied or known.scale != mission.scale
    )


def _come_back_later(mission_id: str) -> None:
    """The lease may be a dead owner's: look again when it has run out."""
    now = time.monotonic()
    if now > _come_back.get(mission_id, 0.0):
        _come_back[mission_id] = now + settings.lease_ttl_s
        app.send_task("sequence", args=[mission_id], queue="sequence", countdown=settings.lease_ttl_s + 0.5)


def _step(mission_id: str, epoch: int) -> bool:
    """One thing that waits; False when there is nothing to do but wait for others."""
    with db.read() as tx:
        mission = missions.get(tx, mission_id)
        desk = backlog.of(tx, mission_id, CLAIM_TTL_S)
        new = frames.list(tx, mission_id, "matched", limit=10_000) if desk.matched else []
    if mission.state == "sharpening" and (mission.sharp_zoom is None or desk == IDLE):
        return _sharpen(mission, epoch)
    if mission.state == "finalising" and not desk.unread and (new or mission.final_generation is None):
        return _solve_finally(mission, epoch)
    if new and (mission.state != "finalising" or desk.unread >= WORTH_A_LOOK):
        _pose(mission, epoch, new)
        return True
    if mission.state == "open" and mission.mode == "visual" and _tie(mission, epoch, desk):
        return True
    if desk.to_render:
        return _dispatch(mission, desk)
    if desk == IDLE and _rests(mission):
        return _solve_finally(mission, epoch)
    if desk.to_publish and not desk.in_flight:
        send("publish", mission_id)  # normally the fuse task has: it may have died in between
        return False
    if mission.state == "finalising" and not (desk.unread or desk.in_flight or desk.to_publish):
        with db.write() as tx:
            missions.finish(tx, mission_id, epoch)
            return missions.get(tx, mission_id).state == "sharpening"
    return False


def _sharpen(mission: Mission, epoch: int) -> bool:
    """Begin to draw the map from the full photos, or, when that is done, end it."""
    known = _recall(mission)
    assert known.layout is not None
    sharp = sharper(known.layout)
    assert sharp.zoom is not None
    with db.write() as tx:
        if mission.sharp_zoom is None:
            keys = everything(sharp, [k for k in tiles.keys(tx, mission.id) if k[0] >= (mission.zoom or 0)])
            sharpening.begin(tx, mission.id, epoch, sharp.zoom, list(keys))
            return True
        if sharpening.end(tx, mission.id):
            update = replace(update_of(sharp, known.camera_keys), final=True)
            known.generation, known.layout = poses.save(tx, mission.id, epoch, update), sharp
    return False


def _recall(mission: Mission) -> Known:
    """What this process knows of the mission, read again when another process has written since."""
    known = _known.get(mission.id)
    if known is None or known.generation != mission.generation:
        with db.read() as tx:
            known = Known.read(
                poses.load(tx, mission.id), frames.sightings(tx, mission.id), mission.reprojection_rms_px
            )
        known.scale = mission.scale
        while len(_known) >= _REMEMBERED:
            _known.pop(next(iter(_known)))
        _known[mission.id] = known
    return known


def _tie(mission: Mission, epoch: int, desk: Backlog) -> bool:
    """Look for ties between maps; whether all was solved again because of some, or of another scale."""
    known = _known.get(mission.id)
    if known is None or known.generation != mission.generation:
        return False
    known.tied |= bool(known.tries) and tying.tied(mission.id, known)
    known.tied |= known.scale != mission.scale
    grown = len(known.homes) >= MERGE_GROWTH * known.solved_frames
    if known.tied and known.homes and (grown or desk == IDLE):
        _pose(mission, epoch, [])
        return True
    if known.untried and desk.unread <= settings.workers:
        _ask(mission.id, tying.look(mission.id, known))
    return False


def _ask(mission_id: str, ask: Sequence[PairKey]) -> None:
    """Have these pairs matched."""
    for some in tasks(ask, settings.workers):
        send("match", mission_id, None, some)


def _pose(mission: Mission, epoch: int, new: Sequence[Frame]) -> None:
    """Place what is new; or, when the mission has grown enough or nothing is new, solve all of it again."""
    clock = Stopwatch()
    known, new_ids = _recall(mission), {f.id for f in new}
    known.learn(new)
    before, solution = known.layout, known.solution
    matches = solving.matches(mission.id, new_ids)
    if solution is None or not new_ids or _due(known, new_ids, matches):
        after, dirty, update = _solved_again(mission, known)
    else:
        assert before is not None
        found = place(solution, known.seen, new_ids, matches)
        keys = {k: known.seen[k].meta.camera_key for k in new_ids}
        grown = joined(before, found, new_ids, keys, mission.mode)
        after = exposed(grown, new_ids, matches, solving.glances(mission.id))
        dirty = known.grown(after, new_ids)
        update = update_of(after, keys, new_ids)
    with db.write() as tx:
        generation = poses.save(tx, mission.id, epoch, replace(update, dirty=dirty))
        tiles.fuse_frames(tx, mission.id)  # whose ground is all shown already waits for nobody's tiles
        clock.spend(tx, mission.id, "pose")
    known.untried |= new_ids
    known.layout, known.generation = after, generation
    log.info("posed", mission=mission.id, new=len(new_ids), posed=len(after.frames), dirty=len(dirty))


def _due(known: Known, new_ids: set[str], matches: Sequence[PairMatch]) -> bool:
    """Whether all is to be solved again instead of placing what is new."""
    homes = known.homes
    fresh = [k for k in new_ids if k not in homes]
    total, located = len(homes) + len(fresh), homes.located + sum(k in known.located for k in fresh)
    grown = total < FEW or total >= GROWTH * known.solved_frames
    # Its first fixes place a map badly that was flown without GPS: twice as many place it better.
    if grown or (located > 0 and located >= GROWTH * known.solved_located):
        return True
    ends = {k for m in matches for k in (m.low, m.high) if k in homes}
    maps = {k: homes[k] for k in ends if homes[k] != k or k in known.waiting}
    known.tied |= joins(maps, new_ids, matches) or lifts(known, new_ids, matches)
    return known.tied and total >= MERGE_GROWTH * known.solved_frames


def _solved_again(mission: Mission, known: Known) -> tuple[Layout, dict[TileId, int], PoseUpdate]:
    """All that were ever read: what came since may tie in a frame that had no place before."""
    before = known.layout
    found, graph = solving.again(mission, known)
    after = solving.laid_out(mission, known.camera_keys, found, before)
    if before and before.zoom and (before.zoom, before.fusion) != (after.zoom, after.fusion):
        dirty = everything(after, _published(mission.id))
    else:
        dirty = changed(before, after).dirty(_may_heal(mission, after))
    total, rms_px = len(after.frames) + len(after.waiting), found.reprojection_rms_px
    update = replace(
        update_of(after, known.camera_keys),
        solved_frames=total,
        reprojection_rms_px=rms_px,
        submaps=graph.to_json(),
    )
    known.solved_frames, known.reprojection_rms_px, known.tied = total, rms_px, False
    known.scale = mission.scale
    known.solved_located = len(known.located)
    return after, dirty, update


def _may_heal(mission: Mission, layout: Layout) -> int:
    """How many tiles may be drawn again now.

    Until the mission is final, all rendering together stays below one pass over all tiles: poses will move
    again, and the final pass redraws everything.
    """
    spent = mission.pixels.get("new", 0) + mission.pixels.get("heal", 0)
    return max(0, int(LIVE_SHARE * pass_pixels(layout.cover) - spent) // TILE_PX**2)


def _rests(mission: Mission) -> bool:
    """Whether no photo has come for a while, and what is shown is not what finalising would show."""
    if mission.state != "open" or mission.generation <= (mission.healed_generation or 0):
        return False
    with db.read() as tx:
        return frames.quiet_s(tx, mission.id) >= settings.stalled_after_s


def _published(mission_id: str) -> Sequence[TileId]:
    with db.read() as tx:
        return tiles.keys(tx, mission_id)


def _solve_finally(mission: Mission, epoch: int) -> bool:
    """The canonical solution: a function of the set of photos alone. False while pairs are missing."""
    clock = Stopwatch()
    with db.read() as tx:
        seen = frames.sightings(tx, mission.id)
    if not seen:  # no photo could be read: there is no map to make
        with db.write() as tx:
            missions.finish(tx, mission.id, epoch)
        return False
    graph = {s.frame_id: GraphFrame(s.frame_id, s.name, s.meta) for s in seen}
    pairs_of_all, ask = wanted.canonical_pairs(mission, list(graph.values()))
    _ask(mission.id, ask)
    if pairs_of_all is None:
        return False
    points = surveyed.points_of(mission.id)
    found, submaps = solved(list(graph.values()), pairs_of_all, KnownScale.from_json(mission.scale), points)
    keys = {k: f.meta.camera_key for k, f in graph.items()}
    layout = solving.laid_out(mission, keys, found)
    update = replace(
        update_of(layout, keys),
        dirty=everything(layout, _published(mission.id)),
        pass_pixels=pass_pixels(layout.cover),
        solved_frames=len(graph),
        reprojection_rms_px=found.reprojection_rms_px,
        submaps=submaps.to_json(),
        final=True,
    )
    with db.write() as tx:
        if surveys.checkpoints(tx, mission.id) != points or (
            missions.get(tx, mission.id).scale != mission.scale
        ):
            return True  # other points, or another scale, came meanwhile
        generation = poses.save(tx, mission.id, epoch, update)
        clock.spend(tx, mission.id, "solve")
    known = Known(generation, layout, len(graph), found.reprojection_rms_px, graph)
    known.solved_located, known.scale = len(known.located), mission.scale
    _known[mission.id] = known
    wanted.forget(mission.id)
    log.info("solved finally", mission=mission.id, frames=len(graph), posed=len(layout.frames))
    return True


def _dispatch(mission: Mission, desk: Backlog) -> bool:
    """Hand out tiles: all that there are workers for, or a batch while photos still wait to be read."""
    sharpens = mission.state == "sharpening"
    if mission.final_generation is not None and not sharpens:
        return _deal(mission, desk)
    now, spent, busy = time.monotonic(), Spent.of(mission.stage_seconds), desk.unread > settings.workers
    last = _batches.get(mission.id, BEGIN)
    if busy:
        drawn = not desk.in_flight and last.over(now, settings.workers)
        room = last.next_tiles(desk.to_render, desk.unread, spent) if drawn else 0
    else:
        room = LIVE_TILES * settings.workers - desk.in_flight
    if room <= 0:
        return False
    with db.write() as tx:
        claimed = tiles.claim_dirty(tx, mission.id, room, CLAIM_TTL_S, by_place=sharpens)
    keys = [(d.z, d.x, d.y) for d in claimed]
    _batches[mission.id] = LiveBatch(now, len(keys), spent)
    for run in live_runs(keys, settings.workers, busy):
        send("fuse", mission.id, run, priority=SPARE if sharpens else None)
    return False


def _deal(mission: Mission, desk: Backlog) -> bool:
    """Hand out the final pass, before the workers have drawn what they were given last."""
    ahead = AHEAD_TILES * settings.workers
    if 2 * desk.in_flight > ahead:
        return False
    with db.write() as tx:
        claimed = tiles.claim_dirty(tx, mission.id, ahead - desk.in_flight, CLAIM_TTL_S, by_place=True)
    for run in runs([(d.z, d.x, d.y) for d in claimed], desk.to_render, settings.workers):
        send("fuse", mission.id, run)
    return False
