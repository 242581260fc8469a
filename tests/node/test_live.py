"""`cobevglue node` as processes that find each other over zenoh on this machine."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import pytest
import zenoh
from prometheus_client.parser import text_string_to_metric_families

from cobevglue.cli import main
from cobevglue.node import OwnList, write_list
from cobevglue.node.network import zenoh_config

from .air import frames

PATIENCE = 120.0  # kernels may have to be compiled [s]


class LiveNode:
    """A process, what it prints, and lists for it."""

    def __init__(self, agent: str, *options: str) -> None:
        self.agent = agent
        self.process = subprocess.Popen(
            [sys.executable, "-W", "error", "-m", "cobevglue", "node", agent, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        self.output: list[str] = []
        self.errors: list[str] = []
        for stream, lines in ((self.process.stdout, self.output), (self.process.stderr, self.errors)):
            threading.Thread(target=self._collect, args=(stream, lines), daemon=True).start()

    @staticmethod
    def _collect(stream: IO[bytes], lines: list[str]) -> None:
        lines.extend(line.decode().rstrip("\n") for line in stream)

    def wait_for(self, condition: Callable[[], Any], act: Callable[[], None] = lambda: None) -> Any:
        """Until the condition holds; acts every tenth of a second."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and self.process.poll() is None:
            act()
            if found := condition():
                return found
            time.sleep(0.1)
        raise AssertionError(f"{self.agent}: {self.process.poll()} {self.output[-1:]} {self.errors}")

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def printed(self, word: str) -> bool:
        return any(word in line for line in list(self.errors))

    def last(self) -> dict[str, Any]:
        """The last result, read as JSON."""
        return json.loads(self.output[-1]) if self.output else {}

    def end(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.process.wait(timeout=PATIENCE)


@pytest.fixture
def run_node() -> Iterator[Callable[..., LiveNode]]:
    nodes: list[LiveNode] = []

    def run(*arguments: str) -> LiveNode:
        nodes.append(LiveNode(*arguments))
        return nodes[-1]

    yield run
    for node in nodes:
        node.process.kill()
        node.process.wait()
        for stream in (node.process.stdin, node.process.stdout, node.process.stderr):
            assert stream is not None
            if stream is not node.process.stdin:
                time.sleep(0.05)
            stream.close()


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Scene:
    """Feeds nodes, from frame to frame."""

    def __init__(self) -> None:
        self.step = 0

    def feed(self, *nodes: LiveNode) -> None:
        frame = frames()[self.step % len(frames())]
        self.step += 1
        time.sleep(0.01)  # two lists less than a millisecond apart are one
        for node in nodes:
            view = frame.agents[node.agent]
            node.say(write_list(OwnList(view.boxes, time.time(), view.body)))


def test_nodes_find_each_other(run_node: Callable[..., LiveNode]) -> None:
    endpoint = free_endpoint()
    car1 = run_node("car1", "--listen", endpoint, "--json", "--metrics", "0")
    car2 = run_node("car2", "--connect", endpoint, "--json")
    car1.wait_for(lambda: car1.printed("ready"))
    car2.wait_for(lambda: car2.printed("ready"))
    topics: dict[str, Any] = {}
    with zenoh.open(zenoh_config(connect=[endpoint])) as session:
        session.declare_subscriber("cobevglue/car1/*", lambda sample: topics.update({str(sample.key_expr): sample}))
        scene = Scene()

        def both_accepted() -> bool:
            found = [node.last().get("alignments", {}) for node in (car1, car2)]
            return all(other["accepted"] for each in found for other in each.values()) and all(found)

        car1.say("this is no object list")
        session.put("cobevglue/stranger/objects", b"no message", attachment=b"no header")
        car1.wait_for(both_accepted, lambda: scene.feed(car1, car2))
        car1.wait_for(lambda: len(topics) == 3, lambda: scene.feed(car1))
    assert car1.printed("object list: not JSON")
    alignments = json.loads(topics["cobevglue/car1/alignments"].payload.to_bytes())
    assert set(alignments) == {"agent", "time", "alignments"}
    fused = json.loads(topics["cobevglue/car1/fused"].payload.to_bytes())
    assert len(fused["boxes"]) > 3

    port = re.findall(r"127.0.0.1:(\d+)", car1.errors[0])[0]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as answer:
        samples = [s for family in text_string_to_metric_families(answer.read().decode()) for s in family.samples]
    counted = {(s.name, *s.labels.values()): s.value for s in samples}
    assert counted["cobevglue_refused_total", "corrupted"] == 1
    assert counted["cobevglue_lists_refused_total",] == 1
    assert counted["cobevglue_received_total", "car2"] >= 1

    assert car1.end(signal.SIGINT) == 0
    car2.process.stdin.close()  # type: ignore[union-attr]
    assert car2.process.wait(timeout=PATIENCE) == 0, "standard input has ended"
    assert not car2.printed("Traceback")


def test_killed_node_is_aligned_again(run_node: Callable[..., LiveNode]) -> None:
    endpoint, scene = free_endpoint(), Scene()
    car1 = run_node("car1", "--listen", endpoint, "--json")
    car2 = run_node("car2", "--connect", endpoint)

    def accepted() -> bool:
        return bool(car1.last().get("alignments", {}).get("car2", {}).get("accepted"))

    car1.wait_for(accepted, lambda: scene.feed(car1, car2))
    car2.process.kill()
    car1.wait_for(lambda: not accepted(), lambda: scene.feed(car1))
    again = run_node("car2", "--connect", endpoint)
    car1.wait_for(accepted, lambda: scene.feed(car1, again))
    assert car1.printed("car2: restarted")


def test_own_lists_from_a_topic(run_node: Callable[..., LiveNode]) -> None:
    endpoint = free_endpoint()
    node = run_node("unit7", "--listen", endpoint, "--json", "--lists", "sensor/objects")
    node.wait_for(lambda: node.printed("ready"))
    line = json.dumps({"boxes": [{"x": 9, "y": 1, "l": 4, "w": 2, "yaw": 0}]})
    with zenoh.open(zenoh_config(connect=[endpoint])) as session:
        node.wait_for(lambda: node.output, lambda: session.put("sensor/objects", line))
    assert node.last()["boxes"][0]["x"] == 9
    assert node.end() == 0


def test_node_waits_for_its_router(run_node: Callable[..., LiveNode]) -> None:
    router, scene = free_endpoint(), Scene()
    car2 = run_node("car2", "--router", router, "--json")
    car2.wait_for(lambda: car2.printed("trying again"))
    car1 = run_node("car1", "--listen", router)  # to one other node, it is as good as a router
    car2.wait_for(lambda: "car1" in car2.last().get("alignments", {}), lambda: scene.feed(car1, car2))
    alone = run_node("car3", "--router", free_endpoint())
    alone.wait_for(lambda: alone.printed("trying again"))
    assert alone.end(signal.SIGINT) == 2


def test_reader_that_goes_away_ends_it() -> None:
    node = f"{sys.executable} -m cobevglue node car1 --listen {free_endpoint()} --json"
    process = subprocess.run(
        f"yes '{{\"boxes\": []}}' | {node} | head -2",
        shell=True,
        capture_output=True,
        timeout=PATIENCE,
        check=False,
    )
    assert len(process.stdout.splitlines()) == 2
    assert b"Traceback" not in process.stderr
    assert b"Exception" not in process.stderr


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["a/b"], "cannot be part of a topic"),
        ([""], "agent_id"),
        (["car1", "--listen", "nowhere"], "zenoh settings: .*<protocol>/<address>"),
        (["car1", "--listen", "tcp/127.0.0.1:{taken}"], "zenoh: Can not create a new TCP listener"),
        (["car1", "--zenoh", "missing.json5"], "zenoh settings"),
        (["car1", "--lists", "a//b"], "zenoh: "),
        (["car1", "--metrics", "{taken}"], "metrics: port"),
        (["car1", "--forget", "0"], "forget"),
        (["car1", "--body", "4.5"], "--body: must be LENGTH,WIDTH"),
        (["car1", "--body", "-4,2"], "--body: must be LENGTH,WIDTH"),
        (["car1", "--aligner", "bevglu"], "aligner"),
    ],
)
def test_bad_options_are_one_line(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert main(["node", *(word.replace("{taken}", port) for word in arguments)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert re.search(expected, lines[-1]), lines
    assert len([line for line in lines if not line.startswith("metrics: http")]) == 1
