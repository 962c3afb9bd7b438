"""Before anything else is imported."""

import os

# as in every process of the program: threads of one that wait for each other's cores cost more than they give
for library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
