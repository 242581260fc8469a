"""The lists of one agent as they come in: which are used, and counts of what is wrong with the others."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

__all__ = ["AgentStream", "Arrival"]

_SET_BACK = 1.0
"""A time stamp that is earlier than the last one by more is of a clock that was set back, not of a late list [s]."""


class Arrival(Enum):
    """What to do with a list."""

    NEXT = auto()
    """Use it."""
    RESTART = auto()
    """Use it, and forget the lists before: the clock was set back."""
    DROP = auto()
    """It is late, or a copy."""


@dataclass(slots=True)
class AgentStream:
    """The lists of one agent.

    Attributes:
        topic: on which they come.
        lists: number of lists that came, those that are not used included.
        unstamped: without a time stamp; the time of receipt is used.
        doubled: with the time stamp of the last one, and therefore not used.
        late: with an earlier time stamp than the last one, and therefore not used.
        set_back: by how many of them the clock was set back; everything starts anew then.
        without_size: number of objects that were left out, since their size is unknown.
        new_identities: how often identities ended; from then on we track the objects.
        longest_gap: between two lists in a row [s].
    """

    topic: str
    lists: int = 0
    unstamped: int = 0
    doubled: int = 0
    late: int = 0
    set_back: int = 0
    without_size: int = 0
    new_identities: int = 0
    longest_gap: float = 0.0
    _last: float | None = field(default=None, repr=False)
    _span: float = field(default=0.0, repr=False)
    _steps: int = field(default=0, repr=False)

    def arrive(self, stamp: float) -> Arrival:
        """Count a list with this time stamp [s], and decide."""
        self.lists += 1
        last, self._last = self._last, stamp
        if last is None:
            return Arrival.NEXT
        step = stamp - last
        if step < -_SET_BACK:
            self.set_back += 1
            return Arrival.RESTART
        if step <= 0.0:
            self._last = last
            if step == 0.0:
                self.doubled += 1
            else:
                self.late += 1
            return Arrival.DROP
        self._span, self._steps = self._span + step, self._steps + 1
        self.longest_gap = max(self.longest_gap, step)
        return Arrival.NEXT

    @property
    def rate(self) -> float:
        """Lists a second; 0 for less than two."""
        return self._steps / self._span if self._steps else 0.0

    def problems(self) -> list[str]:
        """What to tell the user, one sentence each; [] if all is well."""
        told = (
            (self.unstamped, "lists have no time stamp: their time of receipt is used"),
            (self.doubled, "lists have the time stamp of the one before and are not used"),
            (self.late, "lists came after a newer one and are not used"),
            (self.set_back, "times the clock was set back, and the replay started anew"),
            (self.without_size, "objects have no size and are not used"),
            (self.new_identities, "times objects ceased to have identities: they are tracked from there on"),
        )
        return [f"{self.topic}: {count} {what}" for count, what in told if count]
