"""What the services cannot do, in the one exception family of `core.errors`."""

from __future__ import annotations

from core.errors import OrthostreamError


class BadSettings(OrthostreamError):
    """A setting has a value that orthostream cannot work with."""

    code = "bad_settings"


class NotFound(OrthostreamError):
    """There is nothing here under that name."""

    code = "not_found"


class MissionNotFound(NotFound):
    """There is no such mission, or it was deleted."""

    code = "mission_not_found"


class FrameNotFound(NotFound):
    """The mission has no such frame."""

    code = "frame_not_found"


class ObjectNotFound(NotFound):
    """The object store has nothing under that key."""

    code = "object_not_found"


class BadKey(OrthostreamError):
    """An object's key holds letters, digits, '.', '_', '-' and '/' only, and no part begins with a dot."""

    code = "bad_key"


class OutOfDisk(OrthostreamError):
    """The disk of the object store is full. Free some space, then upload again: nothing was lost."""

    code = "out_of_disk"


class LeaseLost(OrthostreamError):
    """Another worker owns the mission by now; what this one wanted to write was not written."""

    code = "lease_lost"


class RevisionConflict(OrthostreamError):
    """The mission was published by somebody else in between; nothing was written. Read again and retry."""

    code = "revision_conflict"
