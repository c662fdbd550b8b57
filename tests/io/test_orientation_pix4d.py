"""Pix4D's parameter files: of a real project, and by hand after its knowledge base and open format (OPF).

That the external file and the full one state one pose in this way was checked once on an image that Pix4D itself wrote
into both: positions agreed to 1e-6 m, rotations to 2e-8. The numbers of the external file here are made up.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial.transform import Rotation
from tools.format_examples import assert_same, block_of, frame, pixels, round_trip

from photoplan.errors import InputError
from photoplan.io.formats import orientation_format, read_cameras, read_orientation_block
from photoplan.io.orientation.block import without_lenses

T, OPK, OFFSET = (332081.125, 3488911.75, 4093.5), (-2.9375, 3.0625, 119.8125), (331967.0, 3488533.0, 4096.0)
F, C, SIZE = 7363.5185, (3686.3371875, 2439.0408125), (7360, 4912)
K, TANGENTIAL = (-0.09005921, 0.10773972, -0.01257055), (-2.9570540e-4, -2.7422056e-4)
EXTERNAL = f"""imageName X Y Z Omega Phi Kappa
DSC 0157.JPG {T[0]:.6f} {T[1]:.6f} {T[2]:.6f} {OPK[0]:.6f} {OPK[1]:.6f} {OPK[2]:.6f}
"""


def rotation() -> np.ndarray:
    """OPF: R_x(ω) R_y(φ) R_z(κ) takes the image's axes right, top, back to the map's."""
    return Rotation.from_euler("XYZ", OPK, degrees=True).as_matrix()


def rows(*values: Any) -> str:
    return "\n".join(" ".join(f"{float(v):.20f}" for v in row) for row in values)


#: Map axes to right, bottom, front.
R_FULL = np.diag([1.0, -1.0, -1.0]) @ rotation().T
FULL = f"""fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

DSC 0157.JPG {SIZE[0]} {SIZE[1]}
{F!r} 0 {C[0]!r}
0 {F!r} {C[1]!r}
0 0 1
{rows(K, TANGENTIAL, np.subtract(T, OFFSET), *R_FULL)}
"""
STEM = "p_calibrated"
#: Written by Pix4D; where from is in the README.md of the folder.
PUBLISHED = Path(__file__).parents[1] / "data" / "pix4d_easyidp"


def project(folder: Path, *, full: bool = True, offset: bool = True) -> Path:
    (folder / "p_wkt.prj").write_text(CRS("EPSG:32648").to_wkt("WKT1_GDAL"))
    if full:
        (folder / f"{STEM}_camera_parameters.txt").write_text(FULL)
    if offset:
        (folder / "p_offset.xyz").write_text("331967.000 3488533.000 4096.000\n")
    path = folder / f"{STEM}_external_camera_parameters.txt"
    path.write_text(EXTERNAL)
    return path


def test_fault_30_a_reference_system_of_absurd_scale_is_named_by_its_file(tmp_path: Path) -> None:
    path = project(tmp_path)
    side = tmp_path / "p_wkt.prj"
    side.write_text(side.read_text().replace('"scale_factor",0.9996', '"scale_factor",-1e300'))
    with pytest.raises(InputError, match=r"p_wkt\.prj"):
        read_orientation_block(path)


def test_both_files_of_pix4d_state_one_orientation(tmp_path: Path) -> None:
    external = read_orientation_block(project(tmp_path))
    full = read_orientation_block(tmp_path / f"{STEM}_camera_parameters.txt")
    for block in (external, full):
        assert block.table.crs == "EPSG:32648"
        assert [i.name for i in block.table.images] == ["DSC 0157.JPG"]
    np.testing.assert_allclose(external.table.centers, full.table.centers, rtol=0, atol=1e-9)
    np.testing.assert_allclose(external.table.rotations, full.table.rotations, rtol=0, atol=1e-13)
    assert external.cameras == full.cameras
    assert any("cameras from p_calibrated_camera_parameters.txt" in n for n in external.table.notes)


def test_published_files_see_the_pixels_of_their_own_projection_matrices() -> None:
    """Files of one project that Pix4D wrote (EasyIDP, MIT): the full file against the project's `pmatrix.txt`, which
    takes coordinates less the offset to pixels without distortion, counted from the corner of the image."""
    block = read_orientation_block(PUBLISHED / "test_calibrated_camera_parameters.txt")
    offset = np.array([368109.0, 3956043.0, 96.0])
    lines = (PUBLISHED / "test_pmatrix.txt").read_text().splitlines()
    assert [i.name for i in block.table.images] == [line.split()[0] for line in lines]
    np.testing.assert_allclose(block.table.centers[0] - offset, (15.940748, -29.026922, 15.154226), atol=1e-6)
    for k, line in enumerate(lines):
        P = np.array(line.split()[1:], float).reshape(3, 4)
        ground = np.random.default_rng(k).uniform([-9, -6, -16], [9, 6, -14], (40, 3)) + block.table.centers[k] - offset
        h = ground @ P[:, :3].T + P[:, 3]
        # Six decimals of the matrix are some thousandths of a pixel here.
        np.testing.assert_allclose(
            pixels(without_lenses(block), ground + offset, k), h[:, :2] / h[:, 2:] - 0.5, atol=0.02
        )
    (camera,) = block.cameras.values()
    assert (camera.lens.k1, camera.lens.p1) == (0.02006588392682263564, -0.00288771142181162843)


def test_the_published_inpho_camera_counts_from_the_middle_of_the_image() -> None:
    """The `.cam` in Inpho's form of the same project states the offset of the principal point from the image's middle,
    in pixels with y up, and the camera constant in millimetres: with the corner of the image at (0, 0) they are those
    of the full file."""
    words = (PUBLISHED / "test_calibrated_internal_camera_parameters.cam").read_text().split()
    x, y = (float(words[len(words) - words[::-1].index(key)]) for key in ("XPOFF", "YPOFF"))
    focal = float(words[words.index("FOCAL") + 1])
    (camera,) = read_orientation_block(PUBLISHED / "test_calibrated_camera_parameters.txt").cameras.values()
    np.testing.assert_allclose(camera.pixels.point, (5472 / 2 - x - 0.5, 3648 / 2 - y - 0.5), atol=1e-9)
    np.testing.assert_allclose(camera.pixels.focal, focal / 12.825 * 5472, rtol=1e-12)


def lens(x: Any, y: Any, k: Any, t: Any) -> Any:
    r2 = x * x + y * y
    g = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    return (
        x * g + 2 * t[0] * x * y + t[1] * (r2 + 2 * x * x),
        y * g + 2 * t[1] * x * y + t[0] * (r2 + 2 * y * y),
    )


def test_the_full_file_sees_the_pixels_of_its_own_formula(tmp_path: Path) -> None:
    """m = K [R | −R t] X with the distortion between R and K, the corner of the image at (0, 0)."""
    project(tmp_path)
    block = read_orientation_block(tmp_path / f"{STEM}_camera_parameters.txt")
    numbers = [np.array(line.split(), float) for line in FULL.splitlines()[9:]]
    K3, k, tangential, t, R = np.array(numbers[:3]), numbers[3], numbers[4], numbers[5], np.array(numbers[6:9])
    X = t + np.random.default_rng(0).uniform([-800, -800, -2400], [800, 800, -1900], (50, 3))
    p = (X - t) @ R.T
    assert (p[:, 2] > 0).all()
    xd, yd = lens(p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], k, tangential)
    m = np.stack([xd, yd, np.ones(50)], axis=1) @ K3.T
    np.testing.assert_allclose(pixels(block, X + OFFSET), m[:, :2] - 0.5, atol=1e-5)


def test_the_external_file_sees_the_pixels_of_its_documentation(tmp_path: Path) -> None:
    """OPF: R_x(ω) R_y(φ) R_z(κ) takes the image's axes right, top, back to the map's."""
    block = read_orientation_block(project(tmp_path))
    X = T + np.random.default_rng(1).uniform([-800, -800, -2400], [800, 800, -1900], (50, 3))
    right, top, back = ((X - T) @ rotation()).T
    xd, yd = lens(right / -back, -top / -back, K, TANGENTIAL)
    expected = np.stack([F * xd + C[0], F * yd + C[1]], axis=1) - 0.5
    np.testing.assert_allclose(pixels(block, X), expected, atol=1e-6)


def test_without_the_offset_positions_are_relative(tmp_path: Path) -> None:
    project(tmp_path, offset=False)
    table = read_orientation_block(tmp_path / f"{STEM}_camera_parameters.txt").table
    assert table.centers[0, 0] == pytest.approx(114.125)
    assert any("relative to p_offset.xyz, which is not there" in n for n in table.notes)


CAM = """Pix4D camera calibration file 0

#Focal Length mm assuming a sensor width of 17.49998592000000030566x13.12498944000000200560mm
F 15.01175404934517487732
#Principal Point mm
Px 8.48210511970419922534
Py 6.33434629978042273990
#Symmetrical Lens Distortion Coeffs
K1 0.03833474118270804865
K2 -0.01750917966495743258
K3 0.02049798716391852335
#Tangential Lens Distortion Coeffs
T1 0.00240851666319534747
T2 0.00292562392135245920
"""


def test_the_cam_file(tmp_path: Path) -> None:
    """A sample from the documentation of EasyIDP (MIT), whose images have 4608 × 3456 px."""
    path = tmp_path / "p_pix4d_calibrated_internal_camera_parameters.cam"
    path.write_text(CAM)
    with pytest.raises(InputError, match=r"size of the images in pixels; it is read from p_calibrated_internal"):
        read_cameras(path)
    (tmp_path / "p_calibrated_internal_camera_parameters.cam").write_text(
        "camera_calibration_file 0\n\n#Image size 4608x3456 pixel\nFOCAL 15.01\n"
    )
    camera: Any = read_cameras(path).cameras["camera 0"]
    assert camera.size == (4608, 3456)
    pixel = 17.49998592 / 4608
    np.testing.assert_allclose(camera.pixels.focal, 15.01175404934517487732 / pixel, rtol=1e-12)
    np.testing.assert_allclose(camera.pixels.point, (8.482105119704199 / pixel - 0.5, 6.334346299780423 / pixel - 0.5))
    lens = camera.lens
    assert (lens.k1, lens.k2, lens.k3) == (0.03833474118270804865, -0.01750917966495743258, 0.02049798716391852335)
    assert (lens.p1, lens.p2) == (0.00240851666319534747, 0.00292562392135245920)
    with pytest.raises(InputError, match="not Pix4D's own camera file"):
        read_cameras(tmp_path / "p_calibrated_internal_camera_parameters.cam")
    # With the external file alone the camera comes from here.
    block = read_orientation_block(project(tmp_path, full=False))
    assert list(block.cameras) == ["camera 0"]


@pytest.mark.parametrize("lens", ["none", "opencv"])
@pytest.mark.parametrize("crs", ["EPSG:32632", None])
def test_round_trip(tmp_path: Path, lens: str, crs: str | None) -> None:
    square = {"focal_px": 3100.0}
    block = block_of({"x": frame(lens, **square), "y": frame("opencv", **square, size=(2000, 1000))}, crs=crs)
    again = round_trip(block, tmp_path / f"q_{STEM[2:]}_external_camera_parameters.txt", "pix4d")
    assert_same(block, again)
    assert again.table.crs == crs
    full = read_orientation_block(tmp_path / "q_calibrated_camera_parameters.txt")
    assert_same(block, full, position=2e-9)
    cam = read_cameras(tmp_path / "q_pix4d_calibrated_internal_camera_parameters.cam").cameras
    assert [c.size for c in cam.values()] == [(4000, 3000), (2000, 1000)]
    first: Any = cam["camera 0"]
    np.testing.assert_allclose(first.pixels.focal, 3100.0, rtol=1e-12)
    np.testing.assert_allclose(first.pixels.point, (2010.25, 1480.5), rtol=1e-12)


def test_losses() -> None:
    losses = orientation_format("pix4d").losses
    square = block_of({"x": frame("opencv", focal_px=900.0)}, crs="EPSG:32632")
    assert list(losses(square)) == []
    assert [x.kind for x in losses(block_of({"x": frame("fisheye")}))] == ["lens", "other"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.replace(" 119.812500", ""), r"external_camera_parameters\.txt:2: "),
        (lambda t: t.replace("119.812500", "inf"), r"external_camera_parameters\.txt:2: .*'inf' is not a number"),
        (lambda t: t.replace("imageName", "image"), "begins neither"),
        (lambda t: t.split("\n")[0], "holds no image"),
    ],
)
def test_fault_18_broken_external_files(tmp_path: Path, change: Any, says: str) -> None:
    path = project(tmp_path, full=False)
    path.write_text(change(EXTERNAL))
    with pytest.raises(InputError, match=says):
        read_orientation_block(path, format="pix4d")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t[: t.rindex("\n", 0, -1)], r"camera_parameters\.txt:17: 9 lines follow"),
        (lambda t: t.replace("0 0 1\n", "0 0 1 2\n"), r"camera_parameters\.txt:12: .*3 numbers"),
        (lambda t: t[:-2].rpartition("-")[0] + t[:-2].rpartition("-")[2], r":16: .*right-handed"),
        (lambda t: t.replace("7360 4912", "7360"), r":9: .*width and height"),
        (lambda t: t.replace("7363.5185 0 ", "7363.5 2.0 "), r":10: .*sheared"),
        (lambda t: t.replace("7363.5185", "-7363"), "greater than 0"),
    ],
)
def test_fault_18_broken_full_files(tmp_path: Path, change: Any, says: str) -> None:
    project(tmp_path)
    path = tmp_path / f"{STEM}_camera_parameters.txt"
    path.write_text(change(FULL))
    with pytest.raises(InputError, match=says):
        read_orientation_block(path, format="pix4d")
