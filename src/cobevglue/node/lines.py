"""Lines of a stream that may be a pipe, a file or a terminal, until it ends or one no longer wants them."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Iterator

__all__ = ["LONGEST_LINE", "read_lines"]

LONGEST_LINE = 4 << 20
"""A longer line [bytes] is no object list; its beginning is handed out as it is, and the rest is skipped."""


def read_lines(descriptor: int, stop: threading.Event) -> Iterator[bytes]:
    """The lines, without their line breaks and without empty ones.

    Unlike a loop over `sys.stdin` it can be ended while it waits: a thread that hangs in a read would hold its lock
    when the program ends.

    Args:
        descriptor: of the stream.
        stop: end when this is set.
    """
    rest, skipping = b"", False
    while not stop.is_set():
        if not select.select([descriptor], [], [], 0.1)[0]:
            continue
        chunk = os.read(descriptor, 1 << 16)
        if not chunk:
            break
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            if line.strip() and not skipping:
                yield line
            skipping = False
        if len(rest) > LONGEST_LINE:
            if not skipping:
                yield rest
            rest, skipping = b"", True
    if rest.strip() and not skipping and not stop.is_set():
        yield rest
