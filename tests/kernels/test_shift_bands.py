"""Displaced bands: the kernel against weights written out, and against functions that it must reproduce."""

import numpy as np
import pytest

from photoplan.kernels.raster import empty_mask, pixel_range, shift_band
from photoplan.kernels.weights import KERNELS


def shifted(source, moved, name="lanczos3", valid=None, offset=(0, 0)):
    h, w = moved.shape[1:]
    out, good = np.empty((h, w), source.dtype), np.ones((h, w), bool)
    coefficients = np.array(KERNELS[name].coefficients)
    shift_band(
        source,
        empty_mask() if valid is None else valid,
        offset,
        moved,
        (coefficients, pixel_range(source.dtype)),
        out,
        good,
    )
    return out, good


@pytest.mark.parametrize("name", ["bilinear", "bicubic", "lanczos3"])
def test_weights_written_out(name):
    rng = np.random.default_rng(1)
    source = rng.random((14, 15))
    moved = rng.uniform(-1.5, 1.5, (2, 6, 7))
    out, good = shifted(source, moved, name, offset=(4, 4))
    kernel = KERNELS[name]
    for r in range(6):
        for c in range(7):
            x, y = 4 + c + moved[0, r, c], 4 + r + moved[1, r, c]
            x0, y0 = int(np.floor(x)), int(np.floor(y))
            first = kernel.taps // 2 - 1
            patch = source[y0 - first : y0 - first + kernel.taps, x0 - first : x0 - first + kernel.taps]
            expected = kernel.weights(y - y0) @ patch @ kernel.weights(x - x0)
            assert out[r, c] == pytest.approx(expected, abs=1e-12)
    assert good.all()


def test_a_wave_is_moved():
    y, x = np.mgrid[:24, :40].astype(float)

    def wave(x, y):
        return 100.0 + 50.0 * np.sin(0.6 * x + 0.4 * y)

    moved = np.full((2, 12, 28), 0.37)
    moved[1] = -0.61
    out, _ = shifted(wave(x, y), moved, offset=(6, 6))
    assert np.abs(out - wave(x + 0.37, y - 0.61)[6:18, 6:34]).max() < 0.5


def test_no_displacement_changes_nothing():
    source = np.random.default_rng(2).integers(0, 255, (9, 11)).astype(np.uint8)
    assert np.array_equal(shifted(source, np.zeros((2, 9, 11)))[0], source)


def test_whole_numbers_are_rounded_and_clipped():
    source = np.zeros((12, 12), np.uint8)
    source[:, 6:] = 255
    out, _ = shifted(source, np.full((2, 12, 12), 0.5))
    assert out.min() == 0 and out.max() == 255
    assert out[6, 5] in (127, 128)


def test_invalid_pixels_spread_as_far_as_the_kernel_reaches():
    source, valid = np.ones((15, 15), np.float32), np.ones((15, 15), bool)
    valid[7, 7] = False
    moved = np.zeros((2, 15, 15))
    assert (~shifted(source, moved, valid=valid)[1]).sum() == 1
    moved[0] = 0.5
    assert np.argwhere(~shifted(source, moved, valid=valid)[1]).tolist() == [[7, c] for c in range(4, 10)]
