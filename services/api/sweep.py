"""The sweep: wakes what has stood still, removes what was deleted. One thread in every API process."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import structlog

from services.catalog import missions, standstill
from services.database import Database
from services.export_names import MAKING
from services.queue import PRIORITIES
from services.settings import Settings
from services.storage import ObjectStore

log = structlog.get_logger(__name__)

_LEFTOVER_S = 6 * 3600.0


class Sweep:
    """Runs every `settings.sweep_s` from `start` to `stop`; what fails is tried again at the next turn."""

    def __init__(
        self, settings: Settings, db: Database, store: ObjectStore, send: Callable[..., Any], uploads: Path
    ) -> None:
        self._settings, self._db, self._store, self._send = settings, db, store, send
        self._uploads = uploads
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sweep", daemon=True)

    def start(self) -> None:
        """Begin; the first sweep comes at once, because what a crash left is waiting."""
        self._thread.start()

    def stop(self) -> None:
        """End within the sweep under way."""
        self._stop.set()
        self._thread.join(timeout=2)

    def once(self) -> None:
        """One sweep."""
        with self._db.write() as tx:
            stalled = standstill.stalled(tx, self._settings.stalled_after_s)
        for wake in stalled:
            # A file that was asked for long ago waits for no more photos, however many are still coming.
            first = {"priority": PRIORITIES["match"]} if wake.task == "export" else {}
            self._send(wake.task, *wake.args, **first)
        with self._db.read() as tx:
            deleted = missions.deleting(tx)
        for mission_id in deleted:
            self._store.delete_prefix(f"missions/{mission_id}/")
            for path in self._settings.exports_dir.glob(f"{mission_id}-*"):
                _remove(path)
            with self._db.write() as tx:
                missions.purge(tx, mission_id)
        self._remove_leftovers()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self.once()
            except (
                Exception
            ) as error:  # the next turn tries again; without the sweep a lost wake-up stays lost
                log.warning("sweep failed", error=f"{type(error).__name__}: {error}")
            self._stop.wait(self._settings.sweep_s)

    def _remove_leftovers(self) -> None:
        """Uploads and exports of a process that was killed: nobody makes one for hours."""
        oldest = time.time() - _LEFTOVER_S
        exports = self._settings.exports_dir.glob(f"{MAKING}*")
        for path in [*self._uploads.glob("upload-*"), *exports]:
            with suppress(FileNotFoundError):
                if path.stat().st_mtime < oldest:
                    _remove(path)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
