"""Which connected map each frame is part of: kept up to date with every photo that is added."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping

from core.geometry import Pose
from core.mosaic import Layout

Home = int | str


class Homes(Mapping[str, Home]):
    """Frame id → its map, of all frames that a layout places or has waiting; one that ties to nothing is a
    map of its own, called by its id.

    The frames of that layout stay as they are; `grow` takes in further ones.
    """

    def __init__(self, layout: Layout | None, located: Collection[str]) -> None:
        """`located`: the frames that have GPS, as of now and whenever it grows."""
        self.layout = layout
        self.located = 0
        """How many of the frames have GPS."""
        self._all_located = located
        self._of: dict[str, Home] = {}
        self._sizes = Counter[Home]()
        for frame_id in (*layout.frames, *layout.waiting) if layout else ():
            self._look_up(frame_id)

    def __getitem__(self, frame_id: str) -> Home:
        """Raises KeyError."""
        return self._of[frame_id]

    def __iter__(self) -> Iterator[str]:
        """The ids, in no order."""
        return iter(self._of)

    def __len__(self) -> int:
        """How many frames."""
        return len(self._of)

    @property
    def maps(self) -> int:
        """How many maps there are."""
        return len(self._sizes)

    def grow(self, layout: Layout, new_ids: Collection[str]) -> None:
        """Take in the frames `new_ids` of the layout."""
        self.layout = layout
        for frame_id in new_ids:
            self._look_up(frame_id)

    def _look_up(self, frame_id: str) -> None:
        if frame_id in self._of:
            self._leave(frame_id)
        assert self.layout is not None
        if frame_id in self.layout.frames:
            self._enter(frame_id, self.layout.frames[frame_id].pose)
        elif frame_id in self.layout.waiting:
            self._enter(frame_id, self.layout.waiting[frame_id])

    def _enter(self, frame_id: str, pose: Pose | None) -> None:
        home = frame_id if pose is None or pose.source == "gnss" else pose.submap
        self._of[frame_id] = home
        self._sizes[home] += 1
        self.located += frame_id in self._all_located

    def _leave(self, frame_id: str) -> None:
        home = self._of.pop(frame_id)
        self._sizes[home] -= 1
        if not self._sizes[home]:
            del self._sizes[home]
        self.located -= frame_id in self._all_located
