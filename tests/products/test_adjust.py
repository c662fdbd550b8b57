"""Bundle adjustment of projects: true figures come back through every convention; faults 13, 16 and 17."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
from tools.adjust_project import CAMERA, FILM, Made, Make, misses, write_project
from tools.thinned import some, thinned

from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.pose import ANGLE_UNITS, angles_from_rotation, rotation_from_angles
from photoplan.io.points import read_image_points
from photoplan.io.project.file import load_project
from photoplan.orientation.bundle.adjust import angle_derivatives
from photoplan.orientation.bundle.model import AdjustSettings
from photoplan.products.adjust.inputs import adjust_prepared, map_result, prepare, read_inputs, started
from photoplan.products.adjust.run import OUTPUTS, AdjustReport, AdjustRequest, adjust_project

pytest.importorskip("matplotlib")


def adjusted(made: Made, **options: Any) -> AdjustReport:
    return adjust_project(AdjustRequest(made.path, **options))


def exactly(made: Made, **options: Any) -> AdjustReport:
    """Without a search for gross errors, which has no scale to judge by where there are no errors at all."""
    return adjusted(made, robust=False, **options)


def found(made: Made) -> tuple[np.ndarray, np.ndarray]:
    """Projection centres and rotations of the project as it stands."""
    project = load_project(made.path)
    unit = 2 * np.pi / ANGLE_UNITS[project.orientation.angle_unit]
    numbers = [project.image(name).pose_numbers for name in made.names]
    rotations = [rotation_from_angles(np.array(a) * unit, project.orientation.rotation) for _, a in numbers]
    return np.array([c for c, _ in numbers]), np.array(rotations)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, old
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("curvature", "refraction"), some([*itertools.product(("strict", "correction", "none"), (False, True))], 0, 3)
)
def test_true_orientations_come_back(tmp_path: Path, curvature: str, refraction: bool) -> None:
    """Measurements of the cameras that products use, without error: what the adjustment finds is the truth."""
    made = write_project(tmp_path, Make(curvature=curvature, refraction=refraction))
    report = exactly(made)
    centers, rotations = found(made)
    np.testing.assert_allclose(centers, made.centers, atol=2e-4)
    np.testing.assert_allclose(rotations, made.rotations, atol=2e-7)
    assert report.sigma0 < 1e-3
    assert report.rejected == 0
    assert report.orientations == 8


@pytest.mark.parametrize(("unit", "rotation"), some([("gon", "pok"), ("rad", "kpo")], 0))
def test_any_unit_and_order_of_angles(tmp_path: Path, unit: str, rotation: str) -> None:
    made = write_project(tmp_path, Make(unit=unit, rotation=rotation))
    exactly(made)
    centers, rotations = found(made)
    np.testing.assert_allclose(centers, made.centers, atol=2e-4)
    np.testing.assert_allclose(rotations, made.rotations, atol=2e-7)


def test_without_any_orientation_to_start_from(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(start=(np.nan, np.nan)))
    report = exactly(made)
    centers, rotations = found(made)
    np.testing.assert_allclose(centers, made.centers, atol=2e-4)
    np.testing.assert_allclose(rotations, made.rotations, atol=2e-7)
    assert any("8 images were oriented from control and tie points" in note for note in report.notes)


METRIC = {"type": "frame", "size": [4000, 3000], "camera_constant_mm": 43.2, "pixel_size_um": [12.0, 12.1]}
BROWN = {"type": "brown", "k1": -0.02, "k2": 0.01, "p1": 2e-4, "p2": -1e-4}


@pytest.mark.parametrize(
    ("camera", "stated", "free"),
    some(
        [
            (CAMERA, {"focal_px": 3596.0, "principal_point_px": [2001.0, 1497.5]}, "c,x0,y0"),
            ({**CAMERA, "focal_px": [3600.0, 3630.0]}, {"focal_px": [3603.0, 3633.025]}, "c,x0,y0"),
            ({**CAMERA, "lens": BROWN}, {"lens": {"type": "none"}}, "k1,k2,p1,p2"),
            ({**CAMERA, "lens": BROWN}, {"focal_px": 3598.0, "lens": {**BROWN, "k1": -0.018}}, "c,k1"),
            (METRIC, {"camera_constant_mm": 43.25, "principal_point_mm": [0.02, -0.03]}, "c,x0,y0"),
            ({**METRIC, "principal_point_px": [2010.0, 1490.0]}, {"camera_constant_mm": 43.23}, "c,x0,y0"),
            ({**METRIC, "lens": {"type": "brown", "unit": "mm", "k1": -1e-5}}, {"camera_constant_mm": 43.25}, "c,k1"),
            (
                {**CAMERA, "lens": {"type": "brown", "unit": "px", "y_axis": "down", "k1": -2e-9, "p2": 1e-8}},
                {"lens": {"type": "brown", "unit": "px", "y_axis": "down", "k1": -1.8e-9}},
                "k1,p1,p2",
            ),
            (
                {**CAMERA, "lens": {"type": "opencv", "k1": -0.02, "p1": 3e-4, "p2": -2e-4, "k4": 0.01}},
                {"lens": {"type": "opencv", "k1": -0.018, "k4": 0.01}},
                "k1,p1,p2",
            ),
            (FILM, {"camera_constant_mm": 153.1, "principal_point_mm": [0.0, 0.0]}, "c,x0,y0"),
            ({**FILM, "lens": BROWN}, {"lens": {**BROWN, "k1": -0.018, "p1": 0.0}}, "k1,p1,p2"),
        ],
        2,
        8,
        9,
    ),
)
def test_calibrated_cameras_come_back_by_the_projects_own_entries(
    tmp_path: Path, camera: dict[str, Any], stated: dict[str, Any], free: str
) -> None:
    """The changed project alone, read by `io.project_cameras`, reproduces the measurements."""
    make = Make(camera=dict(camera), stated=stated)
    made = write_project(tmp_path, make)
    before = load_project(made.path).cameras["cam"]
    report = exactly(made, calibrate=(f"cam={free}",))
    changed = load_project(made.path)
    assert np.abs(misses(made, changed, make)).max() < 2e-3
    assert changed.cameras["cam"] != before
    calibrated = report.cameras[0]
    assert calibrated.parameters == tuple(free.split(","))
    after = changed.cameras["cam"].model_dump()
    for name, value in zip(calibrated.parameters, calibrated.after):
        if name in after["lens"]:
            np.testing.assert_allclose(after["lens"][name], value, atol=1e-15)
    true = {"p1": 0.0, "p2": 0.0, "k2": 0.0, **camera.get("lens", {})}
    if true.get("unit", "tangent") == "tangent":
        for name, value in zip(calibrated.parameters, calibrated.after):
            if name in true:
                np.testing.assert_allclose(value, true[name], atol=3e-6, err_msg=name)


@pytest.mark.parametrize(
    "lens",
    some(
        [
            {"type": "brown", "unit": "mm", "meaning": "correction", "k1": 1e-8},
            {"type": "radial_table", "radii_mm": [0.0, 40.0, 80.0, 120.0], "distortion_um": [0.0, 3.0, -2.0, -5.0]},
            {"type": "radial_table", "angles_deg": [0.0, 15.0, 30.0, 40.0], "distortion_um": [0.0, 3.0, -2.0, -5.0]},
        ],
        0,
    ),
)
def test_a_lens_that_stays_is_stated_for_the_new_camera_constant(tmp_path: Path, lens: dict[str, Any]) -> None:
    """Millimetre coefficients depend on c: with c free, the entry is written so that the lens stays the one used."""
    make = Make(camera={**FILM, "lens": lens}, stated={"camera_constant_mm": 153.4})
    made = write_project(tmp_path, make)
    exactly(made, calibrate=("c",) if lens["type"] == "brown" else ("cam=c",))
    assert np.abs(misses(made, load_project(made.path), make)).max() < 0.01


@pytest.mark.parametrize(
    ("camera", "free", "message"),
    [
        ({**FILM, "lens": {"type": "brown", "meaning": "correction", "k1": 0.01}}, "k1", "stated as a correction"),
        ({**CAMERA, "lens": {"type": "opencv_fisheye", "k1": 0.01}}, "c,k1", r"its lens \(opencv_fisheye\) is not"),
        ({**CAMERA, "lens": {"type": "opencv", "k1": 0.01}}, "b1", 'an OpenCV lens has no b1; a lens of type "brown"'),
        (CAMERA, "k9", r"\['k9'\]; allowed are c, x0"),
    ],
)
def test_parameters_that_cannot_be_unknowns(tmp_path: Path, camera: dict[str, Any], free: str, message: str) -> None:
    made = write_project(tmp_path, Make(camera=dict(camera)))
    with pytest.raises(UsageError, match=message):
        adjusted(made, calibrate=(f"cam={free}",))
    with pytest.raises(UsageError, match="cameras of the project are 'cam'"):
        adjusted(made, calibrate=("other=c",))


def test_height_and_horizontal_control(tmp_path: Path) -> None:
    """Points with one coordinate or two are control too, on the curved earth as on the map."""
    made = write_project(tmp_path, Make(start=(60.0, 1.0)))
    rows = (tmp_path / "control.csv").read_text().strip().split("\n")
    for k in (2, 4):
        name, _, _, z, role = rows[k].split(",")
        rows[k], rows[k + 1] = f"{name},,,{z},{role}", ",".join([*rows[k + 1].split(",")[:3], "", "control"])
    (tmp_path / "control.csv").write_text("\n".join(rows) + "\n")
    report = exactly(made)
    centers, rotations = found(made)
    np.testing.assert_allclose(centers, made.centers, atol=5e-4)
    np.testing.assert_allclose(rotations, made.rotations, atol=5e-7)
    ground = {g.name: g for g in report.ground}
    assert np.isnan(ground["G2"].residual[:2]).all()
    assert np.isnan(ground["G3"].residual[2])
    np.testing.assert_allclose(ground["G2"].residual[2], 0.0, atol=1e-3)


def test_images_that_drop_out_do_not_shift_the_others(tmp_path: Path) -> None:
    """Curvature belongs to each image, also where one before it has no points and takes no part."""
    made = write_project(tmp_path, Make(curvature="correction", refraction=True))
    rows = (tmp_path / "points.csv").read_text().split("\n")
    (tmp_path / "points.csv").write_text("\n".join(r for r in rows if ",a1.tif" not in r))
    before = load_project(made.path).image("a1")
    report = exactly(made)
    assert report.orientations == 7
    assert load_project(made.path).image("a1") == before.model_copy(update={"approximate": True})
    assert "a1" in dict(report.left_out)
    centers, rotations = found(made)
    np.testing.assert_allclose(centers[1:], made.centers[1:], atol=2e-4)
    np.testing.assert_allclose(rotations[1:], made.rotations[1:], atol=2e-7)


@thinned("blocks", 5, 20)
def test_standard_deviations_are_those_of_the_map(tmp_path: Path, blocks: int) -> None:
    """Noisy blocks: errors of orientations divided by their standard deviations spread by about one."""
    z: list[np.ndarray] = []
    for seed in range(blocks):
        made = write_project(tmp_path / str(seed), Make(pixel_noise=0.3, seed=seed, unit="gon", start=(0.5, 0.05)))
        project = load_project(made.path)
        inputs, starts = started(read_inputs(project, project.select()))
        result = map_result(*adjust_prepared(prepare(inputs, starts, {}), AdjustSettings(robust=False)))
        for k, pose in enumerate(result.poses):
            true = angles_from_rotation(made.rotations[k]) * 200 / np.pi
            off = (result.angles[k] - true + 200) % 400 - 200
            z += [(pose.center - made.centers[k]) / result.sigma_center[k], off / result.sigma_angles[k]]
    spread = float(np.sqrt((np.concatenate(z) ** 2).mean()))
    print(f"\nspread of normalised errors of {8 * blocks} orientations: {spread:.3f}")
    assert 0.85 < spread < 1.15


def test_derivatives_of_angles() -> None:
    """Against the angles of turned rotations, for every order."""
    random = np.random.default_rng(3)
    for order in ("opk", "pok", "kpo", "kop", "okp", "pko"):
        R = rotation_from_angles(random.uniform(-1, 1, 3), order)
        J = angle_derivatives(R, order)
        turn = 1e-4 * random.normal(size=3)
        moved = R @ rotation_from_angles(turn, "opk")
        change = angles_from_rotation(moved, order) - angles_from_rotation(R, order)
        np.testing.assert_allclose(J @ turn, change, atol=1e-7)


def test_check_points_positions_and_files(tmp_path: Path) -> None:
    """Everything that is written: project with comments, GeoPackage, residuals, JSON without NaN."""
    made = write_project(tmp_path, Make(pixel_noise=0.3, check=4, positions=True))
    report = adjusted(made)
    facts = report
    assert [path.name for path in report.files] == list(OUTPUTS)
    assert facts.check is not None
    assert facts.check.horizontal == 4
    assert "4 check points; the standard asks for at least 30" in facts.check.warnings[0]
    assert facts.check.rmse_h < 0.3
    assert {strip.name for strip in facts.strips} == {"a", "b"}
    data = json.loads((tmp_path / "adjustment" / "report.json").read_text())
    assert data["check_accuracy"]["RMSE_H"] == pytest.approx(facts.check.rmse_h)
    assert len(data["images"]) == 8
    assert data["sigma0"] == facts.sigma0
    assert data["heights"] == {"system": "ellipsoidal", "computed_in": "ellipsoidal", "operation": "none"}
    assert {Path(path).name for path in data["inputs"]} == {"points.csv", "control.csv", "positions.csv"}
    assert "photoplan" in data["versions"]
    text = made.project_text()
    assert text.startswith("# a remark that stays")
    assert "sigma_center" in text
    assert (tmp_path / "project.previous.toml").is_file()
    layers = {name for name, _ in pyogrio.list_layers(tmp_path / "adjustment" / "points.gpkg")}
    assert layers == {"points", "projection_centres", "ground_residuals"}
    info = pyogrio.read_info(tmp_path / "adjustment" / "points.gpkg", layer="points")
    assert info["crs"] == "EPSG:25832"
    assert info["features"] == facts.points
    again = read_image_points(tmp_path / "adjustment" / "image_points.csv")
    first = read_image_points(tmp_path / "points.csv")
    np.testing.assert_allclose(again.xy, first.xy, atol=1e-6)
    np.testing.assert_array_equal(again.sigma, 0.3)


def test_fault_17_gross_errors_are_named(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3))
    rows = (tmp_path / "points.csv").read_text().split("\n")
    names = [row.split(",")[0] for row in rows]
    often = next(name for name in names if name.startswith("T") and names.count(name) >= 5)
    at = names.index(often)
    point, image, x, y = rows[at].split(",")
    rows[at] = f"{point},{image},{x},{float(y) + 40}"
    (tmp_path / "points.csv").write_text("\n".join(rows))
    gross = adjusted(made).gross
    assert gross[0].what == f"point {point!r} in image {image.removesuffix('.tif')!r}"
    # Computed minus measured: rows were made too large.
    np.testing.assert_allclose(float(gross[0].residual.split()[1]), -40.0, atol=4.0)
    kept = adjusted(made, robust=False, variance_components=False, overwrite=True)
    assert kept.gross == ()
    assert kept.sigma0 > 2


def test_stated_accuracies_that_the_observations_contradict(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3, sigma_image=1.2))
    notes = adjusted(made, dry_run=True).notes
    said = next(note for note in notes if "image points, camera cam: the stated standard deviation is" in note)
    found = re.search(r"is (.*) times too large; (.*) px would fit", said)
    assert found
    np.testing.assert_allclose([float(found[1]), float(found[2])], [4.0, 0.3], rtol=0.15)


def test_fault_17_a_wrong_control_point_is_named(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3))
    XYZ = made.points["G5"]
    edit(tmp_path / "control.csv", f"{XYZ[2]:.6f}", f"{XYZ[2] + 5:.6f}")
    gross = adjusted(made).gross
    assert gross[0].what == "control point 'G5', Z"


@pytest.mark.slow
def test_control_of_which_half_contradicts_the_rest_is_said(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(pixel_noise=0.3))
    for name, off in {"G1": 20, "G3": -30, "G5": 45, "G7": -60, "G9": 80}.items():
        edit(tmp_path / "control.csv", f"{made.points[name][2]:.6f}", f"{made.points[name][2] + off:.6f}")
    facts = adjusted(made, dry_run=True)
    lost = sum(what.what.endswith(", Z") for what in facts.gross)
    assert lost >= 5
    assert any(f"{lost} of 9 control heights are taken out as gross errors: nothing tells" in n for n in facts.notes)
    assert not any("horizontal control" in note for note in facts.notes)


def test_fault_16_what_is_not_determined_is_named(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(control=False))
    with pytest.raises(GeometryError, match=r"."):
        adjusted(made)
    assert not (tmp_path / "adjustment").exists()
    assert not (tmp_path / "project.previous.toml").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("sigma_control = [0.01, 0.01]\n", "", "control point 'G1': its accuracy is not stated; give sigma_control"),
        ('image_points = ["points.csv"]\n', "", "names no image points"),
        ('["points.csv"]', '["none.csv"]', r"none\.csv: cannot be read"),
        ('height_system = "ellipsoidal"\n', "", "height system of orientation and control is not stated"),
    ],
)
def test_what_is_missing_is_asked_for(tmp_path: Path, old: str, new: str, message: str) -> None:
    made = write_project(tmp_path)
    edit(made.path, old, new)
    with pytest.raises(InputError, match=message):
        adjusted(made)


def test_names_that_do_not_fit(tmp_path: Path) -> None:
    made = write_project(tmp_path)
    rows = (tmp_path / "points.csv").read_text()
    swapped = ["point,image,x,y"] + [
        ",".join([r.split(",")[1], r.split(",")[0], *r.split(",")[2:]]) for r in rows.strip().split("\n")[1:]
    ]
    (tmp_path / "points.csv").write_text("\n".join(swapped))
    with pytest.raises(InputError, match=r"points\.csv: the column of points holds images"):
        exactly(made)
    (tmp_path / "points.csv").write_text(rows.replace(".tif", "x.tif"))
    with pytest.raises(InputError, match=r"none of the images is in the project: measured are a1x\.tif"):
        exactly(made)
    (tmp_path / "points.csv").write_text(rows + "T1,other.tif,1,2\n")
    report = exactly(made, dry_run=True)
    assert "1 images of the measurements are not in the project: other.tif" in report.notes
    assert report.files == ()
    assert not (tmp_path / "adjustment").exists()


def test_fault_13_outputs_are_refused_before_any_work(tmp_path: Path) -> None:
    made = write_project(tmp_path)
    exactly(made)
    text = made.project_text()
    with pytest.raises(UsageError, match=r"report\.json: exists already; choose another output or say `overwrite`"):
        exactly(made)
    assert made.project_text() == text
    (tmp_path / "control.csv").rename(tmp_path / "away.csv")
    with pytest.raises(UsageError, match="exists already"):
        exactly(made)
    (tmp_path / "away.csv").rename(tmp_path / "control.csv")
    exactly(made, overwrite=True)
    shared = tmp_path / "adjustment" / "image_points.csv"
    edit(made.path, '"points.csv"', '"adjustment/image_points.csv"')
    with pytest.raises(UsageError, match="the output is the input"):
        exactly(made, overwrite=True)
    assert shared.is_file()
    exactly(made, output=tmp_path / "second")


def test_some_images(tmp_path: Path) -> None:
    made = write_project(tmp_path)
    before = load_project(made.path)
    report = exactly(made, images=("a*",))
    assert report.orientations == 4
    after = load_project(made.path)
    assert after.image("b1") == before.image("b1")
    assert after.image("a1") != before.image("a1")


def test_positions_alone_hold_the_block(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(control=False, positions=True))
    exactly(made)
    np.testing.assert_allclose(found(made)[0], made.centers, atol=2e-3)


@pytest.mark.parametrize("curvature", some(["strict", "none"], 0))
def test_shift_of_strips_and_boresight(tmp_path: Path, curvature: str) -> None:
    """Found in map axes, though the block lies in a system that is turned by the convergence of meridians."""
    shift = {"a": (0.8, -0.5, 0.3), "b": (-0.4, 0.9, -0.2)}
    boresight = (0.2, -0.1, 0.3)
    make = Make(curvature=curvature, positions=True, shift=shift, boresight_deg=boresight, unit="gon", rotation="kpo")
    made = write_project(tmp_path, make)
    report = exactly(made)
    for strip in report.strips:
        np.testing.assert_allclose(strip.shift, shift[strip.name], atol=2e-3)
        np.testing.assert_allclose(strip.rms, 0.0, atol=2e-3)
    assert report.boresight is not None
    # A small rotation's vector and its angles agree to second order.
    np.testing.assert_allclose(report.boresight[0], np.array(boresight) / 0.9, atol=1e-3)
    np.testing.assert_allclose(found(made)[0], made.centers, atol=5e-4)


def test_the_lever_arm_is_found_in_camera_axes(tmp_path: Path) -> None:
    lever = (0.5, -0.3, 1.2)
    made = write_project(tmp_path, Make(positions=True, lever=lever))
    report = exactly(made)
    assert report.lever_arm is not None
    # The prior pulls a little, and the map's scale is that of lengths on the ground, not of the arm.
    np.testing.assert_allclose(report.lever_arm[0], lever, atol=5e-3)


def test_the_stated_calibration_is_used(tmp_path: Path) -> None:
    made = write_project(tmp_path, Make(stated={"focal_px": 3597.0}))
    edit(made.path, "[adjustment]", '[adjustment]\ncalibrate = { cam = ["c"] }')
    report = exactly(made)
    assert report.cameras[0].parameters == ("c",)
    np.testing.assert_allclose(report.cameras[0].after, 3600.0, atol=1e-3)


@pytest.mark.parametrize("where", ["project", pytest.param("option", marks=pytest.mark.slow)])
def test_what_is_known_of_a_camera_beforehand_counts(tmp_path: Path, where: str) -> None:
    """Known to a millionth of a pixel a wrong camera constant stays; hardly known it becomes what it is without."""
    plain = write_project(tmp_path, Make(stated={"focal_px": 3597.0}))
    free = adjusted(plain, robust=False, variance_components=False, calibrate=("c",)).cameras[0].after[0]
    assert abs(free - 3597.0) > 0.5
    for sigma, expected in ((1e-6, 3597.0), (1e5, free)):
        folder = tmp_path / str(sigma)
        folder.mkdir()
        made = write_project(folder, Make(stated={"focal_px": 3597.0}))
        options = {}
        if where == "project":
            known = f'calibrate = {{ cam = ["c"] }}\nprior_sigma = {{ cam = {{ c = {sigma} }} }}'
            edit(made.path, "[adjustment]", f"[adjustment]\n{known}")
        else:
            options["calibrate"] = (f"cam=c:{sigma}",)
        report = adjusted(made, robust=False, variance_components=False, **options)
        np.testing.assert_allclose(report.cameras[0].after, expected, atol=1e-3)


def test_a_standard_deviation_that_is_none_is_refused(tmp_path: Path) -> None:
    made = write_project(tmp_path)
    for text in ("c:x", "c:-1", "c:0", "c:nan"):
        with pytest.raises(UsageError, match="no standard deviation; write c:5"):
            adjusted(made, calibrate=(f"cam={text}",))


def test_control_of_another_program(tmp_path: Path) -> None:
    """gcp_list.txt brings ground points and measurements together."""
    made = write_project(tmp_path)
    rows = [r.split(",") for r in (tmp_path / "points.csv").read_text().strip().split("\n")]
    ground = {n: " ".join(f"{v:.6f}" for v in p) for n, p in made.points.items() if n.startswith("G")}
    lines = ["EPSG:25832"] + [f"{ground[p]} {x} {y} {i} {p}" for p, i, x, y in rows if p in ground]
    (tmp_path / "gcp_list.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "points.csv").write_text("\n".join(",".join(r) for r in rows if r[0] not in ground) + "\n")
    edit(made.path, '"control.csv"', '"gcp_list.txt"')
    exactly(made)
    np.testing.assert_allclose(found(made)[0], made.centers, atol=2e-4)


def test_tables_whose_columns_the_project_declares(tmp_path: Path) -> None:
    """Without headers, with columns that are not used, and with decimal commas: the true orientations."""
    made = write_project(tmp_path)
    for name, order in (("points.csv", (1, 0, None, 2, 3)), ("control.csv", (None, 0, 1, 2, 3))):
        rows = [r.split(",") for r in (tmp_path / name).read_text().strip().split("\n")][1:]
        lines = [";".join("9" if k is None else r[k].replace(".", ",") for k in order) for r in rows]
        (tmp_path / name).write_text("\n".join(lines).replace(",jpg", ".jpg").replace(",tif", ".tif") + "\n")
    with pytest.raises(InputError, match=r"is no header|declare"):
        adjusted(made)
    declared = 'control_columns = "-,name,x,y,z"\nimage_points_columns = "image,point,-,x,y"\ndecimal_comma = true\n'
    edit(made.path, "[observations]\n", "[observations]\n" + declared)
    exactly(made)
    np.testing.assert_allclose(found(made)[0], made.centers, atol=2e-4)
