"""A photo that arrived → its metadata and features, or the reason why it cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from core.decode import decode_rgb
from core.errors import PhotoLost, RejectedFrame
from core.features import FEATURE_SIDE_PX, Features, extract
from core.frame import FrameMeta
from core.metadata import read_metadata
from core.photo import probe
from services.catalog import frames
from services.errors import ObjectNotFound, OutOfDisk
from services.queue import send
from services.tables import Frame
from workers.app import MAX_ATTEMPTS, Stopwatch, db, go_on, log, settings, stage, store
from workers.photos import features_key, photo_key


class Unreadable(RejectedFrame):
    """The photo could not be read, several times over. Report it to orthostream, with the photo."""

    code = "internal"


@stage("ingest")
def ingest(mission_id: str, frame_id: str) -> None:
    """From received to ready or rejected."""
    clock = Stopwatch()
    with db.read() as tx:
        frame = frames.get(tx, mission_id, frame_id)
    if frame.state == "received":
        with db.write() as tx:
            attempts = frames.begin(tx, mission_id, frame_id)  # counts also those that end in a crash
        if attempts > MAX_ATTEMPTS:
            _put_off(mission_id, frame_id, attempts, Unreadable())
            return
        try:
            with _uncounted(mission_id, frame_id):
                data = store.get(photo_key(mission_id, frame_id))
        except ObjectNotFound:
            _put_off(mission_id, frame_id, attempts, PhotoLost())
            return
        try:
            meta, features = read(data, frame)
        except Exception as error:
            _put_off(mission_id, frame_id, attempts, error)
            return
        with _uncounted(mission_id, frame_id):
            store.put(features_key(mission_id, frame_id), features.to_bytes())
        with db.write() as tx:
            if frames.mark_ready(tx, mission_id, frame_id, meta):
                clock.spend(tx, mission_id, "ingest")
    elif frame.state != "ready":
        return
    go_on("match", mission_id, frame_id)


@contextmanager
def _uncounted(mission_id: str, frame_id: str) -> Iterator[None]:
    """A store that is full or away is no fault of the photo's: it waits for as long as that takes."""
    try:
        yield
    except (OSError, OutOfDisk):
        with db.write() as tx:
            frames.forgive(tx, mission_id, frame_id)
        raise


def read(data: bytes, frame: Frame) -> tuple[FrameMeta, Features]:
    """All that is kept of a photo. Raises RejectedFrame."""
    meta = read_metadata(data, probe(data, settings.photo_limits), frame.telemetry)
    rgb = decode_rgb(data, FEATURE_SIDE_PX)
    return meta, extract(rgb, (meta.width, meta.height))


def _put_off(mission_id: str, frame_id: str, attempts: int, error: Exception) -> None:
    """Rejects what is wrong with the photo at once, what is wrong with us after a few attempts."""
    if not isinstance(error, RejectedFrame) and attempts < MAX_ATTEMPTS:
        log.warning("photo not read", frame=frame_id, attempt=attempts, exc_info=error)
        send("ingest", mission_id, frame_id)
        return
    reason = error if isinstance(error, RejectedFrame) else Unreadable(f"{Unreadable.__doc__} ({error})")
    with db.write() as tx:
        frames.mark_rejected(tx, mission_id, frame_id, reason.code, str(reason))
    send("sequence", mission_id)  # it may be what a mission to be finished waits for
