"""Makes the scripts of examples/experiments importable."""

import sys
from pathlib import Path

EXPERIMENTS = Path(__file__).resolve().parents[2] / "examples" / "experiments"
sys.path.insert(0, str(EXPERIMENTS))
