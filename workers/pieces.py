"""One mosaic drawn by all workers of a machine that have nothing more urgent to do, piece by piece.

The kernel forgets the claims of a process that dies, and the pieces that it has drawn stay.
"""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import disk_usage, rmtree
from typing import BinaryIO

from core.cog import MosaicPlan
from core.fusion import Photos
from services.errors import OutOfDisk

SLICE_S = 2.0
"""Who helps looks up after this time: a photo may have come, and goes first."""
_LOOK_S = 0.02


@contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Whether nobody else on this machine is inside such a block with the same path right now."""
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True


def check_room(folder: Path, min_free_bytes: int) -> None:
    """Raises OutOfDisk when what the disk must have left for photos and database has been reached."""
    if disk_usage(folder).free < min_free_bytes:
        raise OutOfDisk


@dataclass(frozen=True, slots=True)
class SharedMosaic:
    """A mosaic of whose plan every helper makes up the same. `folder`: of its own, next to its claims.

    `min_free_bytes`: what drawing leaves free on its disk, or raises OutOfDisk.
    """

    plan: MosaicPlan
    photos: Photos
    folder: Path
    hands: int
    min_free_bytes: int = 0

    def begin(self) -> None:
        """From now on others can help, beginning with what somebody has drawn who was killed."""
        self.forget(but=self.folder)
        self.folder.mkdir(exist_ok=True)

    def write(self, path: Path, crs: str | None) -> None:
        """Draw what nobody else draws, wait for the rest, and put the file together at `path`."""
        while self.lend_a_hand():
            time.sleep(_LOOK_S)  # others are at the last pieces, or died there
        self.plan.assemble(self.folder, path, crs)

    def lend_a_hand(self, for_s: float = float("inf")) -> bool:
        """Draw free pieces, for about `for_s` seconds. Whether there is still something to do."""
        until = time.monotonic() + for_s
        pieces = self.plan.pieces()
        with self._claims().open("wb") as claims:
            # Who begins far from the others decodes other photos than they do.
            place = next((k for k in range(self.hands) if _claimed(claims, len(pieces) + k)), 0)
            start = place * len(pieces) // self.hands
            for k in [*range(start, len(pieces)), *range(start)]:
                if time.monotonic() > until or not self.folder.is_dir():
                    break
                if not self.plan.is_drawn(pieces[k], self.folder) and _claimed(claims, k):
                    self._draw(k)
        return self.folder.is_dir() and not all(self.plan.is_drawn(p, self.folder) for p in pieces)

    def _draw(self, k: int) -> None:
        piece = self.plan.pieces()[k]
        check_room(self.folder.parent, self.min_free_bytes)
        if not self.plan.is_drawn(piece, self.folder):  # by whoever had the claim a moment ago
            self.plan.draw(piece, self.photos, self.folder)

    def _claims(self) -> Path:
        return self.folder.with_suffix(".claims")

    def forget(self, but: Path | None = None) -> None:
        """Remove what was drawn for this file, also from other poses by somebody who was killed."""
        for folder in self.folder.parent.glob(f"{self.folder.stem}.*"):
            if folder.is_dir() and folder != but:
                rmtree(folder, ignore_errors=True)


def _claimed(claims: BinaryIO, number: int) -> bool:
    """Whether this process holds claim `number` from now until the file is closed."""
    try:
        fcntl.lockf(claims, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, number)
    except BlockingIOError:
        return False
    return True
