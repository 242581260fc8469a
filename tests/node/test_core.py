"""A node without its network: in a simulated junction, with messages lost, doubled, late, damaged, and forged."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import Boxes
from cobevglue.messages import MessageError, ObjectMessage, cpm, decode, encode, sdsm
from cobevglue.node import NodeCore, NodeSettings, Outgoing, OwnList, SessionHeader, encode_header
from cobevglue.tracking import Sort

from .air import Drive, frames, own_list

CARS = Boxes([(10.0, 0.0, 0.0), (20.0, 5.0, 0.0)], [(4.5, 1.9, 1.5)] * 2, [0.0, 0.1])


def message_of(
    agent: str, time: float, boxes: Boxes = CARS, session: int = 5, sequence: int = 0
) -> tuple[bytes, bytes]:
    data = encode(ObjectMessage(agent, time, sequence, boxes))
    return data, encode_header(SessionHeader(session, sequence), data)


def receive(core: NodeCore, message: tuple[bytes, bytes], now: float) -> str:
    return core.receive(message[0], now, message[1])


@cache
def recorded() -> list[Outgoing]:
    """What car2 sends in 40 frames."""
    drive = Drive()
    drive.run(40)
    return drive.sent


def test_two_nodes_find_each_other() -> None:
    drive = Drive()
    result = drive.run(20)
    assert drive.error(result) < 1.0
    assert len(result.objects) > len(frames()[19].agents["car1"].boxes)
    assert set(drive.refused) == {""}
    assert drive.ego.metrics.value("alignments_total", agent="car2") == 20
    assert drive.ego.metrics.value("list_rate_hertz") == pytest.approx(10.0)
    assert drive.ego.verdicts == {"car2": "accepted"}


def test_clocks_may_differ_by_days() -> None:
    drive = Drive()
    drive.clock_difference = -3e6
    assert drive.error(drive.run(20)) < 1.0


def test_lost_doubled_and_reordered_messages() -> None:
    drive = Drive()
    held: list[Outgoing] = []

    def disturbed(sent: Outgoing) -> Iterable[tuple[bytes, bytes]]:
        turn = drive.step % 5
        if turn == 1:  # lost
            return []
        if turn == 2:  # overtaken by the next one
            held.append(sent)
            return []
        late = [(held[-1].data, held[-1].header)] if turn == 3 else []
        return [(sent.data, sent.header)] * (2 if turn == 4 else 1) + late

    assert drive.error(drive.run(40, disturbed)) < 1.0
    refused = drive.ego.metrics.by("refused_total", "reason")
    assert refused == {"out of order": 8, "duplicate": 8}
    assert drive.ego.metrics.value("lost_messages", agent="car2") == 8


def test_group_of_three_with_lost_messages() -> None:
    core = NodeCore("car1", 1, NodeSettings(aligner="bevglue-group"))
    others = {name: NodeCore(name, 10) for name in ("car2", "car3")}
    rng = np.random.default_rng(0)
    for k in range(30):
        now = 0.1 * k
        for name, other in others.items():
            sent = other.observe(own_list(frames(3)[k], name, now), now)
            if rng.random() > 0.3:
                core.receive(sent.data, now, sent.header)
        core.observe(own_list(frames(3)[k], "car1", now), now)
        result = core.align(now)
    assert result is not None
    assert all(found.accepted for found in result.alignments.values())


def test_damaged_messages_are_refused() -> None:
    drive = Drive()
    rng = np.random.default_rng(0)

    def damaged(sent: Outgoing) -> Iterable[tuple[bytes, bytes]]:
        bit = int(rng.integers(8 * len(sent.data)))
        data = bytearray(sent.data)
        data[bit // 8] ^= 1 << bit % 8
        return [(bytes(data), sent.header), (sent.data, sent.header[:-1] + bytes([sent.header[-1] ^ 1]))]

    result = drive.run(10, damaged)
    assert result.alignments == {}
    assert drive.ego.metrics.by("refused_total", "reason") == {"corrupted": 20}


def test_restarted_agent_is_aligned_again() -> None:
    drive = Drive()
    drive.run(20)
    for _ in range(10):  # a second of silence
        drive.alone()
    drive.other = NodeCore("car2", 2000)  # numbers begin at 0 again
    accepted = [drive.frame().alignments["car2"].accepted for _ in range(20)]
    assert any(accepted), "within 2 s"
    assert accepted[-1]
    assert drive.ego.metrics.value("restarts_total") == 1
    assert "car2: restarted" in drive.ego.events


def test_replayed_session_changes_nothing() -> None:
    drive = Drive()
    drive.run(20)
    recorded = drive.sent
    for _ in range(10):
        drive.alone()
    drive.other = NodeCore("car2", 2000)

    def with_replay(sent: Outgoing) -> Iterable[tuple[bytes, bytes]]:
        old = recorded[drive.step % 20]
        return [(sent.data, sent.header), (old.data, old.header)]

    assert drive.error(drive.run(20, with_replay)) < 1.0
    assert drive.refused[-40:] == ["", "old session"] * 20


def test_forgotten_agent_cannot_be_replayed() -> None:
    drive = Drive(NodeSettings(forget=1.0))
    drive.run(10)
    for _ in range(20):
        result = drive.alone()
    assert result.alignments == {}
    for old in drive.sent:
        assert drive.ego.receive(old.data, drive.now, old.header) in ("duplicate", "out of order")
    assert drive.alone().alignments == {}
    assert drive.error(drive.run(20)) < 1.0, "its own next messages are welcome"


def test_silent_agent_is_forgotten() -> None:
    drive = Drive(NodeSettings(max_age=0.3, forget=1.0))
    drive.run(10)
    reasons = [drive.alone().alignments for _ in range(12)]
    assert not reasons[5]["car2"].accepted
    assert reasons[5]["car2"].reason.startswith("no new list for 0.6")
    assert reasons[-1] == {}
    assert 'agent="car2"' not in drive.ego.metrics.text()
    assert drive.ego.metrics.value("forgotten_total") == 1
    assert any("car2: silent" in event for event in drive.ego.events)


def test_agents_that_went_leave_nothing_behind() -> None:
    core = NodeCore("car1", 1, NodeSettings(forget=0.15))
    for k in range(50):
        now = 0.1 * k
        assert receive(core, message_of(f"agent{k}", now), now) == ""
        core.observe(OwnList(CARS, now), now)
        core.align(now)
    collaboration = core._collaboration
    assert len(collaboration._trackers) <= 2
    assert len(collaboration._latest) <= 3
    assert len(vars(collaboration.aligner)["_aligners"]) <= 2


def test_stamps_tell_the_age_of_a_list() -> None:
    """The other's lists are of 0.2 s ago, and their stamps say so; nothing that is seen in these frames could."""
    core = NodeCore("car1", 1)
    still = Boxes.concatenate([CARS, CARS.replace(center=CARS.center + [7.0, 20.0, 0.0])])
    for k in range(10):
        now = 0.1 * k
        receive(core, message_of("car2", now - 0.2, still, sequence=k), now)
        core.observe(OwnList(still, now), now)
        result = core.align(now)
    assert result is not None
    assert result.alignments["car2"].time_offset == pytest.approx(-0.2, abs=0.01)


def test_link_that_becomes_slow_is_refused() -> None:
    drive = Drive()
    drive.run(10)
    queue: list[Outgoing] = []

    def slow(sent: Outgoing) -> Iterable[tuple[bytes, bytes]]:
        queue.append(sent)
        return [(queue[-11].data, queue[-11].header)] if len(queue) > 10 else []

    result = drive.run(30, slow)
    assert set(drive.refused[10:]) == {"late"}
    assert not result.alignments["car2"].accepted


def test_clock_that_is_set_starts_anew() -> None:
    drive = Drive()
    drive.run(20)
    drive.clock_difference = -1000.0
    assert drive.error(drive.run(20)) < 1.0
    assert "car2: its clock was set" in drive.ego.events


def test_two_agents_with_one_id() -> None:
    drive = Drive()
    drive.run(10)
    impostor = NodeCore("car2", 3000)

    def two(sent: Outgoing) -> Iterable[tuple[bytes, bytes]]:
        other = impostor.observe(own_list(frames(3)[drive.step % 40], "car3", drive.now), drive.now)
        return [(sent.data, sent.header), (other.data, other.header)]

    assert drive.error(drive.run(20, two)) < 1.0, "the first one is used"
    assert drive.ego.metrics.value("two_agents", agent="car2") == 1
    assert sum("two agents" in event for event in drive.ego.events) == 1
    assert set(drive.refused[11::2]) == {"second agent"}


def test_own_id_of_another_is_reported() -> None:
    core = NodeCore("car1", 1)
    assert receive(core, message_of("car1", 0.0, session=9), 0.0) == "own id"
    assert receive(core, message_of("car1", 0.0, session=1), 0.0) == "echo"
    assert [event for event in core.events if "another agent sends as car1" in event]


def test_newer_versions_are_refused_by_name() -> None:
    core = NodeCore("car1", 1)
    data, header = message_of("car2", 0.0)
    newer = data[:4] + b"\x09" + data[5:] + b"more fields"
    assert core.receive(newer, 0.0, encode_header(SessionHeader(5, 0), newer)) == "newer version"
    assert core.receive(data, 0.0, header[:4] + b"\x02" + header[5:] + b"more") == "newer version"
    assert len(core.events) == 1, "said once"


@pytest.mark.parametrize(
    ("boxes", "time", "why"),
    [
        (CARS.replace(center=[(0, 0, 0), (9000, 0, 0)]), 0.0, "9 km apart"),
        (CARS.replace(center=CARS.center + [1e9, 0, 0]), 0.0, "at no place on Earth"),
        (CARS.replace(size=[(4.5, 1.9, 1.5), (500.0, 2.0, 2.0)]), 0.0, "500 m long"),
        (CARS, 1e15, "microseconds"),
        (Boxes(np.zeros((300, 3)), np.ones((300, 3)), np.zeros(300)), 0.0, "too many"),
    ],
)
def test_implausible_lists_are_refused(boxes: Boxes, time: float, why: str) -> None:
    core = NodeCore("car1", 1)
    assert receive(core, message_of("car2", time, boxes), 0.0) == "implausible", why
    if time == 0.0:
        with pytest.raises(ValueError, match="boxes"):
            core.observe(OwnList(boxes, 0.0), 0.0)


def test_agents_are_bounded() -> None:
    core = NodeCore("car1", 1, NodeSettings(max_agents=3))
    refused = [receive(core, message_of(f"agent{k}", 0.0), 0.0) for k in range(1000)]
    assert refused[:3] == ["", "", ""]
    assert set(refused[3:]) == {"too many agents"}
    assert len(core.events) == 4
    assert len(core.metrics.text().splitlines()) < 100


@pytest.mark.parametrize("kind", ["cpm", "sdsm"])
def test_standard_message_without_header_is_aligned(kind: str) -> None:
    drive, tracker = Drive(), Sort()

    def as_standard(sent: Outgoing) -> Iterable[tuple[bytes, None]]:
        message = replace(decode(sent.data), agent_id="42", body=None)
        tracked = tracker.update(message.boxes.replace(track_id=None), message.time)
        if kind == "cpm":
            data = cpm.encode(cpm.CollectivePerception(42, message.time, tracked))
        else:
            data = sdsm.encode(sdsm.SensorDataSharing(42, message.time, tracked))
        return [(data, None), (data, None)]

    result = drive.run(20, as_standard)
    assert result.alignments["42"].accepted
    assert drive.refused == ["", "duplicate"] * 20


def test_synchronised_clocks_can_be_required() -> None:
    core = NodeCore("car1", 1, NodeSettings(clock_tolerance=1.0))
    core.observe(OwnList(CARS, 500.0), 0.0)
    assert receive(core, message_of("car2", 500.4), 0.2) == ""
    assert receive(core, message_of("car3", 499.0), 2.0) == "other clock"


@pytest.mark.parametrize("step", [1e-310, 1e-12, 1e-4, 1e-3, 0.01])
def test_lists_that_follow_at_once(step: float) -> None:
    """Found by the fuzzer: velocities over the shortest times are infinite."""
    core = NodeCore("car1", 1)
    cars = Boxes.concatenate([CARS, CARS.replace(center=CARS.center + [7.0, 20.0, 0.0])])
    tracked = cars.replace(track_id=[1, 2, 3, 4])
    for k in range(6):
        time = step * (k + 1) if k < 5 else 0.5
        moved = tracked.replace(center=tracked.center + [0.5 * (k % 2), 0.0, 0.0])
        receive(core, message_of("car2", time, moved, sequence=k), 0.1 * k)
        core.observe(OwnList(cars, 0.1 * k), 0.1 * k)
        assert core.align(0.1 * k) is not None


def test_own_list_that_is_late_is_refused() -> None:
    core = NodeCore("car1", 1)
    core.observe(OwnList(CARS, 10.0), 0.0)
    for late in (9.9, 10.0, 10.0 + 1e-9):
        with pytest.raises(ValueError, match="not later"):
            core.observe(OwnList(CARS.replace(track_id=[1, 2]), late), 0.1)
    core.observe(OwnList(CARS, 10.1), 0.1)
    assert core.align(0.1) is not None


def test_own_clock_set_back_starts_anew() -> None:
    drive = Drive()
    drive.run(20)
    core = drive.ego
    core.observe(own_list(frames()[20], "car1", 1.0), drive.now)
    result = core.align(drive.now)
    assert result is not None
    assert result.time == 1.0
    assert any("time goes back" in event for event in core.events)


def test_own_track_ids_of_any_size_are_sent() -> None:
    core = NodeCore("car1", 1)
    sent = core.observe(OwnList(CARS.replace(track_id=[2**40 + 3, -1]), 0.0), 0.0)
    ids = decode(sent.data).boxes.track_id
    assert ids is not None
    assert len(set(ids.tolist())) == 2


def test_own_vehicle_is_sent_with_every_list() -> None:
    body = CARS[:1].replace(center=[(0.5, 0.0, 0.0)])
    core = NodeCore("car1", 1, body=body)
    sent = [core.observe(OwnList(CARS, 0.0), 0.0), core.observe(OwnList(CARS, 0.1, CARS[:1]), 0.1)]
    found = [decode(each.data).body for each in sent]
    assert [each.center[0, 0] for each in found if each is not None] == [0.5, 10.0]


def test_node_before_its_first_list() -> None:
    core = NodeCore("car1", 1)
    assert receive(core, message_of("car2", 0.0), 0.0) == ""
    assert core.align(0.0) is None


@pytest.mark.parametrize("agent", ["", "a" * 65, "a\nb"])
def test_impossible_agent_ids_are_refused(agent: str) -> None:
    with pytest.raises(MessageError, match="agent_id"):
        NodeCore(agent, 1)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 39), st.integers(0, 3), st.integers(0, 2000)), min_size=1, max_size=40),
    st.lists(st.binary(max_size=60), max_size=10),
)
def test_node_survives_arbitrary_deliveries(deliveries: list[tuple[int, int, int]], noise: list[bytes]) -> None:
    """Recorded messages in any order, some damaged, between others that mean nothing."""
    core = NodeCore("car1", 7)
    for step, (index, kind, at) in enumerate(deliveries):
        now = 0.1 * step
        sent = recorded()[index]
        data, header = sent.data, sent.header
        if kind == 1:
            data = data[: at % len(data)]
        elif kind == 2:
            data = data[: at % len(data)] + b"\xff" + data[at % len(data) + 1 :]
        core.receive(data, now, None if kind == 3 else header)
        for each in noise:
            core.receive(each, now, each)
        core.observe(own_list(frames()[step % 80], "car1", now), now)
        assert core.align(now) is not None
