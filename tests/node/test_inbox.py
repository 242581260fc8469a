"""The bounded queues in front of a node, and the lines that fill one of them."""

from __future__ import annotations

import os
import threading
import time

import pytest

from cobevglue.node.inbox import Inbox, ListLine, Received
from cobevglue.node.lines import LONGEST_LINE, read_lines


def message(number: int) -> Received:
    return Received(bytes([number]), None, 0.0)


def test_messages_come_out_in_order() -> None:
    inbox = Inbox()
    for number in range(3):
        inbox.put(message(number))
    assert inbox.take(0.0) == ([message(0), message(1), message(2)], None, False)
    assert inbox.take(0.0) == ([], None, False)


def test_the_oldest_are_dropped_and_counted() -> None:
    inbox = Inbox(messages=2, lists=1)
    for number in range(5):
        inbox.put(message(number))
        inbox.put(ListLine(bytes([number]), 0.0))
    assert inbox.take(0.0) == ([message(3), message(4)], ListLine(b"\x04", 0.0), False)
    assert inbox.take_dropped() == {"messages": 3, "lists": 4}
    assert inbox.take_dropped() == {"messages": 0, "lists": 0}


def test_end_comes_after_the_last_list() -> None:
    inbox = Inbox()
    inbox.put(ListLine(b"1", 0.0))
    inbox.put(ListLine(b"2", 0.0))
    inbox.end()
    assert [inbox.take(0.0)[1:] for _ in range(2)] == [(ListLine(b"1", 0.0), False), (ListLine(b"2", 0.0), True)]


def test_taking_waits_for_another_thread() -> None:
    inbox = Inbox()
    threading.Timer(0.05, inbox.put, [message(1)]).start()
    assert inbox.take(30.0) == ([message(1)], None, False)


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        (b"", []),
        (b"a\nb\n", [b"a", b"b"]),
        (b"a\n\n  \r\nb", [b"a", b"b"]),
        (b"x" * (LONGEST_LINE + 200_000) + b"\nb\n", [b"b"]),
    ],
)
def test_lines_of_a_pipe(written: bytes, expected: list[bytes]) -> None:
    reading, writing = os.pipe()

    def write() -> None:
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(written)

    thread = threading.Thread(target=write)
    thread.start()
    lines = list(read_lines(reading, threading.Event()))
    thread.join()
    os.close(reading)
    if len(written) > LONGEST_LINE:
        assert lines[0] == b"x" * len(lines[0]), "the beginning, for the error message"
        assert len(lines[0]) < LONGEST_LINE + 100_000
        lines = lines[1:]
    assert lines == expected


def test_reading_ends_while_nothing_comes() -> None:
    reading, writing = os.pipe()
    stop = threading.Event()
    threading.Timer(0.05, stop.set).start()
    started = time.monotonic()
    assert list(read_lines(reading, stop)) == []
    assert time.monotonic() - started < 30.0
    os.close(reading)
    os.close(writing)
