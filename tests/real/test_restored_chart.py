"""A photographed chart: a filter measured in one half restores the other, at edges it was not measured at."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples" / "experiments"))


@pytest.fixture(scope="module")
def chart(shared):
    return shared / "data" / "slanted_edges" / "sfrmat3" / "ISO_DSC_300a.jpg"


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exact", "regularised"])
def test_the_mtf_of_other_edges_is_restored(chart, tmp_path, method):
    from restored_chart import FREQUENCIES, restore_chart

    outcome = restore_chart(chart, tmp_path, method)
    at = int(np.argmin(np.abs(FREQUENCIES - 0.3)))
    for direction in "xy":
        before, after = outcome.median(direction)
        print(f"{method} {direction}: MTF(0.3) {before[at]:.3f} -> {after[at]:.3f}")
        assert before[at] < 0.7
        if method == "exact":
            assert after[at] > 0.9
        else:  # what an aperture of one pixel would leave
            assert after[at] == pytest.approx(np.sinc(0.3), abs=0.13)
    assert len(outcome.directions) >= 6
    assert outcome.noise_gain < 6.0
