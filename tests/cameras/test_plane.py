"""Affine and bilinear transformations, and Ecker 1991, appendix A."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.errors import GeometryError, InputError, UsageError

number = st.floats(-2.0, 2.0)
points = np.random.default_rng(1).uniform(-110, 110, (200, 2))

AFFINE = Affine2D(9.8, 0.1, 1100.0, -0.2, -10.1, 1120.0)
BILINEAR = Bilinear2D(9.8, 0.1, 2e-4, 1100.0, -0.2, -10.1, -3e-4, 1120.0)


@st.composite
def affines(draw: st.DrawFn) -> Affine2D:
    a, b, c, d = (draw(number) for _ in range(4))
    return Affine2D(3.0 + a, 0.5 * b, 100 * draw(number), 0.5 * c, -3.0 + d, 100 * draw(number))


@st.composite
def bilinears(draw: st.DrawFn) -> Bilinear2D:
    g, h = draw(affines()), [1e-3 * draw(number) for _ in range(2)]
    return Bilinear2D(g.a1, g.a2, h[0], g.a3, g.a4, g.a5, h[1], g.a6)


@settings(max_examples=50, deadline=None)
@given(affines(), affines())
def test_affine_after_affine(f: Affine2D, g: Affine2D) -> None:
    np.testing.assert_allclose((f @ g)(points), f(g(points)), atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(affines(), bilinears())
def test_appendix_a_affine_after_bilinear_is_bilinear(f: Affine2D, g: Bilinear2D) -> None:
    h = f @ g
    assert isinstance(h, Bilinear2D)
    np.testing.assert_allclose(h(points), f(g(points)), atol=1e-9)
    # The printed coefficients (eq. A.4).
    assert h.b3 == pytest.approx(f.a1 * g.b3 + f.a2 * g.b7)
    assert h.b8 == pytest.approx(f.a4 * g.b4 + f.a5 * g.b8 + f.a6)


def test_appendix_a_two_bilinear_transformations_are_refused() -> None:
    with pytest.raises(UsageError, match=r"A\.8"):
        BILINEAR @ BILINEAR  # type: ignore[operator]


@pytest.mark.parametrize("g", [Affine2D(1.5, 0.0, 3.0, 0.0, -0.7, 5.0), Affine2D(0.0, 1.2, 3.0, -0.8, 0.0, 5.0)])
def test_bilinear_after_scaled_or_exchanged_axes_is_bilinear(g: Affine2D) -> None:
    np.testing.assert_allclose((BILINEAR @ g)(points), BILINEAR(g(points)), atol=1e-11)


def test_bilinear_after_a_rotation_is_refused() -> None:
    with pytest.raises(UsageError, match="rotation"):
        BILINEAR @ Affine2D(0.8, -0.6, 0.0, 0.6, 0.8, 0.0)


@settings(max_examples=50, deadline=None)
@given(affines(), bilinears())
def test_inverse_pairs(f: Affine2D, g: Bilinear2D) -> None:
    np.testing.assert_allclose((~f)(f(points)), points, atol=1e-9)
    np.testing.assert_allclose((~~f)(points), f(points), atol=1e-9)
    same_sheet = np.sign(np.linalg.det(g.derivative(points))) == np.sign(g.determinant)
    np.testing.assert_allclose(g.inverse(g(points[same_sheet])), points[same_sheet], atol=1e-9)


def test_beyond_the_fold_of_a_bilinear_transformation_there_is_nothing() -> None:
    folding = Bilinear2D(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.1, 0.0)  # y' = y (1 + 0.1 x): singular at x = −10
    np.testing.assert_allclose(folding.inverse([[-9.0, 0.5]]), [[-9.0, 5.0]])
    folding = Bilinear2D(1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.1, 0.0)
    assert np.isnan(folding.inverse([[-60.0, 70.0]])).all()


@pytest.mark.parametrize("f", [AFFINE, BILINEAR])
def test_derivative_against_differences(f: Affine2D | Bilinear2D) -> None:
    step = np.eye(2)
    numeric = np.stack([(f(points + e) - f(points - e)) / 2 for e in step], axis=-1)
    np.testing.assert_allclose(f.derivative(points), numeric, atol=1e-9)


def test_shapes_are_kept_and_nan_stays() -> None:
    cube = np.full((2, 3, 4, 2), 1.0)
    cube[0, 0, 0] = np.nan
    for f in (AFFINE, BILINEAR):
        for out in (f(cube), f.inverse(f(cube))):
            assert out.shape == cube.shape
            assert np.isnan(out[0, 0, 0]).all()
            assert np.isfinite(out[1]).all()


def test_singular_or_infinite_coefficients_are_refused() -> None:
    with pytest.raises(GeometryError):
        Affine2D(1, 2, 0, 2, 4, 0)
    with pytest.raises(GeometryError):
        Bilinear2D(1, 2, 1, 0, 2, 4, 1, 0)
    with pytest.raises(InputError):
        Affine2D(1, 0, np.nan, 0, 1, 0)
    with pytest.raises(InputError):
        Bilinear2D(1, 0, 0, np.inf, 0, 1, 0, 0)
