"""Holding a mission: a thread renews the lease while its owner works."""

from __future__ import annotations

import os
import platform
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

from services.catalog import leases
from services.database import Database


@contextmanager
def held(db: Database, mission_id: str, ttl_s: float) -> Iterator[int | None]:
    """The epoch under which the block may write, None when another owner is at work.

    Nothing depends on the renewals for safety: writes are guarded by the epoch. They keep others from
    taking over work that is still going on.
    """
    owner = f"{platform.node()}:{os.getpid()}:{uuid.uuid4().hex[:8]}"
    with db.write() as tx:
        epoch = leases.acquire(tx, mission_id, owner, ttl_s)
    if epoch is None:
        yield None
        return
    done = threading.Event()

    def renew() -> None:
        while not done.wait(ttl_s / 3):
            with db.write() as tx:
                if not leases.renew(tx, mission_id, owner, epoch, ttl_s):
                    return

    thread = threading.Thread(target=renew, name=f"lease of {mission_id}", daemon=True)
    thread.start()
    try:
        yield epoch
    finally:
        done.set()
        thread.join()
        with db.write() as tx:
            leases.release(tx, mission_id, owner, epoch)
