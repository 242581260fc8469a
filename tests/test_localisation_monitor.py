"""The localisation monitor: false claims are found, honest ones are not, and the right agent is named."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2
from cobevglue.alignment import Alignment
from cobevglue.localisation_monitor import LocalisationMonitor, LocalisationMonitorConfig, LocalisationReport
from cobevglue.typing import FloatArray

COVARIANCE = np.diag([0.25, 0.25, math.radians(0.5) ** 2])
TRUE = {"car1": SE2(100.0, 50.0, 0.7), "car2": SE2(120.0, 40.0, 2.0), "car3": SE2(90.0, 80.0, -1.0)}


def aligned(pose: SE2, **fields: float) -> Alignment:
    known: dict[str, Any] = {"risk": 0.001, "evidence": 30.0, "margin": 25.0} | fields
    return Alignment(pose, covariance=np.diag([0.1, 0.1, 1e-4]), **known)


def drive(
    false: dict[str, SE2],
    frames: int = 20,
    names: tuple[str, ...] = ("car1", "car2", "car3"),
    monitor: LocalisationMonitor | None = None,
    **fields: float,
) -> LocalisationReport:
    """The last report where claims are off, in the world's axes, by `false` from the first frame on."""
    monitor = monitor or LocalisationMonitor()
    claimed = {}
    for name in names:
        off = false.get(name, SE2())
        pose = SE2(TRUE[name].x + off.x, TRUE[name].y + off.y, TRUE[name].yaw + off.yaw)
        claimed[name] = pose, COVARIANCE
    found = {name: aligned(TRUE["car1"].inverse() @ TRUE[name], **fields) for name in names[1:]}
    for _ in range(frames):
        report = monitor.update(None, claimed, found, "car1")
    return report


@pytest.mark.parametrize(
    ("why", "false", "alarm", "faulty"),
    [
        ("all claims are true", {}, False, set()),
        ("an error as large as claimed is honest", {"car2": SE2(0.7, -0.5, 0.01)}, False, set()),
        ("another agent is 10 m off", {"car2": SE2(8.0, 6.0)}, True, {"car2"}),
        ("the ego itself is 10 m off", {"car1": SE2(8.0, 6.0)}, True, {"car1"}),
        ("a heading 40 degrees off", {"car3": SE2(0.0, 0.0, 0.7)}, True, {"car3"}),
        ("two of three are off, in different ways", {"car2": SE2(9.0), "car3": SE2(0.0, 9.0)}, True, set()),
        ("all are off alike: no pair can tell", {n: SE2(50.0, 9.0) for n in TRUE}, False, set()),
    ],
)
def test_claims_of_three_agents(why: str, false: dict[str, SE2], alarm: bool, faulty: set[str]) -> None:
    report = drive(false)
    assert report.alarm is alarm, why
    assert report.faulty == faulty, why


def test_two_agents_give_no_attribution() -> None:
    report = drive({"car2": SE2(8.0, 6.0)}, names=("car1", "car2"))
    assert report.alarm
    assert report.faulty == frozenset()
    assert report.unresolved == [("car1", "car2")]
    assert report.prior("car2") is None


def test_two_colluding_agents_blame_the_third() -> None:
    """A limit: whoever is alone against a majority is taken for the faulty one."""
    report = drive({"car2": SE2(9.0, 9.0), "car3": SE2(9.0, 9.0)})
    assert report.faulty == {"car1"}


def test_jump_is_found_within_a_second() -> None:
    monitor = LocalisationMonitor()
    drive({}, 100, monitor=monitor)
    assert drive({"car2": SE2(3.0, 4.0)}, 10, monitor=monitor).alarm


def test_drift_is_found_before_five_metres() -> None:
    monitor = LocalisationMonitor()
    drive({}, 100, monitor=monitor)
    for frame in range(1000):
        off = 0.01 * frame
        if drive({"car2": SE2(off)}, 1, monitor=monitor).alarm:
            break
    assert 2.0 < off < 5.0


def test_alarm_ends_with_the_attack() -> None:
    monitor = LocalisationMonitor()
    drive({}, 50, monitor=monitor)
    assert drive({"car2": SE2(30.0)}, 300, monitor=monitor).alarm
    assert not drive({}, 20, monitor=monitor).alarm


def test_one_wrong_alignment_is_no_alarm() -> None:
    monitor = LocalisationMonitor()
    drive({}, 50, monitor=monitor)
    assert not drive({"car2": SE2(40.0)}, 3, monitor=monitor).alarm


@pytest.mark.parametrize(
    ("why", "fields"),
    [
        ("a risky alignment", {"risk": 0.2}),
        ("a different pose has nearly as much evidence", {"margin": 3.0}),
    ],
)
def test_uncertain_alignments_are_not_used(why: str, fields: dict[str, Any]) -> None:
    assert drive({"car2": SE2(30.0)}, **fields).pairs == {}, why


def test_refused_alignments_are_left_out() -> None:
    claimed = {name: (pose, COVARIANCE) for name, pose in TRUE.items()}
    report = LocalisationMonitor().update(0.0, claimed, {"car2": Alignment.refused("no")}, "car1")
    assert report.pairs == {}
    assert report.prior("car2") is None


def test_consistent_claim_is_the_prior() -> None:
    prior = drive({}).prior("car2")
    assert prior is not None
    translation, yaw = prior[0].error_to(TRUE["car1"].inverse() @ TRUE["car2"])
    assert translation < 1e-9
    assert yaw < 1e-9
    assert np.linalg.eigvalsh(prior[1]).min() > 0.0


def test_reset_forgets_the_alarm() -> None:
    monitor = LocalisationMonitor()
    assert drive({"car2": SE2(30.0)}, monitor=monitor).alarm
    monitor.reset()
    assert not drive({}, 1, monitor=monitor).alarm


@settings(max_examples=25, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-1e4, 1e4), st.floats(-1e4, 1e4))
def test_world_axes_do_not_matter(yaw: float, x: float, y: float) -> None:
    """The same claims in another world frame give the same statistics."""
    world = SE2(x, y, yaw)
    off = SE2(1.0, 0.5, 0.02)
    statistics = []
    for frame in (SE2(), world):
        claimed = {
            "car1": (frame @ TRUE["car1"], COVARIANCE),
            "car2": (
                frame @ SE2(TRUE["car2"].x + off.x, TRUE["car2"].y + off.y, TRUE["car2"].yaw + off.yaw),
                COVARIANCE,
            ),
        }
        monitor = LocalisationMonitor()
        for _ in range(5):
            report = monitor.update(None, claimed, {"car2": aligned(TRUE["car1"].inverse() @ TRUE["car2"])}, "car1")
        statistics.append(report.pairs["car1", "car2"].deviations)
    assert statistics[0] == pytest.approx(statistics[1], rel=1e-6)


def test_honest_errors_have_the_stated_size() -> None:
    """Independent oracle: claims drawn from their covariance are rarely beyond 3 deviations."""
    rng = np.random.default_rng([0, 90])
    above = 0
    for _ in range(200):
        false = {name: SE2(*rng.multivariate_normal(np.zeros(3), COVARIANCE)) for name in ("car1", "car2")}
        above += drive(false, 5, names=("car1", "car2")).pairs["car1", "car2"].deviations > 3.0
    assert above <= 8  # 1.1 % are expected of two Gaussian components


@pytest.mark.parametrize(
    ("message", "ego", "covariance"),
    [
        ("claimed: there is no agent", "car9", COVARIANCE),
        ("claimed: car2: the covariance must be", "car1", np.zeros((3, 3))),
        ("claimed: car2: the covariance must be", "car1", np.eye(2)),
    ],
)
def test_bad_input_is_named(message: str, ego: str, covariance: FloatArray) -> None:
    claimed = {"car1": (TRUE["car1"], COVARIANCE), "car2": (TRUE["car2"], covariance)}
    with pytest.raises(ValueError, match=message):
        LocalisationMonitor().update(0.0, claimed, {}, ego)


def test_unknown_settings_are_errors() -> None:
    with pytest.raises(ValueError, match="did you mean 'jump_time'"):
        LocalisationMonitorConfig.model_validate({"jump_tim": 1.0})
