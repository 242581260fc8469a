"""Pycrate, a second encoder, to compare bytes with."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest


def compiled(text: str, folder: Path) -> Any:
    """The modules of this ASN.1 text, compiled by pycrate; skips the test without it."""
    compiler = pytest.importorskip("pycrate_asn1c.asnproc")
    compiler.GLOBAL.clear()  # it keeps the modules of other tests
    compiler.compile_text(text)
    path = folder / "compiled.py"
    compiler.generate_modules(compiler.PycrateGenerator, str(path))
    return SimpleNamespace(**runpy.run_path(str(path)))
