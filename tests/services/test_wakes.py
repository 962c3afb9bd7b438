"""Few wake-ups, none missed. On every backend."""

from __future__ import annotations

from core.frame import FrameMeta
from services.catalog import backlog, frames, pairs
from services.catalog.pairs import PairResult
from services.database import Database

META = FrameMeta(4000, 3000, drone="a")
CALM_S = 0.5


def arrive(db: Database, mission_id: str, names: str) -> None:
    for name in names:
        with db.write() as tx:
            frames.receive(tx, mission_id, name, name, 10, "image/jpeg", 4000, 3000, now=1.0)
            frames.mark_ready(tx, mission_id, name, META, 1.0)


def match(db: Database, mission_id: str, name: str, at: float, workers: int = 0) -> bool:
    """Whether the sequencer is woken."""
    with db.write() as tx:
        frames.mark_matched(tx, mission_id, name, at)
        return backlog.is_news(tx, mission_id, name, CALM_S, workers)


def test_of_many_frames_matched_at_once_the_first_wakes_and_the_last(db: Database, mission_id: str) -> None:
    arrive(db, mission_id, "abcde")
    woken = [match(db, mission_id, name, 10.0 + 0.1 * k) for k, name in enumerate("abcd")]
    assert woken == [True, False, False, False]
    assert match(db, mission_id, "e", 10.49)  # nobody comes after it who could wake for it


def test_the_frame_after_which_some_workers_have_nothing_to_read_wakes(db: Database, mission_id: str) -> None:
    arrive(db, mission_id, "abcdefg")
    woken = [match(db, mission_id, name, 10.0 + 0.05 * k, workers=2) for k, name in enumerate("abcdefg")]
    assert woken == [True, False, False, False, True, False, True]


def test_a_wake_up_that_was_lost_is_made_up_for_within_moments(db: Database, mission_id: str) -> None:
    arrive(db, mission_id, "abcdefgh")
    times = {name: 10.0 + 0.2 * k for k, name in enumerate("abcdefg")}
    woken = {int(at // CALM_S) for name, at in times.items() if match(db, mission_id, name, at)}
    assert woken == {int(at // CALM_S) for at in times.values()}


def test_a_frame_that_finds_the_others_placed_wakes(db: Database, mission_id: str) -> None:
    arrive(db, mission_id, "abc")
    assert match(db, mission_id, "a", 10.0)
    with db.write() as tx:
        frames.mark_posed(tx, mission_id, ["a"], 10.1)
    assert match(db, mission_id, "b", 10.2)


def test_pairs_with_a_result_are_counted(db: Database, mission_id: str) -> None:
    with db.write() as tx:
        assert pairs.computed(tx, mission_id) == 0
        pairs.claim(tx, mission_id, None, [("a", "b"), ("a", "c"), ("b", "c")])
        assert pairs.computed(tx, mission_id) == 0
        for key in (("a", "b"), ("b", "c"), ("a", "b")):
            pairs.record(tx, mission_id, [PairResult(*key, False, "no_common_turn", 0, {}, None)])
        assert pairs.computed(tx, mission_id) == 2
