"""Shared by the benchmarks: the header of their output and the folder of third-party data."""

from __future__ import annotations

import os
import platform
import re
import sys
import time
from pathlib import Path

import numpy as np

DATA = Path(os.environ.get("COBEVGLUE_DATA", Path(__file__).parents[2] / "shared" / "data"))
"""Third-party data."""


def print_head(*facts: str) -> None:
    """Print the command, the date, the machine and further facts, such as the seed."""
    print(f"$ python {' '.join(sys.argv)}\n\n{', '.join([time.strftime('%Y-%m-%d'), machine(), *facts])}\n")


def machine() -> str:
    """Return processor, number of cores, and versions of Python and NumPy."""
    cpu = platform.machine()
    if Path("/proc/cpuinfo").exists():
        cpu = next(iter(re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())), cpu)
    return f"{cpu}, {os.cpu_count()} cores, Python {platform.python_version()}, NumPy {np.__version__}"
