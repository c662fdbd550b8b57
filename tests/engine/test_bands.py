"""Bands of detail: their sum is the picture, and a pixel's bands do not depend on where a part begins."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.engine.execute import detail_bands

REACHES = (2, 4, 8, 16)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_bands_add_up_in_every_part(dtype: str) -> None:
    random = np.random.default_rng(1)
    picture = random.uniform(0, 250, (2, 70, 90)).astype(dtype)
    usable = random.random((70, 90)) < 0.8
    whole = list(detail_bands(picture, usable, REACHES, np.s_[:, :]))
    assert len(whole) == 4
    np.testing.assert_allclose(sum(whole)[:, usable], picture[:, usable], atol=1e-9)
    # What decides lies within the last but one of the reaches.
    part = list(detail_bands(picture[:, 12:50, 22:68], usable[12:50, 22:68], REACHES, np.s_[8:-8, 8:-8]))
    for band, same in zip(whole, part):
        np.testing.assert_array_equal(band[:, 20:42, 30:60], same)


def test_a_band_holds_its_own_detail_and_what_cannot_be_used_counts_nothing() -> None:
    x = np.broadcast_to(np.arange(120.0), (120, 120))
    level, fine, coarse = np.full((120, 120), 100.0), 20 * np.cos(np.pi * x), 20 * np.cos(2 * np.pi * x / 60)
    picture, middle = (level + fine + coarse)[None], np.s_[25:95, 25:95]
    bands = [np.ptp(band) for band in detail_bands(picture, np.ones((120, 120), bool), REACHES, middle)]
    assert bands[0] == pytest.approx(np.ptp(fine), rel=0.2) and bands[3] == pytest.approx(np.ptp(coarse), rel=0.15)
    usable = x < 70
    spoilt = np.where(usable, picture, 255.0)
    for band, other in zip(*(detail_bands(each, usable, REACHES, np.s_[:, :70]) for each in (picture, spoilt))):
        np.testing.assert_array_equal(band, other)
