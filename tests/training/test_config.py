"""Settings of training: presets, files, single changes, and what is said of wrong ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from cobevglue.perception import CONFIGS
from cobevglue.training import PRESETS, load_config


def test_presets_are_what_their_names_say() -> None:
    assert PRESETS["compact"].model == CONFIGS["compact"]
    assert PRESETS["opv2v"].model == CONFIGS["opv2v"]
    assert all(load_config(name) == preset for name, preset in PRESETS.items())


@pytest.mark.parametrize(
    ("change", "where", "value"),
    [
        ("seed=7", "seed", 7),
        ("optimisation.learning_rate=1e-4", "optimisation.learning_rate", 1e-4),  # YAML would take it for text
        ("model=opv2v", "model", CONFIGS["opv2v"].model_dump()),  # a model by name
        ("model.use_intensity=true", "model", {**CONFIGS["compact"].model_dump(), "use_intensity": True}),
        ("data.worlds=null", "data.worlds", None),
        ("data.options={agents: 2}", "data.options", {"agents": 2}),
        ("data.root=some/where", "data.root", Path("some/where")),
    ],
)
def test_a_single_value_is_changed(change: str, where: str, value: object) -> None:
    found: Any = load_config("compact", [change]).model_dump()
    for name in where.split("."):
        found = found[name]
    assert found == value


@pytest.mark.parametrize(
    ("changes", "splits"),
    [
        ([], ("train", "validation")),  # the simulator's
        (["data.source=v2xset"], ("train", "validate")),
        (["data.source=dair-v2x"], ("train", "val")),
        (["data.source=opv2v", "data.split=test", "data.validation_split=mine"], ("test", "mine")),
    ],
)
def test_splits_are_named_as_in_the_data_set(changes: list[str], splits: tuple[str, str]) -> None:
    data = load_config("compact", changes).data
    assert (data.split_name(validation=False), data.split_name(validation=True)) == splits


def test_file_overrides_preset_and_changes_override_both(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("preset: tiny\nseed: 3\noptimisation: {epochs: 9, clip: 2}\n")
    config = load_config(str(file), ["optimisation.clip=1"])
    assert (config.seed, config.optimisation.epochs, config.optimisation.clip) == (3, 9, 1.0)
    assert config.data == PRESETS["tiny"].data


@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        ("compakt", (), "no preset 'compakt'; did you mean 'compact'"),
        (
            "tiny",
            ("optimisation.epoch=3",),
            "optimisation: OptimisationConfig has no setting 'epoch'; did you mean 'epoc",
        ),
        ("tiny", ("sede=3",), "did you mean 'seed'"),
        ("tiny", ("seed",), "'seed' must be key=value"),
        ("tiny", ("seed=[",), "not readable as YAML"),
        ("tiny", ("seed=-1",), "seed: Input should be greater than or equal to 0"),
        ("tiny", ("model=opv3v",), "model: no model 'opv3v'; did you mean 'opv2v'"),
        ("tiny", ("data.source=v2xse",), "data.source: no data 'v2xse'; did you mean 'v2xset'"),
    ],
)
def test_wrong_settings_are_named(name: str, changes: tuple[str, ...], said: str) -> None:
    with pytest.raises(ValueError) as refused:
        load_config(name, changes)
    assert said in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [("- 1\n", "must be a mapping"), ("a: [\n", "not readable as YAML"), ("sede: 1\n", "did you mean 'seed'")],
)
def test_a_bad_file_is_named(tmp_path: Path, text: str, said: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"bad\.yaml.*" + said):
        load_config(str(file))
    with pytest.raises(FileNotFoundError, match=r"gone\.yaml"):
        load_config(str(tmp_path / "gone.yaml"))
