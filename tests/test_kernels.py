"""The cache of compiled kernels is never stale, and its absence is no error."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import cobevglue
from cobevglue._kernels import KERNEL_FILES

PACKAGE = Path(cobevglue.__file__).parent
USE = "from cobevglue.small_kernels import twice; print(twice(3))"
INLINED = "from cobevglue._kernels import kernel\n\n@kernel()\ndef factor():\n    return {factor}\n"
KERNEL = "from cobevglue._kernels import kernel\nfrom cobevglue.small_factor import factor\n"
KERNEL += "\n@kernel()\ndef twice(x):\n    return factor() * x\n"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package with two small kernels, one of which inlines the other."""
    copy = tmp_path / "cobevglue"
    copy.mkdir()
    (copy / "__init__.py").write_text("")
    source = (PACKAGE / "_kernels.py").read_text()
    files = "".join(f'    "{name}",\n' for name in KERNEL_FILES)
    assert files in source
    (copy / "_kernels.py").write_text(source.replace(files, '    "small_kernels.py",\n    "small_factor.py",\n'))
    (copy / "small_factor.py").write_text(INLINED.format(factor=2))
    (copy / "small_kernels.py").write_text(KERNEL)
    return copy


def run(package: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    unset = ("NUMBA_CACHE_DIR", "PYTHONDONTWRITEBYTECODE", "PYTHONPATH")
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    return subprocess.run(
        [sys.executable, "-c", USE],
        env=inherited | {"PYTHONPATH": str(package.parent)} | environment,
        capture_output=True,
        text=True,
        check=True,
    )


@pytest.mark.parametrize("where", ["beside the source", "NUMBA_CACHE_DIR", "user cache"])
def test_an_edit_of_an_inlined_function_is_noticed(package: Path, tmp_path: Path, where: str) -> None:
    environment = {}
    if where == "NUMBA_CACHE_DIR":
        environment = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    elif where == "user cache":
        (package / "__pycache__").write_text("")  # numba cannot write beside the source
        environment = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "user")}
    assert run(package, **environment).stdout == "6\n"
    assert list(tmp_path.rglob("*.nbi")), "the cache was written"
    # A file of another length: Python itself takes its .pyc for valid if seconds and length of the source are the same.
    (package / "small_factor.py").write_text(INLINED.format(factor=50))
    assert run(package, **environment).stdout == "150\n"


def test_without_a_writable_folder_one_warning(package: Path) -> None:
    (package / "__pycache__").write_text("")
    result = run(package, HOME="/proc/none", XDG_CACHE_HOME="/proc/none")
    assert result.stdout == "6\n"
    assert result.stderr.count("NUMBA_CACHE_DIR") == 1


def test_all_kernel_files_are_hashed() -> None:
    files = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if "@kernel(" in path.read_text()}
    assert files == set(KERNEL_FILES)


def test_kernels_run_uncompiled_for_debuggers(package: Path) -> None:
    assert run(package, NUMBA_DISABLE_JIT="1").stdout == "6\n"
