"""Inpho projects: written by hand after files that programs of others write and read, and published orientations."""

from dataclasses import replace

import numpy as np
import pytest
from tools.orientation_blocks import CAMERA, CENTERS, GROUND, NAMES, block, our_pixels, pixels_of_matrix

from photoplan.errors import InputError
from photoplan.io.camera.model import BrownLens, FilmEntry, FrameEntry
from photoplan.io.formats import orientation_format, read_orientation_block, write_orientation
from photoplan.io.orientation.block import TableFormat, without_lenses

FROM_CAMERA = TableFormat(direction="camera-to-ground")
TO_CAMERA = TableFormat(direction="ground-to-camera")
#: φ = asin 0.6, κ = 90°: the rows are those of the matrix from camera to ground.
TEXT = """\
$PROJECT 5.0.0
  $PROJECT_NAME : Somewhere
  $ANGULAR_UNITS : deg
$END
$COORDINATE_SYSTEM_SET
  $COORDINATE_SYSTEM : EPSG:25832
$END_COORDINATE_SYSTEM
$PHOTO
  $PHOTO_NUM : 01\\ 4711
  $PHOTO_FILE : D:\\images\\4711.tif
  $CAMERA_ID : DMC
  $TERRAIN_HEIGHT : 500.0
  $ORI_STAT : adjusted
  $EXT_ORI : 12:00:00 01/01/2020
      120.01   512000.0   5274000.0   2600.0
      0.0  -0.8  0.6
      1.0   0.0  0.0
      0.0   0.6  0.8
  $PHOTO_POINTS :
    77 1.0 2.0 0
  $END_POINTS
$END
$PHOTO
  $PHOTO_NUM : without
  $CAMERA_ID : DMC
$END
$CAMERA
  $TYPE : DMC
  $BRAND : Custom
  $KIND : CCDFrame
  $CCD_INTERIOR_ORIENTATION :
     83.33333333333333   0.0   6911.5
      0.0  -83.33333333333333   3839.5
  $CCD_COLUMNS : 13824
  $CCD_ROWS : 7680
  $PIXEL_REFERENCE : CenterTopLeft
  $FOCAL_LENGTH : 120.01
  $PRINCIPAL_POINT_PPA : 0.024 -0.036
  $DISTORTION_TYPE : Polynomial
  $RADIAL_COEFFS :
     0.0 0.0 0.0 0.0
     0.0 0.0 0.0 0.0
  $DECENTRE_COEFFS :
     0.0 0.0 0.0 0.0
$END
"""
MATRIX = [[0.0, -0.8, 0.6], [1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]
CENTER = (512000.0, 5274000.0, 2600.0)


def write(folder, text=TEXT):
    path = folder / "block.prj"
    path.write_text(text)
    return path


def test_camera_image_and_orientation(tmp_path):
    found = read_orientation_block(write(tmp_path), FROM_CAMERA)
    table = found.table
    assert [i.name for i in table.images] == ["01 4711"]
    assert table.crs is not None and "25832" in table.crs
    assert found.files == {"01 4711": "D:\\images\\4711.tif"}
    (camera,) = found.cameras.values()
    assert camera.size == CAMERA.size
    assert camera.camera_constant_mm == CAMERA.camera_constant_mm
    assert camera.pixel_size_um == pytest.approx(12.0, rel=1e-12)
    np.testing.assert_allclose(camera.pixels.point, CAMERA.pixels.point, atol=1e-9)
    assert any("1 images have no $EXT_ORI" in n for n in table.notes)
    np.testing.assert_allclose(our_pixels(table, camera)[0], pixels_of_matrix(MATRIX, CENTER), atol=1e-6)
    other = read_orientation_block(write(tmp_path), TO_CAMERA)
    expected = pixels_of_matrix(np.transpose(MATRIX).tolist(), CENTER)
    np.testing.assert_allclose(our_pixels(other.table, camera)[0], expected, rtol=1e-9)


def test_fault_14_what_the_matrix_does_is_told_by_angles_in_the_file_or_declared(tmp_path):
    usual = read_orientation_block(write(tmp_path)).table
    np.testing.assert_allclose(usual.rotations[0], np.transpose(MATRIX), atol=1e-12)
    assert any("ground to camera, as MATCH-AT writes them (another program's" in n for n in usual.notes)
    phi = np.degrees(np.arcsin(0.6))
    # A boresight of some tenths of a degree is usual.
    own = f"$NAVIGATION\n  $PHOTO_NUM : 01\\ 4711\n  $GPS : 1 2 3\n  $INS : 0.3 {phi} 89.8\n$ENDNAV\n"
    found = read_orientation_block(write(tmp_path, TEXT + own)).table
    np.testing.assert_allclose(found.rotations[0], MATRIX, atol=1e-12)
    assert "block.prj: rotation matrices read as camera to ground, as the angles of $INS tell" in found.notes
    R = np.transpose(MATRIX)
    angles = np.degrees([np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(R[0, 2]), np.arctan2(-R[0, 1], R[0, 0])])
    other = f"$NAVIGATION\n  $PHOTO_NUM : 01\\ 4711\n  $INS : {' '.join(map(str, angles))}\n$ENDNAV\n"
    found = read_orientation_block(write(tmp_path, TEXT + other)).table
    np.testing.assert_allclose(found.rotations[0], R, atol=1e-12)
    # In gon the same numbers mean something else, which fits neither.
    text = TEXT.replace("$ANGULAR_UNITS : deg", "$ANGULAR_UNITS : gon") + own
    with pytest.raises(InputError, match=r"differ from the angles of \$INS by \d+° or more, .*`list_readings`"):
        read_orientation_block(write(tmp_path, text))
    # A declaration stands above the angles.
    assert np.allclose(read_orientation_block(write(tmp_path, TEXT + own), TO_CAMERA).table.rotations[0], R)


def test_image_axes_that_are_turned_are_carried_over_to_the_rotation(tmp_path):
    """The pixels' columns run along −y of the image coordinates: a camera mounted across."""
    turned = TEXT.replace("83.33333333333333   0.0   6911.5", "0.0 -83.33333333333333 6911.5")
    turned = turned.replace("0.0  -83.33333333333333   3839.5", "-83.33333333333333 0.0 3839.5")
    found = read_orientation_block(write(tmp_path, turned), FROM_CAMERA)
    (camera,) = found.cameras.values()
    dX, dY, dZ = (np.array(GROUND) - CENTER).T
    r = np.array(MATRIX)
    x, y = (-120.01 * (r[:, k] @ [dX, dY, dZ]) / (r[:, 2] @ [dX, dY, dZ]) for k in (0, 1))
    # The file's own affine transformation, applied as it stands.
    x, y = x + 0.024, y - 0.036
    expected = np.stack([-y * 83.33333333333333 + 6911.5, -x * 83.33333333333333 + 3839.5], axis=-1)
    np.testing.assert_allclose(our_pixels(found.table, camera)[0], expected, atol=1e-6)
    assert any("turned" in n for n in found.table.notes)


@pytest.mark.parametrize("matrix", [None, "camera-to-ground", "ground-to-camera"])
def test_written_and_read_again_in_whole(tmp_path, matrix):
    made = replace(block(crs="EPSG:25832"), matrix=matrix)
    (path,) = write_orientation(made, tmp_path / "out.prj", "inpho")
    again = read_orientation_block(path)
    np.testing.assert_allclose(again.table.centers, made.table.centers, atol=5.1e-7)
    np.testing.assert_allclose(again.table.rotations, made.table.rotations, atol=1e-12)
    assert [i.name for i in again.table.images] == list(NAMES)
    assert again.table.crs is not None and "25832" in again.table.crs
    assert again.files == made.files
    np.testing.assert_allclose(our_pixels(again.table, again.cameras["DMC"]), our_pixels(made.table, CAMERA), atol=1e-4)
    direction = (matrix or "ground-to-camera").replace("-", " ")
    assert f"out.prj: rotation matrices read as {direction}, as the angles of $INS tell" in again.table.notes
    assert "ground to camera" in " ".join(loss.text for loss in orientation_format("inpho").losses(block()))


def test_a_camera_in_pixels_gets_pixels_of_assumed_size(tmp_path):
    camera = FrameEntry(size=(4000, 3000), focal_px=(3100.5, 3101.25), principal_point_px=(2010.25, 1490.5))
    made = block(camera)
    (path,) = write_orientation(made, tmp_path / "out.prj", "inpho")
    again = read_orientation_block(path)
    np.testing.assert_allclose(our_pixels(again.table, again.cameras["DMC"]), our_pixels(made.table, camera), atol=1e-4)
    assert any(loss.kind == "other" and "5 µm" in loss.text for loss in orientation_format("inpho").losses(made))


def test_what_is_lost_is_said(tmp_path):
    losses = orientation_format("inpho").losses
    lens = block(CAMERA.model_copy(update={"lens": BrownLens(type="brown", k1=1e-3)}))
    assert [loss.kind for loss in losses(lens) if loss.kind == "lens"] == ["lens"]
    assert not [loss for loss in losses(without_lenses(lens)) if loss.kind == "lens"]
    marks = {str(k): (float(x), float(y)) for k, (x, y) in enumerate([(-106, -106), (106, -106), (106, 106)])}
    film = block(FilmEntry(type="film", camera_constant_mm=153.0, fiducials_mm=marks, size=(8000, 8000)))
    assert "film" in [loss.kind for loss in losses(film)]
    # Orientation and camera constant are written, and read without a camera.
    (path,) = write_orientation(film, tmp_path / "film.prj", "inpho")
    again = read_orientation_block(path)
    assert again.cameras == {}
    np.testing.assert_allclose(again.table.centers, CENTERS, atol=1e-6)
    with pytest.raises(InputError, match="camera constant with every image"):
        write_orientation(block(camera=None), tmp_path / "none.prj", "inpho")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (("     0.0 0.0 0.0 0.0\n", "     0.0 -1.4e-5 0.0 0.0\n"), "RADIAL_COEFFS correct or distort"),
        (("CenterTopLeft", "TopLeft"), "is TopLeft, not CenterTopLeft"),
        (("-83.3", "83.3"), "mirrored"),
        (("83.33333333333333   0.0", "83.33333333333333   0.1"), "not rectangular"),
        (("  $FOCAL_LENGTH", "  $FOCAL_LENGTH : 1\n  $FOCAL_LENGTH"), "several calibrations"),
        (("  $CCD_INTERIOR_ORIENTATION", "  $X"), r"no \$CCD_INTERIOR_ORIENTATION"),
    ],
)
def test_cameras_that_cannot_be_taken_over_are_left_out_with_the_reason(tmp_path, change, why):
    found = read_orientation_block(write(tmp_path, TEXT.replace(*change, 1)), FROM_CAMERA)
    assert found.cameras == {}
    note = next(n for n in found.table.notes if "is not taken over" in n)
    assert __import__("re").search(why, note), note


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("$EXT_ORI", "$EXT_NO"), r"holds no \$PHOTO with \$EXT_ORI"),
        (("      0.0   0.6  0.8\n", ""), r":14: \$EXT_ORI of image '01 4711' has 3 lines"),
        (("512000.0   5274000.0", "512000.0"), r":14: image '01 4711': c, X, Y, Z: 3 values"),
        (("0.6  0.8", "0.6  inf"), r":14: image '01 4711': rotation = 'inf'"),
        (("0.6  0.8", "0.6  0.9"), r":14: image '01 4711': the nine numbers are not a rotation"),
        (("  $PHOTO_NUM : 01\\ 4711\n", ""), r":8: a \$PHOTO without \$PHOTO_NUM"),
        (("13824", "1e9"), r"camera 'DMC': \$CCD_COLUMNS = '1e9'"),
        (("13824", "99999999"), r"camera 'DMC'.*size"),
        (("FOCAL_LENGTH : 120.01", "FOCAL_LENGTH : 0"), r"camera 'DMC'"),
        (("  $TYPE : DMC\n", ""), r"a camera without \$ID or \$TYPE"),
        (("6911.5", "x"), r"\$CCD_INTERIOR_ORIENTATION = 'x'"),
    ],
)
def test_fault_18_broken_files_name_the_line(tmp_path, change, says):
    with pytest.raises(InputError, match=says) as error:
        read_orientation_block(write(tmp_path, TEXT.replace(*change, 1)), FROM_CAMERA, "inpho")
    assert "block.prj" in str(error.value)


def test_newer_camera_definitions_and_an_unknown_system(tmp_path):
    text = TEXT.replace(
        "$CAMERA\n  $TYPE : DMC\n", "$CAMERA_DEFINITION\n  $ID : DMC\n  $CALIBRATION_SET :\n  $ID : 1\n"
    )
    text = text.replace("  $DISTORTION_TYPE", "  $END\n  $DISTORTION_TYPE").replace("EPSG:25832", "LOCAL1")
    found = read_orientation_block(write(tmp_path, text), FROM_CAMERA)
    assert list(found.cameras) == ["DMC"]
    assert found.table.crs is None
    assert any("'LOCAL1' is not known" in n for n in found.table.notes)


#: Four images of flight line 35 of the oblique survey of Wuppertal, 2024: X, Y, Z and the rows of the matrix.
WUPPERTAL = {
    "035_168_170003763": """375693.31106 5681491.0868 925.6723
      -0.617998724625 -0.414397810619 0.668095824651
      0.558538775542 -0.829475598634 0.002160436945
      0.553273903757 0.374492571122 0.744072107793""",
    "035_160_171003771": """375165.66116 5681128.66801 931.25653
      -0.829021420218 -0.559216456904 -0.000662681846
      0.415820913125 -0.615648652093 -0.66938009037
      0.373920383274 -0.555205990155 0.742919817658""",
    "035_160_174003771": """375165.56471 5681128.81252 931.23247
      -0.616058311491 -0.414936143995 -0.669552203529
      0.56064689824 -0.828050604508 -0.002692929089
      -0.55330571327 -0.377041367466 0.742760119341""",
    "035_160_176003771": """375165.68938 5681128.9972 931.2691
      -0.829241275362 -0.558884260054 -0.002700203592
      0.414347042776 -0.618012957422 0.668114146386
      -0.375067241142 0.552909005464 0.74405389341""",
}


def wuppertal(folder):
    """A project of these images; the camera constant is not published with them and made up."""
    photos = [f"$PHOTO\n  $PHOTO_NUM : {n}\n  $EXT_ORI :\n      100.0 {e}\n$END\n" for n, e in WUPPERTAL.items()]
    return write(folder, "$PROJECT 15.0.0\n$END\n" + "".join(photos))


def azimuths_from_the_flight_line(table):
    """Azimuths of the viewing directions, less a multiple of 90° the flight line's, degrees; and the four quarters."""
    east, north = table.centers[0, :2] - table.centers[1, :2]
    view = -table.rotations[:, :, 2]
    assert np.all(view[:, 2] < -0.7)
    angle = np.degrees(np.arctan2(view[:, 0], view[:, 1]) - np.arctan2(east, north))
    return (angle + 45) % 90 - 45, sorted(np.round(angle / 90) % 4)


def test_published_cameras_look_along_and_across_their_flight_line(tmp_path):
    """cismet CARMA (github.com/cismet/carma, MIT), libraries/mapping/oblique-viewer/src/lib/core/utils/
    exteriorOrientation.spec.ts, commit 3423e08: names, positions and matrix rows of four images, as its viewer serves
    them, taken from the survey's Inpho project. Each comes from another head of one mount; two stations give the flight
    line. The heads of a mount look ahead, back, left and right. Read the other way they would look north, east, south
    and west, 34° from it.
    """
    table = read_orientation_block(wuppertal(tmp_path)).table
    off, quarters = azimuths_from_the_flight_line(table)
    assert np.abs(off).max() < 0.6
    assert quarters == [0, 1, 2, 3]
    turned = read_orientation_block(wuppertal(tmp_path), FROM_CAMERA).table
    assert np.abs(azimuths_from_the_flight_line(turned)[0]).min() > 33
    assert [i.name for i in table.images] == list(WUPPERTAL)


def test_a_project_sees_the_pixels_of_a_published_data_contract(tmp_path):
    """cismet CARMA, scripts/oblique-viewer/README.md and libraries/mapping/oblique-viewer/README.md: rows of the matrix
    are the camera's axes in the ground's (east, north, up), optical axis -z; an affine transformation from millimetres
    of the image to pixels whose (0, 0) is the centre of the first one; the mount's rotation is not applied. Order of
    the sections and camera of scripts/oblique-viewer/test_import_prj.py; the pose is a published one.
    """
    name, pose = list(WUPPERTAL.items())[1]
    text = f"""\
$PROJECT 15.0.0
  $ANGULAR_UNITS : deg
$END
$COORDINATE_SYSTEM_SET
  $ID : ETRS89 UTM32 GCG2016
  $COORDINATE_SYSTEM : EPSG:25832
$END_COORDINATE_SYSTEM
$CAMERA_DEFINITION
  $ID : O42_LE
  $CCD_COLUMNS : 100
  $CCD_ROWS : 80
  $PIXEL_REFERENCE : CenterTopLeft
  $CAMERA_MOUNT_ROTATION : 270
  $ACTIVE_CALIBRATION : 1
  $CALIBRATION_SET :
    $ID : 1
    $CCD_INTERIOR_ORIENTATION :
      10 0 49.5
      0 -10 39.5
    $FOCAL_LENGTH : 124
    $PRINCIPAL_POINT_PPA : 0 0
    $END
  $END
$END
$PHOTO
  $PHOTO_NUM : {name}
  $CAMERA_ID : O42_LE
  $EXT_ORI : 12:00:00 01/01/2026
    124 {pose}
$END
$STATION
  $STATION_ID : _01_7420
  $IMAGES : {{ {name} }}
$END
$MULTIHEADSYSTEM
  $HEAD_DATASET :
    $ID : 1
    $HEADS :
      O42_LE 1 left LE
    $END_HEADS
  $END
$END
"""
    found = read_orientation_block(write(tmp_path, text))
    (camera,) = found.cameras.values()
    rows = np.array([row.split() for row in pose.split("\n")], float)
    rng = np.random.default_rng(0)
    x, y = rng.uniform([-5, -4], [5, 4], (20, 2)).T
    # A ray: its millimetres times the first two axes, the camera constant against the third.
    rays = np.stack([x, y, np.full(20, -124.0)], axis=1) @ rows[1:]
    ground = rows[0] + rays * rng.uniform(6, 10, (20, 1))
    expected = np.stack([10 * x + 49.5, -10 * y + 39.5], axis=1)
    np.testing.assert_allclose(our_pixels(found.table, camera, ground)[0], expected, atol=1e-6)
