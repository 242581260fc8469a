"""No file that is handed out says where on one machine things were."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from cobevglue.relative_paths import without_absolute_paths


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        ("train --out /tmp/a/run1 --set x=/work/features", "train --out run1 --set x=features"),
        ("/work/src/cobevglue/cli/__main__.py train", "cobevglue train"),
        (f"--out {Path.cwd()}/runs/a", "--out runs/a"),
        ({"a": ["/home/me/b", 3, None]}, {"a": ["b", 3, None]}),
        ("runs/fusion at 3 m/s, https://example.org/a/b", "runs/fusion at 3 m/s, https://example.org/a/b"),
    ],
    ids=["options", "the program", "working directory", "nested", "what is not absolute stays"],
)
def test_absolute_paths_become_relative(value: Any, wanted: Any) -> None:
    assert without_absolute_paths(value) == wanted


def test_metadata_of_weights_is_saved_without_them(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from cobevglue.perception.checkpoint import load_checkpoint, save_checkpoint

    save_checkpoint(
        tmp_path / "a.safetensors", "line", {}, torch.nn.Linear(1, 1), {"command": "train --out /tmp/a/run1"}
    )
    assert load_checkpoint(tmp_path / "a.safetensors", "line").metadata == {"command": "train --out run1"}


ROOT = Path(__file__).parent.parent
ABSOLUTE = re.compile(r"(?<![\w.~-])/(?:work|home|tmp|root|Users)/[^\s'\",<]*")
SHIPPED = sorted((ROOT / "src").rglob("weights/*.safetensors"))
RESULTS = sorted(path for path in (ROOT / "docs/results").rglob("*") if path.suffix in {".md", ".csv", ".html"})


def test_there_are_files_to_look_through() -> None:
    assert SHIPPED
    assert RESULTS


@pytest.mark.parametrize("path", SHIPPED + RESULTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_shipped_files_have_no_absolute_paths(path: Path) -> None:
    content = path.read_bytes()
    if path.suffix == ".safetensors":  # its first 8 bytes are the length of the header that follows
        content = content[8 : 8 + int.from_bytes(content[:8], "little")]
    assert ABSOLUTE.findall(content.decode()) == []
