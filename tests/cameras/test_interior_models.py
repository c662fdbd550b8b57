"""Interior orientation: the similarity among its transformations, and what the coefficients of all of them mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.thinned import some

from photoplan.cameras.fiducials import (
    MODELS,
    Affine2D,
    Bilinear2D,
    FiducialFit,
    affine_facts,
    film_shrinkage,
    fit_affine,
    fit_bilinear,
    fit_marks,
    fit_similarity,
    residuals_on_film,
)
from photoplan.errors import InputError

#: Eight marks (USGS report OSL/1785, millimetres).
EIGHT = {
    "1": (-109.990, -110.002), "2": (110.010, 109.999), "3": (-109.989, 109.995), "4": (109.998, -110.002),
    "5": (-111.998, -0.004), "6": (112.004, 0.0), "7": (0.014, 111.993), "8": (0.0, -112.002),
}  # fmt: skip
CORNERS = {name: EIGHT[name] for name in "1234"}


def film(
    turn: float = 0.012, scale: tuple[float, float] = (50.0, 50.0), shear: float = 0.0, mirrored: bool = False
) -> Affine2D:
    """A scan: pixels per millimetre along the plane's axes, turned clockwise; `shear` opens the angle of the axes."""
    x, y = turn, turn + (1 if mirrored else -1) * (math.pi / 2 + shear)
    return Affine2D(
        scale[0] * math.cos(x),
        scale[1] * math.cos(y),
        5700.25,
        scale[0] * math.sin(x),
        scale[1] * math.sin(y),
        5800.5,
    )


def scan(truth: Affine2D | Bilinear2D, noise: float = 0.0, seed: int = 0) -> dict[str, tuple[float, float]]:
    xy = truth(np.array(list(EIGHT.values())))
    xy = xy + np.random.default_rng(seed).normal(0.0, 1.0, xy.shape) * noise
    return {n: (float(x), float(y)) for n, (x, y) in zip(EIGHT, xy)}


def numbers(fit: FiducialFit) -> np.ndarray:
    return np.array([getattr(fit.transformation, f) for f in fit.transformation.__dataclass_fields__])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("turn", [0.0, 0.012, math.pi / 2, 3.0, -2.0])
def test_exact_similarity_is_reproduced(turn: float, mirrored: bool) -> None:
    truth = film(turn, mirrored=mirrored)
    fit = fit_similarity(EIGHT, scan(truth), mirrored=mirrored)
    np.testing.assert_allclose(fit.transformation(list(EIGHT.values())), list(scan(truth).values()), atol=1e-9)
    assert (fit.model, fit.redundancy) == ("similarity", 12)
    assert fit.sigma0 < 1e-10
    assert "similarity interior orientation from 8 fiducial marks" in str(fit)
    assert numbers(fit)[0] ** 2 + numbers(fit)[3] ** 2 == pytest.approx(2500.0)


def test_similarity_is_the_least_squares_solution() -> None:
    """Its residuals have neither a mean, nor a moment along the points, nor about them."""
    fit = fit_similarity(EIGHT, scan(film(0.3, (50.0, 50.01), 2e-4), 0.5))
    v, xy = fit.residuals, np.array(list(EIGHT.values()))
    flipped = xy * (1.0, -1.0)
    np.testing.assert_allclose(v.sum(axis=0), 0.0, atol=1e-8)
    R = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
    turned = flipped @ R.T
    assert (v * turned).sum() == pytest.approx(0.0, abs=1e-6)
    assert (v[:, 0] * turned[:, 1] - v[:, 1] * turned[:, 0]).sum() == pytest.approx(0.0, abs=1e-6)
    assert fit.sigma0 == pytest.approx(math.sqrt((v**2).sum() / 12))


@pytest.mark.parametrize("mirrored", some([False, True], 1))
def test_covariance_of_a_similarity_describes_the_scatter_of_many_scans(mirrored: bool) -> None:
    sd, truth = 0.2, film(0.4, mirrored=mirrored)
    fits = [fit_similarity(EIGHT, scan(truth, sd, seed), mirrored=mirrored) for seed in range(400)]
    found = np.array([numbers(f) for f in fits])
    mean = np.mean([f.covariance for f in fits], axis=0)
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(mean)), rtol=0.15)
    spread = np.sqrt(np.outer(*[np.diag(mean)] * 2))
    np.testing.assert_allclose(np.corrcoef(found.T), mean / spread, atol=0.2)
    assert np.linalg.matrix_rank(mean / spread, tol=1e-9) == 4
    assert np.mean([f.sigma0**2 for f in fits]) == pytest.approx(sd**2, rel=0.1)


def test_models_nest() -> None:
    """More parameters leave smaller sums of squares; each is exact on the film it describes."""
    marks = scan(film(0.01, (50.0, 50.02), 1e-4), 0.3)
    squares = [(fit_marks(model, EIGHT, marks).residuals ** 2).sum() for model in MODELS]
    assert squares == sorted(squares, reverse=True)
    assert [fit_marks(model, EIGHT, marks).redundancy for model in MODELS] == [12, 10, 8]
    assert fit_marks("affine", EIGHT, marks).transformation == fit_affine(EIGHT, marks).transformation
    assert fit_marks("bilinear", EIGHT, marks).transformation == fit_bilinear(EIGHT, marks).transformation
    with pytest.raises(InputError, match="'projective'; allowed are similarity, affine, bilinear"):
        fit_marks("projective", EIGHT, marks)


@pytest.mark.parametrize("model", MODELS)
def test_fault_15_all_models_refuse_the_same(model: str) -> None:
    marks = {name: scan(film())[name] for name in CORNERS}
    with pytest.raises(InputError, match=r"2 fiducial marks .* are needed"):
        fit_marks(model, EIGHT, {n: marks[n] for n in "12"})
    with pytest.raises(InputError, match="'1' and '3' are exchanged"):
        fit_marks(model, EIGHT, {**marks, "1": marks["3"], "3": marks["1"]})
    turned_over = {n: (11500.0 - x, y) for n, (x, y) in marks.items()}
    with pytest.raises(InputError, match="mirrored"):
        fit_marks(model, EIGHT, turned_over)
    assert affine_facts(fit_marks(model, EIGHT, turned_over, mirrored=True).transformation).mirrored
    with pytest.raises(InputError, match="not mirrored"):
        fit_marks(model, EIGHT, marks, mirrored=True)


def test_fault_17_a_similarity_finds_a_wrong_mark_among_three() -> None:
    """An affine transformation takes any three marks; a similarity does not."""
    marks = {name: scan(film())[name] for name in "123"}
    marks["2"] = (marks["2"][0] + 300.0, marks["2"][1])
    assert fit_affine(EIGHT, marks).redundancy == 0
    with pytest.raises(InputError, match="a mark is wrong, or the scan's pixels are not square"):
        fit_similarity(EIGHT, marks)


def test_pixels_that_are_not_square_need_an_affine_transformation() -> None:
    marks = scan(film(0.01, (50.0, 60.0)))
    with pytest.raises(InputError, match="not square"):
        fit_similarity(EIGHT, marks)
    assert affine_facts(fit_affine(EIGHT, marks).transformation).scale == pytest.approx((50.0, 60.0))


@settings(max_examples=60, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(20.0, 90.0), st.floats(20.0, 90.0), st.floats(-0.2, 0.2), st.booleans())
def test_facts_are_those_that_the_scan_was_made_with(
    turn: float, along_x: float, along_y: float, shear: float, mirrored: bool
) -> None:
    facts = affine_facts(film(turn, (along_x, along_y), shear, mirrored))
    assert facts.scale == pytest.approx((along_x, along_y))
    assert facts.pixel_size == pytest.approx((1 / along_x, 1 / along_y))
    assert math.remainder(facts.direction_x - turn, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert facts.shear == pytest.approx(shear, abs=1e-9)
    assert facts.mirrored == mirrored
    if shear == 0.0:
        # A mirrored scan that is not turned has its x axis to the left.
        lay = turn - math.pi if mirrored else turn
        assert math.remainder(facts.rotation - lay, math.tau) == pytest.approx(0.0, abs=1e-9)


def test_rotation_of_a_sheared_scan_is_between_both_axes() -> None:
    facts = affine_facts(film(0.02, shear=0.004))
    of_y = math.remainder(facts.direction_y + math.pi / 2, math.tau)
    assert facts.direction_x == pytest.approx(0.02)
    assert facts.rotation == pytest.approx((0.02 + of_y) / 2)


def test_facts_of_a_bilinear_transformation_are_those_of_the_principal_point() -> None:
    bent = Bilinear2D(50.0, 0.0, 1e-3, 5700.0, 0.0, -50.0, 0.0, 5700.0)
    assert affine_facts(bent).scale == pytest.approx((50.0, 50.0))


@pytest.mark.parametrize("turn", [0.0, 0.7, math.pi / 2])
def test_shrinkage_is_along_the_film_however_it_lies_in_the_scanner(turn: float) -> None:
    """A scanner with 20 × 25 µm; the film has shrunk by 0.3 ‰ along x and grown by 0.1 ‰ along y."""
    shrunk = Affine2D(1 - 3e-4, 0.0, 0.0, 0.0, 1 + 1e-4, 0.0)
    on_glass = Affine2D(math.cos(turn), math.sin(turn), 120.0, math.sin(turn), -math.cos(turn), 130.0)
    to_pixels = Affine2D(1 / 0.020, 0.0, 0.0, 0.0, 1 / 0.025, 0.0)
    transformation = to_pixels @ on_glass @ shrunk
    found = film_shrinkage(transformation, (0.020, 0.025))
    assert (found.x, found.y) == pytest.approx((3e-4, -1e-4), abs=1e-12)
    assert found.mean == pytest.approx(1e-4)
    with pytest.raises(InputError, match="two positive numbers"):
        film_shrinkage(transformation, (0.0, 0.02))


@pytest.mark.parametrize("model", some(MODELS, 2))
def test_sigma_of_the_shrinkage_describes_the_scatter_of_many_scans(model: str) -> None:
    truth = film(0.4, (50.0, 40.0) if model != "similarity" else (50.0, 50.0))
    fits = [fit_marks(model, EIGHT, scan(truth, 0.2, seed)) for seed in range(400)]
    found = [film_shrinkage(f.transformation, (0.02, 0.02), f.covariance) for f in fits]
    spread = np.array([(s.x, s.y) for s in found]).std(axis=0)
    np.testing.assert_allclose(spread, np.sqrt(np.mean([np.square(s.sigma) for s in found], axis=0)), rtol=0.12)
    assert math.isnan(film_shrinkage(truth, (0.02, 0.02)).sigma[0])
    three = fit_affine(EIGHT, {n: scan(truth)[n] for n in "123"})
    assert math.isnan(film_shrinkage(truth, (0.02, 0.02), three.covariance).sigma[1])


def test_residuals_on_film_are_the_plane_points_that_move_by_them() -> None:
    truth = Bilinear2D(49.97, 0.31, 8e-4, 5780.2, 0.29, -50.02, -6e-4, 5795.7)
    plane = np.array(list(EIGHT.values()))
    shift = np.random.default_rng(5).normal(0, 1e-3, plane.shape)
    pixels = truth(plane + shift) - truth(plane)
    np.testing.assert_allclose(residuals_on_film(truth, plane, pixels), shift, atol=1e-8)
