"""Figures are sketches, but where a test looks at them."""

from __future__ import annotations

import pytest

from photoplan.report.page import figure_of, png
from tools.sketched import BLANK, drawn

pytest.importorskip("matplotlib")


def test_a_figure_is_a_pixel_unless_a_fixture_draws() -> None:
    figure = figure_of(1.0, 1.0)
    assert png(figure) == BLANK
    with drawn():
        assert len(png(figure)) > 2 * len(BLANK)
    assert png(figure) == BLANK


@pytest.mark.drawn
def test_a_test_that_is_marked_has_the_figure() -> None:
    assert len(png(figure_of(1.0, 1.0))) > 2 * len(BLANK)
