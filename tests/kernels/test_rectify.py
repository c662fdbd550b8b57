"""The engine's kernel against its slow twin, and what must hold for every kernel and type of pixel."""

from __future__ import annotations

import kernel_reference as twin
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_reference import Mapping, noise, rounded
from tools.kinds import FEW, NAMES, OTHERS, few_of
from tools.thinned import some

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.raster import interleave
from photoplan.kernels.rectify import rectify_tile

#: Those that are compiled with floats, which show what rounding to grey values hides.
FLOATS = some(NAMES, *few_of("float32"))
SIDE = 40 if COMPILED else 9


def run(mapping, relief, source, valid=None, border=None, name="bicubic", rects=None, levels=(-1.0, 2.0), **more):
    relief = np.asarray(relief, np.float32)
    rows, cols = more.pop("shape", relief.shape)
    anchors = mapping.anchors([[0, 0, cols, rows]] if rects is None else rects, levels)
    out = np.full((source.shape[0], *relief.shape), 99, source.dtype)
    out_valid = np.ones(relief.shape, bool)
    rectify_tile(anchors, relief, source, valid, border, name, out, out_valid, **more)
    return out, out_valid


def flat(side=SIDE):
    return np.zeros((side, side), np.float32)


@pytest.mark.parametrize("kinds", [FEW, pytest.param(OTHERS or FEW, marks=pytest.mark.slow)], ids=["few", "others"])
@settings(max_examples=150 if COMPILED else 25, deadline=None)
@given(
    kind=st.integers(0, 999),
    bands=st.integers(1, 6),
    size=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    scale=st.sampled_from((0.3, 0.9, 1.0, 1.15, 1.25, 2.0, 5.0)),
    angle=st.floats(-3.2, 3.2),
    masked=st.booleans(),
    holes=st.booleans(),
    seed=st.integers(0, 10_000),
)
def test_kernel_equals_its_twin(kinds, kind, bands, size, scale, angle, masked, holes, seed):
    name, dtype = kinds[kind % len(kinds)]
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-1.5, 1.5, 2) + np.array(size) / 2
    matrix = Mapping.similarity(scale, angle, shift, rng.uniform(-1, 1, 2)).matrix
    matrix[2, :3] = rng.uniform(-0.01, 0.01, 3)
    mapping = Mapping(matrix)
    source = noise((bands, size[1], size[0]), dtype, seed)
    valid = rng.random(size[::-1]) < 0.7 if masked else None
    relief = rng.uniform(-1, 2, (6, 7)).astype(np.float32)
    if holes:
        relief[rng.random(relief.shape) < 0.2] = np.nan
    border = (-0.5, -0.5, size[0] - 0.5, size[1] - 0.5)
    out, good = run(mapping, relief, source, valid, None, name)
    values, totals, xy = twin.rectify(mapping, relief, source, valid, border, name)
    edge = np.minimum(xy - border[:2], border[2:] - xy).min(axis=-1)
    doubtful = (np.abs(edge) < 1e-4) | (np.abs(totals - 0.5) < 1e-4)
    if name == "nearest":
        doubtful |= (np.abs((xy + 0.5) - np.rint(xy + 0.5)) < 1e-4).any(axis=-1)
    np.testing.assert_array_equal(good[~doubtful], (totals >= 0.5)[~doubtful])
    assert not out[:, ~good].any()
    sure = good & ~doubtful
    limits = np.iinfo(dtype) if dtype != "float32" else np.finfo(dtype)
    expected = np.clip(values[:, sure], limits.min, limits.max)
    # Positions are good to 1e-5 pixel, which moves the result in proportion to the differences of the grey values and
    # more where a small total is divided by; sums are good to 1e-6 of the largest value.
    spread, largest = np.ptp(source.astype(float)), np.abs(source.astype(float)).max()
    slack = 0.5 * (dtype != "float32") + (2e-5 * spread + 1e-6 * largest) / np.minimum(totals[sure], 1.0)
    assert (np.abs(out[:, sure] - expected) <= slack).all()


@pytest.mark.parametrize(("name", "dtype"), [*FEW, *(pytest.param(*kind, marks=pytest.mark.slow) for kind in OTHERS)])
@pytest.mark.parametrize("scale", [0.8, 1.2, 2.7])
def test_constant_stays_constant(name, dtype, scale):
    value = {"uint8": 201, "uint16": 65535, "int16": -32768, "float32": 0.1}[dtype]
    source = np.full((3, 30, 30), value, dtype)
    valid = np.ones((30, 30), bool)
    valid[10:13, 4:9] = False
    source[:, ~valid] = 7
    for bands, mask in ((3, valid), (1, valid), (3, None)):
        pixels = np.full_like(source, value) if mask is None else source
        relief = flat(9 if COMPILED else 5)
        out, good = run(Mapping.similarity(scale, 0.2, (8.3, 3.1)), relief, pixels[:bands], mask, None, name)
        assert good.any()
        assert np.unique(out[:, good]).tolist() == [np.dtype(dtype).type(value)]


@pytest.mark.parametrize("name", some(["bilinear", "bicubic"], *few_of("float32", ("bilinear", "bicubic"))))
def test_ramp_is_reproduced(name):
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0))
    source = (3 * x - 2 * y)[None].astype(np.float32)
    mapping = Mapping.similarity(0.7, 0.3, (20.3, 15.7))
    out, good = run(mapping, flat(30), source, name=name)
    u, v = np.meshgrid(np.arange(30), np.arange(30))
    at_x, at_y = mapping.xy(u, v, 0.0)
    assert good.all()
    np.testing.assert_allclose(out[0], 3 * at_x - 2 * at_y, atol=1e-4)


def _ramp_error(name, fraction):
    """What a kernel makes of the ramp g(i) = i at i + fraction, minus the truth; by the twin's weights."""
    return sum(w * i for i, w in twin.axis_weights(name, 20 + fraction, 1.0).items()) - 20 - fraction


@pytest.mark.parametrize(("name", "largest"), some([("bicubic-1", 0.0962), ("lanczos3", 0.0200)], 0))
def test_ramp_deviates_as_theory_says(name, largest):
    """For a = −1 the ramp's error is f (1 − f) (1 − 2 f), at most 1/(6√3) = 0.0962 pixel (Ecker 1991, eq. 4.15)."""
    source = np.broadcast_to(np.arange(60, dtype=np.float32), (1, 60, 60)).copy()
    mapping = Mapping.similarity(0.9, 0.0, (20.0, 15.0))
    out, _ = run(mapping, flat(30), source, name=name)
    at_x = 20 + 0.9 * np.arange(30)
    f = at_x - np.floor(at_x)
    theory = np.array([_ramp_error(name, each) for each in f])
    if name == "bicubic-1":
        np.testing.assert_allclose(theory, f * (1 - f) * (1 - 2 * f), atol=1e-12)
    np.testing.assert_allclose(out[0] - at_x, np.broadcast_to(theory, (30, 30)), atol=1e-5)
    dense = max(abs(_ramp_error(name, each)) for each in np.linspace(0, 1, 401))
    assert dense == pytest.approx(largest, abs=1e-3)


def test_overshoot_is_clipped():
    source = np.zeros((1, 20, 20), np.uint8)
    source[..., 10:] = 255
    out, _ = run(Mapping.similarity(1.0, 0.0, (4.5, 4.0)), flat(8), source)
    exact = [sum(w * source[0, 0, i] for i, w in twin.axis_weights("bicubic", 4.5 + u, 1.0).items()) for u in range(8)]
    assert min(exact) < -10
    assert max(exact) > 265
    np.testing.assert_array_equal(out[0], np.broadcast_to(rounded(np.array(exact), "uint8"), (8, 8)))


@pytest.mark.parametrize(
    ("dtype", "low"), [("int16", -3), ("uint8", 2), pytest.param("uint16", 2, marks=pytest.mark.slow)]
)
def test_halves_are_rounded_away_from_zero(dtype, low):
    source = np.empty((1, 8, 8), dtype)
    source[..., ::2], source[..., 1::2] = low, low + 1
    out, _ = run(Mapping.similarity(1.0, 0.0, (2.5, 2.0)), flat(3), source, name="bilinear")
    assert np.unique(out).tolist() == [-3 if low < 0 else 3]


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_invalid_pixels_never_leak(name, scale):
    source = np.full((3, 30, 30), 100.0, np.float32)
    valid = np.random.default_rng(1).random((30, 30)) < 0.8
    source[:, ~valid] = np.nan
    out, good = run(Mapping.similarity(scale, 0.1, (5.2, 3.3)), flat(9), source, valid, None, name)
    assert good.sum() > 0
    assert np.isfinite(out).all()
    np.testing.assert_allclose(out[:, good], 100.0)


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("scale", [0.9, 1.2, 3.0])
@pytest.mark.parametrize("masked", [False, True])
def test_crop_of_a_tile_is_the_tile_of_the_crop(name, scale, masked):
    side = 2 * SIDE + 7 if COMPILED else 12
    rng = np.random.default_rng(2)
    extent = int(side * scale) + 12
    source = noise((3, extent, extent), "float32")  # floats show what rounding to grey values hides
    valid = rng.random((extent, extent)) < 0.95 if masked else None
    relief = rng.uniform(-1, 2, (side, side)).astype(np.float32)
    mapping = Mapping.similarity(scale, 0.05, (7.2, 3.9), (0.3, -0.2))
    col, row = (11, 20) if COMPILED else (5, 8)
    rects = [[0, 0, col, side], [col, 0, side, row], [col, row, side, side]]
    more = {"valid": valid, "name": name, "rects": rects, "levels": (-1.0, 0.5, 2.0)}
    whole, good = run(mapping, relief, source, **more)
    for rows, cols in (
        (slice(0, row - 7), slice(0, side)),
        (slice(row - 7, side), slice(5, col + 20)),
        (slice(7, 8), slice(side - 1, side)),
    ):
        part, part_good = run(mapping, relief[rows, cols], source, offset=(cols.start, rows.start), **more)
        np.testing.assert_array_equal(part, whole[:, rows, cols])
        np.testing.assert_array_equal(part_good, good[rows, cols])


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("size", [(1, 1), (2, 5), (5, 2), (6, 6), (3, 200 if COMPILED else 20)])
def test_no_read_outside_the_source(name, size):
    """The source lies inside a larger block of NaN: one wrong load would show."""
    width, height = size
    for lanes in (1, 4):
        block = np.full((width * height + 400) * lanes, np.nan, np.float32)
        packed = block[200 * lanes : (200 + width * height) * lanes].reshape(1, height, width, lanes)
        packed[:] = noise((1, height, width, lanes), "float32")
        for scale in (0.26, 1.0, 1.7):
            mapping = Mapping.similarity(scale, 0.0, (-1.0, -1.0))
            cols, rows = int((width + 1) / scale) + 2, int((height + 1) / scale) + 2
            relief = np.zeros((rows, cols), np.float32)
            out, good = np.empty((lanes, rows, cols), np.float32), np.empty((rows, cols), bool)
            anchors = mapping.anchors([[0, 0, cols, rows]], (0.0, 1.0))
            rectify_tile(anchors, relief, packed, None, None, name, out, good)
            assert good.any() or scale > 1
            assert np.isfinite(out).all()


def test_positions_outside_the_image_are_not_valid():
    source = np.full((1, 10, 10), 50, np.uint8)
    out, good = run(Mapping.similarity(1.0, 0.0, (-3.0, -3.0)), flat(16), source)
    expected = np.zeros((16, 16), bool)
    expected[3:13, 3:13] = True
    np.testing.assert_array_equal(good, expected)
    np.testing.assert_array_equal(out[0], np.where(expected, 50, 0))


@pytest.mark.parametrize("name", NAMES)
def test_border_of_the_image_inside_or_beyond_the_window(name):
    source = noise((1, 12, 12), "uint8")
    mapping = Mapping.similarity(1.0, 0.0, (0.0, 0.0))
    _, good = run(mapping, flat(12), source, None, (2.5, -0.5, 11.5, 7.5), name)
    expected = np.zeros((12, 12), bool)
    expected[:8, 3:] = True
    np.testing.assert_array_equal(good, expected)
    # A window without the margin it should have: nothing is invented beyond it.
    _, good = run(Mapping.similarity(1.0, 0.0, (5.0, 5.0)), flat(12), source, None, (-50.0, -50.0, 50.0, 50.0), name)
    assert not good[7:, :].any()
    assert not good[:, 7:].any()
    assert good[:7, :7].all()


def test_outer_edges_of_border_pixels_belong_to_the_image():
    source = noise((1, 6, 6), "uint8")
    mapping = Mapping.similarity(0.5, 0.0, (-0.5, -0.5))
    out, good = run(mapping, flat(13), source, name="nearest")
    assert good.all()
    np.testing.assert_array_equal(out[0, 0, ::2], source[0, 0, [0, 1, 2, 3, 4, 5, 5]])


def test_pixels_without_rectangle_or_relief_are_empty():
    relief = flat(10)
    relief[2, 3] = np.nan
    out, good = run(Mapping.similarity(), relief, noise((2, 20, 20), "uint16"), rects=[[0, 0, 10, 4]])
    expected = np.zeros((10, 10), bool)
    expected[:4] = True
    expected[2, 3] = False
    np.testing.assert_array_equal(good, expected)
    assert not out[:, ~expected].any()
    assert run(Mapping.similarity(), relief, noise((2, 20, 20), "uint16"), rects=np.empty((0, 4)))[1].sum() == 0


def test_nearest_keeps_grey_values_at_any_scale():
    source = np.zeros((1, 90, 90), np.uint8)
    source[:, ::3, ::3] = 17
    source[:, 1::7, 2::5] = 203
    out, good = run(Mapping.similarity(4.0, 0.1, (9.0, 2.0)), flat(18), source, name="nearest")
    assert good.any()
    assert set(np.unique(out)) <= {0, 17, 203}


@pytest.mark.parametrize("bands", [1, 2, 3, 4, 5, 9])
def test_bands_are_independent(bands):
    source = noise((bands, 30, 30), "uint8")
    mapping = Mapping.similarity(0.9, 0.1, (4.0, 2.0))
    relief = flat(20 if COMPILED else 7)
    together, _ = run(mapping, relief, source)
    alone = np.concatenate([run(mapping, relief, source[[band]])[0] for band in range(bands)])
    assert np.abs(together.astype(int) - alone).max() <= 1
    assert (together != alone).mean() < 1e-3


def test_arrays_of_other_layout_are_accepted():
    source = noise((3, 30, 30), "uint8")
    mapping = Mapping.similarity(1.0, 0.1, (6.0, 2.0))
    expected, expected_good = run(mapping, flat(12), source)
    anchors = mapping.anchors([[0, 0, 12, 12]], (-1.0, 2.0))
    for array in anchors:
        array.flags.writeable = False
    relief = np.asfortranarray(flat(12))
    relief.flags.writeable = False
    out = np.empty((12, 12, 3), np.uint8).transpose(2, 0, 1)
    good = np.empty((24, 24), bool)[::2, ::2]
    rectify_tile(
        anchors, relief, source[:, ::1].copy("F"), None, None, "bicubic", out, good, (np.int32(0), np.int32(0))
    )
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(good, expected_good)


@pytest.mark.parametrize("bands", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("masked", [False, True])
def test_pack(bands, masked):
    source = noise((bands, 5, 37), "uint16")
    valid = np.random.default_rng(0).random((5, 37)) < 0.5 if masked else None
    packed = interleave(source, valid)
    lanes = 1 if bands == 1 else 4
    assert packed.shape == (-(-bands // lanes), 5, 37, lanes)
    planes = packed.transpose(0, 3, 1, 2).reshape(-1, 5, 37)
    np.testing.assert_array_equal(planes[:bands], source if valid is None else np.where(valid, source, 0))
    assert not planes[bands:].any()
