"""Kernels are compiled before the work of a command, by several processes, once."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys

import pytest

from photoplan.kernels import numba_internals, precompile
from photoplan.kernels.precompile import PixelSignatures, signatures, text_of, types_of

#: The list is of use where the cache is.
pytestmark = pytest.mark.skipif(not numba_internals.USABLE, reason="nothing is compiled, or by documented ways alone")

CHEAP = """
import sys, time
from photoplan.kernels import precompile
from photoplan.kernels.precompile import Signature, compile_for
rows = (
    Signature(1.0, ("a",), "terrain.height_ranges", "float32[:, ::1], int32[:, ::1]"),
    Signature(1.0, ("a", "b"), "anchors.owned_bounds", "uint16[:, ::1], int64[::1], int64, bool[:, :, ::1], int64[:, ::1]"),
    Signature(9.0, ("bad",), "terrain.label_upstream", "int64"),
)
precompile.signatures = lambda: rows
precompile._WORTH = 0.5
if sys.argv[2] == "dead":
    sys.executable = "/bin/false"
told = []
for command in sys.argv[1].split(","):
    began = time.process_time()
    count = compile_for([command], [precompile.PixelSignatures()], told.append, lambda: told.append("done"), 2)
    print(command, count, *told, time.process_time() - began < 0.05)
    told.clear()
"""  # noqa: E501


@pytest.fixture
def cold(tmp_path):
    """Runs `CHEAP` with a cache of its own."""

    def run(commands, children="alive"):
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        call = [sys.executable, "-c", CHEAP, commands, children]
        done = subprocess.run(call, env=environment, check=True, capture_output=True, text=True)
        return [line.split() for line in done.stdout.splitlines()]

    return run


def test_every_line_names_a_kernel_and_its_arguments():
    assert len(signatures()) > 60
    for row in signatures():
        assert row.seconds >= 0.1 and row.commands
        function = precompile._dispatcher(row.kernel).py_func
        for pixels in (PixelSignatures(), PixelSignatures("float32", 1, "lanczos3")):
            for kernel, text in precompile._wanted(row.commands, [pixels]):
                if kernel == row.kernel:
                    kinds = types_of(kernel, text)
                    assert len(kinds) == len(inspect.signature(function).parameters), row.kernel
                    assert types_of(kernel, ", ".join(map(text_of, kinds))) == kinds


def test_kernels_of_a_command_are_compiled_once_and_a_warm_cache_costs_nothing(cold):
    assert cold("a") == [["a", "2", "2", "done", "done", "False"]]
    # The first time in a process the sources are read; what is known then costs next to nothing.
    again, warm, part = cold("a,a,b")
    assert again[:2] == ["a", "0"]
    assert (warm, part[:2]) == (["a", "0", "True"], ["b", "0"])


@pytest.mark.parametrize("children", ["alive", "dead"])
def test_lists_that_are_wrong_and_processes_that_die_do_no_harm(cold, children):
    bad, good, again = cold("bad,a,a", children)
    assert bad[:3] == ["bad", "1", "1"]
    assert good[:3] == ["a", "2", "2"]
    assert again[1] == "0" and good.count("done") == 2


@pytest.mark.slow
def test_a_command_finds_all_that_it_needs(tmp_path):
    """After `compile_for` nothing is compiled by an orthophoto of the included block."""
    script = """
import sys
from photoplan.cli.main import run
from photoplan.events import COMPILATIONS
from photoplan.kernels.precompile import PixelSignatures, compile_for
compile_for([sys.argv[1]], [PixelSignatures()], lambda n: None, lambda: None)
before = COMPILATIONS.kernels
assert run(sys.argv[1:]) == 0
print(COMPILATIONS.kernels - before)
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    demo = [sys.executable, "-m", "photoplan", "demo", str(tmp_path / "demo"), "--resolution", "1", "-q"]
    subprocess.run(demo, env=environment, check=True, capture_output=True)
    for command in ("ortho", "mosaic"):
        words = [command, str(tmp_path / "demo" / "project.toml"), "--resolution", "0.3", "--overwrite", "-q"]
        call = [sys.executable, "-c", script, *words]
        done = subprocess.run(call, env=environment, check=True, capture_output=True, text=True)
        assert done.stdout.split()[-1] == "0", command
