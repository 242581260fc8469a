"""What test_processes.py starts with torchrun: `-m training.two_processes FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

from cobevglue.training import load_config, train_detector

from .boxes_on_a_plane import BoxesOnAPlane
from .small import SMALL

CONFIG = load_config("tiny", [*SMALL, "device=cpu", "optimisation.samples_per_epoch=12", "validation.episodes=3"])

if __name__ == "__main__":
    for resume in (False, True):  # one epoch, and another after the run was resumed
        train_detector(
            CONFIG,
            Path(sys.argv[1]),
            resume=resume,
            max_minutes=None if resume else 0.0,
            source=BoxesOnAPlane(0),
            validation_source=BoxesOnAPlane(1),
        )
