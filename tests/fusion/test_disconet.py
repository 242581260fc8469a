"""DiscoNet's edge weights, and its teacher."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from cobevglue.fusion import FUSION_METHODS, FusionSample
from cobevglue.fusion.disconet import DiscoNet, EarlyTeacher, distillation_loss
from cobevglue.perception import DetectionLoss, TargetBatch, assign_targets, collate_targets

from . import checks

DETECTOR = checks.small_detector()


def make_method(seed: int = 1) -> DiscoNet:
    return checks.seeded(DiscoNet, DETECTOR, seed)


def make_sample(agents: int = 2) -> FusionSample:
    """With the features of a merged cloud, which differ from those of any agent."""
    sample = checks.sample_of([checks.view(DETECTOR, seed) for seed in range(agents)])
    return replace(sample, early_features=checks.view(DETECTOR, 10).features)


def make_targets(samples: int) -> TargetBatch:
    anchors = DETECTOR.anchors
    car = np.array([[3.0, 1.0, -1.0, 4.5, 1.9, 1.6, 0.3]])
    return collate_targets([assign_targets(car, np.zeros(1, dtype=bool), anchors)] * samples, len(anchors))


def test_cell_is_softmax_weighted_sum_of_agents() -> None:
    method = make_method()
    maps = torch.rand(3, 8, 4, 5)
    covered = torch.ones(3, 1, 4, 5)
    covered[1, 0, :2] = 0.0
    covered[2, 0, 0] = 0.5
    (fused,) = method.fuse_maps([maps], [covered])
    for row, column in [(0, 0), (1, 3), (3, 4)]:
        weights = []
        for agent in range(3):
            pair = torch.cat([maps[0, :, row, column], maps[agent, :, row, column]])
            logit = method.edge(pair[None, :, None, None]).item()
            weights.append(math.exp(logit) * covered[agent, 0, row, column].item())
        expected = sum(w / sum(weights) * m for w, m in zip(weights, maps[:, :, row, column], strict=True))
        torch.testing.assert_close(fused[:, row, column], expected, rtol=1e-4, atol=1e-5)


def test_gradients_are_finite_outside_coverage() -> None:
    maps = torch.rand(2, 8, 4, 5, requires_grad=True)
    covered = torch.ones(2, 1, 4, 5)
    covered[1, 0, :2] = 0.0
    (fused,) = make_method().fuse_maps([maps], [covered])
    fused.square().sum().backward()  # type: ignore[no-untyped-call]
    assert maps.grad is not None
    assert torch.isfinite(maps.grad).all()
    assert not maps.grad[1, :, :2].any()


def test_distillation_loss_is_zero_for_equal_maps() -> None:
    torch.manual_seed(0)
    student, teacher = torch.randn(2, 8, 4, 5), torch.randn(2, 8, 4, 5)
    assert distillation_loss(teacher, teacher).item() == pytest.approx(0.0, abs=1e-6)
    assert distillation_loss(teacher + 3.0, teacher).item() == pytest.approx(0.0, abs=1e-6)  # as softmax is
    assert distillation_loss(student, teacher).item() > 0.1


def test_distillation_of_a_cell_is_written_out() -> None:
    student, teacher = torch.tensor([0.0, 0.0]), torch.tensor([math.log(3.0), 0.0])
    expected = 0.75 * math.log(0.75 / 0.5) + 0.25 * math.log(0.25 / 0.5)
    assert distillation_loss(student.view(1, 2, 1, 1), teacher.view(1, 2, 1, 1)).item() == pytest.approx(expected)


def test_the_loss_has_the_teachers_part() -> None:
    method, loss = make_method(), DetectionLoss(checks.SMALL)
    samples = [make_sample(), make_sample(3)]
    targets = make_targets(2)
    plain = method.loss(samples, targets, loss)
    assert "distillation" not in plain
    method.teacher = EarlyTeacher(DETECTOR)
    taught = method.loss(samples, targets, loss)
    assert taught["distillation"].item() > 0.0
    assert taught["total"].item() == pytest.approx(
        plain["total"].item() + method.distillation_weight * taught["distillation"].item(), rel=1e-5
    )


def test_single_agent_has_zero_distillation_loss() -> None:
    method = make_method()
    method.teacher = EarlyTeacher(DETECTOR)
    alone = checks.sample_of([checks.view(DETECTOR, 0)])
    terms = method.loss([alone], make_targets(1), DetectionLoss(checks.SMALL))
    assert terms["distillation"].item() == pytest.approx(0.0, abs=1e-6)


def test_samples_without_early_features_are_skipped() -> None:
    method, loss = make_method(), DetectionLoss(checks.SMALL)
    method.teacher = EarlyTeacher(DETECTOR)
    known, unknown = make_sample(), replace(make_sample(), early_features=None)
    both = method.loss([known, unknown], make_targets(2), loss)["distillation"]
    assert both.item() == pytest.approx(method.loss([known], make_targets(1), loss)["distillation"].item(), rel=1e-5)
    assert method.loss([unknown], make_targets(1), loss)["distillation"].item() == 0.0


def test_teacher_is_frozen_and_not_in_student() -> None:
    method = make_method()
    names = set(method.state_dict())
    teacher = EarlyTeacher(DETECTOR).train()
    method.teacher = teacher
    method.train()
    method.loss([make_sample()], make_targets(1), DetectionLoss(checks.SMALL))["total"].backward()  # type: ignore[no-untyped-call]
    assert method.teacher is teacher
    assert not teacher.training
    assert set(method.state_dict()) == names
    assert all(p.grad is None and not p.requires_grad for p in teacher.parameters())
    method.teacher = None
    assert "distillation" not in method.loss([make_sample()], make_targets(1), DetectionLoss(checks.SMALL))


def test_the_teacher_learns_from_the_merged_cloud_alone() -> None:
    teacher = EarlyTeacher(DETECTOR)
    sample = make_sample()
    with torch.no_grad():
        blind = replace(sample, observations=[checks.view(DETECTOR, 7), checks.view(DETECTOR, 8)])
        assert torch.equal(teacher([sample]).logits, teacher([blind]).logits)
    terms = teacher.loss([sample], make_targets(1), DetectionLoss(checks.SMALL))
    terms["total"].backward()  # type: ignore[no-untyped-call]
    assert [name for name, p in teacher.named_parameters() if p.grad is None or not p.grad.any()] == []
    with pytest.raises(ValueError, match="samples: 1: early_features"):
        teacher([sample, replace(sample, early_features=None)])


def test_it_goes_by_the_name_that_users_type() -> None:
    assert FUSION_METHODS["disconet"] is DiscoNet
