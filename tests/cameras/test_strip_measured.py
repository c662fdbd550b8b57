"""Measured points of turbulent strips: their rows tell the moment, and what is left changes smoothly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_chips import FIRST, strip_file
from tools.shaken_strip import ShakenStrip

from photoplan.cameras.base import project
from photoplan.cameras.correctable import CorrectableLine, LineCorrection, TrackPriors
from photoplan.cameras.pushbroom import ChippedLine, LineCamera
from photoplan.io.camera.line import read_line

PRIORS = TrackPriors(
    boresight=2e-3, lever_arm=0.1, time_offset=0.01, knots=0.5, position=0.05, attitude=1e-4, smooth_attitude=1e-4
)


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> tuple[CorrectableLine, np.ndarray, np.ndarray]:
    """A strip, measured positions and what they show: ground that is seen up to seven times."""
    strip = ShakenStrip(columns=120, lines=400, vibration=(3.0, 1.6, 0.5), events=(20.0, 30.0, 5.0), event_lines=30.0)
    folder: Path = tmp_path_factory.mktemp("strip")
    camera = read_line(strip.strip_file(folder), "forward").camera(strip.crs, "ellipsoidal")
    assert isinstance(camera, LineCamera)
    xy = np.random.default_rng(3).uniform((5.0, 20.0), (115.0, 380.0), (150, 2))
    return CorrectableLine(camera, "m", "f", PRIORS, LineCorrection.none()), xy, camera.rays(xy, 300.0)[0]


def test_each_chip_of_a_line_is_compared_by_its_own(tmp_path: Path) -> None:
    """Of what both chips see, the one counts in which it was measured."""
    like = ShakenStrip(lines=200, vibration=(3.0, 0.4, 0.5), events=(20.0, 15.0, 8.0), event_lines=30.0)
    camera = read_line(strip_file(tmp_path, like, 12.0), "nadir").camera(like.crs, "ellipsoidal")
    assert isinstance(camera, ChippedLine)
    strip = CorrectableLine(camera, "m", "f", PRIORS, LineCorrection.none())
    xy = np.random.default_rng(1).uniform((FIRST - 30.0, 20.0), (FIRST + 30.0, 180.0), (60, 2)).round()
    nothing = {each.key: 0.0 * each.values for each in strip.corrections}
    XYZ = camera.rays(xy, 100.0)[0]
    assert np.abs(strip.seen(strip.camera(nothing), XYZ, xy) - xy).max() < 1e-6
    moved = strip.seen(strip.camera(nothing), XYZ + np.array([0.3, 0.0, 0.0]), xy) - xy
    by_ground = strip.by_ground(strip.camera(nothing), XYZ, xy)[:, :, 0]
    assert np.abs(moved - 0.3 * by_ground).max() < 1e-3 and np.abs(moved[:, 1] - 1.0).max() < 0.1


def test_what_was_measured_is_the_moment_that_is_meant(
    shaken: tuple[CorrectableLine, np.ndarray, np.ndarray],
) -> None:
    strip, xy, XYZ = shaken
    nothing = {each.key: 0.0 * each.values for each in strip.corrections}
    assert np.abs(strip.seen(strip.camera(nothing), XYZ, xy) - xy).max() < 1e-6
    # For products the first moment counts, which is another one.
    assert (np.abs(project(strip.plain, XYZ) - xy).max(axis=1) > 1.0).mean() > 0.2


@pytest.mark.parametrize("late", [0.0, 0.0013, 0.004])
def test_a_late_clock_changes_what_is_left_smoothly(
    shaken: tuple[CorrectableLine, np.ndarray, np.ndarray], late: float
) -> None:
    """Derivatives against differences, splines and all, at clocks that are late by parts of a line."""
    strip, xy, XYZ = shaken
    rng = np.random.default_rng(0)
    size = {"mount": np.repeat([1e-4, 0.02, 1e-3], [3, 3, 1]), "knot": np.repeat([0.02, 1e-5], 3)}
    values, step = (
        {each.key: size[each.owner] * rng.normal(size=each.values.shape) for each in strip.corrections} for _ in "12"
    )
    values[strip.keys[0]][0, 6] = late
    ground, part = rng.normal(0.0, 0.02, XYZ.shape), 1e-3

    def at(sign: float) -> np.ndarray:
        moved = {key: values[key] + sign * part * step[key] for key in values}
        return strip.seen(strip.camera(moved), XYZ + sign * part * ground, xy)

    camera = strip.camera(values)
    found = np.einsum("nij,nj->ni", strip.by_ground(camera, XYZ, xy), ground)
    for key, by in strip.by_corrections(camera, XYZ, xy).items():
        found += np.einsum("nij,nj->ni", by.values, step[key].ravel()[by.columns])
    numeric = (at(1.0) - at(-1.0)) / (2 * part)
    assert np.abs(numeric).max() > 2.0
    assert np.abs(numeric - found).max() < 2e-2
