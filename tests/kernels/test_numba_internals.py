"""Vectors and plain loops gather the same; which of them is taken depends on what is known of numba."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from kernel_reference import noise, rounded
from numba import njit

from photoplan.kernels import numba_internals, resample
from photoplan.kernels.jit import COMPILED
from photoplan.kernels.raster import interleave
from photoplan.kernels.rectify import _rule
from photoplan.kernels.weights import KERNELS


def many(gather):
    """A loop around `gather`, compiled in one piece with it where kernels are compiled."""

    @njit
    def run(source, first, stride, parts, coefficients, taps_tag, lanes_tag, out):
        for i in range(first.size):
            gather(source, first[i], stride, parts[i, 0], parts[i, 1], coefficients, taps_tag, lanes_tag, out, i)

    return run


#: Two kernels of numba are compiled for each.
QUICK = {("lanczos3", "uint8"), ("bicubic", "float32")}
GATHER = {"loops": many(resample.gather_loops), "vectors": many(resample.gather)}


@pytest.mark.parametrize(
    ("name", "bands", "dtype"),
    [
        pytest.param(*kind, dtype, marks=[] if (kind[0], dtype) in QUICK else pytest.mark.slow)
        for dtype in ("uint8", "int16", "uint16", "float32")
        for kind in (("nearest", 1), ("bilinear", 4), ("bicubic", 1), ("lanczos3", 4))
    ],
)
def test_vectors_and_loops_gather_what_the_weights_say(name, bands, dtype):
    source = noise((bands, 20, 30), dtype)
    kernel, rng, count = KERNELS[name], np.random.default_rng(0), 200 if COMPILED else 20
    corner = np.stack([rng.integers(0, 30 - kernel.taps, count), rng.integers(0, 20 - kernel.taps, count)], 1)
    parts = rng.uniform(-0.5, 0.5, (count, 2)).astype(np.float32)
    coefficients, tags, _ = _rule(name, np.dtype(dtype), bands)
    packed = interleave(source)
    first = (corner[:, 1] * 30 + corner[:, 0]) * bands
    weights = kernel.weights(parts + 0.5)
    taps = range(kernel.taps)
    patch = np.array([[[source[:, y + j, x + i] for i in taps] for j in taps] for x, y in corner]).astype(float)
    exact = np.einsum("kj,ki,kjib->kb", weights[:, 1], weights[:, 0], patch)
    slack = 2e-6 * np.abs(patch).max()
    for run in GATHER.values():
        out = np.zeros(count * bands, dtype)
        run(packed, first, np.int64(30 * bands), parts, coefficients, *tags, out)
        if dtype == "float32":
            np.testing.assert_allclose(out.reshape(count, bands), exact, rtol=0, atol=slack)
        else:
            np.testing.assert_array_less(np.abs(out.reshape(count, bands) - rounded(exact, dtype).astype(float)), 1.1)
            near = np.abs(np.abs(exact - np.trunc(exact)) - 0.5) < slack
            np.testing.assert_array_equal(out.reshape(count, bands)[~near], rounded(exact, dtype)[~near])


@pytest.mark.parametrize(
    ("version", "usable"), [("0.59.1", False), ("0.60.0", True), ("0.68.1rc1", True), ("0.69.0", False), ("1.0", False)]
)
def test_only_versions_that_were_tried_are_leaned_on(version, usable):
    if not numba_internals.USABLE:
        pytest.skip("plain loops are asked for")
    assert numba_internals._is_usable(version, None) is usable
    assert not numba_internals._is_usable(version, "1")


def test_the_version_here_was_tried():
    if os.environ.get("PHOTOPLAN_PLAIN_KERNELS") or os.environ.get("NUMBA_DISABLE_JIT"):
        pytest.skip("plain loops are asked for")
    assert numba_internals.USABLE, "try the tests with a wider `numba_internals.TRIED`"
    assert resample.gather is numba_internals.gather


SCRIPT = """
from photoplan.kernels import numba_internals, resample
from photoplan.kernels.jit import COMPILED
print(numba_internals.USABLE, resample.gather is resample.gather_loops, numba_internals.INNER_OPTIONS)
"""


def test_plain_loops_can_be_asked_for():
    environment = {**os.environ, "PHOTOPLAN_PLAIN_KERNELS": "1"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False True {}"


NEWER = """
import numba
numba.__version__ = "0.69.0"
import photoplan.kernels.rectify
from photoplan.io.store import versions
print(photoplan.kernels.rectify.gather_runs is not None, versions()["numba"])
"""


@pytest.mark.skipif(not numba_internals.USABLE, reason="plain loops are asked for")
def test_a_newer_numba_is_a_warning_and_stands_in_the_run_record():
    done = subprocess.run([sys.executable, "-c", NEWER], capture_output=True, text=True, check=True)
    assert done.stdout.split("True ")[1].endswith(" (not tried: plain loops)\n")
    assert done.stderr.count("numba 0.69.0 was not tried") == 1 and "Install 'numba>=0.60,<0.69'" in done.stderr
