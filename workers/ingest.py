"""A photo that arrived → its metadata and features, or the reason why it cannot be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from core.decode import decode_rgb
from core.errors import PhotoLost, RejectedFrame
from core.features import FEATURE_SIDE_PX, Features, extract
from core.frame import FrameMeta
from core.metadata import read_metadata
from core.vocabulary import looks
from services.catalog import frames
from services.catalog.frames import Attempt
from services.errors import ObjectNotFound, OutOfDisk
from services.queue import send
from workers.app import MAX_ATTEMPTS, Stopwatch, db, go_on, log, stage, store
from workers.photos import features_key, photo_key


class Unreadable(RejectedFrame):
    """The photo could not be read, several times over. Report it to orthostream, with the photo."""

    code = "internal"


@stage("ingest")
def ingest(mission_id: str, frame_id: str) -> None:
    """From received to ready or rejected."""
    clock = Stopwatch()
    with db.write(durable=False) as tx:
        attempt = frames.begin(tx, mission_id, frame_id)  # counts also those that end in a crash
    if attempt is None:
        with db.read() as tx:
            ready = frames.get(tx, mission_id, frame_id).state == "ready"
    else:
        ready = _read_in(mission_id, frame_id, attempt, clock)
    if ready:
        go_on("match", mission_id, frame_id)


def _read_in(mission_id: str, frame_id: str, attempt: Attempt, clock: Stopwatch) -> bool:
    """One attempt; whether the frame is ready now."""
    if attempt.number > MAX_ATTEMPTS:
        _put_off(mission_id, frame_id, attempt.number, Unreadable())
        return False
    try:
        with _uncounted(mission_id, frame_id):
            data = store.get(photo_key(mission_id, frame_id))
    except ObjectNotFound:
        _put_off(mission_id, frame_id, attempt.number, PhotoLost())
        return False
    try:
        meta, features = read(data, attempt)
    except Exception as error:
        _put_off(mission_id, frame_id, attempt.number, error)
        return False
    with _uncounted(mission_id, frame_id):
        store.put(features_key(mission_id, frame_id), features.to_bytes())
    with db.write(durable=False) as tx:
        if frames.mark_ready(tx, mission_id, frame_id, meta, looks=looks(features.words).tobytes()):
            clock.spend(tx, mission_id, "ingest")
    return True


@contextmanager
def _uncounted(mission_id: str, frame_id: str) -> Iterator[None]:
    """A store that is full or away is no fault of the photo's: it waits for as long as that takes."""
    try:
        yield
    except (OSError, OutOfDisk):
        with db.write() as tx:
            frames.forgive(tx, mission_id, frame_id)
        raise


def read(data: bytes, attempt: Attempt) -> tuple[FrameMeta, Features]:
    """All that is kept of a photo. Raises RejectedFrame."""
    meta = read_metadata(data, attempt, attempt.telemetry)
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
