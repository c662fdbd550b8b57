"""Kernels are compiled once, not in every process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.rectify import is_compiled

SCRIPT = """
import numpy as np
from photoplan.kernels.gather import gather_runs
from photoplan.kernels.place import place_runs
from photoplan.kernels.rectify import is_compiled, rectify_tile
before = is_compiled("int16", 3, "bilinear")
corners = np.array([[[u, v, 1.0] for h in (0, 1) for v in (-.5, 3.5) for u in (-.5, 3.5)]])
anchors = (np.array([[0, 0, 4, 4]], np.int32), np.array([0, 1], np.int32), np.array([[0.0, 1.0]]), corners)
arrays = np.ones((3, 4, 4), np.int16), np.empty((3, 4, 4), np.int16), np.empty((4, 4), bool)
rectify_tile(anchors, np.zeros((4, 4), np.float32), arrays[0], None, None, "bilinear", arrays[1], arrays[2])
assert (arrays[1] == 1).all()
compiled = [sum(kernel.stats.cache_misses.values()) for kernel in (gather_runs, place_runs)]
print(before, is_compiled("int16", 3, "bilinear"), *compiled)
"""


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_second_process_loads_what_the_first_compiled(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    talk = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, check=True, capture_output=True, text=True
        ).stdout
        for _ in range(2)
    ]
    assert talk[0].split() == ["False", "True", "1", "1"]
    assert talk[1].split() == ["True", "True", "0", "0"]


def test_is_compiled_knows_all_kinds():
    for dtype in ("uint8", "float32"):
        for bands in (1, 3):
            assert is_compiled(dtype, bands, "lanczos3") in ((True, False) if COMPILED else (True,))
