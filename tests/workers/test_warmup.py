"""Warming up before the fork: the first photos find everything compiled and loaded."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
from workers import warmup

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        for value in vars(module).values() if name.startswith("core") else ():
            if hasattr(value, "nopython_signatures"):
                found[value.__module__, value.__name__] = len(value.nopython_signatures)
    return found

warmup.rendering()
warmup.solving()
before = compiled()
from tests.core.test_flights_rendered import SMALL, drawn
assert len(drawn(SMALL).map().layout.frames) == 16
late = [key for key, versions in compiled().items() if versions > before.get(key, 0)]
assert not late, late
print(sum(versions > 0 for versions in before.values()))
"""


def test_after_warming_up_a_mission_compiles_and_loads_nothing_more() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 20
