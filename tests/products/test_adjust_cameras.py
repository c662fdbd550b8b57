"""Cameras between project and bundle adjustment: entries that are written give the adjusted camera exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from photoplan.cameras.lenses import Interior
from photoplan.io.camera.model import Camera
from photoplan.io.project.model import Image, interior_of, lens_of
from photoplan.orientation.bundle.model import AdjustedCamera, BlockCamera
from photoplan.products.adjust.sensors import block_camera, calibrated, camera_entries

MARKS = {"a": [-100.0, -100.0], "b": [100.0, -100.0], "c": [100.0, 100.0], "d": [-100.0, 100.0]}
FILM = {"type": "film", "size": [4000, 4000], "camera_constant_mm": 150.0, "fiducials_mm": MARKS}
T = np.random.default_rng(2).uniform(-0.6, 0.6, (50, 2))
BROWN = {"type": "brown", "k1": 1e-7, "k2": 1e-11, "p1": 1e-7, "b1": 1e-4}


def described(entries: dict[str, Any]) -> Any:
    return TypeAdapter(Camera).validate_python(entries)


def image_of(entries: dict[str, Any]) -> Image:
    scan = {name: [2000 + 15 * x, 2000 - 15 * y] for name, (x, y) in MARKS.items()}
    marks = {"fiducials": scan} if entries["type"] == "film" else {}
    return Image.model_validate({"name": "i", "file": "i.tif", "camera": "cam", **marks})


def started(entries: dict[str, Any], *free: str) -> tuple[BlockCamera, Interior]:
    interior = interior_of(described(entries), image_of(entries))
    return block_camera("cam", described(entries), interior, dict.fromkeys(free)), interior


@pytest.mark.parametrize(
    "entries",
    [
        {**FILM, "lens": {**BROWN, "unit": "mm"}},
        {**FILM, "lens": {**BROWN, "unit": "mm", "y_axis": "down", "meaning": "correction"}},
        {**FILM, "lens": {"type": "radial_table", "radii_mm": [0.0, 50.0, 150.0], "distortion_um": [0.0, 30.0, -50.0]}},
        {
            **FILM,
            "lens": {"type": "radial_table", "angles_deg": [0.0, 20.0, 45.0], "distortion_um": [0.0, 30.0, -5.0]},
        },
        {"type": "frame", "size": [4000, 4000], "focal_px": 3000.0, "lens": {**BROWN, "unit": "px"}},
        {"type": "frame", "size": [4000, 4000], "focal_px": [3000.0, 3100.0], "lens": {"type": "opencv", "k1": 0.1}},
    ],
)
def test_a_lens_that_is_no_unknown_stays_the_same_for_another_camera_constant(entries: dict[str, Any]) -> None:
    start, _ = started(entries, "c")
    found = AdjustedCamera("cam", start.c * 1.03, start.principal_point, start.lens, ("c",), np.eye(1))
    new = {**entries, **camera_entries(described(entries), start, found)}
    interior = interior_of(described(new), image_of(new))
    assert interior.c == pytest.approx(start.c * 1.03, rel=1e-14)
    np.testing.assert_allclose(lens_of(described(new)).distort(T), start.lens.distort(T), atol=1e-12)
    before = Interior(
        found.c, start.principal_point, interior_of(described(entries), image_of(entries)).plane_to_pixel, (4000, 4000)
    )
    np.testing.assert_allclose(interior.tangent_to_pixel(T), before.tangent_to_pixel(T), atol=1e-9)


def test_signs_and_units_of_covariances() -> None:
    """OpenCV's p1 is minus a lens's p2 with y up, rows run against y0, millimetres of a camera stated in both."""
    entries = {
        "type": "frame",
        "size": [4000, 3000],
        "camera_constant_mm": 30.0,
        "pixel_size_um": [10.0, 12.5],
        "principal_point_px": [2000.0, 1500.0],
        "lens": {"type": "opencv", "k1": 0.1},
    }
    start, _ = started(entries, "p1", "c", "y0")
    assert start.free == ("c", "y0", "p2")
    C = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.3], [0.5, 0.3, 1.0]])
    found = AdjustedCamera("cam", start.c, start.principal_point, start.lens, start.free, C)
    result = calibrated(described(entries), start, found)
    assert result.parameters == ("c", "y0", "p1")
    assert result.units == ("mm", "px", "")
    scale = np.array([0.01, -0.8, -1.0])
    np.testing.assert_allclose(result.covariance, C * np.outer(scale, scale))
    np.testing.assert_allclose(result.after, [30.0, 1500.0, 0.0])
    np.testing.assert_allclose(result.correlation[2, 0], -0.25)
