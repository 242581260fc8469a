"""One sequence under many conditions: participating agents, ground truth, poses and messages."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.disturbance import LocalisationNoise
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.models import Models
from cobevglue.experiments.results import ConditionResult, ScenarioResult
from cobevglue.experiments.run import MessageMemo, run_sequence
from cobevglue.experiments.study import StudySettings, open_sequence
from cobevglue.fusion.late import LateFusion
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.se2 import SE2

from .tiny import CARS, tiny_settings, world_SE3_lidar, write_agent

STRONG = {"disturbance": "noise", "disturbance_options": {"position": 2.5, "yaw": 2.5}}
CLEAN = Condition(fusion="cobevglue", aligner="given")
ALONE = Condition(fusion="none", aligner="given")
OURS = Condition(fusion="cobevglue", aligner="bevglue")


def run(settings: StudySettings, conditions: list[Condition], number: int = 0) -> ScenarioResult:
    return run_sequence(settings, open_sequence(settings, number), number, conditions, Models(settings))


def numbers(result: ConditionResult) -> list[list[list[float]]]:
    """The boxes of all frames."""
    rows = []
    for frame in result.frames.values():
        boxes = frame.boxes
        assert boxes.score is not None
        rows.append(np.column_stack([boxes.center, boxes.size, boxes.yaw, boxes.score]).tolist())
    return rows


@pytest.fixture(scope="module")
def settings(tiny: Path) -> StudySettings:
    return tiny_settings(tiny)


def test_true_poses_make_noise_harmless(settings: StudySettings) -> None:
    oracle = CLEAN.model_copy(update={"true_poses": True, **STRONG})
    result = run(settings, [CLEAN, oracle, CLEAN.model_copy(update=STRONG)])
    clean, under_noise, given = (numbers(one) for one in result.conditions.values())
    assert under_noise == clean
    assert given != clean


@pytest.mark.parametrize("attack", [STRONG, {"disturbance": "same-place"}, {"disturbance": "offset"}])
def test_claimed_poses_do_not_reach_bevglue(settings: StudySettings, attack: dict[str, object]) -> None:
    attacked = OURS.model_copy(update=attack)
    result = run(settings, [OURS, attacked])
    assert numbers(result.conditions[attacked.key]) == numbers(result.conditions[OURS.key])
    received = [[one.received for one in part.frames.values()] for part in result.conditions.values()]
    assert received[0] == received[1]


def test_pose_errors_are_those_of_the_noise(settings: StudySettings) -> None:
    noisy = CLEAN.model_copy(update=STRONG)
    result = run(settings, [CLEAN, noisy])
    assert result.conditions[CLEAN.key].frames[1].received[0].translation_error == pytest.approx(0.0, abs=1e-9)
    noise = LocalisationNoise(position=2.5, yaw=2.5)
    from cobevglue.experiments.observed_sequence import ObservedSequence

    sequence = ObservedSequence(Models(settings).detector)
    sequence.observe(open_sequence(settings, 0))
    claimed = noise.apply(sequence.frames, 1, "1", (settings.seed, 0)).claimed
    believed = SE2.from_matrix(np.linalg.inv(claimed["1"]) @ claimed["2"])
    true = SE2.from_matrix(np.linalg.inv(world_SE3_lidar(1, 1)) @ world_SE3_lidar(2, 1))
    (received,) = result.conditions[noisy.key].frames[1].received
    assert (received.translation_error, received.yaw_error) == pytest.approx(believed.error_to(true), abs=1e-6)
    assert received.agent == "2"
    assert received.accepted


def test_ground_truth_is_union_with_all_points(settings: StudySettings) -> None:
    result = run(settings, [ALONE])
    for truth in result.truth:
        assert len(truth.objects) == len(CARS)
        assert truth.point_count.min() >= 2 * 60  # of two agents, and some of the ground
        assert truth.objects.track_id is None
    assert result.ego == "1"
    assert result.scenario == "a_pair"


def test_late_agent_takes_part_from_arrival(settings: StudySettings) -> None:
    result = run(settings, [OURS, CLEAN], number=1)
    received = [[one.agent for one in frame.received] for frame in result.conditions[CLEAN.key].frames.values()]
    assert received == [["2"], ["2", "3"], ["2", "3"]]
    assert [list(truth.co_visible) for truth in result.truth] == received


def test_agents_come_and_go_and_egoless_frames_drop(tiny: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data" / "test" / "sequence"
    write_agent(folder, 1, range(3))
    write_agent(folder, 1, range(4, 5))
    write_agent(folder, 2, range(2))
    write_agent(folder, 2, range(3, 5))
    write_agent(folder, 3, range(5), with_clouds=False)
    settings = tiny_settings(tiny, root=str(tmp_path / "data"))
    result = run(settings, [OURS, CLEAN])
    assert result.left_out == {"agents without a cloud": 5, "frames without the ego": 1}
    frames = result.conditions[OURS.key].frames
    assert [[one.agent for one in frame.received] for frame in frames.values()] == [["2"], ["2"], [], ["2"]]


def test_a_roadside_unit_is_never_the_ego(tiny: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data" / "test" / "sequence"
    write_agent(folder, 1, range(2), name="-1")
    write_agent(folder, 2, range(2), name="7")
    result = run(tiny_settings(tiny, dataset="v2xset", root=str(tmp_path / "data")), [CLEAN])
    assert result.ego == "7"
    assert result.conditions[CLEAN.key].frames[0].received[0].agent == "-1"
    alone = tmp_path / "alone" / "test" / "drive"
    write_agent(alone, 1, range(2), name="-1")
    empty = run(tiny_settings(tiny, dataset="v2xset", root=str(tmp_path / "alone")), [CLEAN])
    assert (empty.ego, empty.truth) == ("", [])
    assert empty.left_out == {"frames without the ego": 2}


def test_a_single_agent_detects_alike_in_all_conditions(tiny: Path, tmp_path: Path) -> None:
    write_agent(tmp_path / "data" / "test" / "drive", 1, range(2))
    result = run(tiny_settings(tiny, root=str(tmp_path / "data")), [ALONE, OURS, CLEAN])
    alone, ours, clean = (numbers(one) for one in result.conditions.values())
    assert alone == ours == clean
    assert [truth.co_visible for truth in result.truth] == [{}, {}]


def test_a_frame_without_objects_is_a_frame(tiny: Path, tmp_path: Path) -> None:
    for agent in (1, 2):
        write_agent(tmp_path / "data" / "test" / "sequence", agent, range(2), cars=CARS[:0])
    result = run(tiny_settings(tiny, root=str(tmp_path / "data")), [OURS, CLEAN])
    assert [len(truth.objects) for truth in result.truth] == [0, 0]
    assert [truth.co_visible for truth in result.truth] == [{"2": 0}] * 2
    assert len(result.conditions[OURS.key].frames) == 2


def test_conditions_can_be_run_on_some_frames_only(settings: StudySettings) -> None:
    some = CLEAN.model_copy(update={"every": 2})
    result = run(settings, [CLEAN, some])
    assert list(result.conditions[some.key].frames) == [0, 2]
    assert numbers(result.conditions[some.key]) == numbers(result.conditions[CLEAN.key])[::2]


def test_long_sequence_is_independent_of_blocks(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for agent in (1, 2):
        write_agent(tmp_path / "data" / "test" / "sequence", agent, range(9))
    settings = tiny_settings(tiny, root=str(tmp_path / "data"))
    late = Condition(fusion="late", aligner="given", disturbance="delay", disturbance_options={"seconds": 0.3})
    old = Condition(fusion="late", aligner="given", disturbance="replay", disturbance_options={"seconds": 0.5})
    whole = run(settings, [OURS, late, old])
    monkeypatch.setattr("cobevglue.experiments.run._BLOCK", 4)
    blocks = run(settings, [OURS, late, old])
    for key in whole.conditions:
        assert numbers(blocks.conditions[key]) == numbers(whole.conditions[key])
    assert not whole.conditions[late.key].frames[2].received
    assert whole.conditions[late.key].frames[3].received


def test_work_is_reported_as_it_is_estimated(settings: StudySettings) -> None:
    from cobevglue.experiments.runner import _Job, _work_of

    conditions = [CLEAN, OURS, ALONE.model_copy(update={"every": 3})]
    done: list[float] = []
    run_sequence(settings, open_sequence(settings, 0), 0, conditions, Models(settings), done.append)
    assert sum(done) == pytest.approx(_work_of([_Job(settings, 0, tuple(conditions))]))


def test_a_message_is_made_once_for_a_view(settings: StudySettings) -> None:
    class Counting(LateFusion):
        made = 0

        def message(self, observation: PerceptionOutput) -> Arrays:
            self.made += 1
            return super().message(observation)

    models = Models(settings)
    from cobevglue.experiments.observed_sequence import ObservedSequence

    sequence = ObservedSequence(models.detector)
    sequence.observe(open_sequence(settings, 0))
    first, second = (frame.observations["2"] for frame in sequence.frames[:2])
    method = Counting(models.detector)
    memo = MessageMemo(method)
    assert memo.kind == "boxes"
    again = [memo.message(view) for view in (first, second, first, first)]
    assert method.made == 2
    assert again[0] is again[2]
    assert memo.saved > 0.0
    memo.clear()
    memo.message(first)
    assert method.made == 3


def test_evaluation_range_is_whole_metres_inside_detector(settings: StudySettings) -> None:
    assert Models(settings).evaluation_range == (-12.0, 12.0, -12.0, 12.0)
    models = Models(settings)
    from cobevglue.perception import CONFIGS

    ranges = {}
    for name, config in CONFIGS.items():
        models.detector = PointPillars(config)
        ranges[name] = models.evaluation_range
    assert ranges == {"compact": (-70.0, 70.0, -39.0, 39.0), "opv2v": (-140.0, 140.0, -39.0, 39.0)}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fusion": "none", "aligner": "bevglu"}, "no aligner 'bevglu'; did you mean 'bevglue'"),
        ({"fusion": "none", "aligner": "given", "disturbance": "nois"}, "no disturbance 'nois'; did you mean 'noise'"),
        ({"fusion": "none", "aligner": "given", "evry": 2}, "has no setting 'evry'; did you mean 'every'"),
    ],
)
def test_invalid_conditions_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Condition.model_validate(values)


def test_refused_poses_have_infinite_errors(settings: StudySettings) -> None:
    result = run(settings, [OURS])
    received = [one for frame in result.conditions[OURS.key].frames.values() for one in frame.received]
    assert received
    for one in received:
        assert one.accepted == math.isfinite(one.translation_error) == (one.reason == "")
        assert one.alignment_bytes == one.message_bytes["boxes"]


def test_boxes_are_stored_without_labels_and_tracks(settings: StudySettings) -> None:
    boxes = run(settings, [ALONE]).conditions[ALONE.key].frames[0].boxes
    assert isinstance(boxes, Boxes)
    assert boxes.track_id is None
    assert boxes.label is None


def test_frames_without_label_files_are_skipped_and_counted(settings: StudySettings) -> None:
    from dataclasses import replace

    from cobevglue.datasets import AgentFrame
    from cobevglue.experiments.observed_sequence import ObservedSequence

    def missing() -> tuple[np.ndarray, Boxes]:
        raise FileNotFoundError("calibration.json is not there")

    first, second, *_ = open_sequence(settings, 0)
    points = second.agents["2"].points
    broken = replace(second, agents={**second.agents, "2": AgentFrame(missing, lambda: points)})
    sequence = ObservedSequence(Models(settings).detector)
    assert sequence.observe([first, broken]) == range(1)
    assert sequence.left_out["frames without a label or calibration file"] == 1
