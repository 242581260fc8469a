"""Files of a run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from cobevglue.training.checkpoint import RunState, differing_keys, load_state, provenance, save_state

CPU = torch.device("cpu")


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    state = RunState({"a": {"b": [1]}}, 2, 3, 4.5, None, {"w": torch.ones(2)}, {"w": torch.zeros(2)}, {"state": {}})
    save_state(tmp_path / "state.pt", state)
    found = load_state(tmp_path / "state.pt", CPU)
    assert (found.config, found.processes, found.epoch) == ({"a": {"b": [1]}}, 2, 3)
    assert (found.elapsed, found.best) == (4.5, None)
    assert torch.equal(found.model["w"], torch.ones(2))
    assert [path.name for path in tmp_path.iterdir()] == ["state.pt"]  # nothing else is left


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04 cut off"])
def test_a_broken_file_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "state.pt").write_bytes(content)
    with pytest.raises(ValueError, match=r"state\.pt: not the state of a run"):
        load_state(tmp_path / "state.pt", CPU)


def test_a_missing_file_says_what_it_means(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no epoch of this run was completed"):
        load_state(tmp_path / "state.pt", CPU)


@pytest.mark.parametrize(
    ("one", "other", "names"),
    [
        ({"a": 1}, {"a": 1}, []),
        ({"a": 1, "b": {"c": 2}}, {"a": 1, "b": {"c": 3}}, ["b.c"]),  # dotted
        ({"a": 1}, {"b": 1}, ["a", "b"]),  # only in one of them
        ({"a": {"b": 1}}, {"a": 2}, ["a"]),  # a mapping against a value
    ],
)
def test_settings_that_differ_are_named(one: dict[str, object], other: dict[str, object], names: list[str]) -> None:
    assert differing_keys(one, other) == names


def test_weights_say_where_they_come_from() -> None:
    found = provenance()
    assert found["torch"] == torch.__version__
    assert found["command"]
