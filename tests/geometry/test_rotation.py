"""Ecker 1991, eq. 3.3, and the way back for every order of angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.errors import UsageError
from photoplan.geometry.pose import (
    ROTATION_ORDERS,
    angles_from_rotation,
    axes_of_angles,
    rotation_from_angles,
    rotation_from_view,
    rotation_opk,
    rotation_vector,
    view_from_rotation,
)

angle = st.floats(-np.pi, np.pi, exclude_min=True)
middle = st.floats(-np.pi / 2, np.pi / 2)


@settings(max_examples=60, deadline=None)
@given(angle, angle, angle)
def test_opk_is_the_printed_matrix(omega: float, phi: float, kappa: float) -> None:
    so, co, sp, cp, sk, ck = (f(v) for v in (omega, phi, kappa) for f in (np.sin, np.cos))
    printed = [
        [cp * ck, -cp * sk, sp],
        [co * sk + so * sp * ck, co * ck - so * sp * sk, -so * cp],
        [so * sk - co * sp * ck, so * ck + co * sp * sk, co * cp],
    ]
    np.testing.assert_allclose(rotation_opk(omega, phi, kappa), printed, atol=1e-15)


@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_order_names_the_sequence_of_turned_axes(order: str) -> None:
    single = {
        "o": lambda a: rotation_opk(a, 0, 0),
        "p": lambda a: rotation_opk(0, a, 0),
        "k": lambda a: rotation_opk(0, 0, a),
    }
    angles = (0.3, -0.7, 1.1)
    expected = np.eye(3)
    for name, value in zip(order, angles):
        expected = expected @ single[name](value)
    np.testing.assert_allclose(rotation_from_angles(angles, order), expected, atol=1e-15)


@pytest.mark.parametrize("order", ROTATION_ORDERS)
@settings(max_examples=40, deadline=None)
@given(first=angle, second=middle, third=angle)
def test_angles_and_rotation_are_inverse(order: str, first: float, second: float, third: float) -> None:
    R = rotation_from_angles((first, second, third), order)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    found = angles_from_rotation(R, order)
    np.testing.assert_allclose(rotation_from_angles(found, order), R, atol=1e-11)
    if abs(second) < 1.57:
        # Angles of ±π are the same direction.
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * np.array([first, second, third])), atol=1e-9)


@pytest.mark.parametrize("order", ROTATION_ORDERS)
@pytest.mark.parametrize("second", [np.pi / 2, -np.pi / 2])
def test_where_two_axes_fall_together_the_rotation_is_still_reproduced(order: str, second: float) -> None:
    R = rotation_from_angles((0.4, second, -0.9), order)
    np.testing.assert_allclose(rotation_from_angles(angles_from_rotation(R, order), order), R, atol=1e-12)


def test_no_digits_are_lost_near_the_right_angle() -> None:
    phi = np.pi / 2 - 1e-6
    assert angles_from_rotation(rotation_opk(0.1, phi, 0.2))[1] == pytest.approx(phi, abs=1e-15)


def test_unknown_order_is_named() -> None:
    for call in (rotation_from_angles, angles_from_rotation):
        with pytest.raises(UsageError, match="xyz"):
            call(np.eye(3), "xyz")


@pytest.mark.parametrize("order", ROTATION_ORDERS)
def test_small_changes_of_angles_turn_about_their_axes(order: str) -> None:
    angles = np.array([0.3, -0.5, 1.1])
    R = rotation_from_angles(angles, order)
    axes = axes_of_angles(R, order)
    for k, letter in enumerate(order):
        turned = rotation_from_angles(angles + 1e-6 * np.eye(3)[k], order)
        np.testing.assert_allclose(rotation_vector(turned @ R.T) / 1e-6, axes["opk".index(letter)], atol=1e-6)


def test_views_have_azimuth_pitch_and_roll() -> None:
    level = rotation_from_view(np.pi / 2, 0.0, 0.0)
    np.testing.assert_allclose(level @ (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), atol=1e-15)  # to the east
    np.testing.assert_allclose(level @ (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), atol=1e-15)  # the south is right
    assert (rotation_from_view(0.0, 0.0, 0.1) @ (1.0, 0.0, 0.0))[2] < 0 < rotation_from_view(0.0, 0.1, 0.0)[2, 1]
    for stated in ((0.4, -0.9, 0.2), (-2.5, 1.2, -3.0)):
        R = rotation_from_view(*stated)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1.0) and view_from_rotation(R) == pytest.approx(stated)
