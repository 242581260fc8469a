"""Compiled kernels: one decorator for all numba functions of the package, with an on-disk cache that is never stale.

numba caches each function beside its source, in the user's cache folder, or in `NUMBA_CACHE_DIR`, and checks the time
stamp of the function's own file only. A function that was inlined from another file may change unnoticed. Here the
stamp is a hash of all files that define kernels, wherever the cache is.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numba

__all__ = ["KERNEL_FILES", "kernel"]

KERNEL_FILES = (
    "_iou_kernels.py",
    "alignment/absence.py",
    "alignment/evidence.py",
    "alignment/pose_filter.py",
    "alignment/pose_search.py",
    "alignment/track_motion.py",
)
"""The files that define kernels, relative to the package."""

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(error_model: Literal["python", "numpy"] = "python") -> Callable[[_Function], _Function]:
    """A decorator that compiles a function with numba on its first call and caches the machine code on disk.

    Where no folder is writable, the function is compiled in every process, and one warning says so.

    Args:
        error_model: numba's; "numpy" divides by zero without an exception.
    """

    def compiled(function: _Function) -> _Function:
        dispatcher: Any = numba.njit(error_model=error_model)(function)
        if dispatcher is function:  # NUMBA_DISABLE_JIT=1, for debuggers
            return function
        try:
            dispatcher.enable_caching()
        except RuntimeError:  # numba found no writable folder
            _warn_of_no_cache()
        else:
            dispatcher._cache._cache_file._source_stamp = _source_hash()
        return cast(_Function, dispatcher)

    return compiled


@cache
def _source_hash() -> str:
    package = Path(__file__).parent
    return hashlib.sha256(b"".join((package / name).read_bytes() for name in KERNEL_FILES)).hexdigest()


@cache
def _warn_of_no_cache() -> None:
    warnings.warn(
        f"no writable folder for compiled kernels ({Path(__file__).parent}, the user's cache folder): each process "
        "compiles them anew, some 20 s; set NUMBA_CACHE_DIR to a writable folder",
        RuntimeWarning,
        stacklevel=3,
    )
