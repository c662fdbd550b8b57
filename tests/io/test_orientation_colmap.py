"""COLMAP's text model: the sample of its documentation (colmap.github.io/format.html, BSD-3-Clause), and its models."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tools.format_examples import assert_same, block_of, frame, pixels, round_trip

from photoplan.errors import InputError
from photoplan.io.formats import orientation_format, read_orientation_block

CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 3
1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152
2 PINHOLE 3072 2304 2560.56 2560.56 1536 1152
3 SIMPLE_RADIAL 3072 2304 2559.69 1536 1152 -0.0218531
"""
IMAGES = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 2, mean observations per image: 2
1 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180141.JPG
2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1
2 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180142.JPG
1190.83 663.957 23056 1258.77 640.354 59070
"""
POINTS = """# 3D point list with one line of data per point:
#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)
# Number of points: 3, mean track length: 3.3334
63390 1.67241 0.292931 0.609726 115 121 122 1.33927 16 6542 15 7345 6 6714 14 7227
63376 2.01848 0.108877 -0.0260841 102 209 250 1.73449 16 6519 15 7322 14 7212 8 3991
63371 1.71102 0.28566 0.53475 245 251 249 0.612829 118 4140 117 4473
"""


def model(folder: Path, cameras: str = CAMERAS, images: str = IMAGES) -> Path:
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images)
    (folder / "points3D.txt").write_text(POINTS)
    return folder


def test_the_documentations_sample(tmp_path: Path) -> None:
    block = read_orientation_block(model(tmp_path))
    assert [i.name for i in block.table.images] == ["P1180141.JPG", "P1180142.JPG"]
    assert list(block.cameras) == ["1"]  # the others are of no image
    camera: Any = block.cameras["1"]
    assert (camera.size, camera.pixels.focal, camera.lens.type) == ((3072, 2304), (2559.81, 2559.81), "none")
    # 1536 of 3072 px from the corner is the middle of the image, half a pixel less from the first pixel's centre.
    assert camera.pixels.point == (1535.5, 1151.5)
    # The projection centre is −Rᵀ T: R of the quaternion written out after Hamilton.
    w, x, y, z = np.array([0.851773, 0.0165051, 0.503764, -0.142941]) / np.linalg.norm(
        [0.851773, 0.0165051, 0.503764, -0.142941]
    )
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(block.table.centers[0], -R.T @ [-0.737434, 1.02973, 3.74354], atol=1e-12)
    # One of the sample's points, projected after the documentation: x right, y down, z forwards.
    X = np.array([1.67241, 0.292931, 0.609726])
    p = R @ X + [-0.737434, 1.02973, 3.74354]
    seen = np.array([2559.81 * p[0] / p[2] + 1536, 2559.81 * p[1] / p[2] + 1152]) - 0.5
    np.testing.assert_allclose(pixels(block, X), seen, atol=1e-8)
    assert "states no CRS" in block.table.notes[0]


P = {"f": 900.0, "fx": 900.0, "fy": 905.0, "cx": 503.0, "cy": 371.5, "k1": -0.08, "k2": 0.02, "p1": 1e-3, "p2": -2e-3}
P |= {"k3": 4e-3, "k4": 0.03, "k5": -2e-3, "k6": 1e-3}


def opencv(x: float, y: float, p: dict[str, float]) -> tuple[float, float]:
    r2 = x * x + y * y
    g = (1 + p["k1"] * r2 + p["k2"] * r2**2 + p["k3"] * r2**3) / (1 + p["k4"] * r2 + p["k5"] * r2**2 + p["k6"] * r2**3)
    dx = 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x)
    dy = p["p1"] * (r2 + 2 * y * y) + 2 * p["p2"] * x * y
    return x * g + dx, y * g + dy


def fisheye(x: float, y: float, p: dict[str, float]) -> tuple[float, float]:
    r = float(np.hypot(x, y))
    q = np.arctan(r)
    d = q * (1 + p["k1"] * q**2 + p["k2"] * q**4 + p["k3"] * q**6 + p["k4"] * q**8)
    return x * d / r, y * d / r


MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 0 0 k3 k4 0 0",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 k3 k4 0 0 0 0 0 0 0 0",
    "SIMPLE_DIVISION": "f cx cy 0",
    "DIVISION": "fx fy cx cy 0",
    "FOV": "fx fy cx cy 0",
    "EUCM": "fx fy cx cy 0 1",
}
#: COLMAP's model numbers, as its header `sensor/models.h` lists them.
NUMBERS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "DIVISION": 13, "SIMPLE_FISHEYE": 14, "FISHEYE": 15,
    "EUCM": 16,
}  # fmt: skip


def number(name: str) -> float:
    return P[name] if name in P else float(name)


def model_bin(folder: Path, cameras: list[Any], images: list[Any]) -> None:
    """Write a binary model after COLMAP's `reconstruction_io_binary.cc`; every image has two points."""
    data = struct.pack("<Q", len(cameras))
    for key, kind, values in cameras:
        data += struct.pack(f"<IiQQ{len(values)}d", key, kind, 1000, 750, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for key, w, t, camera, name in images:
        data += struct.pack("<I7dI", key, *w, *t, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", 2) + struct.pack("<ddQ", 1.0, 2.0, 7) * 2
    (folder / "images.bin").write_bytes(data)


@pytest.mark.parametrize("form", ["name", "number", "binary"])
@pytest.mark.parametrize("name", MODELS)
def test_models_see_the_documented_pixels(tmp_path: Path, name: str, form: str) -> None:
    given = MODELS[name].split()
    q = Rotation.from_rotvec([0.2, -0.4, 1.3])
    t = np.array([1.0, -2.0, 30.0])
    w = np.roll(q.as_quat(), 1)
    word = {"name": name, "number": NUMBERS[name]}.get(form)
    values = [number(n) for n in given]
    if form == "binary":
        model_bin(tmp_path, [(7, NUMBERS[name], values)], [(3, w.tolist(), t.tolist(), 7, "a folder/b c.jpg")])
        block = read_orientation_block(tmp_path)
    else:
        cameras = f"7 {word} 1000 750 {' '.join(map(repr, values))}\n"
        images = f"3 {' '.join(map(repr, w.tolist()))} {' '.join(map(repr, t.tolist()))} 7 a folder/b c.jpg\n\n"
        block = read_orientation_block(model(tmp_path, cameras, images) / "images.txt", format="colmap")
    assert block.table.images[0].name == "a folder/b c.jpg"
    p = {n: P[n] if n in given else 0.0 for n in P}
    fx, fy = (P["f"], P["f"]) if "f" in given else (P["fx"], P["fy"])
    for X in np.random.default_rng(2).uniform(-8, 8, (20, 3)):
        x, y, z = q.as_matrix() @ X + t
        xd, yd = (fisheye if "FISHEYE" in name else opencv)(x / z, y / z, p)
        np.testing.assert_allclose(pixels(block, X), [fx * xd + p["cx"] - 0.5, fy * yd + p["cy"] - 0.5], atol=1e-8)


@pytest.mark.parametrize("lens", ["none", "brown", "brown with affinity", "opencv", "rational", "fisheye"])
def test_round_trip(tmp_path: Path, lens: str) -> None:
    block = block_of({"x": frame(lens), "y": frame("opencv")}, middle=(100.0, 200.0, 90.0))
    again = round_trip(block, tmp_path / "sparse", "colmap")
    assert_same(block, again)
    assert [i.camera for i in again.table.images] == ["1", "2", "1", "2", "1"]
    assert sorted(p.name for p in (tmp_path / "sparse").iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]


def test_losses() -> None:
    losses = orientation_format("colmap").losses
    block = block_of({"x": frame("brown with shear")}, crs="EPSG:32632", height_system="ellipsoidal")
    assert [x.kind for x in losses(block)] == ["lens", "crs", "height_system", "other"]


@pytest.mark.parametrize(
    ("cameras", "images", "says"),
    [
        (CAMERAS.replace("SIMPLE_PINHOLE", "MINE"), IMAGES, r"cameras\.txt:4: camera model 'MINE' is not supported"),
        (CAMERAS.replace("SIMPLE_PINHOLE", "18"), IMAGES, r"cameras\.txt:4: camera model '18' is not supported"),
        (
            CAMERAS.replace("PINHOLE 3072 2304 2559.81 1536 1152", "DIVISION 3072 2304 2559.81 1536 1152 -0.02", 1),
            IMAGES,
            r"model SIMPLE_DIVISION with k = -0.02 has no form here",
        ),
        (CAMERAS.replace("SIMPLE_PINHOLE 3072 2304 2559.81 1536", "17 8 4 8"), IMAGES, r".*4 numbers|EQUIRECTANGULAR"),
        (CAMERAS.replace("2559.81 ", ""), IMAGES, r"cameras\.txt:4: .*5 numbers"),
        (CAMERAS.replace("2559.81", "-1"), IMAGES, r"cameras\.txt:4: .*greater than 0"),
        (CAMERAS.replace("2 PIN", "1 PIN"), IMAGES, r"cameras\.txt:5: camera 1 is given twice"),
        (CAMERAS, IMAGES.replace("0.851773", "0.1"), r"images\.txt:5: image 'P1180141.JPG': the quaternion"),
        (CAMERAS, IMAGES.replace(" 1 P1180142", " 9 P1180142"), "camera '9' of image 'P1180142.JPG' is not described"),
        (CAMERAS, IMAGES.replace("1.02973", "x"), r"images\.txt:5: .*'x' is not a number"),
        (
            CAMERAS,
            IMAGES.replace("\n2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1", ""),
            r"images\.txt:6: .* after image",
        ),
        (CAMERAS, "", "holds no image"),
    ],
)
def test_fault_18_broken_models(tmp_path: Path, cameras: str, images: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        read_orientation_block(model(tmp_path, cameras, images), format="colmap")


@pytest.mark.parametrize("name", ["a.jpg", "a 1.jpg", "folder/my a 1.jpg", "7"])
def test_images_without_lines_of_points_are_not_lost(tmp_path: Path, name: str) -> None:
    """Every second image was taken for the points of the one before."""
    one = "1 1 0 0 0 0 0 0 1 "
    model(tmp_path, "1 PINHOLE 200 150 200 200 100 75\n", f"{one}x.jpg\n{'2' + one[1:]}{name}\n{'3' + one[1:]}y.jpg\n")
    with pytest.raises(InputError, match=r"images\.txt:2: .* after image 'x.jpg'; an empty line, or X, Y, POINT3D_ID"):
        read_orientation_block(tmp_path)


@pytest.mark.parametrize("binary", [False, True])
def test_a_camera_that_has_no_form_costs_its_images(tmp_path: Path, binary: bool) -> None:
    """One camera, even one that no image used, had refused the whole model."""
    pinhole, fov = (200, 150, 200.0, 200.0, 100.0, 75.0), (200, 150, 200.0, 200.0, 100.0, 75.0, 0.9)
    for used, left in ((1, ["a.jpg", "b.jpg"]), (2, ["a.jpg"])):
        if binary:
            cameras = [(1, NUMBERS["PINHOLE"], pinhole[2:]), (2, NUMBERS["FOV"], fov[2:])]
            still = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            model_bin(tmp_path, cameras, [(1, *still, 1, "a.jpg"), (2, *still, used, "b.jpg")])
        else:
            rows = [f"{k} {name} {' '.join(map(str, v))}" for k, name, v in ((1, "PINHOLE", pinhole), (2, "FOV", fov))]
            model(tmp_path, "\n".join(rows), f"1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 {used} b.jpg\n\n")
        block = read_orientation_block(tmp_path)
        assert [image.name for image in block.table.images] == left
        told = [note for note in block.table.notes if "camera model FOV" in note]
        assert len(told) == (used == 2) and all("warning: 1 image is left out" in note for note in told)


def test_an_incomplete_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(InputError, match="is not a COLMAP model; give the folder"):
        read_orientation_block(tmp_path, format="colmap")


@pytest.mark.parametrize("cut", [3, 8, 20, 60, 90, 120])
def test_fault_31_a_cut_binary_model_is_refused(tmp_path: Path, cut: int) -> None:
    model_bin(tmp_path, [(1, 1, [900.0, 900.0, 500.0, 375.0])], [(1, [1.0, 0, 0, 0], [0.0, 0, 0], 1, "a.jpg")])
    whole = (tmp_path / "images.bin").read_bytes()
    (tmp_path / "images.bin").write_bytes(whole[:cut])
    with pytest.raises(InputError, match=r"images\.bin: (ends after|image 'a.jpg' has 2 points)"):
        read_orientation_block(tmp_path, format="colmap")
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 1 << 60) + whole[8:])
    with pytest.raises(InputError, match="ends after"):
        read_orientation_block(tmp_path, format="colmap")


RIG = Rotation.from_rotvec([0.02, 0.05, -0.3])


def rigged(folder: Path, *, moved: float = 0.0, turned: float = 0.0, sensor: int = 2, binary: bool = False) -> Path:
    """A model of two images of one rig; the second one's pose in images may be moved or turned."""
    q1, t1 = Rotation.from_rotvec([3.0, 0.2, 0.1]), np.array([4.0, 30.0, -7.0])
    q21, t21 = RIG, np.array([0.5, 0.02, 0.0])
    q2, t2 = Rotation.from_rotvec([0, 0, turned]) * q21 * q1, q21.apply(t1) + t21 + [moved, 0, 0]

    def words(q: Rotation, t: np.ndarray) -> list[float]:
        return [*np.roll(q.as_quat(), 1).tolist(), *t.tolist()]

    def text(q: Rotation, t: np.ndarray) -> str:
        return " ".join(map(repr, words(q, t)))

    if binary:
        camera, empty = [900.0, 900.0, 500.0, 375.0], np.array([])
        images = [(1, words(q1, empty), t1.tolist(), 1, "l/1.jpg"), (2, words(q2, empty), t2.tolist(), 2, "r/1.jpg")]
        model_bin(folder, [(1, 1, camera), (2, 1, camera)], images)
        rigs = struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 1, 0, sensor, 1, *words(q21, t21))
        frames = struct.pack("<QII7dIiIQiIQ", 1, 1, 1, *words(q1, t1), 2, 0, 1, 1, 0, 2, 2)
        (folder / "rigs.bin").write_bytes(rigs)
        (folder / "frames.bin").write_bytes(frames)
        return folder
    cameras = "".join(f"{k} PINHOLE 1000 750 900 900 500 375\n" for k in (1, 2))
    model(folder, cameras, f"1 {text(q1, t1)} 1 l/1.jpg\n\n2 {text(q2, t2)} 2 r/1.jpg\n\n")
    (folder / "rigs.txt").write_text(f"# rigs\n1 2 CAMERA 1 CAMERA {sensor} 1 {text(q21, t21)}\n")
    (folder / "frames.txt").write_text(f"1 1 {text(q1, t1)} 2 CAMERA 1 1 CAMERA 2 2\n")
    return folder


@pytest.mark.parametrize("binary", [False, True])
def test_rigs_and_frames_are_compared_with_the_images(tmp_path: Path, binary: bool) -> None:
    block = read_orientation_block(rigged(tmp_path, binary=binary))
    assert "poses of 2 images agree with rigs" in block.table.notes[0]
    assert [i.name for i in block.table.images] == ["l/1.jpg", "r/1.jpg"]
    for wrong in ({"moved": 0.01}, {"turned": 0.001}):
        with pytest.raises(InputError, match=r"rigs\.\w+ and frames\.\w+ contradict images\.\w+: image 'r/1.jpg'"):
            read_orientation_block(rigged(tmp_path, binary=binary, **wrong))
    with pytest.raises(InputError, match="camera 2 is not a sensor of rig 1"):
        read_orientation_block(rigged(tmp_path, binary=binary, sensor=3))


def test_text_and_binary_of_one_folder_agree_or_are_refused(tmp_path: Path) -> None:
    read_orientation_block(rigged(rigged(tmp_path), binary=True))
    rigged(tmp_path, moved=0.5)
    for name in ("rigs.txt", "frames.txt"):
        (tmp_path / name).unlink()
    with pytest.raises(InputError, match=r"images\.txt and images\.bin disagree \(image 'r/1.jpg'"):
        read_orientation_block(tmp_path)
    assert read_orientation_block(tmp_path / "images.bin").table.images[1].name == "r/1.jpg"


def test_outsiders_models(shared: Path, tmp_path: Path) -> None:
    block = read_orientation_block(shared / "cases/18_colmap4_models/m")
    assert block.cameras["1"].lens.type == "opencv_fisheye"
    with pytest.raises(InputError, match=r"image 'cam1/frame 002.tif': \d+ units and 10°"):
        read_orientation_block(shared / "cases/12_colmap_rigs_disagree/m")
