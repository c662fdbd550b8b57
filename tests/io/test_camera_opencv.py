"""OpenCV's calibration files: written by OpenCV itself where it is installed, and by hand after its layout."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.format_examples import assert_same_cameras, block_of, frame

from photoplan.errors import InputError
from photoplan.io.camera.opencv import render
from photoplan.io.formats import read_cameras, read_orientation, write_orientation
from photoplan.io.orientation.block import OrientationBlock
from photoplan.io.project.model import Image, interior_of, lens_of

YAML = """%YAML:1.0
---
calibration_time: "Tue 03 Feb 2015 10:40:12 PM CET"
nr_of_frames: 25
image_width: 640
image_height: 480
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 657.5, 0., 319.25, 0., 655.0, 241.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.41, 0.58, 1.5e-03, -2.0e-03, -1.1 ]
avg_reprojection_error: 0.19
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [657.5, 0, 319.25, 0, 655.0, 241.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.41, 0.58, 0.0015, -0.002, -1.1]
"""
D5 = (-0.41, 0.58, 1.5e-3, -2.0e-3, -1.1)


def write(folder: Path, text: str, name: str = "calib.yml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def seen(camera: Any, points: np.ndarray) -> np.ndarray:
    """Pixels of points in camera axes x right, y down, z forwards."""
    entry = Image(name="x", file="x", camera="c", center=(0, 0, 0), angles=(0, 0, 0))
    t = points[:, :2] / points[:, 2:] * [1, -1]
    return interior_of(camera, entry).tangent_to_pixel(lens_of(camera).distort(t))


@pytest.mark.parametrize(("text", "name"), [(YAML, "calib"), (ROS, "narrow_stereo")])
def test_calibration_sees_the_documented_pixels(tmp_path: Path, text: str, name: str) -> None:
    """The centre of the upper-left pixel is (0, 0): no half pixel between OpenCV and photoplan."""
    camera = read_cameras(write(tmp_path, text)).cameras[name]
    points = np.random.default_rng(1).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.5], (60, 3))
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2, k3 = D5
    r2 = x * x + y * y
    g = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = 657.5 * (x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 319.25
    v = 655.0 * (y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 241.5
    np.testing.assert_allclose(seen(camera, points), np.stack([u, v], axis=1), atol=1e-9)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "json"])
@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_files_that_opencv_wrote(tmp_path: Path, suffix: str, count: int) -> None:
    cv2 = pytest.importorskip("cv2")
    K = np.array([[657.5, 0, 319.25], [0, 655.0, 241.5], [0, 0, 1]])
    d = np.array([-0.21, 0.08, 1.5e-3, -2.0e-3, -0.01, 0.02, 1e-5, -1e-3, 0, 0, 0, 0, 0, 0])[:count]
    path = tmp_path / f"calib.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", d)
    storage.release()
    camera = read_cameras(path).cameras["calib"]
    points = np.random.default_rng(2).uniform([-0.4, -0.3, 1], [0.4, 0.3, 1.5], (60, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, d)[0][:, 0]
    np.testing.assert_allclose(seen(camera, points), expected, atol=1e-9)


@pytest.mark.parametrize("suffix", ["yml", "json"])
@pytest.mark.parametrize("lens", ["none", "brown", "brown with affinity", "opencv", "rational", "fisheye"])
def test_round_trip(tmp_path: Path, suffix: str, lens: str) -> None:
    camera = frame(lens)
    path = tmp_path / f"c.{suffix}"
    (text,) = render(camera, path, 'cam "1": a').values()
    path.write_text(text)
    block = block_of({'cam "1": a': camera})
    assert_same_cameras(block, OrientationBlock(block.table, read_cameras(path).cameras))


@pytest.mark.parametrize("suffix", ["yml", "json"])
def test_opencv_reads_what_is_written(tmp_path: Path, suffix: str) -> None:
    cv2 = pytest.importorskip("cv2")
    path = tmp_path / f"c.{suffix}"
    (text,) = render(frame("rational"), path, "a").values()
    path.write_text(text)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(
        storage.getNode("camera_matrix").mat(), [[3100, 0, 2010.25], [0, 3102.5, 1480.5], [0, 0, 1]]
    )
    d = storage.getNode("distortion_coefficients").mat().ravel()
    np.testing.assert_array_equal(d, [0.1, 0.01, 3e-4, 0, 1e-3, 0.15, 2e-3, 1e-5])
    assert int(storage.getNode("image_width").real()) == 4000


def test_a_shear_has_no_form_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no form in OpenCV"):
        render(frame("brown with shear"), tmp_path / "c.yml", "a")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace("cols: 3", "cols: 4"), "9 numbers for 3 rows and 4 columns"),
        (lambda t: t.replace("657.5, 0.,", "657.5, 2.,"), "shear"),
        (lambda t: t.replace("rows: 5", "rows: 6").replace("-1.1 ]", "-1.1, 0. ]"), "6 distortion coefficients"),
        (lambda t: t.replace("rows: 5", "rows: 12").replace("-1.1 ]", "-1.1, 0, 0, 0, 0.1, 0, 0, 0 ]"), "thin-prism"),
        (lambda t: t.replace("image_width: 640\n", ""), "image_width: None given"),
        (lambda t: t.replace("640", "640.5"), "whole numbers"),
        (lambda t: t.replace("-0.41", ".nan"), "finite"),
        (lambda t: t + "distortion_model: thin_prism\n", "distortion_model 'thin_prism'"),
        (lambda t: t + "fisheye_model: 1\n", "a fisheye has 4"),
        (lambda t: t + "a: &a [1]\nb: *a\n", "YAML aliases"),
        (lambda t: t.replace("[ -0.41", "[[ -0.41"), "not valid YAML"),
        (lambda t: t.replace("657.5", "-657.5"), "greater than 0"),
    ],
)
def test_fault_18_broken_files(tmp_path: Path, change: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_cameras(write(tmp_path, change(YAML)))


def test_json_by_hand_with_rows(tmp_path: Path) -> None:
    content = {
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": [[657.5, 0, 319.25], [0, 655.0, 241.5], [0, 0, 1]],
    }
    camera: Any = read_cameras(write(tmp_path, json.dumps(content | {"dist_coeffs": [D5]}), "c.json")).cameras["c"]
    assert camera.pixels.point == (319.25, 241.5)
    assert (camera.lens.k1, camera.lens.k3, camera.lens.p2) == (-0.41, -1.1, -2.0e-3)
    assert not read_cameras(tmp_path / "c.json").normalised


def test_as_a_target_of_convert_and_as_a_mistaken_orientation(tmp_path: Path) -> None:
    block = block_of({"cam 1": frame("opencv"), "cam 2": frame("brown")})
    files = write_orientation(block, tmp_path / "out.yml", "opencv")
    assert [f.name for f in files] == ["out_cam_1.yml", "out_cam_2.yml"]
    again = {name: c for f in files for name, c in read_cameras(f).cameras.items()}
    assert_same_cameras(block, OrientationBlock(block.table, again))
    with pytest.raises(InputError, match="describes a camera and no orientation; give it with `camera`"):
        read_orientation(files[0])
