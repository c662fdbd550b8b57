"""The project file: what is written is read again, and every error names its entry and line."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tools.thinned import examples

from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.io.camera.model import BrownLens, FilmEntry, FrameEntry, OpenCVFisheyeLens, OpenCVLens, RadialTableLens
from photoplan.io.files import safe_stem
from photoplan.io.project.file import load_project, parse_project, project_schema, write_project
from photoplan.io.project.model import Image, Orientation, OrthoDefaults, Project, StatedTerrain

MARKS = {"1": (105.999, -106.016), "2": (-106.012, -106.006), "3": (-105.997, 105.993), "4": (106.007, 105.993)}
SCAN = {"1": (68.0, 131.5), "2": (62.0, 2248.0), "3": (2182.0, 2253.0), "4": (2189.0, 141.0)}
DRONE = FrameEntry(size=(2000, 1125), focal_px=(1435.5077, 1432.9259), lens=OpenCVLens(type="opencv", k1=0.0136))
FILM = FilmEntry(type="film", camera_constant_mm=153.24, fiducials_mm=MARKS, size=(2300, 2300))


def project(folder: Path, **changes: Any) -> Project:
    images = (
        Image(name="a", file="a.jpg", camera='DJI "x" ü', center=(1.5, 2.5, 300.0), angles=(0.1, -0.2, 44.4)),
        Image(name="b", file="../b.tif", camera="film", center=(2.0, 3.0, 800.0), angles=(0, 0, 0), fiducials=SCAN),
    )
    entries: dict[str, Any] = {
        "crs": "EPSG:32615",
        "terrain": StatedTerrain(file="dsm.tif", height_system="EPSG:5773"),
        "orientation": Orientation(height_system="ellipsoidal"),
        "cameras": {'DJI "x" ü': DRONE, "film": FILM},
        "images": images,
        "folder": folder.resolve(),
    }
    return Project(**{**entries, **changes})


def test_written_and_read_again_is_equal(tmp_path: Path) -> None:
    lenses = {
        "brown": BrownLens(type="brown", k1=-1e-8, p2=3e-7, unit="mm", y_axis="down", meaning="correction"),
        "table": RadialTableLens(type="radial_table", angles_deg=(0, 7.5, 40.0), distortion_um=(0.0, 3.0, -4.0)),
    }
    cameras: dict[str, Any] = {
        name: FrameEntry(size=(10, 20), camera_constant_mm=120.0, pixel_size_um=12.0, lens=lens)
        for name, lens in lenses.items()
    }
    cameras["fish"] = FrameEntry(size=(9, 9), focal_px=5.0, lens=OpenCVFisheyeLens(type="opencv_fisheye", k4=1e-3))
    cameras["metric"] = FrameEntry(
        size=(640, 1152), camera_constant_mm=120.0, sensor_size_mm=(92.16, 165.888), principal_point_mm=(0.01, -0.02)
    )
    plain = project(tmp_path)
    full = project(
        tmp_path,
        cameras={**plain.cameras, **cameras},
        ortho=OrthoDefaults(
            resolution=0.1, bounds=(0, 0, 10, 10), kernel="bicubic", nodata="mask", overviews=False, tolerance=0.05
        ),
        orientation=Orientation(
            height_system="same", angle_unit="gon", rotation="pok", earth_curvature="strict", refraction=True
        ),
        terrain=StatedTerrain(height=183.25, height_system="same"),
    )
    for made in (plain, full):
        write_project(tmp_path / "project.toml", made)
        assert load_project(tmp_path / "project.toml") == made
    assert [p.name for p in tmp_path.iterdir()] == ["project.toml"]


def usable(name: str) -> bool:
    try:
        return bool(safe_stem(name))
    except InputError:
        return False


@settings(max_examples=examples(10, 60), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.text(min_size=1, max_size=30).filter(usable),
    numbers=st.tuples(
        *[st.floats(-1e8, 1e8)] * 2, st.floats(-12_000.0, 1e6), *[st.floats(-360.0, 360.0, allow_nan=False)] * 3
    ),
)
def test_any_name_and_number_survives(tmp_path: Path, name: str, numbers: tuple[float, ...]) -> None:
    image = Image(name=name, file="a.jpg", camera=name, center=numbers[:3], angles=numbers[3:])
    made = project(tmp_path, cameras={name: DRONE}, images=(image,))
    write_project(tmp_path / "project.toml", made)
    assert load_project(tmp_path / "project.toml") == made


def test_every_entry_has_a_comment_or_a_commented_place(tmp_path: Path) -> None:
    write_project(tmp_path / "p.toml", project(tmp_path))
    text = (tmp_path / "p.toml").read_text()
    for model in (StatedTerrain, Orientation, OrthoDefaults):
        for key in model.model_fields:
            assert f"{key} =" in text


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("size = [2000, 1125]", "size = [2000, 0]", r":39: cameras.*\.size\[2\]: 0 given; allowed is greater than 0"),
        ("k1 = 0.0136", "kk1 = 0.0136", r"lens\.kk1: unknown entry"),
        ("center = [1.5, 2.5, 300.0]", "center = [1.5, nan, 300.0]", r"images\[1\]\.center\[2\]: nan given"),
        ("center = [1.5, 2.5, 300.0]", 'center = [1.5, "2", 300.0]', r"images\[1\]\.center\[2\]: '2' given"),
        ("center = [1.5, 2.5, 300.0]", "center = [1.5, 300.0]", r"images\[1\]\.center\[3\]: is missing"),
        ("camera_constant_mm = 153.24", "camera_constant_mm = true", r"cameras\.film\.camera_constant_mm: True given"),
        ('type = "opencv"', 'type = "open_cv"', "type is not one of 'none', 'brown', 'opencv'"),
        ('type = "film"', 'type = "line"', "type is not one of 'frame', 'film'"),
        ('file = "dsm.tif"', "", "give either file"),
        ('file = "dsm.tif"', 'file = "/vsicurl/x.tif"', r":10: terrain\.file: .*virtual file systems"),
        ('file = "a.jpg"', 'file = "https://example.org/a.jpg"', r"images\[1\]\.file: .*addresses"),
        ("format = 1", "format = 2", ":4: format: 2 given; allowed is 1"),
        ("format = 1", "fromat = 1", "fromat: unknown entry"),
        ('angle_unit = "deg"', 'angle_unit = "grad"', "allowed is 'deg', 'gon' or 'rad'"),
        ('rotation = "opk"', 'rotation = "xyz"', "rotation: 'xyz' given"),
        ('name = "b"', 'name = "a"', "image 'a' .entry 2.: the name is given twice"),
        ('name = "b"', 'name = "../.."', "no letter or digit"),
        ('camera = "film"', 'camera = "filn"', "camera 'filn' is not described; cameras are .*'film'"),
        ("1 = [68.0, 131.5], ", "", "3 fiducial marks|film"),
        ("1 = [68.0, 131.5]", "9 = [68.0, 131.5]", "fiducial marks 9 are not among those of camera 'film'"),
        ("size = [2300, 2300]", "", "size = .width, height. of the scan is stated neither here nor for its camera"),
        ('crs = "EPSG:32615"', 'crs = "EPSG:4326"', "crs: 'WGS 84' is geographic"),
        ('crs = "EPSG:32615"', 'crs = "EPSG:2225"', "US survey foot"),
        ('crs = "EPSG:32615"', "", "crs: is missing"),
        ("[orientation]", "[orientation", "not valid TOML: .*line"),
        ("format = 1", 'format = 1\nfolder = "/"', "unknown entry 'folder'"),
    ],
)
def test_errors_name_file_entry_and_what_is_allowed(tmp_path: Path, old: str, new: str, says: str) -> None:
    made = project(tmp_path)
    if "3 fiducial" in says:
        made = project(tmp_path, cameras={**made.cameras, "film": FILM.model_copy(update={"interior": "bilinear"})})
    path = tmp_path / "project.toml"
    write_project(path, made)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=says) as error:
        load_project(path)
    assert str(path) in str(error.value)
    assert "Traceback" not in str(error.value)
    assert "pydantic" not in str(error.value)


def test_height_systems_are_checked_by_name(tmp_path: Path) -> None:
    path = tmp_path / "project.toml"
    write_project(path, project(tmp_path))
    path.write_text(path.read_text().replace('"EPSG:5773"\n', '"EPSG:32615"\n'))
    with pytest.raises(HeightSystemError, match=r"\[terrain\] height_system"):
        load_project(path)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b'crs = "\xe4"', b"", b"x" * 10, b"a = [" + b"[" * 5000])
def test_files_that_are_no_project(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "project.toml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"project\.toml"):
        load_project(path)
    with pytest.raises(InputError, match="cannot be read"):
        load_project(tmp_path / "missing.toml")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="cannot be read"):
        load_project(tmp_path / "empty")


def test_windows_line_ends_and_a_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "project.toml"
    made = project(tmp_path)
    write_project(path, made)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_project(path) == made


def test_many_images_load_in_a_second(tmp_path: Path) -> None:
    images = tuple(
        Image(
            name=f"i{k}",
            file=f"img/i{k}.tif",
            camera="film",
            center=(k, 1.0, 2.0),
            angles=(0.1, 0.2, 0.3),
            fiducials=SCAN,
        )
        for k in range(805)
    )
    made = project(tmp_path, images=images)
    write_project(tmp_path / "p.toml", made)
    start = time.process_time()
    loaded = load_project(tmp_path / "p.toml")
    assert time.process_time() - start < 1.0
    assert loaded.images == images


def test_images_are_chosen_by_name_and_pattern(tmp_path: Path) -> None:
    made = project(tmp_path)
    assert made.select(None) == ["a", "b"]
    assert made.select(["b", "a"]) == ["a", "b"]
    assert made.select(["?"]) == ["a", "b"]
    with pytest.raises(UsageError, match="'c' is not in the project"):
        made.select(["a", "c"])
    with pytest.raises(InputError, match="'c' is not in the project"):
        made.image("c")
    assert made.resolve("../b.tif") == tmp_path.resolve().parent / "b.tif"


def test_values_are_frozen_and_the_schema_is_json(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="frozen"):
        project(tmp_path).crs = "EPSG:1"  # type: ignore[misc]
    schema = json.loads(project_schema())
    assert "folder" not in schema["properties"]
    tables = {"terrain", "objects", "orientation", "observations", "adjustment", "cameras", "images", "ortho"}
    assert tables | {"crs", "beyond_area", "defaults", "targets", "format"} == set(schema["properties"])


def test_json_round_trip_for_workers(tmp_path: Path) -> None:
    made = project(tmp_path)
    again = parse_project(json.loads(made.model_dump_json(exclude_none=True)), tmp_path.resolve(), "worker")
    assert again == made


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ({"size": (10, 10)}, "either focal_px or camera_constant_mm"),
        ({"size": (10, 10), "focal_px": 5.0, "camera_constant_mm": 5.0}, "either focal_px or camera_constant_mm"),
        ({"size": (10, 10), "camera_constant_mm": 5.0}, "pixel_size_um or sensor_size_mm"),
        ({"size": (10, 10), "focal_px": 5.0, "pixel_size_um": 2.0}, "stands alone"),
        ({"size": (10, 10), "focal_px": 5.0, "principal_point_mm": (0, 0)}, "give principal_point_px"),
        (
            {
                "size": (10, 10),
                "focal_px": 5.0,
                "lens": {"type": "radial_table", "radii_mm": [1, 2], "distortion_um": [1, 2]},
            },
            "need camera_constant_mm",
        ),
        ({"size": (10, 10), "focal_px": 5.0, "lens": {"type": "brown", "unit": "mm"}}, "need camera_constant_mm"),
    ],
)
def test_cameras_are_described_one_way(entries: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        FrameEntry(**entries)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"distortion_um": [1, 2]}, "either angles_deg or radii_mm"),
        ({"radii_mm": [1, 2, 3], "distortion_um": [1, 2]}, "3 positions and 2 distortions"),
        ({"radii_mm": [2, 1], "distortion_um": [1, 2]}, "must increase"),
        ({"angles_deg": [10, 95], "distortion_um": [1, 2]}, "below 90"),
    ],
)
def test_radial_tables_are_complete(table: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        RadialTableLens(type="radial_table", **table)


def test_fiducials_of_one_place_are_refused() -> None:
    with pytest.raises(ValueError, match="1, 2 have the same coordinates"):
        FilmEntry(type="film", camera_constant_mm=150.0, fiducials_mm={**MARKS, "2": MARKS["1"]})
