"""What a node counts and measures, as text in Prometheus' exposition format (version 0.0.4)."""

from __future__ import annotations

import math
from bisect import bisect_left

__all__ = ["CONTENT_TYPE", "Metrics"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

_FAMILIES = {
    "lists_total": ("counter", "Own object lists that were sent and aligned with."),
    "lists_refused_total": ("counter", "Own object lists that could not be used."),
    "list_rate_hertz": ("gauge", "Rate of the own object lists."),
    "sent_bytes_total": ("counter", "Bytes of the messages sent, with their session headers."),
    "received_total": ("counter", "Messages that arrived, by agent."),
    "received_bytes_total": ("counter", "Bytes of the messages that arrived, with their session headers."),
    "refused_total": ("counter", "Messages that were not used, by reason."),
    "lost_messages": ("gauge", "Messages of the agent's session that never arrived."),
    "dropped_total": ("counter", "Oldest entries dropped from a full queue, by queue."),
    "agents": ("gauge", "Other agents that are present."),
    "two_agents": ("gauge", "1 while two agents send under this agent's id."),
    "restarts_total": ("counter", "Agents that were restarted or whose clock was set."),
    "forgotten_total": ("counter", "Agents that fell silent and were forgotten."),
    "alignments_total": ("counter", "Alignments, by agent and verdict."),
    "alignment_risk": ("gauge", "Estimated probability that the pose is wrong, of the last alignment."),
    "time_offset_seconds": ("gauge", "How much later than the own list the other's shows the world; last accepted."),
    "objects": ("gauge", "Objects in the last fused list."),
    "message_seconds": ("histogram", "From the arrival of a message to its being ready for alignment, or refused."),
    "list_seconds": ("histogram", "From the arrival of an own list to the publication of alignments and objects."),
}
"""Type and help by name, without the prefix."""
_PREFIX = "cobevglue_"
_BOUNDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Upper bounds of the buckets of histograms [s]."""

_Labels = tuple[tuple[str, str], ...]


class Metrics:
    """Counters, gauges and histograms by name and labels. Only the names of this module's table exist."""

    def __init__(self) -> None:
        self._values: dict[str, dict[_Labels, float]] = {
            name: {} for name, (kind, _) in _FAMILIES.items() if kind != "histogram"
        }
        self._histograms = {name: _Histogram() for name, (kind, _) in _FAMILIES.items() if kind == "histogram"}

    def count(self, name: str, amount: float = 1.0, **labels: str) -> None:
        """Add to a counter."""
        values, key = self._values[name], tuple(labels.items())
        values[key] = values.get(key, 0.0) + amount

    def set(self, name: str, value: float, **labels: str) -> None:
        """Set a gauge."""
        self._values[name][tuple(labels.items())] = value

    def observe(self, name: str, seconds: float) -> None:
        """Add a duration to a histogram."""
        self._histograms[name].add(seconds)

    def value(self, name: str, **labels: str) -> float:
        """A counter or gauge; the sum over the labels that are not given, 0 if there is none."""
        wanted = set(labels.items())
        return sum(value for key, value in self._values[name].items() if wanted <= set(key))

    def by(self, name: str, label: str) -> dict[str, float]:
        """A counter or gauge by the values of one label."""
        sums: dict[str, float] = {}
        for key, value in self._values[name].items():
            for label_name, label_value in key:
                if label_name == label:
                    sums[label_value] = sums.get(label_value, 0.0) + value
        return sums

    def mean(self, name: str) -> float:
        """Mean of a histogram [s]; 0 if it is empty."""
        return self._histograms[name].mean

    def drop_agent(self, agent: str) -> None:
        """Forget what is labelled with this agent, so that agents that come and go do not add up."""
        for values in self._values.values():
            for key in [key for key in values if ("agent", agent) in key]:
                del values[key]

    def text(self) -> str:
        """All of it, in Prometheus' text format."""
        lines = []
        for name, (kind, explanation) in _FAMILIES.items():
            lines += [f"# HELP {_PREFIX}{name} {explanation}", f"# TYPE {_PREFIX}{name} {kind}"]
            if kind == "histogram":
                lines += self._histograms[name].lines(_PREFIX + name)
            else:
                lines += [f"{_PREFIX}{name}{_labels(key)} {_number(v)}" for key, v in self._values[name].items()]
        return "\n".join(lines) + "\n"


class _Histogram:
    def __init__(self) -> None:
        self._counts = [0] * (len(_BOUNDS) + 1)
        self._sum = 0.0

    def add(self, value: float) -> None:
        self._counts[bisect_left(_BOUNDS, value)] += 1
        self._sum += value

    @property
    def mean(self) -> float:
        return self._sum / max(sum(self._counts), 1)

    def lines(self, name: str) -> list[str]:
        total, lines = 0, []
        for bound, count in zip((*_BOUNDS, math.inf), self._counts, strict=True):
            total += count
            lines.append(f"{name}_bucket{_labels((('le', _number(bound)),))} {total}")
        return [*lines, f"{name}_sum {_number(self._sum)}", f"{name}_count {total}"]


def _labels(labels: _Labels) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{name}="{_escaped(value)}"' for name, value in labels) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


def _number(value: float) -> str:
    if math.isfinite(value):
        return str(int(value)) if value == int(value) and abs(value) < 2**53 else repr(float(value))
    return "NaN" if math.isnan(value) else ("+Inf" if value > 0 else "-Inf")
