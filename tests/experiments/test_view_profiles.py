"""Counts of the profile method beside the figures of Ecker (1991), and that its cuts set all pixels."""

from __future__ import annotations

import pytest
import view_profiles as experiment


@pytest.mark.parametrize("stages", [1, 2, 3, 4, 5])
def test_equations_5_4_and_5_5_to_the_digit(stages: int) -> None:
    """120 × 120 pixels around the vanishing point: 2 m² cuts, and with two stages m² / 2 less."""
    found = experiment.by_border((120, 120), (59.5, 59.5), stages)
    assert found.cuts == round(experiment.cuts_by_ecker(120, stages)) and found.profiles == 4 * 120
    assert found.missing == (0 if stages < 3 else 5) and found.largest <= 0.5
    assert experiment.cuts_by_ecker(120, 1) - experiment.cuts_by_ecker(120, 2) == 120**2 / 2


@pytest.mark.parametrize("name", [*experiment.CASES])
def test_both_selections_set_all_pixels_to_half_a_pixel(name: str) -> None:
    size, vanishing = experiment.CASES[name]
    usual, improved = experiment.by_border(size, vanishing), experiment.by_angle(size, vanishing)
    for found in (usual, improved):
        assert found.missing == 0 and found.largest <= 0.5
        assert found.cuts >= size[0] * size[1]
    assert improved.profiles <= usual.profiles
    quoted = {
        "in the middle": (480, 480), "inside, beside the middle": (400, 360), "opposite a side": (280, 182),
        "opposite a corner": (200, 200), "at infinity": (280, 122),
    }  # fmt: skip
    assert (usual.profiles, improved.profiles) == quoted[name]


def test_at_infinity_nearly_as_many_as_columns() -> None:
    """Ecker: n or m instead of 2 n + m; here two more, along both borders."""
    usual, improved = (f((120, 80), (59.5, 1e9)) for f in (experiment.by_border, experiment.by_angle))
    assert usual.profiles == 120 + 2 * 80 and improved.profiles == 120 + 2


@pytest.mark.slow
def test_profiles_of_a_level_camera_see_what_rays_see() -> None:
    """But for silhouettes, and for what curves inside a mesh: less than 1 % of the pixels; the package's columns all of
    it; the times are told."""
    found = experiment.timed(200, (120, 80))
    print(found)
    assert found.apart < 0.01 and found.same < 1e-6
    assert 0 < found.profiles < found.columns < found.rays
