"""Before anything else is imported."""

import os
import signal

# as in every process of the program: threads of one that wait for each other's cores cost more than they give
for library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# What ignores Ctrl-C hands that on to all it starts, and a shell's background jobs do: tests press it.
signal.signal(signal.SIGINT, signal.default_int_handler)
