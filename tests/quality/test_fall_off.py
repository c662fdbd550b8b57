"""Light fall-off: what a simulation put in comes out, dirt does not count, parts that cannot be told apart are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from tools.thinned import some, thinned

from photoplan.errors import GeometryError, InputError
from photoplan.geometry.grid import Window
from photoplan.quality.camera.fall_off import (
    FallOffModel,
    FallOffSettings,
    correct_fall_off,
    fit_fall_off,
    gain_image,
    surface_terms,
)

SIZE, POINT, FOCAL = (320, 240), (165.0, 118.0), 350.0
TERMS = ((2, 0), (4, 0), (1, 1), (2, 2))
FACTORS = (-0.08, -0.10, 0.05, 0.02)
MODEL = FallOffModel(SIZE, POINT, FOCAL, TERMS, FACTORS)
CORNERS = np.array([0.0, 319.0, 0.0, 319.0]), np.array([0.0, 0.0, 239.0, 239.0])
GIVEN = FallOffSettings("given", FOCAL, POINT)


def flat(model: FallOffModel, seed: int, noise: float = 2.0, level: float = 180.0) -> np.ndarray:
    x, y = np.arange(model.size[0], dtype=float)[None, :], np.arange(model.size[1], dtype=float)[:, None]
    values = level * model.relative(x, y)
    return values + np.random.default_rng(seed).normal(0.0, noise, values.shape)


def test_natural_part_is_the_cosine_to_the_fourth() -> None:
    """45° off the axis a quarter of the light is left (Behr 1989, §4.2.1: cos⁴ω)."""
    model = FallOffModel((201, 201), (100.0, 100.0), 100.0, (), ())
    assert model.relative(np.array(200.0), np.array(100.0)) == pytest.approx(0.25)
    for angle in (0.1, 0.3, 0.7):
        got = model.natural(np.array(100.0 + 100.0 * np.tan(angle)), np.array(100.0))
        assert got == pytest.approx(np.cos(angle) ** 4)


def test_terms_span_the_general_polynomial() -> None:
    for degree in range(1, 7):
        terms = surface_terms(degree)
        assert len(terms) == (degree + 1) * (degree + 2) // 2 - 1
        x, y = np.random.default_rng(degree).uniform(-1, 1, (2, 60))
        model = [FallOffModel((2, 2), (0.0, 0.0), None, (t,), (1.0,)) for t in terms]
        unit = model[0].half_diagonal
        A = np.column_stack([np.ones(60), *(m.relative(x * unit, y * unit) - 1 for m in model)])
        powers = np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
        assert np.linalg.matrix_rank(A) == np.linalg.matrix_rank(np.column_stack([A, powers])) == A.shape[1]


@thinned("runs", 10, 80)
def test_simulated_parts_are_recovered_with_true_standard_deviations(runs: int) -> None:
    errors, corners = [], []
    truth = dict(zip(TERMS, FACTORS))
    true_corners = 1.0 - MODEL.relative(*CORNERS)
    for seed in range(runs):
        found = fit_fall_off(flat(MODEL, seed), GIVEN)
        assert {(t.n, t.m) for t in found.terms} >= set(TERMS)
        errors += [(t.coefficient - truth.get((t.n, t.m), 0.0)) / t.sigma for t in found.terms]
        corners += [(c.total - w) / c.sigma for c, w in zip(found.corners, true_corners)]
    print(f"\nnormalised errors: terms {np.std(errors):.3f}, corners {np.std(corners):.3f}; corner {found.corners[0]}")
    assert 0.9 < np.sqrt(np.mean(np.square(errors))) < 1.1
    assert 0.85 < np.sqrt(np.mean(np.square(corners))) < 1.15
    assert found.corners[0].total == pytest.approx(true_corners[0], abs=0.002)
    assert found.corners[0].natural == pytest.approx(1 - MODEL.natural(*CORNERS)[0])
    assert found.corners[0].artificial == pytest.approx(1 - MODEL.artificial(*CORNERS)[0], abs=0.004)


@thinned("count", 8, 40)
def test_camera_constant_and_point_of_a_pure_natural_fall_off(count: int) -> None:
    model = FallOffModel(SIZE, POINT, FOCAL, (), ())
    settings = FallOffSettings("estimated", estimate_principal_point=True, artificial="none")
    errors = []
    for seed in range(count):
        found = fit_fall_off(flat(model, seed), settings)
        assert found.sigma_camera_constant is not None and found.sigma_principal_point is not None
        errors.append((found.camera_constant - FOCAL) / found.sigma_camera_constant)
        errors += list((np.array(found.model.principal_point) - POINT) / found.sigma_principal_point)
    print(f"\nc {found.camera_constant:.2f} ± {found.sigma_camera_constant:.2f}, normalised {np.std(errors):.3f}")
    assert 0.88 < np.sqrt(np.mean(np.square(errors))) < 1.12
    assert found.rank == ""


@pytest.mark.parametrize("artificial", some(["radial", "surface"], 1))
def test_parts_that_cannot_be_told_apart_are_reported_not_stated(artificial: str) -> None:
    """The polynomial in r² and r⁴ imitates cos⁴ω; the whole is still known, and corrects."""
    image = flat(MODEL, 1)
    found = fit_fall_off(image, FallOffSettings("estimated", principal_point=POINT, artificial=artificial))
    print("\n" + found.rank)
    assert "camera constant" in found.rank and "Give the camera constant" in found.rank
    assert found.camera_constant is None and found.separability["camera constant"] < 0.05
    assert all(c.natural is None and c.artificial is None for c in found.corners)
    if artificial == "surface":
        want = 1.0 - MODEL.relative(*CORNERS)
        np.testing.assert_allclose([c.total for c in found.corners], want, atol=0.004)


def test_brightness_that_does_not_fall_off_gives_no_camera_constant() -> None:
    even = FallOffModel(SIZE, POINT, None, (), ())
    with pytest.raises(GeometryError, match="does not fall off"):
        fit_fall_off(flat(even, 2, 0.5), FallOffSettings("estimated", artificial="none"))


def test_no_fall_off_is_known_no_better_than_a_small_one() -> None:
    """Which of both it is, chance decides; the standard deviation of the corners must hold for both."""
    y, x = np.mgrid[:150, :200]
    square = ((x - 99.5) ** 2 + (y - 74.5) ** 2) / (99.5**2 + 74.5**2)
    rng = np.random.default_rng(4)
    sigmas = []
    for depth in (0.0, 0.0005, 0.01):
        image = 3000 * (1 - depth * square) + rng.normal(0.0, 25.0, square.shape)
        for corner in fit_fall_off(image, FallOffSettings("none")).corners:
            assert abs(corner.total - depth) < 3.5 * corner.sigma
            sigmas.append(corner.sigma)
    assert max(sigmas) < 1.3 * min(sigmas)


def test_dirt_neither_counts_nor_hides() -> None:
    image = flat(MODEL, 3)
    clean = fit_fall_off(image, GIVEN)
    image[100:118, 200:222] *= 0.8
    image[30:36, 40:44] *= 0.6
    image[200, 300] = 255.0  # a hot pixel
    found = fit_fall_off(image, GIVEN)
    for a, b in zip(found.corners, clean.corners):
        assert abs(a.total - b.total) < 3 * b.sigma
    assert len(found.dirt) == 2
    big = min(found.dirt, key=lambda d: abs(d.x - 210.5))
    assert abs(big.x - 210.5) < 4 and abs(big.y - 108.5) < 4 and big.depth == pytest.approx(-0.2, abs=0.02)


def test_correction_levels_the_image() -> None:
    image = flat(MODEL, 4)
    found = fit_fall_off(image, GIVEN)
    level, clipped = correct_fall_off(image, Window(0, 0, *SIZE), found.model)
    blocks = level[:240, :320].reshape(24, 10, 32, 10).mean(axis=(1, 3))
    print(f"\nbefore {100 * found.range_before:.1f} %, after {100 * np.ptp(blocks) / found.level:.2f} %")
    assert found.range_before > 0.5 and clipped == 0
    # Noise of a block of 100 pixels is 0.11 % in the middle and 0.3 % in the corner.
    assert np.std(blocks) / found.level < 0.0025
    assert found.residual_rms < 0.006


def test_gain_is_one_in_the_middle_and_the_inverse_elsewhere() -> None:
    gains = gain_image(MODEL)
    assert gains.dtype == np.float32 and gains.shape == (240, 320)
    assert gains[118, 165] == pytest.approx(1.0)
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    np.testing.assert_allclose(gains * MODEL.relative(x, y), 1.0, rtol=1e-6)
    small = gain_image(MODEL, 8)
    assert small.shape == (30, 40)
    np.testing.assert_allclose(small, gains.reshape(30, 8, 40, 8).mean(axis=(1, 3)), rtol=2e-3)


def test_windows_are_corrected_as_the_whole_and_dark_stays_dark() -> None:
    model = FallOffModel(SIZE, POINT, FOCAL, TERMS, FACTORS, dark=12.0)
    image = np.full((3, 240, 320), 100, np.uint8)
    whole, clipped = correct_fall_off(image, Window(0, 0, *SIZE), model)
    assert whole.dtype == np.uint8 and clipped == 0
    part, _ = correct_fall_off(image[:, 30:90, 100:200], Window(100, 30, 100, 60), model)
    np.testing.assert_array_equal(part, whole[:, 30:90, 100:200])
    dark, _ = correct_fall_off(np.full((240, 320), 12, np.uint8), Window(0, 0, *SIZE), model)
    assert (dark == 12).all()
    _, many = correct_fall_off(np.full((240, 320), 240, np.uint8), Window(0, 0, *SIZE), model)
    assert many > 1000


def test_bad_input_is_refused_in_words() -> None:
    image = flat(MODEL, 5)
    structure = ndimage.gaussian_filter(np.random.default_rng(6).normal(0, 1, image.shape), 6)
    with pytest.raises(InputError, match="shows a structure"):
        fit_fall_off(image * (1 + 0.1 * structure / structure.std()), GIVEN)
    with pytest.raises(InputError, match="no brightness"):
        fit_fall_off(np.random.default_rng(0).normal(-1.0, 1.0, (240, 320)), GIVEN)
    with pytest.raises(InputError, match="at least 16"):
        fit_fall_off(image[:8, :8], GIVEN)
    with pytest.raises(InputError, match="half of them"):
        fit_fall_off(np.where(np.arange(320) < 60, image, np.nan), GIVEN)
    with pytest.raises(InputError, match="camera constant"):
        FallOffSettings("given")
    with pytest.raises(InputError, match=r"term \(3, 2\)"):
        FallOffModel(SIZE, POINT, None, ((3, 2),), (0.1,))
    with pytest.raises(InputError, match="leaves it"):
        correct_fall_off(image, Window(10, 0, *SIZE), MODEL)
    far = FallOffModel(SIZE, POINT, None, ((2, 0),), (-1.5,))
    with pytest.raises(InputError, match="lower degree"):
        gain_image(far)
