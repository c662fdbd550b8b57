"""Four aerial frames against a satellite image nobody fitted them to, and against other orthophotos of the same frames.

The satellite's own position is known to some metres only, so its constant offset is not tested: the scatter of the
offsets inside a frame and the differences between frames are. Rules chosen on another program's products, before the
first comparison of a photoplan product: gradients of the mean band (the two sensors' radiometry differs) at 7 m,
patches of 400 m, a correlation above 0.7. Grey values and colours were tried too: their scatter is as small, but their
medians of the four frames differ by 1.0 to 1.6 m; gradients at 10 m by 1.1 m.
"""

from __future__ import annotations

import numpy as np
import pytest
from tools.matching import gradients, match, robust_sd
from tools.pictures import gray
from tools.thinned import some

QUALITY = 0.7


@pytest.fixture(scope="module")
def against_satellite(shared, ngi):
    satellite = gradients(gray(shared / "data" / "ngi_dmc" / "ref" / "sentinel2_b432_byte.tif"), 7.0)
    found = [match(gradients(gray(path), 7.0), satellite, patch=400, stride=400, search=20, filled=0.9) for path in ngi]
    assert len(found) == 4
    return [(one.keep(one.quality > QUALITY), len(one)) for one in found]


@pytest.mark.slow
def test_offsets_to_the_satellite_scatter_less_than_1_5_m(against_satellite):
    for kept, found in against_satellite:
        assert len(kept) >= 90 and len(kept) >= 0.8 * found
        scatter = robust_sd(kept.dx), robust_sd(kept.dy)
        assert max(scatter) <= 1.5, f"robust standard deviation {scatter} m"  # measured: 0.49 to 0.83


@pytest.mark.slow
def test_frames_agree_with_each_other_within_1_m(against_satellite):
    medians = np.array([[np.median(kept.dx), np.median(kept.dy)] for kept, _ in against_satellite])
    spread = np.ptp(medians, axis=0)
    assert (spread <= 1.0).all(), f"medians of the four frames {medians.round(2).tolist()} m"  # measured: 0.61 and 0.22


@pytest.mark.parametrize(
    "frame, limit",
    some([(0, 1.0), (1, 1.0), (2, 1.0), (3, 2.5)]),
)
def test_orthophotos_agree_with_others_of_the_same_frames(shared, ngi, frame, limit):
    """Same orientation and heights; made from the full-resolution frames by other software, 5 m.

    Frame 3 (0253) lies 2.3 m east of its reference; so does orthority's orthophoto of it, and against the satellite it
    agrees with its neighbours: the offset is that reference's own.
    """
    theirs = gradients(gray(shared / "data" / "ngi_dmc" / "ref" / f"ngi_rgb_byte_{frame + 1}.tif"), 5.0)
    found = match(gradients(gray(ngi[frame]), 5.0), theirs, patch=200, stride=400, search=10, filled=0.9)
    kept = found.keep(found.quality > QUALITY)
    assert len(kept) >= 120
    offset = np.median(kept.dx), np.median(kept.dy)
    assert max(map(abs, offset)) <= limit, f"median offset {offset} m"  # measured: 0.16 to 0.98, 2.26
    assert max(robust_sd(kept.dx), robust_sd(kept.dy)) <= 2.0  # measured: 0.87 to 1.81
