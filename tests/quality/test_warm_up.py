"""Warm-up drift of targets (Behr 1989, §4.1.1): shift and scale separated, exponential course, repetitions."""

from __future__ import annotations

import numpy as np
import pytest
from tools.thinned import thinned

from photoplan.errors import GeometryError, InputError
from photoplan.quality.camera.drift import warm_up

#: Nine hours, every five minutes, five repetitions of 0.02 px in rows and 0.03 px in columns, drift of 0.3 px.
TIMES = np.arange(0.0, 9 * 3600.0, 300.0)
TAU = 5000.0
COURSE = 1 - np.exp(-TIMES / TAU)
SPREAD = np.array([0.03, 0.02])
MARKS = {"mark": (250.0, 250.0), "target": (420.0, 120.0), "third": (100.0, 400.0), "fourth": (400.0, 420.0)}
DRIFT = np.array([0.3, -0.2])
SCALE, ROTATION = 2e-4, 5e-5


def measured(names: tuple[str, ...], seed: int, scale: float = SCALE) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    xy = np.array([MARKS[n] for n in names])
    centre = xy.mean(axis=0)
    out = {}
    for name, place in zip(names, xy):
        d = place - centre
        turned = np.array([scale * d[0] - ROTATION * d[1], scale * d[1] + ROTATION * d[0]])
        true = place + COURSE[:, None] * (DRIFT + turned)
        out[name] = true[:, None] + rng.normal(0, 1, (len(TIMES), 5, 2)) * SPREAD
    return out


def test_repeated_measurements() -> None:
    """Standard deviations of five repetitions: 0.03 px in columns, 0.02 px in rows (Behr's means)."""
    found = warm_up(TIMES, measured(tuple(MARKS), 1))
    assert found.repeat_sigma is not None
    print(f"\nrepetitions {found.repeat_sigma[0]:.4f}, {found.repeat_sigma[1]:.4f} px")
    np.testing.assert_allclose(found.repeat_sigma, SPREAD, rtol=0.05)
    np.testing.assert_allclose(found.sigma0, SPREAD / np.sqrt(5), rtol=0.15)


@pytest.mark.parametrize(
    ("reference", "runs"),
    [("first", 30), *(pytest.param(each, 60, marks=pytest.mark.slow) for each in ("first", "mean"))],
)
def test_parameters_have_true_standard_deviations(reference: str, runs: int) -> None:
    errors: dict[str, list[float]] = {"shift_x": [], "shift_y": [], "scale": [], "rotation": []}
    truth = {"shift_x": DRIFT[0] * COURSE, "shift_y": DRIFT[1] * COURSE, "scale": SCALE * COURSE}
    truth["rotation"] = ROTATION * COURSE
    for seed in range(runs):
        found = warm_up(TIMES, measured(tuple(MARKS), seed), reference=reference)
        for name, values in truth.items():
            course = found.course(name)
            want = values - (values.mean() if reference == "mean" else 0.0)
            # One epoch per run: those of a run share the error of their reference.
            errors[name].append(float((course.values - want)[50] / course.sigmas[50]))
            errors[name].append(float((course.values - want)[90] / course.sigmas[90])) if reference == "mean" else None
    spreads = {name: float(np.sqrt(np.mean(np.square(e)))) for name, e in errors.items()}
    print(f"\nagainst the {reference}: " + ", ".join(f"{n} {s:.3f}" for n, s in spreads.items()))
    assert 0.9 < np.sqrt(np.mean([s**2 for s in spreads.values()])) < 1.1
    assert all(0.75 < s < 1.25 for s in spreads.values())


@thinned("runs", 10, 60)
def test_exponential_course_is_recovered(runs: int) -> None:
    size, tau = [], []
    for seed in range(runs):
        a = warm_up(TIMES, measured(("mark", "target"), seed)).course("shift_x").approach
        assert a is not None and a.change is not None and a.sigma_change is not None
        assert a.time_constant is not None and a.sigma_time_constant is not None
        size.append((a.change - 0.3) / a.sigma_change)
        tau.append((a.time_constant - TAU) / a.sigma_time_constant)
    within = a.time_within(0.02)
    print(f"\n{a.change:.3f} ± {a.sigma_change:.3f} px, τ {a.time_constant:.0f} ± {a.sigma_time_constant:.0f} s")
    print(f"within 0.02 px after {within:.0f} s; normalised {np.std(size):.3f}, {np.std(tau):.3f}")
    for errors in (size, tau):
        assert 0.82 < np.sqrt(np.mean(np.square(errors))) < 1.18  # 60 samples: ± 0.09
    assert within == pytest.approx(TAU * np.log(0.3 / 0.02), rel=0.1)


def test_same_direction_but_other_amounts_is_a_change_of_scale() -> None:
    """Behr's two conclusions: a common shift of the origin, and a change of scale where amounts differ."""
    with_scale = warm_up(TIMES, measured(("mark", "target"), 2))
    a = with_scale.course("scale").approach
    assert a is not None and a.change == pytest.approx(SCALE, rel=0.15)
    without = warm_up(TIMES, measured(("mark", "target"), 3, scale=0.0))
    b = without.course("scale").approach
    assert b is not None and (b.change is None or abs(b.change) < 2e-5)
    moved = {t.name: t.largest for t in with_scale.targets}
    assert abs(moved["mark"][0] - moved["target"][0]) > 0.02


def test_one_target_gives_a_shift_and_says_what_it_does_not_give() -> None:
    found = warm_up(TIMES, measured(("mark",), 4))
    assert found.model == "shift" and [c.name for c in found.courses] == ["shift_x", "shift_y"]
    assert any("cannot be told from a shift" in note for note in found.notes)
    with pytest.raises(GeometryError, match="it needs 2"):
        warm_up(TIMES, measured(("mark",), 4), model="similarity")


def test_affine_separates_columns_and_rows() -> None:
    rng = np.random.default_rng(5)
    xy = {n: np.array(p) for n, p in MARKS.items()}
    positions = {
        n: p + COURSE[:, None] * (DRIFT + p * [3e-4, -1e-4]) + rng.normal(0, 0.01, (len(TIMES), 2))
        for n, p in xy.items()
    }
    found = warm_up(TIMES, positions, model="affine", reference="mean")
    for name, want in (("scale_x", 3e-4), ("scale_y", -1e-4)):
        course = found.course(name)
        difference = course.values - want * (COURSE - COURSE.mean())
        assert abs(difference / course.sigmas).max() < 4.5
    line = {n: positions[n] for n in ("mark", "target")} | {"between": (positions["mark"] + positions["target"]) / 2}
    with pytest.raises(GeometryError, match="on a line"):
        warm_up(TIMES, line, model="affine")


def test_missing_measurements_are_left_out() -> None:
    positions = measured(tuple(MARKS), 6)
    whole = warm_up(TIMES, positions)
    positions["third"][20:30] = np.nan
    positions["mark"][5, 2] = np.nan
    found = warm_up(TIMES, positions)
    assert np.isfinite(found.course("scale").values).all()
    np.testing.assert_allclose(found.course("shift_x").values, whole.course("shift_x").values, atol=0.03)


def test_bad_input_is_refused_in_words() -> None:
    positions = measured(("mark", "target"), 7)
    with pytest.raises(InputError, match="does not come after"):
        warm_up(TIMES[::-1], positions)
    times = TIMES.copy()
    times[3] = np.nan
    with pytest.raises(InputError, match="measurement 4 has no time"):
        warm_up(times, positions)
    with pytest.raises(InputError, match="no target"):
        warm_up(TIMES, {})
    with pytest.raises(InputError, match="for 108 epochs"):
        warm_up(TIMES, {"mark": positions["mark"][:5]})
    positions["target"][0] = np.nan
    with pytest.raises(InputError, match="target is not measured in the first epoch"):
        warm_up(TIMES, positions)
    with pytest.raises(InputError, match="bound"):
        a = warm_up(TIMES, measured(("mark",), 8)).course("shift_x").approach
        assert a is not None
        a.time_within(0.0)
