"""Optimisation: AdamW, learning rate schedule, precision, exponential moving average of the weights."""

from __future__ import annotations

import copy
import math
from typing import Annotated, Generic, Literal, TypeVar

import torch
from pydantic import Field
from torch import Tensor, nn

from cobevglue.settings import Settings
from cobevglue.training.checkpoint import RunState

__all__ = ["Learner", "MeanWeights", "OptimisationConfig", "autocast", "learning_rate", "make_optimizer"]

Model = TypeVar("Model", bound=nn.Module)

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0.0, lt=1.0)]


class OptimisationConfig(Settings):
    """Settings of the optimisation: AdamW with one cycle of the learning rate over all steps.

    Attributes:
        epochs: number of epochs.
        samples_per_epoch: of all processes together, rounded down to full batches.
        batch_size: number of samples per step and process.
        learning_rate: maximum learning rate.
        start: learning rate of the first step, relative to the maximum.
        warm_up: share of all steps in which the learning rate increases to the maximum, as half a cosine.
        end: learning rate of the last step, relative to the maximum; it decreases as half a cosine.
        weight_decay: of weights with more than one dimension, not of biases and normalisation.
        clip: maximum norm of the gradient.
        mean_decay: decay per step of the exponential moving average of the weights, which is validated and saved
            (smaller in the first steps); 0 uses the current weights.
        precision: of convolutions and matrix products; weights, normalisation and loss are always float32. "auto" is
            bfloat16 on CUDA and float32 elsewhere. On CPUs with AVX512-BF16 or AMX, "bfloat16" halves the time.
    """

    epochs: Annotated[int, Field(ge=1)] = 30
    samples_per_epoch: Annotated[int, Field(ge=1)] = 1000
    batch_size: Annotated[int, Field(ge=1)] = 4
    learning_rate: _Positive = 2e-3
    start: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    warm_up: _Share = 0.1
    end: Annotated[float, Field(ge=0.0, le=1.0)] = 1e-3
    weight_decay: Annotated[float, Field(ge=0.0)] = 0.01
    clip: _Positive = 10.0
    mean_decay: _Share = 0.999
    precision: Literal["auto", "float32", "bfloat16"] = "auto"

    def steps_per_epoch(self, processes: int = 1) -> int:
        """Number of full batches per epoch and process.

        Raises:
            ValueError: less than one.
        """
        steps = self.samples_per_epoch // (self.batch_size * processes)
        if not steps:
            raise ValueError(
                f"optimisation.samples_per_epoch: {self.samples_per_epoch} samples are no full batch of "
                f"{self.batch_size}" + (f" for each of {processes} processes" if processes > 1 else "")
            )
        return steps


def autocast(config: OptimisationConfig, device: torch.device) -> torch.autocast:
    """Context of the forward pass in the precision of `config`."""
    wanted = config.precision == "bfloat16" or (config.precision == "auto" and device.type == "cuda")
    return torch.autocast(device.type, torch.bfloat16, enabled=wanted)


def learning_rate(step: int, steps: int, config: OptimisationConfig) -> float:
    """Learning rate of step `step` (from 0) of `steps`: a function without state, so nothing is stored for resuming."""
    rising = config.warm_up * steps
    if step < rising:
        return config.learning_rate * _half_cosine(config.start, 1.0, step / rising)
    return config.learning_rate * _half_cosine(1.0, config.end, (step - rising) / max(steps - 1 - rising, 1.0))


def _half_cosine(first: float, last: float, share: float) -> float:
    return last + (first - last) * (1.0 + math.cos(math.pi * min(share, 1.0))) / 2.0


def make_optimizer(model: nn.Module, config: OptimisationConfig) -> torch.optim.AdamW:
    """AdamW over the trainable parameters, with weight decay for those of more than one dimension."""
    parameters = [p for p in model.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in parameters if p.ndim > 1], "weight_decay": config.weight_decay},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=config.learning_rate, betas=(0.9, 0.99))


class MeanWeights(Generic[Model]):
    """Exponential moving average of the weights and the normalisation statistics of a model.

    Attributes:
        model: the averaged model, in evaluation mode.
    """

    def __init__(self, model: Model, decay: float) -> None:
        """Start from the current weights."""
        self.model = copy.deepcopy(model)
        self.model.eval().requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, model: nn.Module, step: int) -> None:
        """Update the average with the weights after step `step` (from 0)."""
        decay = min(self._decay, (1.0 + step) / (10.0 + step))
        ours, theirs = self.model.state_dict(), model.state_dict()
        floating = [name for name, value in ours.items() if value.is_floating_point()]
        torch._foreach_lerp_([ours[n] for n in floating], [theirs[n] for n in floating], 1.0 - decay)
        for name in ours.keys() - set(floating):
            ours[name].copy_(theirs[name])


class Learner(Generic[Model]):
    """A model, the moving average of its weights, and its optimiser.

    Attributes:
        model: the model in training.
        mean: the averaged model, for validation and saving.
        config: settings.
    """

    def __init__(self, model: Model, config: OptimisationConfig, state: RunState | None = None) -> None:
        """Start from the current weights, or from a saved state.

        Args:
            model: to train.
            config: settings.
            state: of the run to resume; loaded into the model, too.
        """
        self.model, self.config = model, config
        if state is not None:
            model.load_state_dict(state.model)
        self._mean = MeanWeights(model, config.mean_decay)
        self.mean = self._mean.model
        self._optimizer = make_optimizer(model, config)
        if state is not None:
            self.mean.load_state_dict(state.mean_model)
            self._optimizer.load_state_dict(state.optimizer)

    def learn(self, loss: Tensor, step: int, steps: int) -> tuple[float, Tensor]:
        """Perform optimisation step `step` (from 0) of `steps`.

        Returns:
            The learning rate, and the norm of the gradient before clipping.
        """
        rate = learning_rate(step, steps, self.config)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.config.clip)
        self._optimizer.step()
        self._mean.update(self.model, step)
        return rate, norm.detach()

    def state(
        self, config: Settings, epoch: int, elapsed: float, processes: int = 1, best: float | None = None
    ) -> RunState:
        """The state for resuming; see `RunState`."""
        return RunState(
            config=config.model_dump(mode="json"),
            processes=processes,
            epoch=epoch,
            elapsed=elapsed,
            best=best,
            model=self.model.state_dict(),
            mean_model=self.mean.state_dict(),
            optimizer=self._optimizer.state_dict(),
        )
