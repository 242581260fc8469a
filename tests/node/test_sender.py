"""Which messages of a sender are new; times in seconds, all by hand."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.node.sender import Admission, DelayFloor, Sender
from cobevglue.node.session_header import SessionHeader

MAX_AGE, TAKEOVER = 0.5, 0.5
FIRST = 100  # session


def admit(sender: Sender, header: tuple[int, int] | None, time: float, now: float) -> Admission:
    return sender.admit(None if header is None else SessionHeader(*header), time, now, MAX_AGE, TAKEOVER)


def sender_after(number: int, headers: bool = True) -> Sender:
    """A sender whose messages 0 to `number` arrived; message k is of second 0.1 k, and arrives at 1000 + 0.1 k."""
    sender = Sender(SessionHeader(FIRST, 0) if headers else None, 0.0, 1000.0)
    for k in range(1, number + 1):
        assert admit(sender, (FIRST, k) if headers else None, 0.1 * k, 1000.0 + 0.1 * k) == Admission()
    return sender


@pytest.mark.parametrize(
    ("header", "time", "arrival", "expected", "why"),
    [
        ((FIRST, 11), 1.1, 1.1, Admission(), "the next one"),
        ((FIRST, 14), 1.4, 1.4, Admission(), "three were lost"),
        ((FIRST, 10), 1.0, 1.1, Admission("duplicate"), "the last one again"),
        ((FIRST, 7), 0.7, 1.1, Admission("duplicate"), "an earlier one again"),
        ((FIRST, 11), 1.0, 1.1, Admission("duplicate"), "the same list under another number"),
        ((FIRST, 11), 1.0 + 1e-9, 1.1, Admission("duplicate"), "too near to be another list"),
        ((FIRST, 11), 1.1, 1.4, Admission(), "0.3 s later than the fastest"),
        ((FIRST, 11), 1.1, 1.7, Admission("late"), "0.6 s later than the fastest"),
        ((FIRST, 11), -50.0, 1.1, Admission(starts_anew="its clock was set"), "its clock was set back"),
        ((FIRST, 11), 50.0, 1.1, Admission(starts_anew="its clock was set"), "its clock was set forward"),
        ((FIRST - 1, 999), 1.1, 1.1, Admission("old session"), "of an earlier run"),
        ((FIRST - 1, 999), 9.1, 9.1, Admission("old session"), "even after a silence"),
        ((FIRST + 1, 0), 1.1, 1.1, Admission("second agent"), "another run while this one goes on"),
        ((FIRST + 1, 0), 2.0, 2.0, Admission(starts_anew="restarted"), "another run after a silence"),
        (None, 2.0, 2.0, Admission("old session"), "without a header, from one that sends headers"),
    ],
)
def test_message_after_ten(
    header: tuple[int, int] | None, time: float, arrival: float, expected: Admission, why: str
) -> None:
    assert admit(sender_after(10), header, time, 1000.0 + arrival) == expected, why


@pytest.mark.parametrize(
    ("time", "arrival", "expected"),
    [
        (1.1, 1.1, Admission()),
        (1.0, 1.1, Admission("duplicate")),
        (0.5, 1.1, Admission("out of order")),
        (1.1, 1.9, Admission("late")),
    ],
)
def test_without_headers_time_stamps_order(time: float, arrival: float, expected: Admission) -> None:
    assert admit(sender_after(10, headers=False), None, time, 1000.0 + arrival) == expected


def test_overtaken_message_is_out_of_order_once() -> None:
    sender = sender_after(10)
    assert admit(sender, (FIRST, 13), 1.3, 1001.3).refused == ""
    assert sender.lost == 2
    assert admit(sender, (FIRST, 12), 1.2, 1001.3).refused == "out of order"
    assert admit(sender, (FIRST, 12), 1.2, 1001.4).refused == "duplicate"
    assert sender.lost == 1


def test_backlog_after_a_stall_is_late() -> None:
    sender = sender_after(10)
    refused = [admit(sender, (FIRST, k), 0.1 * k, 1004.0).refused for k in range(11, 41)]
    assert refused[:20] == ["late"] * 20
    assert refused[-3:] == ["", "", ""]


def test_old_session_stays_refused_after_restart() -> None:
    sender = sender_after(10)
    admit(sender, (FIRST + 1, 0), 5.0, 1005.0)
    assert admit(sender, (FIRST, 11), 1.1, 1005.1).refused == "old session"
    assert admit(sender, (FIRST + 1, 1), 5.1, 1005.1) == Admission()


def test_two_agents_with_one_id_are_noticed() -> None:
    sender = sender_after(10)
    noticed = []
    for k in range(11, 40):
        now = 1000.0 + 0.1 * k
        assert admit(sender, (FIRST, k), 0.1 * k, now) == Admission()
        assert admit(sender, (FIRST + 7, k), 0.1 * k, now).refused == "second agent"
        noticed.append(sender.two_agents(now))
    assert not noticed[5], "stragglers of another session are no second agent"
    assert noticed[-1]
    assert not sender.two_agents(1000.0 + 0.1 * k + 2.0), "it went"


def test_replay_is_no_second_agent() -> None:
    sender = sender_after(10)
    for k in range(11, 40):
        now = 1000.0 + 0.1 * k
        admit(sender, (FIRST, k), 0.1 * k, now)
        admit(sender, (FIRST - 5, 3), 0.3, now)  # the same old message again and again
    assert not sender.two_agents(now)


def test_clock_drift_is_not_taken_for_delay() -> None:
    sender, refused = sender_after(0), set()
    for k in range(1, 40_000):  # the sender's clock is slow by 0.1 %, in 4,000 s by 4 s
        refused.add(admit(sender, (FIRST, k), 0.0999 * k, 1000.0 + 0.1 * k).refused)
    assert refused == {""}


def test_delay_floor_forgets_after_a_minute() -> None:
    floor = DelayFloor()
    assert floor.shortest == math.inf
    assert floor.excess(1.0, 0.0) == 0.0
    assert floor.excess(1.5, 29.0) == 0.5
    assert floor.excess(1.5, 59.0) == 0.5
    assert floor.excess(1.5, 91.0) == 0.0


@given(st.lists(st.tuples(st.integers(1, 3), st.integers(0, 30), st.floats(0.0, 1.0)), max_size=60))
def test_admitted_messages_only_go_forward(deliveries: list[tuple[int, int, float]]) -> None:
    """Whatever arrives when: admitted messages grow by session, and in a session by number."""
    sender, last, now = Sender(SessionHeader(1, 0), 0.0, 0.0), (1, 0), 0.0
    for session, sequence, wait in deliveries:
        now += wait
        if not admit(sender, (session, sequence), 100.0 * session + 0.1 * sequence, now).refused:
            assert (session, sequence) > last
            last = session, sequence
        assert sender.lost >= 0
