"""Live nodes under load: eight agents over zenoh with kills and restarts, and a day of frames as fast as possible.

    python benchmarks/node.py                             # one minute of eight agents at 10 Hz on this machine
    python benchmarks/node.py --seconds 1800              # half an hour
    python benchmarks/node.py --realtime                  # undisturbed by other work on the machine (needs root)
    python benchmarks/node.py --only time-lapse --frames 864000    # 24 h of frames, without a network
    python benchmarks/node.py --json results.json

The agents are those of a simulated junction, whose eight seconds are driven forwards and backwards in turn, so that
nothing jumps. Over zenoh each agent is a process of its own, `cobevglue node`, fed through standard input; every 15 s
one of them is killed (SIGKILL) and started again. Messages are handled when they are ready for alignment or refused.
In the time-lapse one `NodeCore` receives the messages of seven senders, of which some are lost, doubled, late, or
damaged, and the senders restart now and then. Ctrl-C ends it early, with the results so far.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations, cycle
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.alignment import Alignment, BEVGlue
from cobevglue.messages import ObjectMessage, encode
from cobevglue.node import NodeCore, OwnList, SessionHeader, encode_header, warm_up, write_list
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.simulation import Junction, JunctionSettings, ObjectListFrame
from cobevglue.tracking import Sort
from cobevglue.typing import BoolArray
from common import print_head

RATE = 10.0
AGENTS = tuple(f"car{number}" for number in range(1, 9))
DOWN_FOR, LOOK_FOR = 1.5, 10.0
"""A killed agent is down for so long, and then takes some seconds to start; alignments are looked for so long [s]."""
SETTLED = 20.0
"""Memory is compared from then on [s]."""
LOST, DOUBLED, LATE, DAMAGED = 0.05, 0.02, 0.03, 0.01
"""Shares of the messages in the time-lapse."""
SCENE_FRAMES, SCENES = 3000, 6
"""Frames of one junction in the time-lapse before another one begins, after a pause; number of junctions."""


def main() -> None:
    """Run the soak and the time-lapse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("soak", "time-lapse"))
    parser.add_argument("--seconds", type=float, default=60.0, help="of the soak")
    parser.add_argument("--realtime", action="store_true", help="real-time priority for agents that have started")
    parser.add_argument("--kill-every", type=float, default=15.0, help="[s]")
    parser.add_argument("--frames", type=int, default=3000, help="of the time-lapse")
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print_head(f"seed {arguments.seed}")
    results: dict[str, Any] = {}
    if arguments.only != "time-lapse":
        results["soak"] = soak(arguments.seconds, arguments.seed, arguments.kill_every, arguments.realtime)
    if arguments.only != "soak":
        results["time-lapse"] = time_lapse(arguments.frames, arguments.seed)
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=1))


def show(title: str, results: dict[str, Any]) -> None:
    """Print a table of one column."""
    print(f"## {title}\n")
    for name, value in results.items():
        print(f"| {name} | {value} |")
    print(flush=True)


def back_and_forth(seed: int) -> list[ObjectListFrame]:
    """The frames of a junction, forwards and then backwards."""
    frames = list(Junction(seed, JunctionSettings(agents=len(AGENTS))))
    return [*frames, *frames[-2:0:-1]]


# ---------------------------------------------------------------------------------------------------------- over zenoh


@dataclass
class AgentProcess:
    """A `cobevglue node` process and its state."""

    name: str
    port: int
    endpoints: list[str]
    metrics_port: int
    process: subprocess.Popen[bytes] | None = None
    started: int = 0
    memory: list[tuple[float, float]] = field(default_factory=list)

    def start(self) -> None:
        """Start the process; it is ready some seconds later."""
        others = [word for endpoint in self.endpoints for word in ("--connect", endpoint)]
        command = [sys.executable, "-m", "cobevglue", "node", self.name, "--listen", f"tcp/127.0.0.1:{self.port}"]
        self.process = subprocess.Popen(
            [*command, *others, "--metrics", str(self.metrics_port)],
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            preexec_fn=lambda: os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0)),
        )
        assert self.process.stdin is not None
        os.set_blocking(self.process.stdin.fileno(), False)
        self.memory.clear()
        self.started += 1

    def feed(self, line: bytes) -> None:
        """Give it a list; lost if it does not read."""
        if self.process is not None and self.process.stdin is not None:
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                os.write(self.process.stdin.fileno(), line)

    def kill(self) -> None:
        """SIGKILL."""
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.process = None

    def is_ready(self) -> bool:
        """Return whether the process answers requests for its metrics."""
        return bool(self.metrics())

    def prioritise(self) -> None:
        """Real-time priority, once it has started: on a computer of its own it would not compete with the others."""
        assert self.process is not None
        set_realtime(self.process.pid)

    def metrics(self) -> dict[str, float]:
        """Its metrics by name and labels; empty if it does not answer."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.metrics_port}/metrics", timeout=2.0) as answer:
                text = answer.read().decode()
        except OSError:
            return {}
        return {name: float(value) for name, value in re.findall(r"^(cobevglue_\S+) (\S+)$", text, re.MULTILINE)}

    def note_memory(self, now: float) -> None:
        """Resident memory [MB]."""
        if self.process is not None:
            status = Path(f"/proc/{self.process.pid}/status").read_text()
            self.memory.append((now, int(re.findall(r"VmRSS:\s+(\d+)", status)[0]) / 1024.0))


class Listener:
    """Subscribes to the alignments of all agents."""

    def __init__(self, endpoints: list[str]) -> None:
        import zenoh

        from cobevglue.node.network import zenoh_config

        self.results: list[tuple[float, dict[str, Any]]] = []
        self._session: Any = zenoh.open(zenoh_config(connect=endpoints))
        self._subscriber = self._session.declare_subscriber("cobevglue/*/alignments", self._take)

    def _take(self, sample: Any) -> None:
        self.results.append((time.time(), json.loads(sample.payload.to_bytes())))

    def close(self) -> None:
        """End the session."""
        self._session.close()


def soak(seconds: float, seed: int, kill_every: float, realtime: bool) -> dict[str, Any]:
    """Eight agents for so long; kills and restarts one after the other."""
    warm_up()  # fills the cache of compiled kernels
    ports = free_ports(2 * len(AGENTS))
    endpoints = [f"tcp/127.0.0.1:{port}" for port in ports[: len(AGENTS)]]
    agents = [
        AgentProcess(name, ports[i], [e for e in endpoints if not e.endswith(f":{ports[i]}")], ports[len(AGENTS) + i])
        for i, name in enumerate(AGENTS)
    ]
    for agent in agents:
        agent.start()
    while not all(agent.is_ready() for agent in agents):
        time.sleep(0.5)
    if realtime:
        for agent in agents:
            agent.prioritise()
    listener = Listener(endpoints)
    stop = threading.Event()
    begin = time.time()
    feeder = threading.Thread(target=feed, args=(agents, seed, begin, stop))
    feeder.start()
    if realtime:
        set_realtime(os.getpid())
    started = time.time()
    handled: Counter[str] = Counter()
    restarts: list[tuple[str, float]] = []
    next_kill, victims, revive = started + kill_every, cycle(range(1, len(agents))), 0.0
    victim: AgentProcess | None = None
    while (now := time.time()) < started + seconds:
        if victim is None and now >= next_kill and now < started + seconds - LOOK_FOR:
            victim = agents[next(victims)]
            add_handled(handled, victim)
            victim.kill()
            restarts.append((victim.name, now))
            revive, next_kill = now + DOWN_FOR, next_kill + kill_every
        elif victim is not None and victim.process is None and now >= revive:
            victim.start()
        elif victim is not None and victim.process is not None and victim.is_ready():
            if realtime:
                victim.prioritise()
            victim = None
        if victim is None:
            for agent in agents:
                agent.note_memory(now - started)
        time.sleep(1.0 if victim is None else 0.05)
    for agent in agents:
        add_handled(handled, agent)
    refused = Counter[str]()
    for agent in agents:
        for name, value in agent.metrics().items():
            if name.startswith("cobevglue_refused_total"):
                refused[name.split('"')[1]] += int(value)
    stop.set()
    feeder.join()
    exit_codes = []
    for agent in agents:
        assert agent.process is not None
        agent.process.send_signal(signal.SIGTERM)
        exit_codes.append(agent.process.wait(timeout=10.0))
    listener.close()
    results = {
        "agents, rate, duration": f"{len(AGENTS)}, {RATE:g} Hz, {seconds:.0f} s",
        "messages handled": f"{handled['message count']:,}",
        "handled within 20 ms": share(handled["message le 0.02"], handled["message count"]),
        "handled within 50 ms": share(handled["message le 0.05"], handled["message count"]),
        "own lists": f"{handled['list count']:,}",
        "list to publication within 20 ms": share(handled["list le 0.02"], handled["list count"]),
        "list to publication within 50 ms": share(handled["list le 0.05"], handled["list count"]),
        "dropped": handled["dropped"],
        "refused at the end": dict(refused),
        **memory_growth(agents),
        **accepted(listener.results),
        **times_to_alignment(listener.results, restarts, undisturbed(seed), begin),
        "exit codes after SIGTERM": str(exit_codes),
        "real-time priority; load average": f"{'yes' if realtime else 'no'}; {os.getloadavg()[0]:.1f}",
    }
    show("Soak", results)
    return results


def feed(agents: list[AgentProcess], seed: int, start: float, stop: threading.Event) -> None:
    """Give every agent its lists at the rate, each at its own phase."""
    frames = back_and_forth(seed)
    lines = [
        [write_list(OwnList(frame.agents[name].boxes, 0.5, frame.agents[name].body)) for name in AGENTS]
        for frame in frames
    ]
    tick = 0
    while not stop.is_set():
        due = start + tick / (RATE * len(agents))
        time.sleep(max(0.0, due - time.time()))
        step, who = divmod(tick, len(agents))
        line = lines[step % len(lines)][who].replace('"time": 0.5', f'"time": {time.time():.6f}', 1)
        agents[who].feed(line.encode() + b"\n")
        tick += 1


def add_handled(handled: Counter[str], agent: AgentProcess) -> None:
    """Add the counts of a process that is about to end."""
    metrics = agent.metrics()
    for kind in ("message", "list"):
        handled[f"{kind} count"] += int(metrics.get(f"cobevglue_{kind}_seconds_count", 0))
        for bound in ("0.02", "0.05"):
            handled[f"{kind} le {bound}"] += int(metrics.get(f'cobevglue_{kind}_seconds_bucket{{le="{bound}"}}', 0))
    handled["dropped"] += int(sum(value for name, value in metrics.items() if "dropped_total" in name))


def memory_growth(agents: list[AgentProcess]) -> dict[str, str]:
    """Resident memory of the processes that ran from the beginning, or since their restart."""
    growth, sizes = [], []
    for agent in agents:
        settled = [(t, size) for t, size in agent.memory if t >= agent.memory[0][0] + SETTLED]
        if len(settled) >= 2:
            growth.append(settled[-1][1] - settled[0][1])
            sizes.append(settled[-1][1])
    if not growth:
        return {"memory growth": "not measured: the run is too short"}
    return {
        "memory of a process": f"{np.median(sizes):.0f} MB, at most {max(sizes):.0f} MB",
        f"its growth after its first {SETTLED:.0f} s": f"{np.median(growth):+.2f} MB, at most {max(growth):+.2f} MB",
    }


def accepted(results: list[tuple[float, dict[str, Any]]]) -> dict[str, str]:
    """Share of pairs that are aligned."""
    verdicts = [found["accepted"] for _, document in results for found in document["alignments"].values()]
    return {"alignments": f"{len(verdicts):,}", "accepted": share(sum(verdicts), len(verdicts))}


def undisturbed(seed: int) -> dict[frozenset[str], BoolArray]:
    """Return, for each pair, the frames accepted by an uninterrupted aligner: some pairs share too few objects."""
    frames = back_and_forth(seed)
    trackers = {name: Sort() for name in AGENTS}
    aligners = {pair: BEVGlue() for pair in combinations(AGENTS, 2)}
    found: dict[frozenset[str], list[bool]] = {frozenset(pair): [] for pair in aligners}
    for step in range(2 * len(frames)):
        frame, now = frames[step % len(frames)], step / RATE
        lists = {name: trackers[name].update(frame.agents[name].boxes, now) for name in AGENTS}
        for (ego, other), aligner in aligners.items():
            own, theirs = frame.agents[ego].body, frame.agents[other].body
            alignment = aligner.align(lists[ego], lists[other], now, ego_body=own, other_body=theirs)
            found[frozenset((ego, other))].append(alignment.accepted)
    return {pair: np.array(accepted[len(frames) :]) for pair, accepted in found.items()}


def times_to_alignment(
    results: list[tuple[float, dict[str, Any]]],
    restarts: list[tuple[str, float]],
    control: dict[frozenset[str], BoolArray],
    begin: float,
) -> dict[str, Any]:
    """From the first result of a restarted agent to the first accepted alignment, of each pair and direction."""
    times, possible = [], []
    again = 0
    for name, killed in restarts:
        before = pairs_accepted([doc for t, doc in results if killed - 1.0 <= t < killed], name)
        later = [(t, doc) for t, doc in results if t > killed + DOWN_FOR]
        first = next((t for t, doc in later if doc["agent"] == name), None)
        if first is None:
            continue
        again += 1
        found: dict[tuple[str, str], float] = {}
        for t, document in later:
            if first <= t <= first + LOOK_FOR:
                for pair in pairs_accepted([document], name):
                    found.setdefault(pair, t - first)
        for pair in sorted(before):
            accepted_there = control[frozenset(pair)]
            phase = round(RATE * (first - begin)) + np.arange(round(2.0 * RATE))
            times.append(found.get(pair, math.inf))
            possible.append(bool(accepted_there[phase % len(accepted_there)].any()))
    if not times:
        return {"kills": len(restarts)}
    median, most = np.median(times), np.quantile(times, 0.95, method="lower")
    return {
        "kills, restarted": f"{len(restarts)}, {again}",
        "pairs aligned before the kill": len(times),
        "aligned again, median": f"{median:.2f} s",
        "aligned again, 95 % within": f"{most:.2f} s",
        "aligned again, the slowest": f"{max(times):.2f} s",
        "aligned again within 2 s of the first frame": share(sum(t <= 2.0 for t in times), len(times)),
        "the same, of pairs that an uninterrupted aligner accepts in these 2 s": share(
            sum(t <= 2.0 for t, could in zip(times, possible, strict=True) if could), sum(possible)
        ),
    }


def pairs_accepted(documents: list[dict[str, Any]], name: str) -> set[tuple[str, str]]:
    """(ego, other) that are accepted in any of these, of pairs with this agent."""
    return {
        (document["agent"], other)
        for document in documents
        for other, found in document["alignments"].items()
        if found["accepted"] and name in (document["agent"], other)
    }


def set_realtime(pid: int) -> None:
    """Real-time priority for all threads of a process."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it ended just now
            os.sched_setscheduler(int(thread.name), os.SCHED_RR, os.sched_param(1))


def free_ports(number: int) -> list[int]:
    """Return unused ports."""
    sockets = [socket.socket() for _ in range(number)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [int(each.getsockname()[1]) for each in sockets]
    for each in sockets:
        each.close()
    return ports


def share(part: int, whole: int) -> str:
    """In percent."""
    return f"{100.0 * part / whole:.3f} % of {whole:,}" if whole else "-"


# ---------------------------------------------------------------------------------------------------------- time-lapse


@dataclass
class SimulatedSender:
    """Another agent: its tracker, its session, and the messages that are still on their way."""

    name: str
    session: int
    sequence: int = 0
    tracker: Sort = field(default_factory=Sort)
    late: list[tuple[float, bytes, bytes]] = field(default_factory=list)

    def send(self, frame: ObjectListFrame, now: float, rng: np.random.Generator) -> Iterator[tuple[bytes, bytes]]:
        """What arrives now of this and earlier messages."""
        view = frame.agents[self.name]
        tracked = self.tracker.update(view.boxes, now).replace(score=None, label=None)
        message = encode(ObjectMessage(self.name, now, self.sequence, tracked, view.body))
        header = encode_header(SessionHeader(self.session, self.sequence), message)
        self.sequence += 1
        what = rng.random()
        if what < DAMAGED:
            at = int(rng.integers(len(message)))
            yield message[:at] + bytes([message[at] ^ 1 << int(rng.integers(8))]) + message[at + 1 :], header
        elif what < DAMAGED + LATE:
            self.late.append((now + float(rng.uniform(0.1, 2.0)), message, header))
        elif what > LOST + DAMAGED + LATE:
            yield message, header
            if rng.random() < DOUBLED:
                yield message, header
        for arrival in [entry for entry in self.late if entry[0] <= now]:
            self.late.remove(arrival)
            yield arrival[1], arrival[2]


def time_lapse(frames: int, seed: int) -> dict[str, Any]:
    """Run one node with seven senders as fast as possible."""
    warm_up()
    core = NodeCore("car1", 1)
    session, now, done = 1, 1e6, 0
    verdicts: Counter[str] = Counter()
    errors, steps = array("d"), array("d")  # small, so that the memory of the node shows
    refused: Counter[str] = Counter()
    memory: list[float] = []
    begin = time.perf_counter()
    scenes = [back_and_forth(seed + scene) for scene in range(SCENES)]
    making = time.perf_counter() - begin
    interrupted: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: interrupted.append(number))
    begin = time.perf_counter()
    while done < frames and not interrupted:
        scene = scenes[done // SCENE_FRAMES % SCENES]
        senders = []
        for name in AGENTS[1:]:
            session += 1
            senders.append(SimulatedSender(name, session))
        now += 10.0
        for step in range(min(SCENE_FRAMES, frames - done)):
            rng = np.random.default_rng([seed, 7, done])
            frame = scene[step % len(scene)]
            now += 1.0 / RATE
            if step % 500 == 499:  # one starts again
                session += 1
                senders[step // 500 % len(senders)] = SimulatedSender(AGENTS[1 + step // 500 % len(senders)], session)
            for sender in senders:
                for data, header in sender.send(frame, now, rng):
                    core.receive(data, now, header)
            started = time.perf_counter()
            view = frame.agents["car1"]
            core.observe(OwnList(view.boxes, now, view.body), now)
            result = core.align(now)
            steps.append(time.perf_counter() - started)
            assert result is not None
            for name, alignment in result.alignments.items():
                judge(alignment, frame.ego_SE2_other("car1", name), verdicts, errors)
            core.events.clear()
            done += 1
            if interrupted:
                break
            if done % 500 == 0:
                memory.append(resident_memory())
                if len(steps) > 200_000:
                    del steps[:100_000], errors[:-100_000]
    seconds = time.perf_counter() - begin
    refused.update({reason: int(count) for reason, count in core.metrics.by("refused_total", "reason").items()})
    judged = verdicts["right"] + verdicts["wrong"]
    results = {
        "frames": f"{done:,}, {done / RATE / 3600.0:.2f} h of driving at {RATE:g} Hz",
        "frames/s": f"{done / seconds:.0f} (and {making:.0f} s to make the scenes)",
        "own list to result, median, 99.9 %, longest": " ms, ".join(
            f"{1e3 * value:.1f}" for value in (np.median(steps), np.quantile(steps, 0.999), max(steps))
        )
        + " ms",
        "alignments": f"{sum(verdicts.values()):,}",
        "accepted": share(judged, sum(verdicts.values())),
        "wrong (over 3 m or 3°), of accepted": share(verdicts["wrong"], judged),
        "median error": f"{np.median(errors):.2f} m",
        "refused messages": dict(refused),
        "restarts noticed": int(core.metrics.value("restarts_total")),
        "memory after 500 frames, halfway, at the end": " ".join(
            f"{memory[k]:.1f}" for k in (0, len(memory) // 2, -1) if memory
        )
        + " MB",
    }
    show("Time-lapse", results)
    return results


def judge(alignment: Alignment, truth: SE2, verdicts: Counter[str], errors: array[float]) -> None:
    """Count an alignment as right, wrong or refused."""
    pose = alignment.ego_SE2_other
    if pose is None:
        verdicts["refused"] += 1
        return
    error = math.hypot(pose.x - truth.x, pose.y - truth.y)
    turned = abs(math.degrees(float(wrap_angle(pose.yaw - truth.yaw))))
    errors.append(error)
    verdicts["right" if error <= 3.0 and turned <= 3.0 else "wrong"] += 1


def resident_memory() -> float:
    """Of this process [MB]."""
    return int(re.findall(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())[0]) / 1024.0


if __name__ == "__main__":
    main()
