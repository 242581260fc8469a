"""Training in two processes, as `torchrun` starts them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cobevglue.perception import PointPillars
from cobevglue.training import train_detector

from .boxes_on_a_plane import BoxesOnAPlane
from .two_processes import CONFIG

TESTS = Path(__file__).resolve().parents[1]

LOOPBACK = "lo0" if sys.platform == "darwin" else "lo"


def torchrun(*words: object, new: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Two processes of this program, which makes the folder `new`. Gloo (torch 2.13) now and then hangs here in
    its first collective, before any step of ours: both processes wait, with unread bytes in both sockets. Then they are
    stopped and started again."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [*launcher, *map(str, words)]
    for _ in range(5):
        if new is not None:
            shutil.rmtree(new, ignore_errors=True)  # of a try that was too slow
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(TESTS), "GLOO_SOCKET_IFNAME": LOOPBACK},
        ) as process:
            try:
                out, error = process.communicate(timeout=75)
            except subprocess.TimeoutExpired:
                process.terminate()  # the launcher then stops what it started
                continue
            return subprocess.CompletedProcess(command, process.returncode, out, error)
    raise TimeoutError("torchrun: five times its processes did not finish")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two processes: one epoch, and another after it was resumed."""
    folder = tmp_path_factory.mktemp("two") / "run"
    done = torchrun("-m", "training.two_processes", folder, new=folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_one_process_writes_for_both(folder: Path) -> None:
    entries = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    # Twelve samples in batches of two are six steps alone and three together.
    assert [entry["step"] for entry in entries if entry["group"] == "epoch"] == [3, 6]
    assert [entry["epoch"] for entry in entries if entry["group"] == "validation"] == [1, 2]
    assert len(list(folder.glob("events.*"))) == 2
    assert PointPillars.load(folder / "last.safetensors").metadata["epoch"] == 2


def test_resuming_with_other_process_count_raises(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"number of processes \(2 before, now 1\)"):
        train_detector(CONFIG, folder, resume=True, source=BoxesOnAPlane(), validation_source=BoxesOnAPlane())


def test_the_program_can_be_started_so(folder: Path) -> None:
    """Both processes find the run that is there, and refuse; nothing is trained."""
    done = torchrun("-m", "cobevglue", "train", "detector", "--config", "tiny", "--out", folder, "--set", "device=cpu")
    assert done.returncode != 0
    assert "has a run already" in done.stderr
