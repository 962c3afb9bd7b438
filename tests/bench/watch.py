"""A process tree seen from outside: its memory, and the CPU seconds that each kind of process has spent."""

from __future__ import annotations

import subprocess
import time
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import psutil

LOOK_S, WEIGH_S = 0.1, 0.6
ENDS = ("broker", "api", "sequencer", "workers")


def label(process: psutil.Process) -> str:
    """What a process of the tree is, from its command line."""
    line = " ".join(process.cmdline())
    for word, name in (
        ("valkey", "broker"),
        ("uvicorn", "api"),
        ("sequence", "sequencer"),
        ("celery", "workers"),
        ("serve", "supervisor"),
    ):
        if word in line:
            return name
    return "cli"


@dataclass
class Watched:
    """`looks`: moments (seconds since the epoch) and the CPU seconds by kind of process until then.

    `weights`: moments and the megabytes (PSS) of each kind of process.
    """

    exit: int = 0
    peak_pss_mb: int = 0
    wall_s: float = 0.0
    looks: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    weights: list[tuple[float, dict[str, int]]] = field(default_factory=list)

    def cpu_s(self, since: float = 0.0, until: float = float("inf")) -> dict[str, float]:
        """CPU seconds by kind of process between two moments."""
        before, after = self._at(since), self._at(until)
        spent = {name: round(s - before.get(name, 0.0), 2) for name, s in after.items()}
        return spent | {"all": round(sum(spent.values()), 2)}

    def pss_mb(self, moment: float) -> dict[str, int]:
        """Megabytes by kind of process at a moment."""
        weighed = bisect_right(self.weights, moment, key=lambda w: w[0])
        return self.weights[max(weighed - 1, 0)][1] if self.weights else {}

    def _at(self, moment: float) -> dict[str, float]:
        seen = bisect_right(self.looks, moment, key=lambda look: look[0])
        return self.looks[seen - 1][1] if seen else {}


def watch(command: Sequence[str]) -> Watched:
    """Runs a command to its end and looks at its process tree meanwhile."""
    started, weighed = time.monotonic(), 0.0
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    seen, names, cpu = Watched(), dict[int, str](), dict[int, float]()
    root = psutil.Process(process.pid)
    while process.poll() is None:
        weigh = time.monotonic() - weighed > WEIGH_S
        weight = dict[str, float]()
        for member in _tree(root):
            try:
                times = member.cpu_times()
                cpu[member.pid] = times.user + times.system
                if names.get(member.pid) not in ENDS:  # a child is its parent's copy until it has begun
                    names[member.pid] = label(member)
                if weigh:
                    kind = names[member.pid]
                    weight[kind] = weight.get(kind, 0.0) + member.memory_full_info().pss / 1e6
            except psutil.NoSuchProcess:
                continue
        if weigh:
            weighed, seen.peak_pss_mb = time.monotonic(), max(seen.peak_pss_mb, round(sum(weight.values())))
            seen.weights.append((time.time(), {kind: round(mb) for kind, mb in sorted(weight.items())}))
        by_kind = dict[str, float]()
        for pid, seconds in cpu.items():
            by_kind[names.get(pid, "cli")] = by_kind.get(names.get(pid, "cli"), 0.0) + seconds
        seen.looks.append((time.time(), by_kind))
        time.sleep(LOOK_S)
    seen.exit, seen.wall_s = process.returncode, round(time.monotonic() - started, 1)
    return seen


def _tree(root: psutil.Process) -> list[psutil.Process]:
    try:
        return [root, *root.children(recursive=True)]
    except psutil.NoSuchProcess:
        return []
