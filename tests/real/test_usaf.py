"""A real picture of a USAF-1951 target (LAB-UMK/usaf1951, MIT licence): groups 2 to 5 are in it, under uneven light."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photoplan.quality.patterns.usaf import UsafRules, measure_usaf

FILE = Path(__file__).parent / "usaf1951" / "3.npy"

#: Middles of vertical bars, read in the picture by eye: column, row.
PLACES = {(2, 1): (224, 206), (2, 4): (124, 120), (3, 3): (274, 61), (3, 6): (284, 136), (4, 2): (200, 77)}


@pytest.fixture(scope="module")
def found():
    return measure_usaf(np.load(FILE), UsafRules(group=2))


def test_groups_of_the_picture(found):
    print(f"groups {found.groups}, resolved {found.resolved_groups}, {found.place.matched} threes of bars")
    assert found.groups == (2, 3, 4, 5)
    assert found.resolved_groups == (2, 3, 4)
    assert found.place.matched >= 15 and found.place.rms < 0.6


def test_elements_are_where_they_are(found):
    for (group, element), (x, y) in PLACES.items():
        (item,) = [b for b in found.bars if (b.group, b.element, b.horizontal) == (group, element, False)]
        assert np.hypot(item.centre[0] - x, item.centre[1] - y) < 1.5, item


def test_limiting_resolution_of_both_directions(found):
    across = found.limit(horizontal=False)
    down = found.limit(horizontal=True)
    for name, item in (("vertical", across), ("horizontal", down)):
        print(
            f"{name} bars: {item.group}.{item.element}, {item.lp_mm:.1f} LP/mm, {item.contrast:.3f} ± {item.sigma:.3f}"
        )
    # By eye: bars across the columns part up to 4.1, those across the rows to 4.3.
    assert (across.group, across.element) == (4, 1)
    assert (down.group, down.element) in ((4, 2), (4, 3))
    # Neighbouring elements lose contrast from one to the next where nothing else changes.
    for horizontal in (True, False):
        fine = [b.contrast for b in found.bars if b.horizontal == horizontal and 3 <= b.group <= 4][:9]
        assert all(np.diff(fine) < 0.02)


def test_the_group_has_to_be_one_that_the_layout_allows(found):
    from photoplan.errors import InputError

    with pytest.raises(InputError, match="even one"):
        measure_usaf(np.load(FILE), UsafRules(group=3))
    again = measure_usaf(np.load(FILE), UsafRules(pixel_um=found.pixel_um))
    assert again.groups == found.groups
