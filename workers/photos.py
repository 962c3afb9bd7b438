"""What this process keeps of photos and features, bounded by bytes; all of it can be made again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.decode import decode_to_draw
from core.errors import PhotoLost
from core.features import Features
from core.parts import WHOLE, Part, Share, Window, WindowOf
from services.errors import ObjectNotFound
from services.storage import ObjectStore
from workers.app import settings, store

Pixels = NDArray[np.uint8]


def photo_key(mission_id: str, frame_id: str) -> str:
    """Where a photo's bytes are in the store."""
    return f"missions/{mission_id}/photos/{frame_id}"


def features_key(mission_id: str, frame_id: str) -> str:
    """Where a photo's features are in the store."""
    return f"missions/{mission_id}/features/{frame_id}"


Likely = Callable[[str], Share]
"""The part of a frame's photo that the map will probably show."""


def _whole(frame_id: str) -> Share:
    return WHOLE


class BytesLru:
    """The values used last, as many as fit into `limit_bytes` (at least the newest one)."""

    def __init__(self, limit_bytes: int) -> None:
        """Starts empty."""
        self._limit_bytes = limit_bytes
        self._held: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self.held_bytes = 0

    def clear(self) -> None:
        """Forgets all: it can be made again."""
        self._held.clear()
        self.held_bytes = 0

    @property
    def room_bytes(self) -> int:
        """How much more there is room for without letting go of anything."""
        return max(0, self._limit_bytes - self.held_bytes)

    def forget(self, key: Hashable) -> None:
        """Lets go of one value."""
        self.held_bytes -= self._held.pop(key, (None, 0))[1]

    def get(self, key: Hashable, make: Callable[[], tuple[Any, int]]) -> Any:
        """The value under `key`, made by `make` (value, bytes) when it is not there."""
        if key in self._held:
            self._held.move_to_end(key)
            return self._held[key][0]
        value, size = make()
        self._held[key] = (value, size)
        self.held_bytes += size
        while self.held_bytes > self._limit_bytes and len(self._held) > 1:
            self.held_bytes -= self._held.popitem(last=False)[1][1]
        return value


@dataclass(frozen=True, slots=True)
class PhotoShelf:
    """All missions' photos as one process sees them."""

    store: ObjectStore
    pictures: BytesLru
    features: BytesLru
    words: BytesLru
    thumbs: BytesLru

    @classmethod
    def of(cls, store: ObjectStore, limit_bytes: int) -> PhotoShelf:
        """A shelf that holds about `limit_bytes`, most of it decoded photos."""
        small = limit_bytes // 16
        return cls(
            store, BytesLru(limit_bytes - 4 * small), BytesLru(small), BytesLru(2 * small), BytesLru(small)
        )

    def features_of(self, mission_id: str, frame_id: str) -> Features:
        """A frame's features. Raises ObjectNotFound."""
        key = features_key(mission_id, frame_id)

        def load() -> tuple[Features, int]:
            data = self.store.get(key)
            return Features.from_bytes(data), len(data)

        features: Features = self.features.get(key, load)
        return features

    def words_of(self, mission_id: str, frame_id: str) -> NDArray[np.float32]:
        """A frame's appearance vector. Raises ObjectNotFound."""

        def load() -> tuple[NDArray[np.float32], int]:
            words = self.features_of(mission_id, frame_id).words.copy()
            return words, words.nbytes

        words: NDArray[np.float32] = self.words.get((mission_id, frame_id), load)
        return words

    def thumb_of(self, mission_id: str, frame_id: str) -> Pixels:
        """A frame's thumbnail. Raises ObjectNotFound."""

        def load() -> tuple[Pixels, int]:
            thumb = self.features_of(mission_id, frame_id).thumb.copy()
            return thumb, thumb.nbytes

        thumb: Pixels = self.thumbs.get((mission_id, frame_id), load)
        return thumb

    def part_of(
        self, mission_id: str, frame_id: str, max_side: int | None, likely: Likely, window_of: WindowOf
    ) -> Part:
        """A part of a photo, at the mission's resolution, that holds the window. Raises ObjectNotFound.

        `likely`: what more is kept of it; all of it, while there is room.
        """
        key = photo_key(mission_id, frame_id)

        def load() -> tuple[Part, int]:
            def kept(width: int, height: int) -> Window:
                if 3 * width * height <= self.pictures.room_bytes:
                    return Window(0, 0, width, height)
                return window_of(width, height).joined(likely(frame_id).window(width, height))

            pixels, height = decode_to_draw(self.store.get(key), max_side, lambda *size: kept(*size).bottom)
            width = pixels.shape[1]
            part = Part(pixels, 0, 0, width, height).cut(kept(width, height))
            return part, part.pixels.nbytes

        part: Part = self.pictures.get((key, max_side), load)
        if not part.holds(window_of(part.width, part.height)):
            self.pictures.forget((key, max_side))
            part = self.pictures.get((key, max_side), load)
        return part


shelf = PhotoShelf.of(store, settings.photo_cache_bytes)
"""The one shelf of this process."""


class FileGone(PhotoLost):
    """A photo's file is gone from the storage."""

    def __init__(self, frame_id: str) -> None:
        """Whose."""
        super().__init__(f"The file of photo {frame_id} is gone from the storage. Upload it again.")
        self.frame_id = frame_id


@dataclass(frozen=True, slots=True)
class MissionPhotos:
    """One mission's photos as `core.parts` asks for them."""

    shelf: PhotoShelf
    mission_id: str
    max_side: int | None
    likely: Likely = _whole

    def photo(self, frame_id: str) -> Pixels:
        """See core.parts.Photos. Raises FileGone."""
        return self.part(frame_id, lambda width, height: Window(0, 0, width, height)).pixels

    def part(self, frame_id: str, window_of: WindowOf) -> Part:
        """See core.parts.Parts. Raises FileGone."""
        try:
            return self.shelf.part_of(self.mission_id, frame_id, self.max_side, self.likely, window_of)
        except ObjectNotFound as error:
            raise FileGone(frame_id) from error

    def thumb(self, frame_id: str) -> Pixels:
        """See core.parts.Photos."""
        return self.shelf.thumb_of(self.mission_id, frame_id)
