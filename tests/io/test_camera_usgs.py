"""The template for calibration reports, with the numbers of USGS report OSL/1785 (public domain)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.cameras.lenses import Interior
from photoplan.errors import InputError
from photoplan.io.camera.model import FilmEntry
from photoplan.io.formats import distance_differences, read_cameras
from photoplan.io.project.model import lens_of

TEMPLATE = Path(__file__).resolve().parents[2] / "docs" / "templates" / "usgs-camera.toml"
PRINTED = {"1-2": 311.128, "3-4": 311.116, "5-6": 224.002, "7-8": 223.996}
#: Section VII and II of the report.
MARKS = {"1": (-109.990, -110.002), "2": (110.010, 109.999), "3": (-109.989, 109.995), "4": (109.998, -110.002)}
MARKS |= {"5": (-111.998, -0.004), "6": (112.004, 0.0), "7": (0.014, 111.993), "8": (0.0, -112.002)}
ANGLES, MEAN = [7.5, 15, 22.7, 30, 35, 40], [3, 4, 1, -3, -4, 3]
PPS = (0.006, -0.010)


def template() -> FilmEntry:
    (camera,) = read_cameras(TEMPLATE).cameras.values()
    assert isinstance(camera, FilmEntry)
    return camera


def test_the_template_holds_the_report() -> None:
    camera = template()
    assert camera.camera_constant_mm == 152.299
    assert camera.principal_point_mm == PPS
    assert camera.fiducials_mm == MARKS
    lens: Any = camera.lens
    assert (list(lens.angles_deg), list(lens.distortion_um)) == (ANGLES, MEAN)


def test_coordinates_agree_with_the_printed_distances() -> None:
    """Opposite marks within 3 µm (measured: 1.4 µm at most)."""
    for pair, printed in PRINTED.items():
        a, b = (template().fiducials_mm[m] for m in pair.split("-"))
        assert abs(math.dist(a, b) - printed) <= 0.003
    assert max(map(abs, distance_differences(MARKS, PRINTED, "x").values())) < 1.5


def test_lines_between_marks_meet_in_the_printed_points() -> None:
    """The report's indicated principal points, and 89° 59′ 55″ and 89° 59′ 43″ between the lines."""
    for pairs, point, angle in (
        (("1", "2", "3", "4"), (0.006, -0.006), (89, 59, 55)),
        (("5", "6", "7", "8"), (0.007, -0.002), (89, 59, 43)),
    ):
        a, b, c, d = (np.array(template().fiducials_mm[m]) for m in pairs)
        u, v = b - a, d - c
        s, _ = np.linalg.solve(np.column_stack([u, -v]), c - a)
        np.testing.assert_allclose(a + s * u, point, atol=0.002)
        degrees = np.degrees(np.arccos(abs(u @ v) / np.linalg.norm(u) / np.linalg.norm(v)))
        assert abs(degrees - (angle[0] + angle[1] / 60 + angle[2] / 3600)) * 3600 < 4


def plane_points(camera: FilmEntry, t: np.ndarray) -> np.ndarray:
    """Points of the image plane in the system of the fiducial marks, millimetres."""
    interior = Interior.metric((1, 1), camera.camera_constant_mm, 1.0, camera.principal_point_mm)
    assert interior.principal_point == camera.principal_point_mm
    return np.array(camera.principal_point_mm) + camera.camera_constant_mm * lens_of(camera).distort(t)


@pytest.mark.parametrize("azimuth", [0, 37, 90, 215])
def test_distortion_refers_to_the_point_of_symmetry(azimuth: float) -> None:
    """Section II: at each field angle the point lies D further out than c tan α, from the point of symmetry."""
    along = np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    for angle, micrometres in zip(ANGLES, MEAN):
        radius = 152.299 * np.tan(np.radians(angle)) + micrometres / 1000
        seen = plane_points(template(), np.tan(np.radians(angle)) * along[None])[0]
        np.testing.assert_allclose(seen, np.array(PPS) + radius * along, atol=1e-9)


def test_what_the_wrong_principal_point_would_make() -> None:
    """Figures of the reference page: 11.7 µm as a shift of the image, 0.005 µm in the distortion itself."""
    camera = template()
    t = np.stack(np.meshgrid(*(np.linspace(-0.72, 0.72, 121),) * 2), axis=-1).reshape(-1, 2)
    t = t[np.hypot(t[:, 0], t[:, 1]) < np.tan(np.radians(40))]
    autocollimation = camera.model_copy(update={"principal_point_mm": (0.0, 0.0)})
    shift = plane_points(camera, t) - plane_points(autocollimation, t)
    np.testing.assert_allclose(shift, np.broadcast_to(PPS, shift.shape), atol=1e-12)
    assert np.hypot(*PPS) * 1000 == pytest.approx(11.66, abs=0.01)
    # A distortion that is centred on the other point, in micrometres.
    lens, c = lens_of(camera), camera.camera_constant_mm
    moved = t + np.array(PPS) / c
    difference = (lens.distort(moved) - moved) - (lens.distort(t) - t)
    assert 0.004 < np.abs(difference).max() * c * 1000 < 0.006


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("[110.010, 109.999]", "[110.010, 109.899]"), r"report: .*'LMK 1000 266613B'.*1-2 by -71 µm.*2-4 by -100 µm"),
        (("1-2 = 311.128", "1-9 = 311.128"), "distance '1-9'"),
        (("1-2 = 311.128", "1-2 = -311.128"), "distance '1-2' = -311.128 mm"),
        (("1-2 = 311.128", '1-2 = "311"'), "distance 1-2: '311' given"),
        (('camera = "LMK 1000 266613B"', 'camera = "RC 10"'), "camera = 'RC 10'"),
        (("distances_mm = {", "distances = {"), "needed is distances_mm"),
    ],
)
def test_slips_of_the_pen_are_named(tmp_path: Path, change: tuple[str, str], says: str) -> None:
    text = TEMPLATE.read_text(encoding="utf-8")
    assert change[0] in text
    (tmp_path / "c.toml").write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=says):
        read_cameras(tmp_path / "c.toml")
