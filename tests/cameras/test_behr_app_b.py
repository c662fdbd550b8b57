"""Behr 1989, appendix B, fig. B.4: a video camera is calibrated by nine positions of an analytical plotter's stage.

Point 1 has lost its sign in print: with DX = +3250 it would lie on point 3. The printed matrices came from unrounded
pixel coordinates, which are printed with two decimals; so what is computed from these may differ by as much as these
decimals allow, and what is computed from the printed matrix by its last digit. The appendix's text speaks of mean
residuals of 0.9 to 1.3 and at most 2.0 pixels, ten times what the figure prints (0.10, 0.13, 0.21).
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from photoplan.cameras.fiducials import Affine2D, FiducialFit, affine_facts, fit_affine
from photoplan.errors import InputError

#: DX, DY of the stage (µm), measured column and row (pixels), printed residuals (pixels).
TABLE = {
    "1": (-3250.0, 2250.0, 444.20, 402.38, 0.09, 0.08),
    "2": (0.0, 2250.0, 253.76, 399.44, 0.00, -0.04),
    "3": (3250.0, 2250.0, 63.32, 396.81, -0.09, 0.14),
    "4": (3250.0, 0.0, 64.96, 237.61, 0.09, -0.13),
    "5": (0.0, 0.0, 255.25, 240.34, 0.02, -0.21),
    "6": (-3250.0, 0.0, 445.45, 243.35, -0.12, -0.01),
    "7": (-3250.0, -2250.0, 447.11, 84.42, 0.08, 0.00),
    "8": (0.0, -2250.0, 256.56, 81.73, -0.13, 0.12),
    "9": (3250.0, -2250.0, 66.39, 78.87, 0.05, 0.06),
}
STAGE = {name: row[:2] for name, row in TABLE.items()}
MEASURED = {name: row[2:4] for name, row in TABLE.items()}
PRINTED_RESIDUALS = np.array([row[4:] for row in TABLE.values()])
#: Stage to video, and back; the back shift is relative to "actual x, y plate position".
PRINTED = Affine2D(-0.0585689723, -0.0006508574, 255.22, -0.0008640474, 0.0706376731, 240.55)
PRINTED_BACK = Affine2D(-17.0715661833, -0.1572978566, 4394.90, -0.2088211754, 14.1548276245, -3351.66)
#: Half of the last printed digit of a measured coordinate.
ROUNDED = 0.005
GON = 200 / math.pi


@pytest.fixture(scope="module")
def fit() -> FiducialFit:
    return fit_affine(STAGE, MEASURED)


def numbers(f: Affine2D) -> np.ndarray:
    return np.array([f.a1, f.a2, f.a3, f.a4, f.a5, f.a6])


def reach_of_rounding() -> np.ndarray:
    """How far the coefficients (of one row) move if all nine coordinates are rounded for the worst."""
    A = np.column_stack([list(STAGE.values()), np.ones(9)])
    return np.abs(np.linalg.pinv(A)).sum(axis=1) * ROUNDED


def test_matrix_from_stage_to_video(fit: FiducialFit) -> None:
    got, want = numbers(fit.transformation), numbers(PRINTED)
    last_digit = np.tile([0.5e-10, 0.5e-10, 0.005], 2)
    print("\nstage to video  ", *(f"{g:.10f} printed {w:.10f}\n" for g, w in zip(got, want)))
    assert (np.abs(got - want) <= np.tile(reach_of_rounding(), 2) + last_digit).all()
    np.testing.assert_allclose(got[[2, 5]], want[[2, 5]], rtol=0, atol=0.005)
    np.testing.assert_allclose(got[[0, 1, 3, 4]], want[[0, 1, 3, 4]], rtol=0, atol=6e-7)


def test_matrix_from_video_to_stage(fit: FiducialFit) -> None:
    """The inverse of the matrix to the last digits that the matrix allows; the shift is printed from unrounded ones."""
    got, want = numbers(~PRINTED), numbers(PRINTED_BACK)
    np.testing.assert_allclose(got[[0, 1, 3, 4]], want[[0, 1, 3, 4]], rtol=0, atol=3e-8)
    shift = 0.005 * 17.24  # the last digit of the printed shift, in micrometres of the stage
    np.testing.assert_allclose(got[[2, 5]], want[[2, 5]], rtol=0, atol=shift)
    back = numbers(~fit.transformation)
    np.testing.assert_allclose(back[[2, 5]], want[[2, 5]], rtol=0, atol=shift)
    np.testing.assert_allclose(back[[0, 1, 3, 4]], want[[0, 1, 3, 4]], rtol=0, atol=2e-4)


def test_scale_factors_and_pixel_sizes(fit: FiducialFit) -> None:
    """A scale factor is the length of a column of the matrix: pixels per micrometre along one axis of the stage."""
    facts = affine_facts(PRINTED)
    assert facts.scale == pytest.approx((0.0585753455, 0.0706406716), abs=1e-10)
    for transformation in (PRINTED, fit.transformation):
        assert tuple(round(s, 2) for s in affine_facts(transformation).pixel_size) == (17.07, 14.16)


def test_rotations(fit: FiducialFit) -> None:
    """Printed as the rotation of the y axis is minus the sum of both directions; their difference is the shear."""
    for transformation in (PRINTED, fit.transformation):
        facts = affine_facts(transformation)
        assert round(facts.direction_x * GON, 2) == 200.94
        assert round(-(facts.direction_x + facts.direction_y) * GON, 2) == -301.53
        assert round(facts.direction_y * GON, 2) == 100.59
        assert round(facts.shear * GON, 2) == 0.35
        assert not facts.mirrored


def test_residuals(fit: FiducialFit) -> None:
    """Printed as measured minus transformed."""
    got = -fit.residuals
    for name, g, w in zip(fit.names, got, PRINTED_RESIDUALS):
        print(f"{name}  {g[0]:+.4f} {g[1]:+.4f}  printed {w[0]:+.2f} {w[1]:+.2f}")
    # Half a digit of the residual, and what the rounding of the coordinates does to it.
    A = np.column_stack([list(STAGE.values()), np.ones(9)])
    moved = np.abs(np.eye(9) - A @ np.linalg.pinv(A)).sum(axis=1) * ROUNDED
    assert (np.abs(got - PRINTED_RESIDUALS) <= moved[:, None] + 0.005).all()
    assert np.abs(got - PRINTED_RESIDUALS).max() < 0.0085


def test_mean_errors(fit: FiducialFit) -> None:
    """Of columns and of rows with 9 − 3 degrees of freedom each, and of both with 12."""
    columns, rows = np.sqrt((fit.residuals**2).sum(axis=0) / 6)
    assert (round(columns, 2), round(rows, 2), round(fit.sigma0, 2)) == (0.10, 0.13, 0.12)
    assert fit.redundancy == 12


def test_point_1_as_printed_lies_on_point_3() -> None:
    printed = {**STAGE, "1": (3250.0, 2250.0)}
    with pytest.raises(InputError, match="'1' and '3' have the same place"):
        fit_affine(printed, MEASURED)
