"""Cameras from files: the meaning of every number, against its documentation and by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.errors import InputError
from photoplan.io.camera.model import FilmEntry, FrameEntry, IdealLens, OpenCVFisheyeLens, OpenCVLens
from photoplan.io.formats import read_cameras
from photoplan.io.orientation.opensfm import resized


def write(folder: Path, name: str, content: str | object) -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_the_drone_blocks_camera(block: Path) -> None:
    cameras = read_cameras(block / "int.yaml").cameras
    assert list(cameras) == ["DJI FC300S half-res"]
    camera = cameras["DJI FC300S half-res"]
    assert isinstance(camera, FrameEntry)
    assert camera.size == (2000, 1125)
    assert camera.pixels.focal == (1435.5077, 1432.9259)
    assert camera.pixels.point == (999.5, 562.0)
    assert camera.lens == OpenCVLens(type="opencv", k1=0.01358910, k2=0.03861561, p1=-0.00167842, p2=0.00106552)


def test_the_dmc_camera(shared: Path) -> None:
    camera = read_cameras(shared / "data" / "ngi_dmc" / "eo" / "ngi_int_param.yaml").cameras["Integraph DMC"]
    assert isinstance(camera, FrameEntry)
    # 120 mm over pixels of 92.16 mm / 640 = 0.144 mm.
    np.testing.assert_allclose(camera.pixels.focal, 120 / 0.144, rtol=1e-14)
    assert camera.pixels.point == (319.5, 575.5)
    assert camera.lens == IdealLens()


def test_yaml_units_and_the_principal_point_in_parts_of_the_larger_side(tmp_path: Path) -> None:
    text = """
Pinhole camera:
    type: pinhole
    im_size: [150, 200]
    focal_len: 120.
    sensor_size: [75., 100.]
    cx: -0.01
    cy: 0.02
Brown camera:
    type: brown
    im_size: [400, 300]
    focal_len: 0.8333
    k1: -0.25
    k2: 0.2
    p1: 0.01
    p2: 0.02
    k3: -0.1
Fish:
    type: fisheye
    im_size: [400, 300]
    focal_len: [0.5, 0.6]
    k1: 0
"""
    cameras: Any = read_cameras(write(tmp_path, "int.yaml", text)).cameras
    pinhole, brown, fish = cameras.values()
    assert pinhole.pixels.focal == (240.0, 240.0)
    # Middle (149/2, 199/2), larger side 200; x right, y down.
    np.testing.assert_allclose(pinhole.pixels.point, (74.5 - 2.0, 99.5 + 4.0))
    np.testing.assert_allclose(brown.pixels.focal, 0.8333 * 400)
    assert brown.lens == OpenCVLens(type="opencv", k1=-0.25, k2=0.2, p1=0.01, p2=0.02, k3=-0.1)
    assert fish.pixels.focal == (200.0, 240.0)
    # An equidistant lens is one even where all coefficients are zero.
    assert fish.lens == OpenCVFisheyeLens(type="opencv_fisheye")


GOOD = {"type": "pinhole", "im_size": [100, 80], "focal_len": 1.0}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"type": "spherical"}, "type 'spherical'; allowed are pinhole, brown, fisheye, opencv"),
        ({"type": None}, "type None"),
        ({"im_size": None}, "im_size is missing"),
        ({"im_size": [100]}, "2 numbers are needed"),
        ({"im_size": [100.5, 80]}, "whole numbers"),
        ({"im_size": [100, -80]}, r"size\[2\]: -80 given"),
        ({"focal_len": "1,5"}, "focal_len: '1,5' given"),
        ({"focal_len": float("inf")}, "finite number"),
        ({"focal_len": -1.0}, "greater than 0"),
        ({"k1": 0.1}, "unknown k1"),
        ({"type": "opencv", "s1": 0.1}, "thin-prism"),
        ({"type": "opencv", "tx": 0.1}, "tilt"),
        ({"sensor_size": [0, 1]}, "positive numbers"),
    ],
)
def test_yaml_errors_name_camera_and_entry(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    import yaml

    path = write(tmp_path, "int.yaml", yaml.safe_dump({"Cam 1": {**GOOD, **change}}))
    with pytest.raises(InputError, match=says) as error:
        read_cameras(path)
    assert "'Cam 1'" in str(error.value)


BOMB = "a: &a [x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 8)}]\n" for i in range(8)
)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (BOMB, ":2: YAML aliases"),
        ("a: " + "[" * 5000, "nested deeper"),
        ("a: {type: pinhole, im_size: [1, 2], focal_len: 1}\na: {type: brown}", ":2: 'a' is given twice"),
        ("a: !!python/object/apply:os.system ['true']", "not valid YAML"),
        ("a: [1, 2", "not valid YAML"),
        ("- 1\n- 2\n", "no cameras"),
        ("", "no cameras"),
        ("{}", "describes no camera"),
        ("x" * 300_000, "at most"),
        ("a: \x00", "zero byte"),
    ],
)
def test_fault_18_hostile_and_broken_yaml(tmp_path: Path, content: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_cameras(write(tmp_path, "int.yaml", content))


def test_own_toml_reads_cameras_alone_and_names_lines(tmp_path: Path) -> None:
    text = """
[cameras.RC10]
type = "film"
camera_constant_mm = 153.24
principal_point_mm = [-0.001, 0.003]
fiducials_mm = { 1 = [105.999, -106.016], 2 = [-106.012, -106.006], 3 = [-105.997, 105.993], 4 = [106.007, 105.993] }

[cameras.drone]
size = [100, 80]
focal_px = 90
"""
    cameras = read_cameras(write(tmp_path, "c.toml", text)).cameras
    assert isinstance(cameras["RC10"], FilmEntry)
    assert cameras["RC10"].fiducials_mm["1"] == (105.999, -106.016)
    assert isinstance(cameras["drone"], FrameEntry)
    with pytest.raises(InputError, match=r"c\.toml:10: cameras\.drone\.focal_px: -90 given"):
        read_cameras(write(tmp_path, "c.toml", text.replace("= 90", "= -90")))
    with pytest.raises(InputError, match=r"no \[cameras.NAME\] table"):
        read_cameras(write(tmp_path, "d.toml", "[camera]\nx = 1"))


def test_unknown_suffix_lists_the_formats(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.toml, \.yaml, \.yml, \.json, \.xml, \.cam, \.txt"):
        read_cameras(write(tmp_path, "camera.dat", "x"))


ODM = {
    "v2 dji 5472 3648 brown": {
        "projection_type": "brown",
        "width": 1368,
        "height": 912,
        "focal_x": 0.6664614123723713,
        "focal_y": 0.6664614123723713,
        "c_x": -0.0015460447606643697,
        "c_y": 0.004751874732641298,
        "k1": -0.26,
        "k2": 0.10,
        "p1": 0.0007,
        "p2": 0.0002,
        "k3": -0.025,
    }
}


def test_opensfm_brown_is_opencvs_in_parts_of_the_larger_side(tmp_path: Path) -> None:
    file = read_cameras(write(tmp_path, "cameras.json", ODM))
    assert file.normalised
    camera: Any = file.cameras["v2 dji 5472 3648 brown"]
    np.testing.assert_allclose(camera.pixels.focal, 0.6664614123723713 * 1368)
    np.testing.assert_allclose(
        camera.pixels.point,
        (1367 / 2 - 0.0015460447606643697 * 1368, 911 / 2 + 0.004751874732641298 * 1368),
    )
    assert camera.lens == OpenCVLens(type="opencv", k1=-0.26, k2=0.10, p1=0.0007, p2=0.0002, k3=-0.025)
    # A world of the same sensor at four times the resolution: the edge of the image stays where it was.
    big = resized(camera, (5472, 3648), "x")
    for axis in (0, 1):
        edge = (camera.pixels.point[axis] + 0.5) / camera.size[axis]
        assert abs((big.pixels.point[axis] + 0.5) / big.size[axis] - edge) < 1e-12
        assert abs(big.pixels.focal[axis] / big.size[axis] - camera.pixels.focal[axis] / camera.size[axis]) < 1e-12
    with pytest.raises(InputError, match="another aspect ratio"):
        resized(camera, (5472, 3078), "x")


def test_opensfm_models(tmp_path: Path) -> None:
    cameras = {
        "p": {"projection_type": "perspective", "width": 400, "height": 300, "focal": 0.8, "k1": -0.1, "k2": 0.02},
        "f": {"projection_type": "fisheye", "width": 400, "height": 300, "focal": 0.5, "k1": 0.01, "k2": 0.0},
        "s": {"projection_type": "spherical", "width": 400, "height": 200},
    }
    good = {k: cameras[k] for k in "pf"}
    read: Any = read_cameras(write(tmp_path, "a.json", [{"cameras": good, "shots": {}}])).cameras
    assert read["p"].pixels.focal == (320.0, 320.0)
    assert read["p"].pixels.point == (199.5, 149.5)
    assert read["p"].lens == OpenCVLens(type="opencv", k1=-0.1, k2=0.02)
    assert read["f"].lens == OpenCVFisheyeLens(type="opencv_fisheye", k1=0.01)
    with pytest.raises(InputError, match="'spherical' is not supported"):
        read_cameras(write(tmp_path, "b.json", [{"cameras": cameras, "shots": {}}]))
    with pytest.raises(InputError, match=r"p1 = 0\.1 is not supported"):
        read_cameras(write(tmp_path, "c.json", {"p": {**cameras["p"], "p1": 0.1}}))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[1, 2]", "neither"),
        ("{}", "neither"),
        ('{"a": {"projection_type": "perspective", "width": 4, "height": 3, "focal": NaN}}', "NaN"),
        ('{"a": {"projection_type": "perspective", "width": 4, "height": 3}}', "focal: None given"),
        ("[" * 100_000, "nested|valid JSON"),
        ('{"a": ', ":1: not valid JSON"),
    ],
)
def test_fault_18_hostile_and_broken_json(tmp_path: Path, content: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_cameras(write(tmp_path, "a.json", content))
