"""Disc centres of a real exposure series per wavelength, and its lateral chromatic aberration.

Point Grey Flea3 with narrow-band filters, raw GBRG mosaic (Boost licence). A wavelength is measured in the colour plane
that responds most to it: planes that hardly respond see what filters let through elsewhere, and the overflow of the
others. An exposure is usable if that plane is nowhere saturated and its ground is at 12 grey values or more; 550 nm has
one such exposure, so nothing is said of its repeatability. Repeatability is the scatter of the centre of the same disc
over the usable exposures; no common shift is removed.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
import rasterio

from photoplan.quality.colour import ChromaticModel, disc_displacements, find_discs, fit_band

SIZE = (408, 344)
PLANES = {"G": (0, 3), "B": (1,), "R": (2,)}
STRONGEST = {400: "G", 450: "B", 500: "G", 550: "G", 600: "R", 650: "R", 700: "R"}


@pytest.fixture(scope="module")
def series(shared):
    """Discs by wavelength and exposure time."""
    numbers = np.add.outer(2 * (np.arange(SIZE[1]) % 2), np.arange(SIZE[0]) % 2)
    found = {}
    for path in sorted((shared / "data" / "flea3_exposure_series" / "disks").glob("*.tif")):
        wavelength, time = map(int, re.search(r"_(\d+)nm_(\d+)ms", path.name).groups())
        with rasterio.open(path) as file:
            grey = file.read(1)
        planes = np.where(np.isin(numbers, PLANES[STRONGEST[wavelength]]), numbers, -1)
        used = grey[planes >= 0]
        if np.percentile(used, 99.9) < 250 and np.percentile(used, 90) >= 12:
            found.setdefault(wavelength, {})[time] = find_discs(grey, planes=planes)
    return found


@pytest.mark.slow
def test_centres_repeat_within_a_twentieth_of_a_pixel(series):
    print()
    checked = []
    for wavelength, exposures in sorted(series.items()):
        lists = list(exposures.values())
        places = []
        for disc in lists[0]:
            same = [min(other, key=lambda o: np.hypot(o.x - disc.x, o.y - disc.y)) for other in lists]
            if all(np.hypot(o.x - disc.x, o.y - disc.y) < 2.0 for o in same):
                places.append([(o.x, o.y) for o in same])
        places = np.array(places)
        n = places.shape[1]
        if n < 2:
            print(f"{wavelength} nm: one usable exposure, {sorted(exposures)} ms")
            continue
        left = places - places.mean(1, keepdims=True)
        scatter = np.sqrt((left**2).sum((0, 1)) / (len(places) * (n - 1)))
        print(f"{wavelength} nm: {len(places)} discs, {sorted(exposures)} ms: ± {scatter[0]:.3f}, {scatter[1]:.3f} px")
        assert len(places) >= 28
        assert (scatter < 0.05).all()
        checked.append(wavelength)
    assert checked == [400, 450, 500, 600, 650, 700]


@pytest.mark.slow
def test_lateral_aberration_grows_with_the_wavelength(series):
    """Against 550 nm: from green to red scale and shift grow, from one axis outside the crop; blue turns back."""
    reference = series[550][25]
    print()
    scale, shift = {550: 0.0}, {550: np.zeros(2)}
    for wavelength in (450, 500, 600, 650, 700):
        exposures = series[wavelength]
        measured = disc_displacements(reference, exposures[max(exposures)])
        chosen = fit_band(1, SIZE, measured)
        radial = ChromaticModel(SIZE, 2, (fit_band(1, SIZE, measured, "scale"),))
        terms = radial.bands[0].terms
        scale[wavelength] = terms[1][2] / radial.half_diagonal
        shift[wavelength] = np.array(terms[0][2:])
        print(
            f"{wavelength} nm: shift {shift[wavelength][0]:.3f} {shift[wavelength][1]:.3f} px, scale "
            f"{scale[wavelength]:.2e}, at the crop's corner {radial.corner(1):.3f} px; {chosen.kind}, residuals "
            f"{chosen.residual:.3f} px of {chosen.count} discs"
        )
        assert chosen.residual < 0.05 and chosen.rejected <= 2
    lengths = [500, 550, 600, 650, 700]
    assert (np.diff([scale[w] for w in lengths]) > 0).all()
    assert (np.diff([shift[w].sum() for w in lengths]) > 0).all()
    # Where nothing moves is the lens's axis: one place for the reddest bands.
    centres = np.array([-shift[w] / scale[w] for w in (650, 700)])
    radius = np.hypot(*centres[1])
    moved = np.hypot(*shift[700])
    print(f"axis {centres[1].round()} px from the crop's middle; 700 nm {moved:.2f} px at a radius of {radius:.0f} px")
    assert np.abs(np.diff(centres, axis=0)).max() < 150
    assert 2.5 < moved < 4.0
