"""What a global solve needs of the photos is kept: the next one reads none of them again."""

from __future__ import annotations

from typing import Any

import pytest

from services.catalog import missions


def test_a_second_solve_reads_no_photos_features(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = bench.modules["sequence"]
    bench.upload(photos)
    bench.drain()
    with bench.db.read() as tx:
        mission = missions.get(tx, bench.mission_id)
    known, solving = sequence._known[bench.mission_id], sequence.solving

    def gone(*_: Any) -> None:
        raise AssertionError("a features file was read again")

    first = solving.laid_out(mission, known.camera_keys, solving.again(mission, known)[0])
    monkeypatch.setattr(type(solving.shelf), "features_of", gone)
    again = solving.laid_out(mission, known.camera_keys, solving.again(mission, known)[0])
    assert again.frames.keys() == first.frames.keys() == set(known.seen)
    assert {k: f.gain for k, f in again.frames.items()} == {k: f.gain for k, f in first.frames.items()}
    held = solving._glances.held_bytes
    assert held / len(solving._glances._held) < 4096
