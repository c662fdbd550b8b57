"""PATB: three records for each image (PCI Geomatics, Using Pat-B in OrthoEngine); the fixture is written by hand."""

from dataclasses import replace
from math import cos, radians, sin

import numpy as np
import pytest
from tools.orientation_blocks import CAMERA, block, our_pixels, pixels_of_matrix

from photoplan.errors import InputError
from photoplan.io.formats import orientation_format, read_orientation, read_orientation_block, write_orientation
from photoplan.io.orientation.block import TableFormat

FROM_CAMERA = TableFormat(direction="camera-to-ground")
TO_CAMERA = TableFormat(direction="ground-to-camera")
#: φ = asin 0.6, ω = 0, κ = 90°: all elements are exact.
TEXT = """\
            4711                     512000.00000   5274000.00000      2600.00000
  0.000000000000 -0.800000000000  0.600000000000  1.000000000000  0.000000000000
  0.000000000000  0.000000000000  0.600000000000  0.800000000000
"""
MATRIX = [[0.0, -0.8, 0.6], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]


def write(folder, text=TEXT):
    path = folder / "block.ori"
    path.write_text(text)
    return path


def test_both_directions_against_the_collinearity_equations(tmp_path):
    center = (512000.0, 5274000.0, 2600.0)
    for form, r in ((FROM_CAMERA, MATRIX), (TO_CAMERA, np.transpose(MATRIX).tolist())):
        table = read_orientation(write(tmp_path), form)
        expected = pixels_of_matrix(r, center)
        np.testing.assert_allclose(our_pixels(table)[0], expected, rtol=1e-9)
    assert table.images[0].name == "4711"
    assert table.notes == ("block.ori: rotation matrices read as ground to camera",)


def test_fault_14_what_the_matrix_does_is_not_guessed(tmp_path):
    with pytest.raises(InputError, match=r"block\.ori: .*declare `rotation_direction` .*`list_readings`"):
        read_orientation(write(tmp_path))


@pytest.mark.parametrize("matrix", ["camera-to-ground", "ground-to-camera"])
def test_written_and_read_again(tmp_path, matrix):
    made = replace(block(), matrix=matrix)
    (path,) = write_orientation(made, tmp_path / "out.ori", "patb")
    form = FROM_CAMERA if matrix == "camera-to-ground" else TO_CAMERA
    again = read_orientation_block(path, form)
    np.testing.assert_allclose(again.table.centers, made.table.centers, atol=5.1e-6)
    np.testing.assert_allclose(again.table.rotations, made.table.rotations, atol=1e-12)
    np.testing.assert_allclose(our_pixels(again.table), our_pixels(made.table), atol=1e-3)
    write_orientation(replace(again, cameras=made.cameras, matrix=matrix), path, "patb", overwrite=True)
    third = read_orientation(path, form)
    np.testing.assert_allclose(third.rotations, made.table.rotations, atol=1e-12)


def test_layout_is_that_of_the_description(tmp_path):
    (path,) = write_orientation(block(), tmp_path / "out.ori", "patb")
    first, second, third = path.read_text().split("\n")[:3]
    # I16, 16X, 3F16.5 / 5F16.12 / 4F16.12: columns of 16 characters.
    assert (len(first), len(second), len(third)) == (80, 80, 64)
    columns = [first[k : k + 16] for k in range(0, 80, 16)]
    assert columns[0].strip() == "4711"
    assert float(columns[1]) == CAMERA.camera_constant_mm
    assert [float(c) for c in columns[2:]] == [512345.678, 5274112.875, 2630.44]
    a = [float((second + third)[k : k + 16]) for k in range(0, 144, 16)]
    np.testing.assert_allclose(np.reshape(a, (3, 3)), block().table.rotations[0], atol=6e-13)
    without = write_orientation(block(camera=None), tmp_path / "none.ori", "patb")[0].read_text().split("\n")[0]
    assert without[16:32].strip() == ""


def test_a_file_after_the_published_layout_with_angles_of_the_published_convention(tmp_path):
    """Layout: PCI Geomatics, Using Pat-B in OrthoEngine (support.pcigeomatics.com, article 204186705): photo number and
    centre `I16,16X,3F16.5`, a11 a12 a13 a21 a22 `5F16.12`, a23 a31 a32 a33 `4F16.12`. Matrix: Pix4D, How are the
    internal and external camera parameters defined? (support.pix4d.com, article 202559089), which calls its ω, φ, κ
    PATB's convention: R = R_ω R_φ R_κ takes the camera's axes to the world's (X east, Y north, Z up). Neither says
    that the matrix of the file is this R and not its transpose, so the direction is declared.
    """
    omega, phi, kappa = -2.25, 3.5, 117.0
    o, p, k = map(radians, (omega, phi, kappa))
    a = [
        [cos(p) * cos(k), -cos(p) * sin(k), sin(p)],
        [cos(o) * sin(k) + sin(o) * sin(p) * cos(k), cos(o) * cos(k) - sin(o) * sin(p) * sin(k), -sin(o) * cos(p)],
        [sin(o) * sin(k) - cos(o) * sin(p) * cos(k), sin(o) * cos(k) + cos(o) * sin(p) * sin(k), cos(o) * cos(p)],
    ]
    flat = [f"{v:16.12f}" for row in a for v in row]
    records = [f"{13300001:16d}{'':16}{475222.5:16.5f}{5943050.25:16.5f}{6064.49:16.5f}", "".join(flat[:5])]
    path = write(tmp_path, "\n".join([*records, "".join(flat[5:])]) + "\n")
    (image,) = read_orientation(path, FROM_CAMERA).images
    assert (image.name, image.center) == ("13300001", (475222.5, 5943050.25, 6064.49))
    np.testing.assert_allclose(image.angles, (omega, phi, kappa), atol=1e-9)


def test_names_that_patb_may_not_take_are_told():
    """Catalyst, Exporting a project to PATB (catalyst.earth, oe_ImpExpATproj_ExpPATB): at most 15 characters."""
    made = block()
    images = [replace(made.table.images[0], name=name) for name in ("a" * 15, "b" * 16)]
    losses = orientation_format("patb").losses
    for image, told in zip(images, (False, True)):
        lost = losses(replace(made, table=replace(made.table, images=(image,)), files={}))
        assert any("more than 15 characters" in loss.text for loss in lost) == told


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("", ""), None),
        (("1.000000000000", "1.1"), r":2: image '4711': the nine numbers are not a rotation matrix"),
        (("-0.800000000000", " 0.800000000000"), ":2: .*not a rotation"),
        (("-0.800000000000", "nan"), r":2: image '4711': a11 .* 'nan' is not a number"),
        (("  0.000000000000  0.000000000000  0.600", "  0.600"), r":3: image '4711': a23 .* 2 values; 4 numbers"),
        (("512000.00000   5274000.00000", "512000.0"), ":1: 3 values"),
        (("0.800000000000\n", "0.800000000000\n4712 1 2 3\n"), ":4: 4 lines; PATB has three"),
    ],
)
def test_fault_18_broken_files_name_the_line(tmp_path, change, says):
    text = (
        TEXT[: -len("0.800000000000\n")] + TEXT[-len("0.800000000000\n") :].replace(*change)
        if "\n" in change[0]
        else TEXT.replace(*change, 1)
    )
    path = write(tmp_path, text)
    if says is None:
        assert len(read_orientation(path, FROM_CAMERA, "patb").images) == 1
        return
    with pytest.raises(InputError, match=says):
        read_orientation(path, FROM_CAMERA, "patb")


def test_an_empty_file(tmp_path):
    with pytest.raises(InputError, match="holds no image"):
        read_orientation(write(tmp_path, "\n\n"), FROM_CAMERA, "patb")
