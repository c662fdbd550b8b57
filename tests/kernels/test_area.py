"""Averaging where the target is coarser than the source."""

from __future__ import annotations

import kernel_reference as twin
import numpy as np
import pytest
from kernel_reference import Mapping, noise
from test_rectify import run
from tools.kinds import few_of
from tools.thinned import some

from photoplan.kernels.jit import COMPILED
from photoplan.kernels.weights import KERNELS, stretch

AVERAGING = ("bilinear", "bicubic", "bicubic-1", "lanczos3")


def wave(frequency, direction, side, phase):
    """A sinusoid of so many periods per pixel, 100 ± 100."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    angle = 2 * np.pi * frequency * (x * np.cos(direction) + y * np.sin(direction)) + phase
    return (100 + 100 * np.sin(angle))[None].astype(np.float32)


def reduced_wave(frequency, direction, factor, name, every=1):
    """Amplitude (1 = unchanged) that a sinusoid has after the reduction, also where it has become a constant.

    every > 1: reduce by factor / every and then drop pixels, which is the kernel without widening.
    """
    cells = 40 if COMPILED else 3
    side = int(factor * (cells + 1)) + 26
    mapping, relief = Mapping.similarity(factor / every, 0.0, (12.3, 12.3)), np.zeros((cells * every, cells * every))
    energy = 0.0
    for phase in (0.0, np.pi / 2):
        out, good = run(mapping, relief, wave(frequency, direction, side, phase), name=name)
        assert good.all()
        energy += np.mean((out[:, ::every, ::every].astype(float) - 100) ** 2)
    return np.sqrt(energy) / 100


@pytest.mark.parametrize("factor", [2.0, 3.7, 8.0])
@pytest.mark.parametrize("direction", [0.0, 0.6])
def test_waves_beyond_the_new_limit_vanish(factor, direction):
    """The zone plate, ring by ring: what the coarser grid cannot hold must not come back as another wave.

    Without widening the same kernel keeps such waves nearly whole: that is the alias.
    """
    frequencies = np.array([1.6, 2.0, 3.1]) * 0.5 / factor / max(np.cos(direction), np.sin(direction))
    for frequency in frequencies[frequencies < 0.4]:
        assert reduced_wave(frequency, direction, factor, "bicubic") < 0.07
        assert reduced_wave(frequency, direction, factor, "lanczos3") < 0.07
        assert reduced_wave(frequency, direction, factor, "bicubic", int(np.ceil(factor))) > 0.5


@pytest.mark.parametrize("factor", [2.0, 8.0])
def test_waves_well_below_the_limit_stay(factor):
    assert reduced_wave(0.1 / factor, 0.3, factor, "bicubic") > 0.93
    assert reduced_wave(0.1 / factor, 0.3, factor, "lanczos3") > 0.97


@pytest.mark.skipif(not COMPILED, reason="a large picture")
def test_zone_plate_does_not_alias():
    """Energy in the part of the reduced plate whose rings are finer than the new grid can hold."""
    side, factor = 1024, 4.0
    x, y = np.meshgrid(np.arange(side) - side / 2, np.arange(side) - side / 2)
    plate = (127.5 + 127.5 * np.cos(np.pi * 0.9 * (x**2 + y**2) / side))[None].astype(np.float32)
    cells = int(side / factor)
    mapping = Mapping.similarity(factor, 0.0, ((factor - 1) / 2, (factor - 1) / 2))
    u, v = np.meshgrid(np.arange(cells), np.arange(cells))
    at_x, at_y = mapping.xy(u, v, 0.0)
    finest = np.maximum(np.abs(at_x - side / 2), np.abs(at_y - side / 2)) * 0.9 / side
    beyond = finest > 1.5 * 0.5 / factor
    widened, good = run(mapping, np.zeros((cells, cells)), plate)
    assert (widened[0][beyond & good] / 127.5).std() < 0.02
    plain, good = run(Mapping.similarity(1.0, 0.0, (1.5, 1.5)), np.zeros((side, side)), plate)
    plain, good = plain[:, ::4, ::4], good[::4, ::4]
    assert (plain[0][beyond & good] / 127.5).std() > 0.3


@pytest.mark.parametrize("name", some(AVERAGING, *few_of("float32", AVERAGING)))
@pytest.mark.parametrize("scale", [1.12, 1.29, 1.31, 6.3])
def test_equals_the_twin(name, scale):
    source = noise((3, 60, 60), "float32")
    mapping = Mapping.similarity(scale, 0.3, (17.0, 4.0))
    side = 6
    out, good = run(mapping, np.zeros((side, side)), source, name=name)
    values, totals, _ = twin.rectify(
        mapping, np.zeros((side, side), np.float32), source, None, (-0.5, -0.5, 59.5, 59.5), name
    )
    np.testing.assert_array_equal(good, totals >= 0.5)
    np.testing.assert_allclose(out[:, good], values[:, good], atol=2e-2)


@pytest.mark.skipif(not COMPILED, reason="a large picture")
def test_scale_of_forty():
    source = noise((1, 900, 900), "uint16")
    mapping = Mapping.similarity(40.0, 0.1, (60.0, 60.0))
    out, good = run(mapping, np.zeros((18, 18)), source, name="bicubic")
    for v, u in ((0, 0), (7, 9), (12, 3), (3, 17)):
        x, y = mapping.xy(u, v, 0.0)
        scales = mapping.scales(u, v, 0.0)
        exact, total = twin.sample(source, None, "bicubic", x, y, scales)
        assert bool(good[v, u]) == (total >= 0.5)
        if good[v, u]:
            assert abs(float(out[0, v, u]) - exact[0]) < 0.6


@pytest.mark.parametrize("name", AVERAGING)
def test_where_nothing_is_widened_the_area_path_is_the_fast_one(name):
    """A rectangle that is looked at pixel by pixel, because one end of it is coarse, has the same bytes in the rest."""
    side = 60 if COMPILED else 20
    matrix = Mapping.similarity(0.8, 0.0, (5.0, 5.0)).matrix
    matrix[2, 0] = -0.3 / side
    mapping = Mapping(matrix)
    source = noise((3, 2 * side, 2 * side), "uint8")
    relief = np.zeros((side, side), np.float32)
    fine = int(0.3 * side)
    assert max(mapping.scales(fine, side, 0.0)) < 1.06
    assert max(mapping.scales(side - 1, 0, 0.0)) > 1.3
    together, _ = run(mapping, relief, source, name=name)
    apart, _ = run(mapping, relief[:, :fine], source, name=name, rects=[[0, 0, fine, side]])
    twice, _ = run(mapping, relief, source, name=name, rects=[[0, 0, fine, side], [fine, 0, side, side]])
    np.testing.assert_array_equal(twice[:, :, :fine], apart)
    # Other rectangles have other reference points: 1e-5 pixel, which may tip a rounding.
    difference = np.abs(together[:, :, :fine].astype(int) - apart)
    assert difference.max() <= 1
    assert (difference > 0).mean() < 2e-3


def test_walls_do_not_smear():
    """The relief jumps by 30 m, which moves the image by 30 pixels: the scale is the camera's, not the jump's."""
    source = noise((1, 60, 60), "uint8")
    mapping = Mapping.similarity(1.0, 0.0, (4.0, 4.0), (1.0, 0.0))
    relief = np.zeros((8, 12), np.float32)
    relief[:, 6:] = 30.0
    out, good = run(mapping, relief, source, levels=(0.0, 15.0, 30.0))
    assert good.all()
    np.testing.assert_array_equal(out[0, :, :6], source[0, 4:12, 4:10])
    np.testing.assert_array_equal(out[0, :, 6:], source[0, 4:12, 40:46])


def test_result_is_continuous_in_the_scale():
    source = noise((1, 40, 40), "float32")
    scales = np.linspace(1.0, 1.5, 26)
    values = []
    for scale in scales:
        mapping = Mapping.similarity(scale, 0.0, (20.3 - 2 * scale, 20.4 - 2 * scale))
        values.append(run(mapping, np.zeros((5, 5)), source)[0][0, 2, 2])
    assert np.abs(np.diff(values)).max() < 40
    assert values[0] == pytest.approx(twin.sample(source, None, "bicubic", 20.3, 20.4)[0][0], abs=1e-2)


def test_rule_of_the_stretch():
    np.testing.assert_allclose(stretch([0.2, 1.0, 1.1, 1.2, 1.3, 1.31, 40.0]), [1, 1, 1, 1.15, 1.3, 1.31, 40])
    assert set(KERNELS) == {"nearest", *AVERAGING}
