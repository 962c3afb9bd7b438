"""The whole map as it was at a revision, on every database."""

from __future__ import annotations

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from services.catalog import missions, tiles
from services.catalog.tiles import Key, Render
from services.database import Database

SMALL = st.tuples(st.integers(3, 4), st.integers(0, 2), st.integers(0, 2))
PUBLICATIONS = st.lists(
    st.dictionaries(SMALL, st.one_of(st.none(), st.integers(0, 3)), min_size=1, max_size=6), max_size=6
)


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(PUBLICATIONS)
def test_a_revision_is_what_had_been_published_by_then(
    db: Database, publications: list[dict[Key, int | None]]
) -> None:
    with db.write() as tx:
        mission_id = missions.create(tx, "grows").id
        other = missions.create(tx, "another").id
        tiles.publish(tx, other, 0, [Render((3, 0, 0), 1, "other", "e", "image/jpeg", 1)], [])
    shown: dict[Key, str] = {}
    history = {0: dict(shown)}
    for publication in publications:
        changes = [
            Render(key, 1) if what is None else Render(key, 1, f"tile-{what}", str(what), "image/webp", 9)
            for key, what in publication.items()
        ]
        with db.write() as tx:
            now = missions.get(tx, mission_id).revision
            revision = tiles.publish(tx, mission_id, now, changes, [])
        for change in changes:
            shown.pop(change.key, None)
            if change.object_key is not None:
                shown[change.key] = change.object_key
        history[revision] = dict(shown)
    with db.read() as tx:
        for revision, then in history.items():
            found = tiles.at(tx, mission_id, revision)
            assert {t.key: t.object_key for t in found} == then
            assert [t.key for t in found] == sorted(then)
