"""Python compiled to machine code by numba, with the same options everywhere.

Kept on disk (`cache`), so that only the first start after an installation compiles; without the interpreter's
lock (`nogil`), so that the threads of a process render side by side; and dividing by zero as numpy does
(`error_model`): a check before every division would keep loops from becoming vector code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
T = TypeVar("T")


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """The same function in machine code, to the last bit as it is written.

    Compiled for each combination of argument types at its first call; numba's errors are raised then.
    """
    return cast(Callable[P, T], numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def compiled_loosely(function: Callable[P, T]) -> Callable[P, T]:
    """As `compiled`, but a product and a sum may be rounded once, where the processor can, not twice."""
    return cast(
        Callable[P, T],
        numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function),
    )
