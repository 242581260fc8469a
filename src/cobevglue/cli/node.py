"""`cobevglue node`: a live agent."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_note

if TYPE_CHECKING:
    from cobevglue.boxes import Boxes
    from cobevglue.node import NodeCore
    from cobevglue.node.inbox import Inbox

__all__ = ["node"]

_EVERY_SECOND, _EVERY_TEN_SECONDS = 1.0, 10.0
_STANDARD_INPUT = 0


def node(
    agent: Annotated[str, typer.Argument(metavar="AGENT", help="Id of this agent; no other may have it.")],
    listen: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Where others reach this node: tcp/0.0.0.0:7447.")
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help="Another node; through it, this one finds the rest.")
    ] = None,
    router: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="A zenoh router, through which everything goes.")
    ] = None,
    zenoh: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of zenoh (JSON5): TLS, access control.")
    ] = None,
    lists: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="Take the own lists from a topic instead of standard input.")
    ] = None,
    body: Annotated[
        str | None,
        typer.Option(metavar="L,W[,X[,Y]]", help="Length and width of the own vehicle, and its middle, in metres."),
    ] = None,
    metrics: Annotated[
        int | None,
        typer.Option(metavar="PORT", min=0, max=65535, help="Serve metrics at http://127.0.0.1:PORT/metrics."),
    ] = None,
    forget: Annotated[float, typer.Option(metavar="SECONDS", help="Forget agents that are silent for so long.")] = 5.0,
    aligner: Annotated[str, typer.Option(help="bevglue, or bevglue-group for up to four agents.")] = "bevglue",
    as_json: Annotated[bool, typer.Option("--json", help="Print each result as a line of JSON.")] = False,
) -> None:
    """Run a live agent: send its object lists, align with the others, publish alignments and fused objects.

    The own object lists are lines of JSON on standard input: an object list as for `align`, with "time" in seconds (by
    default the time at which it arrives) and, where it is not always the same, "body", the own vehicle's box. A list
    that cannot be used is reported and skipped.

    Without --listen, --connect or --router, nodes find each other by multicast. The topics are
    cobevglue/AGENT/objects, alignments and fused.

    Exit code: 0 when standard input ends or on SIGINT or SIGTERM, 2 bad input (also if no list could be used).
    """
    from cobevglue.node import MetricsPage, NodeCore, NodeSettings, new_session, warm_up
    from cobevglue.node.inbox import Inbox
    from cobevglue.node.live import run_node
    from cobevglue.node.metrics_server import serve_metrics
    from cobevglue.node.network import connect as connected
    from cobevglue.node.network import zenoh_config

    def wait(error: str) -> bool:
        print_note(f"{error}; trying again")
        return not stop.wait(_EVERY_SECOND)

    def give_up(_error: str) -> bool:
        return False

    inbox, page, stop = Inbox(), MetricsPage(), threading.Event()
    with ExitStack() as stack:
        with expected_errors(), _missing_package():
            settings = NodeSettings.model_validate({"forget": forget, "aligner": aligner})
            core = NodeCore(agent, new_session(), settings, None if body is None else _own_vehicle(body))
            config = zenoh_config(listen or (), connect or (), router, zenoh)
            if metrics is not None:
                port = stack.enter_context(serve_metrics(page, metrics))
                print_note(f"metrics: http://127.0.0.1:{port}/metrics")
            warm_up()
            page.text = core.metrics.text()
            stack.enter_context(_ended_by_signals(stop))
            network = stack.enter_context(connected(agent, config, inbox, lists, wait if router else give_up))
        stack.enter_context(nullcontext() if lists is not None else _standard_input(inbox, stop))
        status = _StatusLine(core)
        print_note(f"{agent}: ready")
        try:
            run_node(core, network, inbox, stop, status.note, _print_line if as_json else None, page, status.update)
        except BrokenPipeError:  # nobody reads the results any more
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status.end()
    if not core.metrics.value("lists_total") and core.metrics.value("lists_refused_total"):
        raise InputError("standard input: no object list could be used")


def _own_vehicle(text: str) -> Boxes:
    from cobevglue.cli.body_option import parse_body

    try:
        return parse_body(text)
    except ValueError:
        raise InputError(f"--body: must be LENGTH,WIDTH or LENGTH,WIDTH,X,Y, got {text!r}") from None


def _print_line(document: dict[str, Any]) -> None:
    print(json.dumps(document, ensure_ascii=False, allow_nan=False), flush=True)


@contextmanager
def _missing_package() -> Iterator[None]:
    """A package of an extra that is not installed is bad input, too."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise InputError(str(error)) from error


@contextmanager
def _ended_by_signals(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM set `stop` until the block ends."""
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _standard_input(inbox: Inbox, stop: threading.Event) -> Iterator[None]:
    """A thread that reads own lists from standard input until the block ends."""
    from cobevglue.node.inbox import ListLine
    from cobevglue.node.lines import read_lines

    def read() -> None:
        for line in read_lines(_STANDARD_INPUT, stop):
            inbox.put(ListLine(line, time.monotonic()))
        inbox.end()

    thread = threading.Thread(target=read, name="standard input", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


class _StatusLine:
    """A line on standard error: rewritten every second on a terminal, otherwise a new one every ten seconds."""

    def __init__(self, core: NodeCore) -> None:
        from cobevglue.node.live import status_line

        self._core, self._line = core, status_line
        self._terminal = sys.stderr.isatty()
        self._next = time.monotonic() + _EVERY_SECOND

    def update(self) -> None:
        """Show the line if it is time."""
        now = time.monotonic()
        if now >= self._next:
            self._next = now + (_EVERY_SECOND if self._terminal else _EVERY_TEN_SECONDS)
            self._show(self._line(self._core), "\r\x1b[K" if self._terminal else "", "" if self._terminal else "\n")

    def note(self, text: str) -> None:
        """Show another line, above it."""
        self._show(text, "\r\x1b[K" if self._terminal else "", "\n")

    def end(self) -> None:
        """The last state."""
        self.note(self._line(self._core))

    @staticmethod
    def _show(text: str, before: str, after: str) -> None:
        print(before + " ".join(text.split()), end=after, file=sys.stderr, flush=True)
