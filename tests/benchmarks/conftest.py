"""`benchmarks` is no package: its modules are imported as they are when its scripts run."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
