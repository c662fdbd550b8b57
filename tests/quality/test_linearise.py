"""Grey values to light and back: the standard's figures, inverse pairs, tables that cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.quality.curves import Linearisation


def test_srgb_has_the_figures_of_its_standard():
    srgb = Linearisation("srgb")
    light = srgb.to_linear(np.array([0, 1, 10, 11, 128, 188, 255], np.uint8)) / 255.0
    assert light == pytest.approx(
        [0.0, 1 / 255 / 12.92, 10 / 255 / 12.92, 0.0033465, 0.2158605, 0.5028865, 1.0], abs=1e-7
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_every_linearisation_is_inverted(dtype):
    values = np.linspace(0, 1, 256) if dtype is np.float32 else np.arange(256)
    rows = np.column_stack([np.arange(256.0), np.arange(256.0) ** 1.8, 300.0 - np.arange(256.0), np.arange(256.0)])
    for way in (Linearisation(), Linearisation("srgb"), Linearisation.from_table(rows)):
        for band in (1, 2, 3):
            light = way.to_linear(values.astype(dtype), band)
            assert way.to_values(light, dtype, band) == pytest.approx(values, abs=1e-6)


def test_not_a_number_stays_and_light_beyond_the_scale_has_values():
    srgb = Linearisation("srgb")
    light = srgb.to_linear(np.array([np.nan, -0.1, 1.2]))
    assert np.isnan(light[0]) and light[1] < 0.0 and light[2] > 1.0
    assert srgb.to_values(light)[1:] == pytest.approx([-0.1, 1.2], abs=1e-12)


def test_limits_are_the_light_of_the_first_and_last_grey_value():
    assert Linearisation("srgb").limits(np.uint8) == (0.0, 255.0)
    assert Linearisation.from_table(np.arange(256.0)[::-1] + 5.0).limits(np.uint8) == (5.0, 260.0)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (np.r_[np.arange(20.0), 19.0, 21.0], "line 21 of column 1 holds 19 after 19"),
        (np.column_stack([[0.0, 2.0, 1.0], [0.0, 1.0, 2.0]]), "line 3 holds 1"),
        (np.zeros((4, 5)), "given is shape"),
        (np.array([1.0]), "2 to 65536 lines"),
        (np.array([0.0, np.nan]), "finite"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(rows, words):
    with pytest.raises(InputError, match=words):
        Linearisation.from_table(rows)


def test_grey_values_that_the_table_lacks_are_refused():
    with pytest.raises(InputError, match="0 to 255"):
        Linearisation.from_table(np.arange(256.0)).to_linear(np.array([0, 300], np.uint16))


def test_tables_of_published_charts(shared):
    folder = shared / "data" / "slanted_edges" / "sfrmat3"
    one = Linearisation.from_table(np.loadtxt(folder / "lut1.dat"))
    three = Linearisation.from_table(np.loadtxt(folder / "lut3.dat"))
    grey = np.arange(256, dtype=np.uint8)
    assert one.light is not None and one.light.shape == (256, 1)
    assert three.light is not None and three.light.shape == (256, 3)
    assert np.array_equal(three.to_linear(grey, 2), np.loadtxt(folder / "lut3.dat")[:, 1])
    with pytest.raises(InputError, match="band 4 has no column"):
        three.to_linear(grey, 4)
