"""Sharpness of images against each other, from energies of what they show of the same ground."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from photoplan.quality.curves import blur_of, detail_energies, detail_quotients


def test_images_and_ground_are_told_apart() -> None:
    """Sums of both with gaps, single patches that are far off; what shares no ground with others counts as sharp."""
    rng = np.random.default_rng(0)
    blur, ground = np.array([0.0, 0.3, 1.2, 0.7, 0.1]), rng.normal(size=60)
    quotients = ground[:, None] - blur + rng.normal(0, 0.02, (60, 5))
    quotients[rng.random(quotients.shape) < 0.4] = np.nan
    quotients[rng.integers(0, 60, 8), rng.integers(0, 5, 8)] += 5
    alone = np.full((60, 1), np.nan)
    alone[7] = -9.0
    found = blur_of(np.concatenate([quotients, alone], axis=1))
    np.testing.assert_allclose(found, [*blur, 0.0], atol=0.05)
    assert (blur_of(np.full((3, 2), np.nan)) == 0).all()


def test_fine_detail_goes_with_blur_by_the_filters_response() -> None:
    """White noise has equal power at all frequencies: energies are integrals of the squared responses."""
    grey = np.random.default_rng(3).normal(size=(712, 712))
    w = 2 * np.pi * np.fft.fftfreq(512)
    one = (6 + 8 * np.cos(w) + 2 * np.cos(2 * w)) / 16
    smooth = one[:, None] * one
    for sigma in (0.0, 1.2):
        lens = np.exp(-(sigma**2) * (w[:, None] ** 2 + w**2))
        want = [(lens * (1 - smooth) ** 2).mean(), (lens * (smooth - smooth**2) ** 2).mean()]
        blurred = gaussian_filter(grey, sigma, truncate=8) if sigma else grey
        np.testing.assert_allclose(detail_energies(blurred).mean(axis=(1, 2)), want, rtol=0.03)


def test_noise_is_taken_off_where_an_image_is_quietest() -> None:
    """Half of one patch shows noise alone: what it has is taken off both patches."""
    rng = np.random.default_rng(2)
    ground, noise = gaussian_filter(rng.normal(size=(2, 264, 264)), (0, 0.8, 0.8)), rng.normal(0, 0.05, (2, 264, 264))
    ground[0, :132] = 0.0
    energies = [detail_energies(each) for each in ground + noise]
    plain = detail_quotients([detail_energies(each) for each in ground])
    np.testing.assert_allclose(detail_quotients(energies), plain, atol=0.02)
    raw = [0.5 * np.log2(np.divide(*each.mean(axis=(1, 2)))) for each in energies]
    assert (raw > plain + 0.02).all()
    assert np.isnan(detail_quotients([np.ones((2, 4, 4))])).all() and not len(detail_quotients([]))
