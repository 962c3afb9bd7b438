"""What this process keeps of photos and features, bounded by bytes; all of it can be made again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.decode import decode_rgb
from core.errors import PhotoLost
from core.features import Features
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

    def picture_of(self, mission_id: str, frame_id: str, max_side: int | None) -> Pixels:
        """A photo decoded at the mission's resolution. Raises ObjectNotFound."""
        key = photo_key(mission_id, frame_id)

        def load() -> tuple[Pixels, int]:
            pixels = decode_rgb(self.store.get(key), max_side)
            return pixels, pixels.nbytes

        pixels: Pixels = self.pictures.get((key, max_side), load)
        return pixels


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
    """One mission's photos as `core.fusion` asks for them."""

    shelf: PhotoShelf
    mission_id: str
    max_side: int | None

    def photo(self, frame_id: str) -> Pixels:
        """See core.fusion.Photos. Raises FileGone."""
        try:
            return self.shelf.picture_of(self.mission_id, frame_id, self.max_side)
        except ObjectNotFound as error:
            raise FileGone(frame_id) from error

    def thumb(self, frame_id: str) -> Pixels:
        """See core.fusion.Photos."""
        return self.shelf.thumb_of(self.mission_id, frame_id)
