"""Stage calibration (Behr 1989, appendix B): printed figures, standard deviations, gross and systematic errors."""

from __future__ import annotations

import math

import numpy as np
import pytest

from photoplan.errors import GeometryError, InputError
from photoplan.quality.camera.geometry import b4_lines, stage_calibration

#: DX, DY (µm), column, row, printed residuals; point 1 with its sign, which the print has lost.
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
ROWS = np.array(list(TABLE.values()))
GON = 200 / math.pi
GRID = np.array([(x, y) for y in range(5) for x in range(5)], float) * 1000
MATRIX = np.array([[0.05, 0.001], [-0.002, -0.07]])


def simulated(seed: int, noise: float = 0.1) -> np.ndarray:
    return GRID @ MATRIX.T + [20.0, 400.0] + np.random.default_rng(seed).normal(0, noise, (25, 2))


def test_figures_of_appendix_b() -> None:
    found = stage_calibration(TABLE, ROWS[:, :2], ROWS[:, 2:4])
    f, b = found.to_image, found.to_stage
    print("\n" + "\n".join(b4_lines(found, "µm")))
    # From coordinates of two decimals; what rounding allows is derived in tests/cameras/test_behr_app_b.py.
    np.testing.assert_allclose([f.a1, f.a2, f.a4, f.a5], [-0.0585689723, -0.0006508574, -0.0008640474, 0.0706376731],
                               rtol=0, atol=6e-7)  # fmt: skip
    np.testing.assert_allclose([f.a3, f.a6], [255.22, 240.55], rtol=0, atol=0.005)
    np.testing.assert_allclose([b.a1, b.a2, b.a4, b.a5], [-17.0715661833, -0.1572978566, -0.2088211754, 14.1548276245],
                               rtol=0, atol=2e-4)  # fmt: skip
    np.testing.assert_allclose([b.a3, b.a6], [4394.90, -3351.66], rtol=0, atol=0.087)
    assert tuple(round(s, 2) for s in found.facts.pixel_size) == (17.07, 14.16)
    np.testing.assert_allclose(found.facts.scale, (0.0585753455, 0.0706406716), rtol=0, atol=6e-7)
    assert round(found.facts.direction_x * GON, 2) == 200.94 and round(found.printed_rotation_y, 2) == -301.53
    assert (round(found.sigma[0], 2), round(found.sigma[1], 2), round(found.sigma0, 2)) == (0.10, 0.13, 0.12)
    assert np.abs(found.residuals - ROWS[:, 4:]).max() < 0.0085
    assert not found.gross and found.redundancy == 12


def test_text_has_the_printed_figures() -> None:
    text = "\n".join(b4_lines(stage_calibration(TABLE, ROWS[:, :2], ROWS[:, 2:4]), "um"))
    for printed in ("255.22", "240.55", "17.07 um", "14.16 um", "200.94 gon", "-301.53", "M0 = 0.12", "0.10 0.13"):
        assert printed in text, printed


def test_standard_deviations_are_true() -> None:
    size = 1 / np.linalg.norm(MATRIX, axis=0)
    direction = np.arctan2(MATRIX[1], MATRIX[0])
    errors = []
    for seed in range(200):
        found = stage_calibration(map(str, range(25)), GRID, simulated(seed))
        errors += list((np.array(found.facts.pixel_size) - size) / found.sigma_pixel_size)
        turn = np.array([found.facts.direction_x, found.facts.direction_y]) - direction
        errors += [math.remainder(t, math.tau) / s for t, s in zip(turn, found.sigma_direction)]
        shear = (direction[0] - direction[1]) % math.tau - math.pi / 2
        errors.append((found.facts.shear - shear) / found.sigma_shear)
    print(f"\nnormalised errors {np.std(errors):.3f}")
    assert 0.9 < np.sqrt(np.mean(np.square(errors))) < 1.1


def test_gross_errors_are_named_and_left_out() -> None:
    P = simulated(1)
    clean = stage_calibration(map(str, range(25)), GRID, P)
    P[3, 0] += 2.0
    P[17, 1] -= 1.0
    found = stage_calibration(map(str, range(25)), GRID, P)
    assert found.gross == ("3", "17") and found.residuals[3, 0] == pytest.approx(2.0, abs=0.3)
    assert found.sigma0 == pytest.approx(clean.sigma0, rel=0.1)
    alarms = sum(bool(stage_calibration(map(str, range(25)), GRID, simulated(s)).gross) for s in range(300))
    assert alarms <= 2


def test_systematic_residuals_are_seen() -> None:
    """Figure B.3 lets one suspect a system in the residuals of 9 × 9 points."""
    P = simulated(2, 0.02)
    straight = stage_calibration(map(str, range(25)), GRID, P).systematic
    P[:, 0] += 0.1 * ((GRID[:, 0] - 2000) / 2000) ** 2
    bent = stage_calibration(map(str, range(25)), GRID, P).systematic
    assert straight is not None and straight > 0.01 and bent is not None and bent < 1e-6


def test_point_1_as_printed_is_a_gross_error() -> None:
    """With DX = +3250, as printed, point 1 lies on point 3: nothing fits, and the message names it."""
    S = ROWS[:, :2].copy()
    S[0, 0] = 3250.0
    found = stage_calibration(TABLE, S, ROWS[:, 2:4])
    assert found.gross == ("1",)
    assert round(found.facts.pixel_size[0], 1) == 17.1


def test_bad_points_are_refused_in_words() -> None:
    P = simulated(3)
    with pytest.raises(InputError, match="3 points; 4 are needed"):
        stage_calibration("abc", GRID[:3], P[:3])
    with pytest.raises(InputError, match="'a' is given twice"):
        stage_calibration("abca", GRID[:4], P[:4])
    with pytest.raises(GeometryError, match="on a line"):
        stage_calibration("abcde", GRID[:5], P[:5])
    bad = P.copy()
    bad[2] = np.nan
    with pytest.raises(InputError, match="'2' has a coordinate"):
        stage_calibration(map(str, range(25)), GRID, bad)
    mixed = P[np.random.default_rng(4).permutation(25)]
    found = stage_calibration(map(str, range(25)), GRID, mixed)
    assert found.sigma0 > 20  # nothing stands out where all is wrong; M0 says so
