"""Interior orientation of film: the quarry of Ecker 1991, §8.1, and marks that are wrong (fault 15)."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.cameras.fiducials import Affine2D, Bilinear2D, FiducialFit, fit_affine, fit_bilinear
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.errors import GeometryError, InputError
from photoplan.geometry.pose import Pose, rotation_opk

#: Ecker 1991, §8.1.1 (calibration of 22.8.74, millimetres) and §8.1.2 (scanner coordinates, pixels of 0.1 mm).
QUARRY_MM = {"1": (105.999, -106.016), "2": (-106.012, -106.006), "3": (-105.997, 105.993), "4": (106.007, 105.993)}
QUARRY_PX = {"1": (68.0, 131.5), "2": (62.0, 2248.0), "3": (2182.0, 2253.0), "4": (2189.0, 141.0)}

#: Eight marks (USGS report OSL/1785, millimetres) and a scan of them.
EIGHT_MM = {
    "1": (-109.990, -110.002), "2": (110.010, 109.999), "3": (-109.989, 109.995), "4": (109.998, -110.002),
    "5": (-111.998, -0.004), "6": (112.004, 0.0), "7": (0.014, 111.993), "8": (0.0, -112.002),
}  # fmt: skip
TRUTH = Affine2D(49.97, 0.31, 5780.2, 0.29, -50.02, 5795.7)
BENT = Bilinear2D(49.97, 0.31, 8e-4, 5780.2, 0.29, -50.02, -6e-4, 5795.7)


def scan(truth: Affine2D | Bilinear2D, noise: float = 0.0, seed: int = 0) -> dict[str, tuple[float, float]]:
    xy = truth(np.array(list(EIGHT_MM.values())))
    xy = xy + np.random.default_rng(seed).normal(0.0, 1.0, xy.shape) * noise
    return {n: (float(x), float(y)) for n, (x, y) in zip(EIGHT_MM, xy)}


def coefficients(fit: FiducialFit) -> np.ndarray:
    return np.array([getattr(fit.transformation, f) for f in fit.transformation.__dataclass_fields__])


def test_quarry_affine_residuals() -> None:
    """±0.23 pixel in x and ±1.11 pixel in y."""
    fit = fit_affine(QUARRY_MM, QUARRY_PX, mirrored=True)
    np.testing.assert_allclose(np.abs(fit.residuals), [[0.23, 1.11]] * 4, atol=0.005)
    assert fit.redundancy == 2
    assert fit.sigma0 == pytest.approx(np.sqrt((fit.residuals**2).sum() / 2))
    assert "sigma0 1.598 px" in str(fit)


def test_quarry_bilinear_leaves_no_residuals_and_says_so() -> None:
    fit = fit_bilinear(QUARRY_MM, QUARRY_PX, mirrored=True)
    np.testing.assert_allclose(fit.residuals, 0.0, atol=1e-9)
    np.testing.assert_allclose(fit.transformation(list(QUARRY_MM.values())), list(QUARRY_PX.values()), atol=1e-9)
    assert fit.redundancy == 0
    assert np.isnan(fit.sigma0)
    assert np.isnan(fit.covariance).all()
    assert "not checked" in str(fit)


def test_quarry_camera_sees_its_quarry() -> None:
    """The orientation printed in §8.1.2 (ω near 200 gon), brought into photoplan's axes as `FrameCamera` says."""
    R = rotation_opk(*(np.array([200.9777, 0.4335, 40.9304]) * np.pi / 200))
    center = np.array([43429.32, 332890.06, 1014.68])
    flipped = {n: (-x, y) for n, (x, y) in QUARRY_MM.items()}
    interior = Interior(153.24, (0.001, 0.003), fit_affine(flipped, QUARRY_PX).transformation, (2300, 2300))
    camera = FrameCamera(interior, NoLens(), Pose(center, R @ np.diag([1.0, -1.0, -1.0])))
    quarry = np.array([[x, y, z] for x in (43050.0, 43625.0) for y in (332550.0, 333350.0) for z in (150.0, 330.0)])
    # Eq. 3.1 and 4.2 as they stand in the source, with its own matrix and its own marks.
    r, d = R, quarry - center
    N = d @ r[:, 2]
    xy = np.stack([-0.001 - 153.24 * (d @ r[:, 0]) / N, 0.003 - 153.24 * (d @ r[:, 1]) / N], axis=-1)
    printed = fit_affine(QUARRY_MM, QUARRY_PX, mirrored=True).transformation(xy)
    np.testing.assert_allclose(project(camera, quarry), printed, atol=1e-8)
    middle = printed.mean(axis=0)
    assert (np.abs(middle - 1150) < 600).all()
    assert ((printed > 0) & (printed < 2300)).all(
        axis=1
    ).sum() == 6  # two corners of the box at 330 m lie beside the image


def test_exact_marks_are_reproduced() -> None:
    fit = fit_affine(EIGHT_MM, scan(TRUTH))
    np.testing.assert_allclose(coefficients(fit), coefficients_of(TRUTH), rtol=1e-10, atol=1e-9)
    bilinear = fit_bilinear(EIGHT_MM, scan(BENT))
    np.testing.assert_allclose(coefficients(bilinear), coefficients_of(BENT), rtol=1e-9, atol=1e-9)
    assert bilinear.redundancy == 8


def coefficients_of(f: Affine2D | Bilinear2D) -> np.ndarray:
    return np.array([getattr(f, n) for n in f.__dataclass_fields__])


@pytest.mark.parametrize(("fit", "truth"), [(fit_affine, TRUTH), (fit_bilinear, BENT)])
def test_covariance_and_sigma0_describe_the_scatter_of_many_scans(fit: object, truth: Affine2D | Bilinear2D) -> None:
    sd = 0.2
    fits = [fit(EIGHT_MM, scan(truth, sd, seed)) for seed in range(400)]  # type: ignore[operator]
    found = np.array([coefficients(f) for f in fits])
    mean_covariance = np.mean([f.covariance for f in fits], axis=0)
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(mean_covariance)), rtol=0.15)
    normalised = mean_covariance / np.sqrt(np.outer(*[np.diag(mean_covariance)] * 2))
    np.testing.assert_allclose(np.corrcoef(found.T), normalised, atol=0.2)
    assert np.mean([f.sigma0**2 for f in fits]) == pytest.approx(sd**2, rel=0.1)


def test_order_and_rows_of_a_file_do_not_matter() -> None:
    measured = scan(TRUTH, 0.3)
    a = fit_affine(EIGHT_MM, measured)
    rows = [(n, x, y) for n, (x, y) in reversed(measured.items())]
    b = fit_affine(EIGHT_MM, rows)
    assert a.names == b.names
    assert a.transformation == b.transformation


def test_fault_15_missing_marks() -> None:
    measured = scan(TRUTH)
    five = {n: measured[n] for n in "12345"}
    assert fit_affine(EIGHT_MM, five).missing == ("6", "7", "8")
    assert fit_affine(EIGHT_MM, {n: measured[n] for n in "123"}).redundancy == 0
    with pytest.raises(InputError, match=r"2 fiducial marks \('1', '2'\).*3 are needed.*'3', '4'"):
        fit_affine(EIGHT_MM, {n: measured[n] for n in "12"})
    with pytest.raises(InputError, match="4 are needed"):
        fit_bilinear(EIGHT_MM, {n: measured[n] for n in "123"})
    with pytest.raises(InputError, match="0 fiducial marks"):
        fit_affine(EIGHT_MM, {})


def test_fault_15_unknown_mark() -> None:
    with pytest.raises(InputError, match=r"'9' is not calibrated.*'1', '2'"):
        fit_affine(EIGHT_MM, {**scan(TRUTH), "9": (1.0, 2.0)})


def test_fault_15_duplicated_marks() -> None:
    measured = scan(TRUTH)
    rows = [(n, x, y) for n, (x, y) in measured.items()]
    with pytest.raises(InputError, match="measured fiducial mark '3' is given twice"):
        fit_affine(EIGHT_MM, [*rows, ("3", 5.0, 5.0)])
    with pytest.raises(InputError, match="'2' and '5' have the same place"):
        fit_affine(EIGHT_MM, {**measured, "5": measured["2"]})


@pytest.mark.parametrize("fit", [fit_affine, fit_bilinear])
@pytest.mark.parametrize("names", ["1234", "12345678"])
@pytest.mark.parametrize(("a", "b"), [("1", "4"), ("2", "4"), ("3", "1")])
def test_fault_15_exchanged_marks(fit: object, names: str, a: str, b: str) -> None:
    measured = {n: scan(TRUTH, 0.2)[n] for n in names}
    measured[a], measured[b] = measured[b], measured[a]
    with pytest.raises(InputError, match=f"'{min(a, b)}' and '{max(a, b)}' are exchanged"):
        fit(EIGHT_MM, measured)  # type: ignore[operator]


@pytest.mark.parametrize("fit", [fit_affine, fit_bilinear])
def test_fault_15_exchanged_marks_on_a_diagonal(fit: object) -> None:
    """Four corners with a diagonal exchanged are a mirrored scan to the last digit: both are said."""
    measured = scan(TRUTH)
    measured["1"], measured["2"] = measured["2"], measured["1"]
    with pytest.raises(InputError, match=r"mirrored.*'1' and '2' or '3' and '4' are exchanged"):
        fit(EIGHT_MM, {n: measured[n] for n in "1234"})  # type: ignore[operator]
    with pytest.raises(InputError, match=r"^fiducial marks '1' and '2' are exchanged"):
        fit(EIGHT_MM, measured)  # type: ignore[operator]


@pytest.mark.parametrize("fit", [fit_affine, fit_bilinear])
def test_fault_15_mirrored_scan(fit: object) -> None:
    mirrored = {n: (11500 - x, y) for n, (x, y) in scan(TRUTH).items()}
    with pytest.raises(InputError, match="mirrored"):
        fit(EIGHT_MM, mirrored)  # type: ignore[operator]
    assert fit(EIGHT_MM, mirrored, mirrored=True).transformation.determinant > 0  # type: ignore[operator]
    with pytest.raises(InputError, match="not mirrored"):
        fit(EIGHT_MM, scan(TRUTH), mirrored=True)  # type: ignore[operator]


def test_fault_17_a_wrong_mark_is_named() -> None:
    measured = scan(TRUTH, 0.2)
    x, y = measured["6"]
    with pytest.raises(InputError, match="'6' is wrong"):
        fit_affine(EIGHT_MM, {**measured, "6": (x + 250.0, y)})
    four = {n: measured[n] for n in "1234"}
    with pytest.raises(InputError, match="one of '1', '2', '3', '4' is wrong"):
        fit_affine(EIGHT_MM, {**four, "4": (measured["4"][0], measured["4"][1] + 400.0)})


def test_fault_16_marks_on_a_line() -> None:
    line = {n: (10.0 * k, 5.0 * k) for k, n in enumerate("1234")}
    with pytest.raises(GeometryError, match="line"):
        fit_affine(line, line)


def test_fault_18_a_mark_that_is_no_number() -> None:
    with pytest.raises(InputError, match=r"'2'.*finite"):
        fit_affine(EIGHT_MM, {**scan(TRUTH), "2": (np.nan, 1.0)})
