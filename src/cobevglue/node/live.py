"""The loop of a live node: takes what waits in the inbox, lets the core handle it, and passes on the results."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

from cobevglue.alignment.to_dict import alignment_to_dict
from cobevglue.messages import to_dict
from cobevglue.node.core import NodeCore, NodeResult
from cobevglue.node.inbox import Inbox
from cobevglue.node.metrics_server import MetricsPage
from cobevglue.node.network import Network
from cobevglue.node.own_list import parse_list

__all__ = ["result_documents", "run_node", "status_line"]

_IDLE = 0.2  # [s]


def run_node(
    core: NodeCore,
    network: Network,
    inbox: Inbox,
    stop: threading.Event,
    note: Callable[[str], None],
    show_result: Callable[[dict[str, Any]], None] | None = None,
    page: MetricsPage | None = None,
    show_status: Callable[[], None] | None = None,
) -> None:
    """Handle what arrives until there are no more own lists or `stop` is set.

    Args:
        core: of the agent.
        network: its connection.
        inbox: that the network and the reader of own lists fill.
        stop: ends the loop.
        note: takes lines for the user: events, and own lists that cannot be used.
        show_result: takes a JSON document of each result.
        page: takes the text of the metrics.
        show_status: is called again and again, several times a second.
    """
    ended = False
    while not ended and not stop.is_set():
        messages, line, ended = inbox.take(_IDLE)
        for message in messages:
            core.receive(message.data, message.arrival, message.header)
            core.metrics.observe("message_seconds", time.monotonic() - message.arrival)
        if line is not None:
            try:
                sent = core.observe(parse_list(line.text, time.time()), line.arrival)
            except ValueError as error:
                core.metrics.count("lists_refused_total")
                note(str(error))
            else:
                network.send(sent)
                result = core.align(time.monotonic())
                assert result is not None
                alignments, fused = result_documents(core.agent, result)
                network.publish(json.dumps(alignments), json.dumps(fused))
                if show_result is not None:
                    show_result({**alignments, **fused})
                core.metrics.observe("list_seconds", time.monotonic() - line.arrival)
        core.forget_silent(time.monotonic())
        for queue, dropped in inbox.take_dropped().items():
            if dropped:
                core.metrics.count("dropped_total", dropped, queue=queue)
        while core.events:
            note(core.events.popleft())
        if page is not None and (line is not None or not messages):
            page.text = core.metrics.text()
        if show_status is not None:
            show_status()


def result_documents(agent: str, result: NodeResult) -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON documents of a result: alignments, and fused objects."""
    head = {"agent": agent, "time": result.time}
    alignments = {name: alignment_to_dict(alignment) for name, alignment in result.alignments.items()}
    return {**head, "alignments": alignments}, {**head, **to_dict(result.objects)}


def status_line(core: NodeCore) -> str:
    """One line: rate, agents with their verdicts, messages refused and dropped, time of a list."""
    metrics = core.metrics
    verdicts = ", ".join(f"{name} {verdict}" for name, verdict in core.verdicts.items())
    refused = ", ".join(f"{count:.0f} {reason}" for reason, count in metrics.by("refused_total", "reason").items())
    return (
        f"{core.agent}: {metrics.value('lists_total'):.0f} lists, {metrics.value('list_rate_hertz'):.1f} Hz, "
        f"{metrics.mean('list_seconds') * 1e3:.0f} ms | {verdicts or 'no other agent'} | "
        f"{metrics.value('objects'):.0f} objects | refused {refused or 0}, "
        f"dropped {metrics.value('dropped_total'):.0f}"
    )
