"""One sequencer per mission: a lease that runs out, and an epoch that fences its former owner off."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from services.catalog.rows import clock, hold
from services.errors import LeaseLost
from services.tables import Lease

_NOBODY = ""


def acquire(tx: Session, mission_id: str, owner: str, ttl_s: float, now: float | None = None) -> int | None:
    """The new epoch when the mission was free or its lease had run out, else None.

    `owner` names one run of one process; whoever holds the lease does not get it a second time.
    """
    hold(tx, mission_id)
    now = clock(now)
    lease = _read(tx, mission_id)
    if lease is None:
        lease = Lease(mission_id=mission_id, owner=_NOBODY, epoch=0, expires_at=0.0)
        tx.add(lease)
    if lease.owner != _NOBODY and lease.expires_at > now:
        return None
    lease.owner, lease.epoch, lease.expires_at = owner, lease.epoch + 1, now + ttl_s
    return lease.epoch


def renew(
    tx: Session, mission_id: str, owner: str, epoch: int, ttl_s: float, now: float | None = None
) -> bool:
    """Hold on for another `ttl_s`; False when somebody else has taken over."""
    hold(tx, mission_id)
    lease = _read(tx, mission_id)
    if lease is None or (lease.owner, lease.epoch) != (owner, epoch):
        return False
    lease.expires_at = clock(now) + ttl_s
    return True


def release(tx: Session, mission_id: str, owner: str, epoch: int) -> None:
    """Let go, so that the next one need not wait; nothing happens when the lease is another's."""
    hold(tx, mission_id)
    lease = _read(tx, mission_id)
    if lease is not None and (lease.owner, lease.epoch) == (owner, epoch):
        lease.owner, lease.expires_at = _NOBODY, 0.0


def guard(tx: Session, mission_id: str, epoch: int) -> None:
    """Raise LeaseLost unless `epoch` is the present owner's; it stays so until this transaction ends.

    A lease that ran out while nobody took it still holds: only a newer epoch or a release ends it.
    """
    hold(tx, mission_id)
    lease = _read(tx, mission_id)
    if lease is None or lease.epoch != epoch or lease.owner == _NOBODY:
        raise LeaseLost()


def _read(tx: Session, mission_id: str) -> Lease | None:
    # The locked mission row keeps every other writer of the lease away.
    query = select(Lease).where(Lease.mission_id == mission_id).execution_options(populate_existing=True)
    return tx.scalars(query).one_or_none()
