"""What waits to be handled by a node's main thread: bounded, and the oldest is dropped where it does not keep up."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

__all__ = ["Inbox", "ListLine", "Received"]


@dataclass(frozen=True, slots=True)
class Received:
    """A message that arrived, with its session header if there was one; `arrival` on the monotonic clock [s]."""

    data: bytes
    header: bytes | None
    arrival: float


@dataclass(frozen=True, slots=True)
class ListLine:
    """An own list as text; `arrival` on the monotonic clock [s]."""

    text: bytes
    arrival: float


class Inbox:
    """Two queues, filled by other threads: messages and own lists.

    Args:
        messages: that wait at most.
        lists: that wait at most.
    """

    def __init__(self, messages: int = 512, lists: int = 2) -> None:
        self._ready = threading.Condition()
        self._messages: deque[Received] = deque(maxlen=messages)
        self._lists: deque[ListLine] = deque(maxlen=lists)
        self._dropped = {"messages": 0, "lists": 0}
        self._ended = False

    def put(self, item: Received | ListLine) -> None:
        """Add to the queue of its kind; drops the oldest of it if it is full."""
        with self._ready:
            if isinstance(item, Received):
                self._dropped["messages"] += len(self._messages) == self._messages.maxlen
                self._messages.append(item)
            else:
                self._dropped["lists"] += len(self._lists) == self._lists.maxlen
                self._lists.append(item)
            self._ready.notify()

    def end(self) -> None:
        """There will be no more own lists."""
        with self._ready:
            self._ended = True
            self._ready.notify()

    def take(self, timeout: float) -> tuple[list[Received], ListLine | None, bool]:
        """All messages that wait, and the next own list, waiting for either.

        Args:
            timeout: how long to wait at most [s].

        Returns:
            The messages, the list or None, and whether that was the last one.
        """
        with self._ready:
            self._ready.wait_for(lambda: self._messages or self._lists or self._ended, timeout)
            messages = list(self._messages)
            self._messages.clear()
            line = self._lists.popleft() if self._lists else None
            return messages, line, self._ended and not self._lists

    def take_dropped(self) -> dict[str, int]:
        """How many were dropped since the last call, by queue."""
        with self._ready:
            dropped, self._dropped = self._dropped, dict.fromkeys(self._dropped, 0)
            return dropped
