"""`cobevglue train`: what it prints, and what it says of what cannot be trained."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cobevglue.cli import main

pytest.importorskip("torch")

from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.training import detector

from .boxes_on_a_plane import BoxesOnAPlane
from .small import SMALL

WORDS = ["train", "detector", "--config", "tiny", *(word for change in SMALL for word in ("--set", change))]


@pytest.fixture
def small_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes on a plane in the place of the simulator, which takes longer."""
    monkeypatch.setattr(detector, "make_source", lambda config, seed, validation: BoxesOnAPlane(int(validation)))


@pytest.mark.usefixtures("small_world")
def test_a_run_is_one_document_with_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main([*WORDS, "--out", str(out), "--max-minutes", "0", "--json"]) == 0
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert (document["folder"], document["epochs"], document["finished"]) == (str(out), 1, False)
    assert "epoch 1/2" in captured.err  # progress goes to standard error
    assert "resume" in captured.err

    assert main([*WORDS, "--out", str(out)]) == 2  # a run is there
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert "has a run already" in captured.err

    assert main([*WORDS, "--out", str(out), "--resume"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "detector", "--config", "tinny"], "did you mean 'tiny'"),  # a preset with a typing error
        (["train", "detector", "--config", "gone.yaml"], "gone.yaml"),  # a file that is not there
        (["train", "detector", "--config", "tiny", "--set", "sead=1"], "did you mean 'seed'"),
        (["train", "fusoin", "--config", "tiny"], "detector"),  # a stage that does not exist
        (["train", "fusion", "--config", "coalgin"], "did you mean 'coalign'"),
        (["train", "detector", "--config", "tiny", "--resume", "--out", "nowhere"], "no epoch of this run"),
    ],
)
@pytest.mark.usefixtures("small_world")
def test_bad_input_is_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert len(captured.err.splitlines()) == 1


def test_an_interrupted_run_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupted(BoxesOnAPlane):
        def episode(self, index: int) -> list[LabelledCloud]:
            if index >= 8:  # of the second epoch
                raise KeyboardInterrupt
            return super().episode(index)

    monkeypatch.setattr(detector, "make_source", lambda config, seed, validation: Interrupted())
    assert main([*WORDS, "--out", str(tmp_path)]) == 130
    assert "--resume" in capsys.readouterr().err


def test_without_torch_there_is_one_line(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "from cobevglue.cli import main\n"
        "sys.exit(main(['train', 'detector', '--config', 'tiny']))"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        'error: the detector needs PyTorch, which is not installed: pip install "cobevglue[perception]"'
    ]
