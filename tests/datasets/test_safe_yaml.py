"""numpy values in YAML are decoded, everything else with a Python tag is refused and never run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from cobevglue.datasets.safe_yaml import read_yaml


def load(path: Path, text: str, keys: tuple[str, ...] = ("a", "b")) -> dict[str, Any]:
    path.write_text(text)
    return read_yaml(path, keys)


@settings(max_examples=40, deadline=None)
@given(
    st_numpy.arrays(st.sampled_from(["<f8", ">f8", "<f4", "<i8", "|u1"]), st_numpy.array_shapes(min_dims=0, max_dims=3))
)
def test_dumped_numpy_arrays_round_trip(
    tmp_path_factory: pytest.TempPathFactory,
    array: np.ndarray,
) -> None:
    text = yaml.dump({"a": array, "b": array})  # the second one shares anchors with the first
    document = load(tmp_path_factory.mktemp("yaml") / "f.yaml", text)
    np.testing.assert_array_equal(document["a"], array.astype(np.float64))
    np.testing.assert_array_equal(document["b"], array.astype(np.float64))


def test_column_major_numpy_1_and_scalars_are_read(tmp_path: Path) -> None:
    pose = np.asfortranarray(np.arange(16.0).reshape(4, 4))
    text = yaml.dump({"a": pose, "b": [np.float64(2.5), np.float32(0.5), np.int64(-3)]})
    assert "numpy._core" in text or "numpy.core" in text
    for name in ("numpy._core", "numpy.core"):
        document = load(tmp_path / "f.yaml", text.replace("numpy._core", name))
        np.testing.assert_array_equal(document["a"], pose)
        assert document["b"] == [2.5, 0.5, -3]


def test_decoded_array_is_writable(tmp_path: Path) -> None:
    load(tmp_path / "f.yaml", yaml.dump({"a": np.eye(2)}))["a"][0, 0] = 5.0


def test_blocks_not_asked_for_are_not_parsed(tmp_path: Path) -> None:
    document = load(tmp_path / "f.yaml", "camera0:\n  cords: [broken\na:\n- 1\n- - 2\nplan: {\nb: {x: y}\n")
    assert document == {"a": [1, [2]], "b": {"x": "y"}}


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/object/apply:os.system ['touch {hit}']",
        "a: !!python/object/new:subprocess.Popen [['touch', '{hit}']]",
        "a: !!python/name:os.system ''",
        "a: !!python/module:os ''",
        "a: !!python/object/apply:builtins.eval [\"open('{hit}', 'w')\"]",
        "a: !!python/object/apply:numpy.core.multiarray._reconstruct\n  args: [!!python/name:os.system '', [0], x]",
        "a: !!python/object/apply:numpy.load ['{hit}']",
    ],
)
def test_code_in_yaml_is_refused(tmp_path: Path, text: str) -> None:
    hit = tmp_path / "hit"
    with pytest.raises(ValueError, match=r"f\.yaml: not readable as YAML"):
        load(tmp_path / "f.yaml", text.format(hit=hit))
    assert not hit.exists()


ARRAY = yaml.dump({"a": np.eye(2)})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("- f8", "- O8", "plain number"),
        ("- f8", "- 7", "plain number"),
        ("- <", "- '!'", "byte order"),
        ("  - 2\n    - 2\n", "  - 2000000000\n    - 2000000000\n", "size"),
        ("numpy.ndarray", "numpy.matrix", "numpy.matrix"),
    ],
)
def test_a_damaged_array_is_an_error(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = ARRAY.replace(old, new)
    assert text != ARRAY
    with pytest.raises(ValueError, match=message) as error:
        load(tmp_path / "f.yaml", text)
    assert "f.yaml" in str(error.value)
    assert "\n" not in str(error.value)


def test_an_array_of_objects_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"f\.yaml"):
        load(tmp_path / "f.yaml", yaml.dump({"a": np.array([None, "x"], dtype=object)}))


@pytest.mark.parametrize("text", ["a: [1, 2", "- 1\n- 2\n", "just text", "", "a: \x00", "? [\n"])
def test_non_mapping_is_one_error_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match=r"f\.yaml") as error:
        load(tmp_path / "f.yaml", text)
    assert "\n" not in str(error.value)


def test_binary_and_missing_files_raise(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_bytes(b"\xff\xfe\x00a")
    with pytest.raises(ValueError, match=r"f\.yaml"):
        read_yaml(tmp_path / "f.yaml", ("a",))
    with pytest.raises(FileNotFoundError, match=r"g\.yaml"):
        read_yaml(tmp_path / "g.yaml", ("a",))


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_bytes(b"\xef\xbb\xbfa: 1\nb: 2\n")
    assert read_yaml(tmp_path / "f.yaml", ("a", "b")) == {"a": 1, "b": 2}


def test_a_repeated_key_is_named(tmp_path: Path) -> None:
    """PyYAML would keep the last one, and an object of a file that lists its id twice would be lost."""
    (tmp_path / "f.yaml").write_text("a:\n  5: {x: 1}\n  6: {x: 2}\n  5: {x: 3}\n")
    with pytest.raises(ValueError, match=r"f\.yaml: not readable as YAML: the key 5 is repeated .*line 4"):
        read_yaml(tmp_path / "f.yaml", ("a",))


def test_a_merged_mapping_may_override_keys(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text("b: &b {x: 1, y: 2}\na:\n  <<: *b\n  x: 3\n")
    assert read_yaml(tmp_path / "f.yaml", ("a",))["a"] == {"x": 3, "y": 2}
