"""A pyramid before rectification of a turbulent strip is as good as one after it (Schlüter 2001, §3)."""

import re
from pathlib import Path

import numpy as np
import pyramid_strip as strips
import pytest

from photoplan.kernels.jit import COMPILED
from photoplan.matching.facets.observe import FILTERS

pytestmark = pytest.mark.skipif(not COMPILED, reason="thousands of patches")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "experiments" / "pyramid-strip.md"


def test_filters_are_those_of_table_1():
    """Schlüter 2001, table 1: whole numbers as printed; each divided by its sum."""
    printed = {3: (1, 2, 1), 5: (1, 4, 6, 4, 1), 11: (51, 0, -87, 0, 298, 475, 298, 0, -87, 0, 51)}
    assert sum(printed[11]) == 999
    assert FILTERS.keys() == printed.keys()
    for span, numbers in printed.items():
        np.testing.assert_allclose(FILTERS[span] * sum(numbers), numbers, rtol=0, atol=1e-12)


def test_ground_and_image_are_inverse():
    strip = strips.Strip(120, 300, 0.8)
    angles = strip.angles()
    line, column = np.meshgrid(np.arange(60.0, 240, 7), np.arange(0.0, 120, 7), indexing="ij")
    back = strip.image_of(strip.ground(line, column, angles), angles)
    # Where pitch runs against the flight the fixed points are reached slowly: thousandths of a pixel are left.
    np.testing.assert_allclose(back, np.stack([line, column], axis=-1), rtol=0, atol=3e-3)
    assert np.degrees(np.abs(np.diff(angles)).max(axis=1)).min() / strips.LINE > 0.8


@pytest.mark.slow
def test_figures_on_the_page():
    rows = re.findall(
        r"^\| ([\d.]+) \| ([\d.]+) % \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", PAGE.read_text("utf-8"), re.M
    )
    assert len(rows) == 4
    for rate, within, longest, along, across, ratio in np.array(rows, float):
        outcome = strips.run(strips.Strip(600, 1600, rate))
        assert 100 * outcome.quarter == pytest.approx(within, abs=0.06) and within >= 99.7
        assert outcome.largest == pytest.approx(longest, abs=0.01) and longest < 0.5
        assert np.sqrt((outcome.vectors**2).mean(axis=0)) == pytest.approx([along, across], abs=6e-4)
        assert outcome.ratio == pytest.approx(ratio, abs=0.01)
        assert len(outcome.vectors) >= 0.999 * len(outcome.found.at)


@pytest.mark.slow
def test_a_long_strip_beside_the_figures_of_the_source():
    outcome = strips.run(strips.Strip(2400, 6000, 0.7))
    assert len(outcome.vectors) > 31_000
    assert outcome.quarter >= 0.997 and outcome.largest < 0.5
    assert 1.2 < outcome.ratio < 1.3
    rows = dict(re.findall(r"^\| ([a-z ]+) \|[^|]+\| ([^|]+) \|$", PAGE.read_text("utf-8"), re.M))
    assert rows["difference vectors"] == f"{len(outcome.vectors):,}"
    assert rows["within a quarter of a pixel"] == f"{100 * outcome.quarter:.2f} %"
    assert rows["over half a pixel"] == f"none, longest {outcome.largest:.2f} px"
    assert rows["along the flight larger than across"] == f"{100 * outcome.ratio - 100:.0f} %"
