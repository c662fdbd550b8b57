"""USAF-1951 targets: found turned, mirrored and dark; contrast of three bars; limits; numbers of groups; refusals."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from tools.patterns import bars, star, three_bars, usaf_chart
from tools.thinned import some

from photoplan.errors import InputError
from photoplan.quality.patterns.bars import clipped_pixels
from photoplan.quality.patterns.usaf import UsafRules, measure_usaf, usaf_frequency

SCALE, ORIGIN, SHAPE = 22.3, (230.4, 205.7), (420, 440)


@cache
def chart(turn, mirrored):
    return usaf_chart(SHAPE, SCALE, ORIGIN, turn=turn, mirrored=mirrored)


@cache
def measured(turn, mirrored):
    return measure_usaf(noisy(turn, mirrored), UsafRules(group=0))


def noisy(turn=0.0, mirrored=False):
    return chart(turn, mirrored) + np.random.default_rng(0).normal(0.0, 2.0, SHAPE)


def test_frequency_of_groups_and_elements():
    # 2^(G + (E − 1)/6), MIL-STD-150A: 0.25, 1, 1.12, 7.13, 228 LP/mm
    printed = {(-2, 1): 0.25, (0, 1): 1.0, (0, 2): 1.12, (2, 6): 7.13, (7, 6): 228.0}
    for (group, element), lp_mm in printed.items():
        assert usaf_frequency(group, element) == pytest.approx(lp_mm, rel=5e-3)


@pytest.mark.parametrize(
    ("turn", "mirrored", "dark"),
    some([(0.0, False, False), (0.06, False, False), (1.3, True, False), (3.0, False, True), (1.3, True, True)], 2, 4),
)
def test_contrast_of_all_elements_of_a_known_chart(turn, mirrored, dark):
    if dark:
        found = measure_usaf(240.0 - noisy(turn, mirrored), UsafRules(group=0))
    else:
        found = measured(turn, mirrored)
    assert found.place.bright != dark
    assert found.pixel_um == pytest.approx(1000.0 / SCALE, rel=2e-3)
    assert found.groups == (0, 1, 2, 3)
    assert found.full == pytest.approx(170.0, rel=0.01)
    # Pixels along the bars leave few places within a period above 0.2 cycles per pixel.
    bound = 0.03 if turn == 0.0 else 0.02
    worst = 0.0
    for item in found.bars:
        if item.frequency > 0.41:
            continue
        true = three_bars(1.0 / item.frequency, 0.7)
        worst = max(worst, abs(item.contrast - true))
        assert abs(item.contrast - true) < bound + 2.0 * item.sigma, item
    print(f"turned by {turn}: largest error of the contrast transfer up to 0.41 cy/px {worst:.3f}")
    # The contrast transfer of three bars is 0.196 at element 3.2, 0.114 at 3.3, 0.05 at 3.4.
    for horizontal in (True, False):
        last = found.limit(horizontal=horizontal)
        assert last is not None and (last.group, last.element) in ((3, 2), (3, 3))


def test_shading_is_removed_locally():
    light = 30.0 * (np.arange(SHAPE[1]) / SHAPE[1])[None, :]
    shaded = measure_usaf(noisy(1.3, True) + light, UsafRules(group=0))
    for a, b in zip(measured(1.3, True).bars, shaded.bars):
        assert a.contrast == pytest.approx(b.contrast, abs=0.01, nan_ok=True)


def test_group_numbers_by_pixel_size_or_as_given():
    picture = noisy(1.3, True)
    # 44.84 µm on the target: the first element would have 1 LP/mm; a quarter of it: 4 LP/mm, group 2.
    assert measure_usaf(picture, UsafRules(pixel_um=250 / SCALE)).groups[0] == 2
    assert measure_usaf(picture, UsafRules(group=-2)).bars[0].lp_mm == 0.25


@pytest.mark.slow
def test_group_numbers_that_cannot_be_are_refused():
    picture = noisy()
    with pytest.raises(InputError, match="same at every scale"):
        measure_usaf(picture, UsafRules())
    with pytest.raises(InputError, match="no even group"):
        measure_usaf(picture, UsafRules(pixel_um=500 / SCALE))
    with pytest.raises(InputError, match="even one"):
        measure_usaf(picture, UsafRules(group=3))
    with pytest.raises(InputError, match="not 4"):
        measure_usaf(picture, UsafRules(group=4, pixel_um=250 / SCALE))


def test_clipped_target_is_refused():
    picture = np.clip(noisy(1.3, True) * 1.5, 0, 255).astype(np.uint8)
    with pytest.raises(InputError, match="saturated or clipped"):
        measure_usaf(picture, UsafRules(group=0), clipped=clipped_pixels(picture))


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (lambda: np.random.default_rng(0).normal(100, 10, (200, 200)), "no USAF-1951 target"),
        (lambda: bars((200, 200), 0.05, 0.0), "no USAF-1951 target"),
        (lambda: star((200, 200), (100, 100), 24), "no USAF-1951 target"),
        (lambda: np.full((100, 100), 5.0), "no pattern"),
        (lambda: usaf_chart(SHAPE, SCALE, ORIGIN, over=2)[:150, :150], "no USAF-1951 target"),
        (lambda: usaf_chart((220, 240), 9.0, (115.0, 105.0), 1.6, over=4), r"(no bars are wide enough|no USAF)"),
    ],
)
def test_no_number_without_a_target(picture, message):
    with pytest.raises(InputError, match=message):
        measure_usaf(picture(), UsafRules(group=0))
