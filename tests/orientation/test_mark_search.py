"""Fiducial marks found unaided in simulated scans whose marks are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.mark_scans import CORNERS, ArrayScan, Simulated, ring_cross_pattern, simulate
from tools.thinned import some, thinned

from photoplan.cameras.fiducials import MarkPart, MarkPattern
from photoplan.errors import InputError
from photoplan.orientation.marks.fiducials import FiducialSearch, find_fiducials
from photoplan.orientation.marks.locate import TURNS, FiducialResult, MarkLayout, MarksNotFound, fit_placement

PATTERN = ring_cross_pattern()
LAYOUT = MarkLayout.of(CORNERS, dict.fromkeys(CORNERS, PATTERN))


def errors(found: FiducialResult, truth: dict[str, tuple[float, float]]) -> NDArray[np.float64]:
    return np.array([(m.x - truth[m.name][0], m.y - truth[m.name][1]) for m in found.marks])


@thinned("count", 3, 30)
def test_marks_of_scans_of_any_kind_within_a_twentieth_of_a_pixel_and_standard_deviations_are_true(count: int) -> None:
    rng = np.random.default_rng(1)
    off, sigmas, tops = [], [], []
    for seed in range(count):
        made = Simulated(
            rotation=int(rng.integers(4)) * 90,
            mirrored=bool(rng.integers(2)),
            negative=bool(rng.integers(2)),
            small_turn=rng.uniform(-3, 3),
            blur=rng.uniform(0.5, 1.6),
            offset=tuple(rng.uniform(-2, 2, 2)),
            pixel_mm=rng.uniform(0.08, 0.13),
        )
        assert made.contrast / made.noise == 20
        grey, truth = simulate(made, seed)
        known = FiducialSearch(made.pixel_mm, made.rotation, made.mirrored)
        found = find_fiducials(ArrayScan(grey), LAYOUT, known)
        assert [m.method for m in found.marks] == ["matching"] * 4
        assert found.negative == made.negative
        off.append(errors(found, truth))
        sigmas.append([(m.sigma_x, m.sigma_y) for m in found.marks])
        tops.append([np.subtract(m.paraboloid, truth[m.name]) for m in found.marks])
    all_off, all_sigmas = np.concatenate(off), np.concatenate(sigmas)
    assert len(all_off) == 4 * count
    assert np.sqrt(np.mean(all_off**2)) <= 0.05
    assert 0.8 <= np.sqrt(np.mean((all_off / all_sigmas) ** 2)) <= 1.25
    assert np.sqrt(np.mean(np.square(tops))) <= 0.1


@pytest.mark.parametrize("pixel_mm", some([0.08, 0.115], 1))
def test_resolution_need_not_be_known(pixel_mm: float) -> None:
    grey, truth = simulate(Simulated(pixel_mm=pixel_mm, small_turn=-1.5), 5)
    for stated in (None, pixel_mm * 3):
        found = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(stated, 0, False))
        assert np.abs(errors(found, truth)).max() < 0.2
        assert found.pixel_mm == pytest.approx(pixel_mm, rel=1e-3)
        assert any("as stated, do not fit" in note for note in found.notes) == (stated is not None)


def test_four_equal_corners_do_not_tell_the_rotation_and_that_is_said() -> None:
    grey, truth = simulate(Simulated(rotation=90, pixel_mm=0.13), 2)
    found = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13))
    assert (found.turn.rotation, found.turn.mirrored) == (0, False)
    assert any("every one of these rotations" in note and "0° is assumed" in note for note in found.notes)
    mirrored = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13, usual_mirrored=True))
    assert mirrored.turn.mirrored
    stated = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13, 90, False))
    assert not stated.notes
    assert np.abs(errors(stated, truth)).max() < 0.2


def test_rotations_that_the_calibrated_values_exclude_are_not_assumed_though_two_others_fit() -> None:
    """Marks that mirror each other in a diagonal tell the scan by half a turn, but not from its mirrored twin."""
    marks = {"1": (-26.0, -26.0), "2": (26.1, -25.9), "3": (-25.9, 26.1), "4": (26.0, 26.0)}
    layout = MarkLayout.of(marks, dict.fromkeys(marks, PATTERN))
    grey, truth = simulate(Simulated(marks=marks, rotation=180, shrinkage=(0.0, 0.0), pixel_mm=0.13), 4)
    found = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.13))
    assert (found.turn.rotation, found.turn.mirrored) == (180, False)
    assert np.abs(errors(found, truth)).max() < 0.2
    assert found.sigma0_um < 10
    (note,) = found.notes
    assert "180°, 90° mirrored; 180° is assumed" in note
    assert "excluded by the calibrated values" in note


#: A fifth mark on one side tells all turns but the mirrored ones; a sixth, off its middle, those too.
FIVE = CORNERS | {"5": (26.0, 9.0)}


@pytest.mark.parametrize(
    "turn", [pytest.param(turn, marks=[] if k == 6 else pytest.mark.slow) for k, turn in enumerate(TURNS)], ids=str
)
def test_marks_without_symmetry_tell_how_the_scan_is_turned(turn) -> None:  # type: ignore[no-untyped-def]
    layout = MarkLayout.of(FIVE, dict.fromkeys(FIVE, PATTERN))
    made = Simulated(marks=FIVE, rotation=turn.rotation, mirrored=turn.mirrored, small_turn=1.0, pixel_mm=0.13)
    grey, truth = simulate(made, 3)
    found = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.13))
    assert found.turn == turn
    assert not found.notes
    assert np.abs(errors(found, truth)).max() < 0.2


def test_calibrated_values_tell_the_rotation_where_they_differ_enough() -> None:
    marks = {"1": (-26.0, -26.0), "2": (26.0, 26.0), "3": (-26.0, 26.0), "4": (26.08, -25.95)}
    layout = MarkLayout.of(marks, dict.fromkeys(marks, PATTERN))
    grey, truth = simulate(Simulated(marks=marks, rotation=180, noise=3.0, shrinkage=(0, 0)), 4)
    found = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.1, mirrored=False))
    assert found.turn.rotation == 180
    assert any("told by the calibrated values" in note for note in found.notes)
    assert np.abs(errors(found, truth)).max() < 0.2


@pytest.mark.parametrize("turn", some([TURNS[1], TURNS[6]], 1), ids=str)
def test_a_mark_without_symmetry_tells_the_rotation(turn) -> None:  # type: ignore[no-untyped-def]
    bars = [[(-0.2, -1), (0.2, -1), (0.2, 1), (-0.2, 1)], [(0.2, 0.6), (1, 0.6), (1, 1), (0.2, 1)]]
    flag = MarkPattern("flag", tuple(MarkPart(np.array(b, float), 1.0) for b in bars), 0.0, (-1.4, -1.4, 1.4, 1.4))
    layout = MarkLayout.of(CORNERS, dict.fromkeys(CORNERS, flag))
    rng = np.random.default_rng(0)
    n = 560
    matrix = turn.matrix / 0.1
    grey = np.full((n, n), 40.0)
    rows, columns = np.indices((n, n), dtype=float)
    truth = {}
    for name, xy in CORNERS.items():
        truth[name] = tuple(matrix @ np.array(xy) + (n - 1) / 2)
        d = np.stack([columns - truth[name][0], rows - truth[name][1]], -1) @ np.linalg.inv(matrix).T
        x, y = d[..., 0], d[..., 1]
        shape = ((abs(x) < 0.2) & (abs(y) < 1)) | ((x > 0) & (x < 1) & (y > 0.6) & (y < 1))
        grey[shape] = 200
    grey += rng.normal(0, 8, grey.shape)
    found = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.1))
    assert found.turn == turn
    assert not found.notes
    assert np.abs(errors(found, truth)).max() < 0.3


def test_fault_15_a_covered_mark_is_named_and_three_marks_are_said_to_be_unchecked() -> None:
    grey, truth = simulate(Simulated(covered=("3",)), 6)
    found = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.1, 0, False))
    assert [m.name for m in found.marks] == ["1", "2", "4"]
    assert [m.name for m in found.missing] == ["3"]
    lost = found.missing[0]
    assert lost.correlation < 0.6
    assert "nothing correlates" in lost.reason
    assert (lost.x, lost.y) == pytest.approx(truth["3"], abs=1)
    assert any("no redundancy" in note for note in found.notes)
    assert np.isnan(found.sigma0_um)


def test_fault_15_two_covered_marks_are_an_error_that_names_them() -> None:
    grey, _ = simulate(Simulated(covered=("3", "4"), pixel_mm=0.13), 6)
    with pytest.raises(MarksNotFound, match=r"2 of 4 .*Found: '1'.*'2'.*Not found: '3'.*'4'") as refused:
        find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13, 0, False))
    assert {mark.name: mark.found for mark in refused.value.sought} == {"1": True, "2": True, "3": False, "4": False}


@pytest.mark.parametrize("factor", some([0.7, 1.3], 1))
def test_marks_of_another_size_than_described_are_found_and_said(factor: float) -> None:
    grey, truth = simulate(Simulated(pixel_mm=0.13), 6)
    found = find_fiducials(ArrayScan(grey), LAYOUT.with_marks(factor), FiducialSearch(0.13, 0, False))
    assert "not found as described" in found.notes[0]
    assert np.abs(errors(found, truth)).max() < 0.2
    as_described = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13, 0, False))
    assert not any("as described" in note for note in as_described.notes)


def test_fault_15_a_scan_without_marks_is_refused() -> None:
    grey, _ = simulate(Simulated(covered=tuple(CORNERS), pixel_mm=0.13), 6)
    with pytest.raises(InputError, match=r"(?i)not found"):
        find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.13, 0, False))
    with pytest.raises(InputError, match="none of the 4"):
        find_fiducials(ArrayScan(np.full((500, 500), 128.0)), LAYOUT)


def test_fault_15_a_look_alike_is_not_taken_and_said() -> None:
    grey, truth = simulate(Simulated(picture=18.0, false=((21.0, 22.5), (-20.5, -24.0))), 7)
    found = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.1, 0, False))
    assert np.abs(errors(found, truth)).max() < 0.2
    assert sum("another place looks like mark" in note for note in found.notes) == 2


def test_fault_15_a_look_alike_of_a_covered_mark_is_not_taken() -> None:
    grey, _ = simulate(Simulated(covered=("2",), false=((22.0, 24.0),)), 8)
    found = find_fiducials(ArrayScan(grey), LAYOUT, FiducialSearch(0.1, 0, False))
    assert [m.name for m in found.missing] == ["2"]


def test_fault_15_a_false_mark_beside_the_true_place_is_named_by_the_others() -> None:
    marks = CORNERS | {"5": (26.0, 0.0), "6": (-26.0, 0.0), "7": (0.0, 26.0)}
    layout = MarkLayout.of(marks, dict.fromkeys(marks, PATTERN))
    grey, _ = simulate(Simulated(marks=marks, covered=("5",), false=((26.0, 0.15),)), 9)
    found = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.1, 0, False))
    assert [m.name for m in found.missing] == ["5"]
    assert any("'5' is left out" in note for note in found.notes)


def test_fault_15_a_stated_rotation_that_does_not_fit_is_not_followed_silently() -> None:
    layout = MarkLayout.of(FIVE, dict.fromkeys(FIVE, PATTERN))
    grey, _ = simulate(Simulated(marks=FIVE, rotation=90, pixel_mm=0.13), 3)
    with_0 = find_fiducials(ArrayScan(grey), layout, FiducialSearch(0.13, 0, False))
    assert [m.name for m in with_0.missing] == ["5"]
    assert any("turned by 90° it would show 5" in note for note in with_0.notes)


def test_windows_stay_small() -> None:
    grey, _ = simulate(Simulated(pixel_mm=0.08), 1)
    scan = ArrayScan(grey)
    find_fiducials(scan, LAYOUT, FiducialSearch(0.08, 0, False))
    assert scan.largest < 0.1 * grey.size


def test_a_similarity_is_recovered() -> None:
    rng = np.random.default_rng(3)
    mm = rng.uniform(-100, 100, (5, 2))
    for turn in TURNS:
        matrix, shift = 12.3 * turn.matrix, np.array([700.0, 650.0])
        got, at = fit_placement(mm, mm @ matrix.T + shift, turn.mirrored)
        np.testing.assert_allclose(got, matrix, atol=1e-9)
        np.testing.assert_allclose(at, shift, atol=1e-7)


def test_turns_are_counter_clockwise_as_one_looks_at_the_scan() -> None:
    right, up = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    by = {str(t): (tuple(t.matrix @ right), tuple(t.matrix @ up)) for t in TURNS}
    assert by["0°"] == ((1, 0), (0, -1))
    assert by["90°"] == ((0, -1), (-1, 0))
    assert by["0° mirrored"] == ((-1, 0), (0, -1))
    assert all(np.linalg.det(t.matrix) == (1 if t.mirrored else -1) for t in TURNS)


@pytest.mark.parametrize(
    "wrong", [{"rotation": 45}, {"pixel_mm": -1.0}, {"pixel_mm": float("nan")}, {"least_correlation": 1.0}]
)
def test_settings_are_checked(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        replace(FiducialSearch(), **wrong)  # type: ignore[arg-type]
