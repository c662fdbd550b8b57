"""The drone block against the coloured point cloud of its own survey (see the block's licence file).

Horizontal datum, scale and heading of the orientation were fitted to the cloud, so this proves tilt, distortion,
relief and the images' mutual registration, not absolute position. The rules were chosen on another program's
orthophotos, before the first comparison of a photoplan product: patches of 20 m, a correlation above 0.7, nothing else
rejected. Patches of 10 m were tried first; the other program's orthophotos then had an rms of 7.2 and 7.8 cm, since the
smaller patches fall more often on single trees. Three images (0018, 0019, 0023) have medians of 7 to 10 cm, with both
programs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tools.matching import match
from tools.pictures import gray
from tools.thinned import some

RULES = {"patch": 20.0, "stride": 10.0, "search": 1.0, "filled": 0.4}
QUALITY = 0.7


@pytest.fixture(scope="module", params=some([6, 18], 0))
def offsets(block, request):
    """Kept matches of images, of every third in `make test`."""
    orthos = request.getfixturevalue("brighton" if request.param == 18 else "thirds")
    cloud = gray(block / "ref_ortho_from_cloud.tif")
    found = [match(gray(path), cloud, **RULES) for path in orthos]
    return [one.keep(one.quality > QUALITY) for one in found], sum(map(len, found)), request.param


def test_orthophotos_lie_on_the_point_cloud_to_6_cm(offsets):
    kept, found, count = offsets
    assert len(kept) == count and min(map(len, kept)) >= 3, "patches in every image"
    dx, dy = (np.concatenate([getattr(one, name) for one in kept]) for name in ("dx", "dy"))
    assert len(dx) >= 10 * count and len(dx) >= 0.95 * found, "nearly all patches are used"
    rms = np.sqrt(np.mean([dx**2, dy**2], axis=1))
    assert (rms <= 0.06).all(), f"rms of the offsets {rms[0]:.3f} {rms[1]:.3f} m"  # measured: 0.043 and 0.044


def test_no_common_offset_is_left(offsets):
    """A half pixel lost between pixel corner and centre would show here as 5 cm."""
    kept, *_ = offsets
    dx, dy = (np.concatenate([getattr(one, name) for one in kept]) for name in ("dx", "dy"))
    assert abs(dx.mean()) <= 0.02 and abs(dy.mean()) <= 0.02  # measured: 0.000 and −0.005


def test_the_comparison_would_notice_half_a_pixel(block, thirds):
    cloud = gray(block / "ref_ortho_from_cloud.tif")
    ortho = gray(thirds[4])
    as_made, moved = (match(one, cloud, **RULES) for one in (ortho, replace(ortho, left=ortho.left + 0.05)))
    assert min(len(as_made), len(moved)) >= 10
    assert np.median(moved.dx) - np.median(as_made.dx) == pytest.approx(0.05, abs=0.01)
    assert np.median(moved.dy) - np.median(as_made.dy) == pytest.approx(0.0, abs=0.01)
