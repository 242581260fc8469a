"""Files that are there complete or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from cobevglue.datasets.atomic_files import atomic_write


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), atomic_write(path) as partial:
        fail(partial)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
