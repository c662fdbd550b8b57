"""Turbulent flights: 50 Hz of several pixels from line to line, two strong events (Schlüter 2001, figs. 2 and 4)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.shaken_strip import ShakenStrip

from photoplan.cameras.base import project
from photoplan.cameras.pushbroom import LineCamera
from photoplan.geometry.pose import cubic_convolution
from photoplan.io.camera.line import read_line


def camera_of(strip: ShakenStrip, folder: Path, name: str = "nadir") -> LineCamera:
    return read_line(strip.strip_file(folder), name).camera(strip.crs, "ellipsoidal")


def pace_of(camera: LineCamera, xy: np.ndarray, height: float, pixel: float) -> np.ndarray:
    """By how many pixels of so many metres, the pace of the flight, the view moves on along it (+X) in a line."""
    later, earlier = (camera.rays(xy + np.array([0.0, step]), height)[0][:, 0] for step in (0.005, -0.005))
    return np.abs(later - earlier) / (0.01 * pixel)


@pytest.mark.slow
def test_the_source_s_strip_is_its_own_inverse(tmp_path: Path) -> None:
    """12,000 × 24,000 pixels, as in fig. 4: pixels go down to the ground and come back to 1e-8 px."""
    strip = ShakenStrip(columns=12_000, lines=24_000, flying=8000.0, pitch=0.0045, vibration=(4.0, 1.5, 1.0))
    camera = camera_of(strip, tmp_path)
    rng = np.random.default_rng(2)
    xy = rng.uniform(0.0, (11_999.0, 23_999.0), (600, 2))
    # Half of them where the aircraft was thrown about.
    xy[:300, 1] = np.clip(rng.choice([0.3, 0.73], 300) * 24_000 + rng.normal(0.0, 60.0, 300), 0, 23_999)
    for height in (0.0, 900.0):
        ground = camera.rays(xy, height)[0]
        pace = pace_of(camera, xy, height, strip.pixel)
        moments = camera.moments(ground)
        nearest = np.full(len(xy), np.inf)
        np.minimum.at(nearest, moments.point, np.abs(moments.xy - xy[moments.point]).max(axis=1))
        count = np.bincount(moments.point, minlength=len(xy))
        seen = np.bincount(count)
        told = ", ".join(f"{nearest[pace > least].max():.1e} px at {least:g}" for least in (1.0, 0.5, 0.1))
        print(f"\n{height:g} m: worst {told} of the pace or more; {nearest.max():.1e} px where the view stands still")
        print("points seen once, twice, …:", seen[1:])
        # Northings are rounded to 5e-10 m, which is 1.3e-9 px; where the view is slow, a row's rounding is columns.
        assert nearest[pace > 0.5].max() < 1e-8 and nearest[pace > 0.1].max() < 1e-6
        assert seen[2::2].sum() <= 3 and seen[3::2].sum() > 100 and seen[1] > 200
        once = (count == 1) & (pace > 0.1)
        assert np.abs(project(camera, ground[once]) - xy[once]).max() < 1e-6


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> tuple[ShakenStrip, LineCamera]:
    strip = ShakenStrip(columns=120, lines=400, vibration=(3.0, 1.6, 0.5), events=(20.0, 30.0, 5.0), event_lines=30.0)
    return strip, camera_of(strip, tmp_path_factory.mktemp("strip"))


def test_lines_see_what_was_drawn(shaken: tuple[ShakenStrip, LineCamera]) -> None:
    """Rays of whole lines against other means than this code, to a thousandth of a pixel."""
    strip, camera = shaken
    y, x = (each.astype(float) for each in np.mgrid[: strip.lines, : strip.columns : 7])
    found = camera.rays(np.stack([x, y], axis=-1), 300.0)[0][..., :2]
    assert np.abs(found - strip.seen(300.0)[:, ::7]).max() < 1e-3 * strip.pixel


def test_every_moment_is_found_and_the_first_is_taken(shaken: tuple[ShakenStrip, LineCamera]) -> None:
    """Each pixel is one of the moments of its ground; what is seen, is seen an odd number of times."""
    camera = shaken[1]
    xy = np.random.default_rng(3).uniform((30.0, 40.0), (90.0, 360.0), (1500, 2))
    ground = camera.rays(xy, 300.0)[0]
    moments = camera.moments(ground)
    near = np.abs(moments.xy - xy[moments.point]).max(axis=1) < 1e-5
    count = np.bincount(moments.point, minlength=len(xy))
    print("\npoints seen once, twice, …:", np.bincount(count)[1:])
    pace = pace_of(camera, xy, 300.0, shaken[0].pixel)
    found = np.isin(np.arange(len(xy)), moments.point[near])
    assert found[pace > 0.4].all() and found.mean() > 0.99
    exact = np.full(len(xy), np.inf)
    np.minimum.at(exact, moments.point, np.abs(moments.xy - xy[moments.point]).max(axis=1))
    assert exact[pace > 0.5].max() < 3e-8
    assert (count % 2 == 1).mean() > 0.97 and (count >= 3).sum() > 300 and (count == 1).sum() > 300
    same = moments.point[1:] == moments.point[:-1]
    assert (np.diff(moments.xy[:, 1])[same] > 0).all()
    found = project(camera, ground)
    one = count[moments.point] == 1
    assert np.abs(found[moments.point[one]] - moments.xy[one]).max() < 1e-9
    # The one that is taken is among them, and before it the point only turned back within a line.
    gap = np.abs(moments.xy[:, 1] - found[moments.point, 1])
    assert np.isin(np.arange(len(xy)), moments.point[gap < 1e-9]).mean() > 0.999
    earlier = moments.xy[:, 1] < found[moments.point, 1] - 1e-9
    line = np.floor(moments.xy[:, 1])
    pairs = np.unique(np.stack([moments.point[earlier], line[earlier]], axis=1), axis=0, return_counts=True)[1]
    assert earlier.sum() > 20 and (pairs % 2 == 0).mean() > 0.97


def test_derivatives_are_those_of_differences(shaken: tuple[ShakenStrip, LineCamera]) -> None:
    camera = shaken[1]
    xy = np.random.default_rng(1).uniform((5.0, 50.0), (115.0, 350.0), (60, 2)).round() + 0.3
    ground = camera.rays(xy, 300.0)[0]
    once = np.bincount(camera.moments(ground).point, minlength=60) == 1
    step = 1e-4
    differences = np.stack(
        [(project(camera, ground + e) - project(camera, ground - e)) / (2 * step) for e in step * np.eye(3)], axis=-1
    )
    found = camera.derivatives(ground)
    # Where the view turns round, it changes within the step.
    flat = once & (np.abs(differences[:, 1]).max(axis=1) < 20)
    assert flat.sum() > 20
    assert np.abs(found - differences)[flat].max() < 1e-2


def test_between_the_lines_geometry_is_that_of_the_grey_values(shaken: tuple[ShakenStrip, LineCamera]) -> None:
    """Where a ray of a quarter line meets the ground is what cubic convolution makes of its neighbours' ground."""
    camera = shaken[1]
    rows, part = np.arange(60.0, 340.0, 7.0), 0.25
    at = [camera.rays(np.stack([np.full_like(rows, 50.0), rows + k], axis=1), 300.0)[0] for k in (-1, 0, 1, 2, part)]
    woven = np.einsum("k,knj->nj", cubic_convolution(np.array([part]))[0], np.array(at[:4]))
    pixel = 0.3
    assert np.abs(at[4] - at[1]).max() > 0.5 * pixel
    assert np.abs(woven - at[4]).max() < 3e-3 * pixel
