"""Whether a message of another agent is new: by its session and number, its time stamp, and when it arrived.

What a receiver knows of a sender, message by message. Nothing here depends on the clocks of the two being the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from cobevglue.node.session_header import SessionHeader

__all__ = ["SAME_INSTANT", "Admission", "DelayFloor", "Sender"]

_WINDOW = 64
"""Sequence numbers behind the newest that are known to have arrived or not."""
_FLOOR_PERIOD = 30.0
"""The shortest delay is that of the last 30 to 60 s, so that clocks may drift [s]."""
_CLOCK_JUMP = 1.0
"""A message that arrives so much earlier than its time stamp lets expect: the clock was set forward [s]."""
SAME_INSTANT = 1e-3
"""Lists whose time stamps differ by less are one [s]."""
_RIVAL_MESSAGES, _RIVAL_TIME = 5, 1.0
"""So many messages over so long [s] of another session beside the current one are no stragglers."""
_NO_HEADER = SessionHeader(0, 0)


@dataclass(frozen=True, slots=True)
class Admission:
    """The verdict on a message.

    Attributes:
        refused: why it is not to be used; "" if it is new.
        starts_anew: it does not continue what came before: the sender was restarted, or its clock was set.
    """

    refused: Literal["", "duplicate", "out of order", "late", "old session", "second agent"] = ""
    starts_anew: Literal["", "restarted", "its clock was set"] = ""


class DelayFloor:
    """The shortest recent delay of a link, up to the unknown difference of the two clocks."""

    def __init__(self) -> None:
        self._before = self._current = math.inf
        self._since = -math.inf

    def excess(self, delay: float, now: float) -> float:
        """By how much this delay exceeds the shortest one, itself included [s].

        Args:
            delay: time of arrival less the time stamp, each on its own clock [s].
            now: time of arrival [s].
        """
        if now - self._since > _FLOOR_PERIOD:
            self._before = self._current if now - self._since <= 2 * _FLOOR_PERIOD else math.inf
            self._current, self._since = math.inf, now
        self._current = min(self._current, delay)
        return delay - self.shortest

    @property
    def shortest(self) -> float:
        """The shortest delay; infinite before the first."""
        return min(self._before, self._current)


@dataclass(slots=True)
class _Rival:
    """Another session that sends under the same agent id."""

    session: int
    order: float
    first: float
    last: float
    messages: int = 1


class Sender:
    """The messages of one agent so far.

    Messages with a `SessionHeader` are ordered by it, others by their time stamps (session 0).

    Args:
        header: of the first message, or None.
        time: its time stamp [s].
        now: when it arrived [s], on the receiver's clock.

    Attributes:
        heard: when the last message of the current session arrived [s], on the receiver's clock.
        lost: messages of the current session that have not arrived, by their sequence numbers.
    """

    def __init__(self, header: SessionHeader | None, time: float, now: float) -> None:
        self._start(header or _NO_HEADER, time, now)

    def _start(self, header: SessionHeader, time: float, now: float) -> None:
        self.session, self._sequence, self._time, self.heard = header.session, header.sequence, time, now
        self.lost = 0
        self._rival: _Rival | None = None
        self._arrived = 1  # bit k: the message k before the newest
        self._floor = DelayFloor()
        self._floor.excess(now - time, now)

    def admit(
        self, header: SessionHeader | None, time: float, now: float, max_age: float, takeover: float
    ) -> Admission:
        """The verdict on the next message that arrived.

        Args:
            header: that came with it, or None.
            time: its time stamp [s].
            now: when it arrived [s].
            max_age: a message that was so much longer on its way than the fastest is late [s].
            takeover: another session may follow the current one after so long a silence [s].
        """
        key = header or _NO_HEADER
        if key.session != self.session:
            if key.session > self.session and now - self.heard > takeover:
                self._start(key, time, now)
                return Admission(starts_anew="restarted")
            self._note_rival(key.session, key.sequence if header else time, now)
            return Admission("old session" if key.session < self.session else "second agent")
        self.heard = now
        behind = self._sequence - key.sequence if header else self._time - time
        if header and behind >= 0:
            return Admission("duplicate" if self._arrived_before(int(behind)) else "out of order")
        same_instant = abs(time - self._time) < SAME_INSTANT
        if same_instant or (not header and behind > 0):
            return Admission("duplicate" if same_instant else "out of order")
        if header:
            self._advance(key.sequence)
        before, self._time = self._time, time
        delay = now - time
        if time < before or delay < self._floor.shortest - _CLOCK_JUMP:
            self._floor = DelayFloor()
            self._floor.excess(delay, now)
            return Admission(starts_anew="its clock was set")
        if self._floor.excess(delay, now) > max_age:
            return Admission("late")
        return Admission()

    def two_agents(self, now: float) -> bool:
        """Whether two agents send under this id: another session goes on beside the current one."""
        rival = self._rival
        return (
            rival is not None
            and rival.messages >= _RIVAL_MESSAGES
            and rival.last - rival.first >= _RIVAL_TIME
            and now - rival.last <= _RIVAL_TIME
            and now - self.heard <= _RIVAL_TIME
        )

    def _arrived_before(self, behind: int) -> bool:
        """Whether the message so many numbers before the newest has arrived; from now on it has."""
        if behind >= _WINDOW:
            return False
        arrived = bool(self._arrived >> behind & 1)
        if not arrived:
            self._arrived |= 1 << behind
            self.lost = max(self.lost - 1, 0)  # or it was sent before the first that arrived
        return arrived

    def _advance(self, sequence: int) -> None:
        step = sequence - self._sequence
        self._sequence = sequence
        self.lost += step - 1
        self._arrived = (self._arrived << step | 1) & ((1 << _WINDOW) - 1) if step < _WINDOW else 1

    def _note_rival(self, session: int, order: float, now: float) -> None:
        rival = self._rival
        if rival is None or rival.session != session or now - rival.last > _RIVAL_TIME:
            self._rival = _Rival(session, order, now, now)
        elif order > rival.order:
            rival.order, rival.last = order, now
            rival.messages += 1
