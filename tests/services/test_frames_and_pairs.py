"""Frames come in once and move forward only; pairs are computed once and never missed. On every backend."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Any

import pytest

from core.errors import EmptyFile
from core.frame import FrameMeta, GpsFix
from services.catalog import events, frames, missions, pairs
from services.catalog.frames import Attempt, Upload
from services.catalog.pairs import PairResult
from services.catalog.standstill import stalled
from services.catalog.wakes import Wake
from services.database import Database
from services.errors import FrameNotFound, MissionNotFound

Race = Callable[[int, Callable[[int], Any]], list[Any]]
META = FrameMeta(4000, 3000, f_px=3000.5, captured_s=12.25, gps=GpsFix(47.0, 9.0, 500.0), drone="a")


def receive(
    db: Database, mission_id: str, frame_id: str, now: float = 1.0, name: str = ""
) -> tuple[Upload, bool]:
    with db.write() as tx:
        return frames.receive(
            tx, mission_id, frame_id, name or f"{frame_id}.jpg", 10, "image/jpeg", 4000, 3000, now=now
        )


def advance(db: Database, mission_id: str, frame_id: str, to: str, now: float = 1.0) -> None:
    receive(db, mission_id, frame_id, now)
    with db.write() as tx:
        frames.mark_ready(tx, mission_id, frame_id, META, now)
        if to in ("matched", "posed"):
            frames.mark_matched(tx, mission_id, frame_id, now)
        if to == "posed":
            frames.mark_posed(tx, mission_id, [frame_id], now)


def state(db: Database, mission_id: str, frame_id: str) -> str:
    with db.read() as tx:
        return frames.get(tx, mission_id, frame_id).state


class TestReceiving:
    def test_the_same_photo_twice_is_one_row(self, db: Database, mission_id: str) -> None:
        first, created = receive(db, mission_id, "f", now=1.0)
        again, created_again = receive(db, mission_id, "f", now=2.0, name="copy of f.jpg")
        assert (created, created_again) == (True, False)
        assert again.frame_id == first.frame_id
        with db.read() as tx:
            assert [(f.name, f.received_at) for f in frames.list(tx, mission_id)] == [("f.jpg", 1.0)]

    def test_of_many_uploads_of_one_photo_at_once_one_creates_it(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        assert sum(race(6, lambda _: receive(db, mission_id, "f")[1])) == 1

    def test_another_mission_may_have_the_same_photo(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            other = missions.create(tx, "other").id
        assert receive(db, mission_id, "f")[1]
        assert receive(db, other, "f")[1]

    def test_an_unknown_mission_takes_nothing(self, db: Database) -> None:
        with pytest.raises(MissionNotFound):
            receive(db, "nowhere", "f")

    def test_names_that_no_database_stores_are_cleaned(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "f", name="a\x00b\ud800.jpg")
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
        assert frame.name == "ab?.jpg"

    def test_a_refused_upload_is_remembered_with_its_reason(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            frame = frames.record_rejected_upload(tx, mission_id, "f", "empty.jpg", 0, EmptyFile())
        assert (frame.state, frame.reason_code, frame.name) == ("rejected", "empty_file", "empty.jpg")
        assert frame.reason is not None
        assert "0 bytes" in frame.reason
        with db.read() as tx:
            assert frames.sightings(tx, mission_id) == []


class TestStates:
    def test_the_way_of_a_frame(self, db: Database, mission_id: str) -> None:
        advance(db, mission_id, "f", "posed", now=5.0)
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
            (seen,) = frames.sightings(tx, mission_id)
            kinds = [e.payload["state"] for e in events.since(tx, mission_id, 0) if e.kind == "frame"]
        assert (frame.state, frame.ready_at, frame.matched_at, frame.posed_at) == ("posed", 5.0, 5.0, 5.0)
        assert seen.meta == META
        assert kinds == ["received", "ready", "matched", "posed"]

    def test_a_late_second_run_changes_nothing(self, db: Database, mission_id: str) -> None:
        advance(db, mission_id, "f", "posed", now=5.0)
        with db.write() as tx:
            before = missions.get(tx, mission_id).event_seq
            assert not frames.mark_ready(tx, mission_id, "f", FrameMeta(1, 1), 9.0)
            assert not frames.mark_matched(tx, mission_id, "f", 9.0)
            assert not frames.mark_rejected(tx, mission_id, "f", "no", "no", 9.0)
            assert missions.get(tx, mission_id).event_seq == before
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
        assert (frame.state, frame.ready_at, frame.meta) == ("posed", 5.0, META.to_json())

    def test_steps_cannot_be_skipped(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "f")
        with db.write() as tx:
            assert not frames.mark_matched(tx, mission_id, "f")
            assert frames.mark_posed(tx, mission_id, ["f"]) == []
        assert state(db, mission_id, "f") == "received"

    def test_a_rejected_photo_stays_rejected(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "f")
        with db.write() as tx:
            assert frames.mark_rejected(tx, mission_id, "f", "truncated_image", "Copy it again.")
            assert not frames.mark_ready(tx, mission_id, "f", META)
            assert frames.mark_posed(tx, mission_id, ["f"]) == []
        assert state(db, mission_id, "f") == "rejected"

    def test_a_frame_that_waits_is_kept_with_its_pose_until_it_is_tied(
        self, db: Database, mission_id: str
    ) -> None:
        for frame_id in ("f", "g"):
            advance(db, mission_id, frame_id, "matched")
        island = {"submap": 3, "center": [1.5, 2.0, 60.0]}
        with db.write() as tx:
            assert frames.mark_waiting(tx, mission_id, {"g": None, "f": island}) == ["f", "g"]
            assert frames.mark_waiting(tx, mission_id, {"f": island}) == []
            assert frames.islands(tx, mission_id) == {"f": island, "g": None}
        with db.read() as tx:
            assert [s.state for s in frames.sightings(tx, mission_id)] == ["waiting"] * 2
            assert "kept" in (frames.get(tx, mission_id, "f").reason or "")
            assert missions.progress(tx, mission_id).idle
        with db.write() as tx:
            assert frames.mark_posed(tx, mission_id, ["f"]) == ["f"]
            assert frames.mark_unplaced(tx, mission_id, {"g": ("oblique", "It shows the sky.")}) == ["g"]
            assert frames.islands(tx, mission_id) == {}
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
        assert (frame.state, frame.reason_code, frame.island) == ("posed", None, None)

    def test_only_what_failed_for_our_reasons_is_tried_again(self, db: Database, mission_id: str) -> None:
        for frame_id, code in (("f", "internal"), ("g", "truncated_image")):
            receive(db, mission_id, frame_id)
            with db.write() as tx:
                frames.begin(tx, mission_id, frame_id)
                frames.mark_rejected(tx, mission_id, frame_id, code, "Why.")
        with db.write() as tx:
            assert [frames.retry(tx, mission_id, f) for f in ("f", "g", "f")] == [True, False, False]
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
        assert (frame.state, frame.reason, frame.attempts) == ("received", None, 0)
        assert state(db, mission_id, "g") == "rejected"

    def test_an_unplaced_frame_is_seen_and_may_be_posed_later(self, db: Database, mission_id: str) -> None:
        advance(db, mission_id, "f", "matched")
        with db.write() as tx:
            assert frames.mark_unplaced(tx, mission_id, {"f": ("not_placeable", "Nothing says where.")}) == [
                "f"
            ]
        with db.read() as tx:
            assert [s.state for s in frames.sightings(tx, mission_id)] == ["rejected"]
        with db.write() as tx:
            assert frames.mark_posed(tx, mission_id, ["f"]) == ["f"]
        with db.read() as tx:
            frame = frames.get(tx, mission_id, "f")
        assert (frame.state, frame.reason_code, frame.reason) == ("posed", None, None)

    def test_unknown_frames_are_told_apart_from_old_news(self, db: Database, mission_id: str) -> None:
        with pytest.raises(FrameNotFound), db.write() as tx:
            frames.mark_ready(tx, mission_id, "nobody", META)
        with pytest.raises(FrameNotFound), db.write() as tx:
            frames.begin(tx, mission_id, "nobody")

    def test_attempts_are_counted(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "f")
        for expected in (1, 2, 3):
            with db.write() as tx:
                assert frames.begin(tx, mission_id, "f") == Attempt(expected, 4000, 3000, None)
        advance(db, mission_id, "f", "ready")
        with db.write() as tx:
            assert frames.begin(tx, mission_id, "f") is None

    def test_pages_follow_the_order_of_arrival(self, db: Database, mission_id: str) -> None:
        for i, frame_id in enumerate(["c", "a", "b", "e", "d"]):
            receive(db, mission_id, frame_id, now=float(i // 2))
        seen: list[str] = []
        with db.read() as tx:
            while page := frames.list(tx, mission_id, limit=2, after=seen[-1] if seen else None):
                seen += [f.id for f in page]
            assert seen == ["a", "c", "b", "e", "d"]
            assert len(frames.list(tx, mission_id, state="received")) == 5
            assert frames.list(tx, mission_id, state="fused") == []


class TestStalled:
    def test_what_stood_still_is_found_once(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "a", now=0.0)
        advance(db, mission_id, "b", "ready", now=0.0)
        advance(db, mission_id, "c", "matched", now=0.0)
        advance(db, mission_id, "d", "matched", now=0.0)
        receive(db, mission_id, "new", now=95.0)
        wanted = {
            Wake("ingest", (mission_id, "a")),
            Wake("match", (mission_id, "b")),
            Wake("sequence", (mission_id,)),
        }
        with db.write() as tx:
            found = stalled(tx, 10.0, now=100.0)
        assert set(found) == wanted
        assert len(found) == len(wanted)
        with db.write() as tx:
            assert stalled(tx, 10.0, now=105.0) == []  # stamped
        with db.write() as tx:
            assert set(stalled(tx, 10.0, now=111.0)) == wanted | {Wake("ingest", (mission_id, "new"))}

    def test_sweeps_at_the_same_time_share_the_work(self, db: Database, mission_id: str, race: Race) -> None:
        for i in range(30):
            receive(db, mission_id, f"f{i:02}", now=float(i) / 100)

        def sweep(_: int) -> list[Wake]:
            with db.write() as tx:
                return list(stalled(tx, 10.0, now=100.0))

        found = [wake for some in race(4, sweep) for wake in some]
        assert len(found) == len(set(found)) == 30

    def test_a_long_queue_that_moves_is_left_alone(self, db: Database, mission_id: str) -> None:
        for i in range(10):
            receive(db, mission_id, f"f{i}", now=float(i))
        with db.write() as tx:  # the third was overtaken; those behind it have only not had their turn
            for frame_id in ("f0", "f1", "f9"):
                frames.mark_ready(tx, mission_id, frame_id, META, now=99.0)
        with db.write() as tx:
            woken = {w.args[1] for w in stalled(tx, 5.0, now=100.0) if w.task == "ingest"}
        assert woken == {"f2", "f3"}

    def test_deleted_missions_sleep(self, db: Database, mission_id: str) -> None:
        receive(db, mission_id, "a", now=0.0)
        with db.write() as tx:
            missions.delete(tx, mission_id)
        with db.write() as tx:
            assert stalled(tx, 10.0, now=100.0) == []


IDS = [f"{i:032x}" for i in range(24)]


def result(low: str, high: str, accepted: bool = True, matches: bytes = b"m") -> PairResult:
    return PairResult(
        low, high, accepted, "ok" if accepted else "too_few_inliers", 50, {"final": 50}, matches
    )


class TestPairs:
    def test_of_many_claims_of_the_same_pairs_each_is_won_once(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        every = list(combinations(IDS, 2))

        def claim(i: int) -> list[pairs.Key]:
            mine: list[pairs.Key] = []
            for start in range(0, len(every), 23):
                some = [p[::-1] if i % 2 else p for p in every[start : start + 23]]
                with db.write() as tx:
                    mine += pairs.claim(tx, mission_id, f"proposer {i}", some)
            return mine

        won = [pair for mine in race(5, claim) for pair in mine]
        assert sorted(won) == sorted(every)

    def test_neighbours_that_arrive_at_once_are_matched_exactly_once(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        """Ready first, then look: of two frames the later one to commit sees the other."""
        for frame_id in IDS[:8]:
            receive(db, mission_id, frame_id)

        def arrive(i: int) -> list[pairs.Key]:
            with db.write() as tx:
                frames.mark_ready(tx, mission_id, IDS[i], META)
            with db.read() as tx:
                others = [s.frame_id for s in frames.sightings(tx, mission_id)]
            with db.write() as tx:
                return list(pairs.claim(tx, mission_id, IDS[i], [(IDS[i], o) for o in others]))

        won = [pair for mine in race(8, arrive) for pair in mine]
        assert sorted(won) == sorted(combinations(IDS[:8], 2))

    def test_the_second_run_of_a_task_gets_its_unfinished_pairs_again(
        self, db: Database, mission_id: str
    ) -> None:
        a, b, c = IDS[:3]
        with db.write() as tx:
            assert pairs.claim(tx, mission_id, a, [(a, b), (c, a), (a, a)]) == [(a, b), (a, c)]
            pairs.record(tx, mission_id, [result(a, b)])
        with db.write() as tx:
            assert pairs.claim(tx, mission_id, a, [(a, b), (a, c)]) == [(a, c)]
            assert pairs.claim(tx, mission_id, b, [(b, a), (b, c)]) == [(b, c)]

    def test_the_final_solve_takes_over_what_nobody_finished(self, db: Database, mission_id: str) -> None:
        a, b, c = IDS[:3]
        with db.write() as tx:
            pairs.claim(tx, mission_id, a, [(a, b)])
            assert pairs.claim(tx, mission_id, None, [(a, b), (b, c)]) == [(a, b), (b, c)]

    def test_the_first_result_stays(self, db: Database, mission_id: str) -> None:
        a, b, c = IDS[:3]
        with db.write() as tx:
            pairs.claim(tx, mission_id, a, [(a, b)])
            pairs.record(tx, mission_id, [result(a, b, matches=b"first"), result(b, c, matches=b"unclaimed")])
            pairs.record(tx, mission_id, [result(a, b, matches=b"second")])
        with db.read() as tx:
            assert pairs.accepted(tx, mission_id) == [b"first", b"unclaimed"]

    def test_accepted_matches_come_sorted_and_by_frame(self, db: Database, mission_id: str) -> None:
        a, b, c, d = IDS[:4]
        results = [
            result(c, d, matches=b"cd"),
            result(a, b, matches=b"ab"),
            result(a, d, accepted=False),
            result(b, c, matches=b"bc"),
        ]
        with db.write() as tx:
            pairs.record(tx, mission_id, results)
            pairs.claim(tx, mission_id, a, [(a, c)])
        with db.read() as tx:
            assert pairs.accepted(tx, mission_id) == [b"ab", b"bc", b"cd"]
            assert pairs.accepted(tx, mission_id, [b]) == [b"ab", b"bc"]
            assert pairs.accepted(tx, mission_id, [b, a]) == [b"ab", b"bc"]
            assert pairs.accepted(tx, mission_id, []) == []
            assert pairs.keys(tx, mission_id, "claimed") == [(a, c)]
            assert len(pairs.keys(tx, mission_id)) == 5
            summary = pairs.summary(tx, mission_id)
        assert (summary.total, summary.done, summary.accepted) == (5, 4, 3)
        assert summary.reasons == {"ok": 3, "too_few_inliers": 1}

    def test_a_big_claim_is_one_call(self, db: Database, mission_id: str) -> None:
        every = [(f"{i:032x}", f"{j:032x}") for i, j in combinations(range(90), 2)]
        with db.write() as tx:
            assert pairs.claim(tx, mission_id, None, every) == every
            pairs.record(tx, mission_id, [result(*pair) for pair in every])
        with db.read() as tx:
            assert len(pairs.accepted(tx, mission_id, [i for p in every for i in p])) == len(every)
