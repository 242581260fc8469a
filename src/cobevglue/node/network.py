"""A node's connection to the others by zenoh: settings, topics, and a session.

| topic | content |
|---|---|
| `cobevglue/AGENT/objects` | the agent's messages in bytes, each with its session header as the attachment |
| `cobevglue/AGENT/alignments` | JSON: `agent`, `time`, and `alignments` by the other agents' ids |
| `cobevglue/AGENT/fused` | JSON: `agent`, `time`, and `boxes`: everyone's objects in the agent's frame |

Needs: pip install 'cobevglue[live]'
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cobevglue.node.core import Outgoing
from cobevglue.node.inbox import Inbox, ListLine, Received

if TYPE_CHECKING:
    from zenoh import Config, Sample

__all__ = ["Network", "connect", "zenoh_config"]

_PREFIX = "cobevglue"
_MESSAGE_ENCODING = "application/x-cobevglue-objects"
_NOT_IN_TOPICS = set("/*$?#")
_SOURCE_PLACES = re.compile(r"( at |: )?/\S+\.rs:\d+\.?")


def zenoh_config(
    listen: Sequence[str] = (), connect: Sequence[str] = (), router: str | None = None, file: Path | None = None
) -> Config:
    """Settings of the session.

    Args:
        listen: endpoints at which others reach this node, such as tcp/0.0.0.0:7447.
        connect: endpoints of other nodes; those learn of each other.
        router: endpoint of a zenoh router, through which everything goes then.
        file: of zenoh's own settings (JSON5), for TLS and access control; the other arguments come on top.

    Without any endpoint, nodes in the same network find each other by multicast.

    Raises:
        ValueError: an endpoint or the file is not valid.
        ModuleNotFoundError: zenoh is not installed.
    """
    zenoh = _zenoh()
    try:
        config: Config = zenoh.Config() if file is None else zenoh.Config.from_file(str(file))
        if file is None or listen or connect or router:
            config.insert_json5("mode", '"client"' if router else '"peer"')
        if listen:
            config.insert_json5("listen/endpoints", json.dumps(list(listen)))
        if connect or router:
            config.insert_json5("connect/endpoints", json.dumps([*connect, *([router] if router else [])]))
        if listen or connect or router:
            config.insert_json5("scouting/multicast/enabled", "false")
    except zenoh.ZError as error:
        raise ValueError(f"zenoh settings: {_one_line(error)}") from None
    return config


class Network:
    """An open session; what arrives goes to the inbox."""

    def __init__(self, session: Any, agent: str, inbox: Inbox, lists_topic: str | None) -> None:
        zenoh = _zenoh()
        topic = f"{_PREFIX}/{agent}"
        newest = {"congestion_control": zenoh.CongestionControl.DROP, "express": True}  # a late one is worth nothing
        self._objects = session.declare_publisher(f"{topic}/objects", encoding=_MESSAGE_ENCODING, **newest)
        self._alignments = session.declare_publisher(f"{topic}/alignments", encoding="application/json", **newest)
        self._fused = session.declare_publisher(f"{topic}/fused", encoding="application/json", **newest)

        def take_message(sample: Sample) -> None:
            attachment = sample.attachment
            header = None if attachment is None else attachment.to_bytes()
            inbox.put(Received(sample.payload.to_bytes(), header, time.monotonic()))

        def take_list(sample: Sample) -> None:
            inbox.put(ListLine(sample.payload.to_bytes(), time.monotonic()))

        others = zenoh.Locality.REMOTE
        self._subscribers = [session.declare_subscriber(f"{_PREFIX}/*/objects", take_message, allowed_origin=others)]
        if lists_topic is not None:
            self._subscribers.append(session.declare_subscriber(lists_topic, take_list))

    def send(self, message: Outgoing) -> None:
        """Send a message to the others."""
        self._objects.put(message.data, attachment=message.header)

    def publish(self, alignments: str, fused: str) -> None:
        """Publish the two JSON documents."""
        self._alignments.put(alignments)
        self._fused.put(fused)


@contextmanager
def connect(
    agent: str,
    config: Config,
    inbox: Inbox,
    lists_topic: str | None = None,
    try_again: Callable[[str], bool] = lambda error: False,
) -> Iterator[Network]:
    """A session until the block ends.

    Args:
        agent: id of the own agent; a part of the topics.
        config: from `zenoh_config`.
        inbox: for what arrives.
        lists_topic: topic of the own lists, one JSON document each; None if they come otherwise.
        try_again: whether to try again when the session cannot be opened; gets the reason.

    Raises:
        ValueError: the session cannot be opened, for example because the port is in use, or a topic is not valid.
        ModuleNotFoundError: zenoh is not installed.
    """
    zenoh = _zenoh()
    if not agent or _NOT_IN_TOPICS & set(agent):
        raise ValueError(f"agent id: {agent!r} cannot be part of a topic: without {' '.join(sorted(_NOT_IN_TOPICS))}")
    session, error = _opened(config)
    while session is None and try_again(error):
        session, error = _opened(config)
    if session is None:
        raise ValueError(error)
    try:
        try:
            network = Network(session, agent, inbox, lists_topic)
        except zenoh.ZError as error:
            raise ValueError(f"zenoh: {_one_line(error)}") from None
        yield network
    finally:
        session.close()


def _opened(config: Config) -> tuple[Any, str]:
    """A session, or None and why."""
    zenoh = _zenoh()
    try:
        return zenoh.open(config), ""
    except zenoh.ZError as error:
        return None, f"zenoh: {_one_line(error)}"


def _one_line(error: Exception) -> str:
    """Zenoh's message without the places in its source code."""
    return " ".join(_SOURCE_PLACES.sub("", str(error)).split())


def _zenoh() -> Any:
    """The zenoh module: imported on first use, since few need it."""
    try:
        import zenoh
    except ImportError as error:
        raise ModuleNotFoundError(
            f"a node needs eclipse-zenoh: pip install 'cobevglue[live]' ({error})", name="zenoh"
        ) from None
    return zenoh
