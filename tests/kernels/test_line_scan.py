"""Rows of a turbulent flight lie apart: each is sampled at its own place across, as if they had never moved."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from photoplan.kernels.rectify import rectify_tile
from photoplan.kernels.weights import KERNELS

SIZE = 56
HEIGHT = 40.0


def anchors(scale: float, shifts: NDArray[np.float64] | None, late: float = 0.0) -> tuple[NDArray, ...]:
    """One box over a tile of 24 × 24 pixels: x and y from 14.27 and 15.21 on, a `scale` from pixel to pixel.

    `shifts` (rows,): how far each row of the source lies beside; half of it as a change per metre of height.
    """
    side = 24
    u = v = np.array([-0.5, side - 0.5])
    x, y = 14.27 + scale * u, 15.21 + scale * v
    corners = np.array([[(x[i & 1], y[i >> 1 & 1], 1.0) for i in range(8)]])
    rects, heights = np.array([[0, 0, side, side]], np.int32), np.array([[0.0, 100.0]])
    frame, nodes = np.zeros(5), np.empty((0, 0, 2), np.float32)
    if shifts is not None:
        frame = np.array([-20.0, -2.0, 1 / 48, 1.0, 1.0, HEIGHT - 10.0])
        nodes = np.zeros((SIZE + 4, 4, 5), np.float32)
        beside = np.pad(shifts, 2, mode="edge")
        nodes[..., 0], nodes[..., 2] = beside[:, None] / 2, beside[:, None] / 20
        nodes[..., 1] = late
        nodes[..., 4] = np.arange(SIZE + 4)[:, None] - late + 1e-3
    return rects, np.array([0, 1], np.int32), heights, corners, frame, nodes


def resampled(kernel: str, source: NDArray, valid: NDArray | None, parts: tuple) -> tuple[NDArray, NDArray]:
    relief = np.full((24, 24), HEIGHT, np.float32)
    out, out_valid = np.zeros((len(source), 24, 24), source.dtype), np.zeros((24, 24), bool)
    rectify_tile(parts, relief, source, valid, None, kernel, out, out_valid)
    return out, out_valid


def moved(source: NDArray, shifts: NDArray[np.int64], fill: float) -> NDArray:
    """Each row shifted to the right, whole pixels."""
    out = np.full_like(source, fill)
    for row, s in enumerate(shifts.tolist()):
        to, of = slice(max(s, 0), SIZE + min(s, 0)), slice(max(-s, 0), SIZE - max(s, 0))
        out[..., row, to] = source[..., row, of]
    return out


@pytest.mark.parametrize(
    ("kernel", "scale", "dtype"),
    [
        ("bicubic", 0.8, "float32"),
        pytest.param("bicubic", 1.2, "float32", id="averaged"),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("bicubic", 0.8, "uint8"), ("bicubic", 1.2, "uint8"), ("nearest", 0.8, "uint8"))
        ),
        *(pytest.param(name, 0.8, "float32", marks=pytest.mark.slow) for name in ("lanczos3", "bilinear")),
    ],
)
def test_rows_that_have_been_shifted_give_the_pixels_of_those_that_have_not(
    kernel: str, scale: float, dtype: str
) -> None:
    """By up to 6 pixels, at random from row to row; with a hole; bytes in three bands."""
    rng = np.random.default_rng(3)
    bands = 3 if dtype == "uint8" else 1
    source = rng.integers(0, 255, (bands, SIZE, SIZE)).astype(dtype)
    shifts = rng.integers(-6, 7, SIZE)
    for holes in (False, True):
        valid = np.ones((SIZE, SIZE), np.uint8)
        valid[24:27, 22:27] = 0
        given = (valid, moved(valid, shifts, 0)) if holes else (None, None)
        rest, still = resampled(kernel, source, given[0], anchors(scale, None))
        shaken, seen = resampled(kernel, moved(source, shifts, 0), given[1], anchors(scale, shifts.astype(float)))
        # Where weights of rows are missing they are balanced about the place, see `line_scan_runs`: another rule
        reach = KERNELS[kernel].taps
        near = np.zeros((24, 24), bool)
        if holes:
            y, x = ((n + scale * np.arange(24)) for n in (15.21, 14.27))
            near = ((y > 23 - reach) & (y < 27 + reach))[:, None] & ((x > 21 - reach) & (x < 28 + reach))
            assert not still.all() and still.any()
        assert (seen == still).all()
        assert seen.mean() > 0.9
        miss = np.abs(shaken.astype(float) - rest)[:, ~near & still]
        assert miss.max() <= (1.0 if dtype == "uint8" else 0.01)
        assert (miss > (0.5 if dtype == "uint8" else 0.01)).mean() < 0.002


def test_a_ramp_stays_where_it_is_at_the_ragged_border() -> None:
    """Rows end where they have been shifted to; the rest still gives the ramp, but for the last pixels."""
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    shifts = np.where(np.arange(SIZE) % 3 == 1, 5, 0)
    source = (3 * u + 7 * v)[None]
    valid = np.ones((SIZE, SIZE), np.uint8)
    valid[:, 26:] = 0
    out, seen = resampled("bicubic", moved(source, shifts, 0), valid, anchors(0.8, shifts * 1.0))
    x, y = 14.27 + 0.8 * np.arange(24), 15.21 + 0.8 * np.arange(24)
    truth = 3 * x + 7 * y[:, None]
    far = x < 26 - 7
    assert seen[:, far].all() and not seen.all()
    assert np.abs(out[0] - truth)[:, far].max() < 0.01
    some = seen & (x < 24)
    assert (np.abs(out[0] - truth)[some] < 0.35 * 7).mean() > 0.95


def test_a_late_row_is_found_and_its_neighbours_are_sampled_beside_it() -> None:
    """All rows a row and a half late: the same picture, as much further down."""
    rng = np.random.default_rng(4)
    source = rng.integers(0, 255, (1, SIZE, SIZE)).astype(np.float32)
    shifts = rng.integers(-4, 5, SIZE)
    shaken, seen = resampled("bicubic", moved(source, shifts, 0), None, anchors(0.8, shifts * 1.0, 1.5))
    parts = list(anchors(0.8, None))
    parts[3] = parts[3] + np.array([0.0, 1.5, 0.0])
    rest, still = resampled("bicubic", source, None, tuple(parts))
    assert seen.all() and still.all()
    assert np.abs(shaken - rest).max() < 0.02
