"""`photoplan init`: real blocks, and every way in which files do not fit together."""

from __future__ import annotations

import json
import shutil
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner, Result
from pyproj import Proj
from rasterio.transform import from_origin

from photoplan.cli.table import VERBS
from photoplan.errors import HeightSystemError, InputError, PhotoplanError, UsageError
from photoplan.geometry.crs import crs_step
from photoplan.geometry.pose import rotation_opk
from photoplan.io.camera.model import FilmEntry, FrameEntry
from photoplan.io.orientation.block import TableFormat
from photoplan.io.project.file import load_project
from photoplan.products.init import InitRequest, init_project, make_project

command = VERBS["init"].command("init")
HEAD = "name,x,y,z,omega,phi,kappa\n"
YAML = "cam:\n  type: pinhole\n  im_size: [40, 30]\n  focal_len: 50\n  sensor_size: [40, 30]\n"


def raster(path: Path, size: tuple[int, int] = (40, 30), **options: Any) -> Path:
    profile = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 1, "dtype": "uint8", **options}
    with rasterio.open(path, "w", **profile) as file:
        file.write(np.zeros((1, size[1], size[0]), profile["dtype"]))
    return path


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Any]:
    """A tiny block: two images, camera, table, terrain in UTM 32."""
    (tmp_path / "images").mkdir()
    for name in ("a", "b"):
        raster(tmp_path / "images" / f"{name}.tif")
    (tmp_path / "int.yaml").write_text(YAML)
    (tmp_path / "ext.csv").write_text(HEAD + "a,500010,5400010,900,0.5,-0.25,90\nb.jpg,500020,5400020,901,0,0,-90\n")
    (tmp_path / "ext.prj").write_text("EPSG:32632")
    raster(
        tmp_path / "dtm.tif",
        (20, 20),
        dtype="float32",
        crs="EPSG:32632",
        transform=from_origin(499900, 5400200, 20, 20),
    )
    return {
        "folder": tmp_path / "out",
        "images": (str(tmp_path / "images" / "*.tif"),),
        "camera": tmp_path / "int.yaml",
        "orientation": tmp_path / "ext.csv",
        "terrain": str(tmp_path / "dtm.tif"),
        "height_system": "same",
    }


def test_the_drone_block(block: Path, tmp_path: Path) -> None:
    said: list[str] = []
    request = InitRequest(
        folder=tmp_path / "brighton",
        images=(str(block / "images" / "*.jpg"),),
        camera=block / "int.yaml",
        orientation=block / "ext.csv",
        terrain=str(block / "dsm.tif"),
        height_system="same",
    )
    result = init_project(request, SimpleNamespace(talk=said.append))
    assert load_project(result.path) == result.project
    assert said[0] == (
        '  18 images · camera "DJI FC300S half-res", 2000 × 1125 px, OpenCV lens · EPSG:32615 (from ext.prj)'
    )
    assert "height systems: terrain declared the same, orientation declared the same" in said[1]
    project = result.project
    assert [i.name for i in project.images] == [f"DJI_00{k}" for k in range(18, 36)]
    assert project.images[0].center == (576661.8239, 5188164.7692, 207.2298)
    assert project.images[0].angles == (1.074164, -3.800570, -42.559458)
    assert not Path(project.images[0].file).is_absolute()
    assert project.resolve(project.images[0].file) == (block / "images" / "DJI_0018.jpg").resolve()
    assert project.resolve(project.terrain.file or "") == (block / "dsm.tif").resolve()


def test_fault_02_undeclared_height_systems_stop_after_the_summary(block: Path, tmp_path: Path) -> None:
    said: list[str] = []
    request = InitRequest(
        tmp_path / "x",
        (str(block / "images" / "*.jpg"),),
        block / "int.yaml",
        block / "ext.csv",
        str(block / "dsm.tif"),
    )
    with pytest.raises(HeightSystemError) as error:
        init_project(request, SimpleNamespace(talk=said.append))
    assert "18 images" in said[0]
    assert str(error.value).startswith(
        "height systems: terrain not stated, orientation not stated → declare one, or `height_system` same"
    )
    assert not (tmp_path / "x").exists()


def test_the_dmc_block(shared: Path, tmp_path: Path) -> None:
    data = shared / "data" / "ngi_dmc"
    request = InitRequest(
        folder=tmp_path / "ngi",
        images=(str(data / "images" / "*.tif"),),
        camera=data / "eo" / "ngi_int_param.yaml",
        orientation=data / "eo" / "ngi_xyz_opk.csv",
        terrain=str(data / "dem.tif"),
        height_system="EPSG:3855",
    )
    project = init_project(request).project
    assert load_project(request.path) == project
    assert len(project.images) == 4
    assert project.crs.startswith("+proj=tmerc +lat_0=0 +lon_0=25")
    assert (project.terrain.height_system, project.orientation.height_system) == ("EPSG:3855", "EPSG:3855")


def test_images_and_lines_without_partner_are_listed(files: dict[str, Any], tmp_path: Path) -> None:
    raster(tmp_path / "images" / "c.tif")
    with files["orientation"].open("a") as table:
        table.write("d,1,2,3,4,5,6\n")
    said: list[str] = []
    result = make_project(InitRequest(**files), SimpleNamespace(talk=said.append))
    assert result.without_orientation == ("c.tif",)
    assert result.without_image == ("d",)
    assert "  left out, no orientation: c.tif" in said
    assert "  left out, no image file: d" in said
    assert [i.name for i in result.project.images] == ["a", "b"]


def test_names_match_without_suffix_and_capitals(files: dict[str, Any], tmp_path: Path) -> None:
    text = files["orientation"].read_text().replace("\na,", '\n"dir/A.JPG",')
    files["orientation"].write_text(text)
    assert [i.name for i in make_project(InitRequest(**files)).project.images] == ["a", "b"]


def test_fault_12_two_files_or_lines_with_one_base_name(files: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    raster(tmp_path / "more" / "a.tif")
    both = {**files, "images": (*files["images"], str(tmp_path / "more" / "*.tif"))}
    with pytest.raises(InputError, match=r"images/a\.tif' and .*more/a\.tif' are both image 'a' by the base name"):
        init_project(InitRequest(**both))
    assert not files["folder"].exists()
    # The same file by two patterns is one file.
    twice = {**files, "images": (*files["images"], *files["images"])}
    assert len(make_project(InitRequest(**twice)).project.images) == 2
    with files["orientation"].open("a") as table:
        table.write("left/a.tif,1,2,3,4,5,6\n")
    assert make_project(InitRequest(**files)).without_image == ("left/a.tif",)


def test_fault_12_equal_base_names_are_told_apart_by_folder(files: dict[str, Any], tmp_path: Path) -> None:
    """Files of two folders go to the lines of their folders; names and products are distinct."""
    for folder in ("100MEDIA", "101MEDIA"):
        (tmp_path / folder).mkdir()
        raster(tmp_path / folder / "a.tif")
    text = files["orientation"].read_text().replace("\na,", "\n101MEDIA/a,")
    files["orientation"].write_text(text + "D:\\\\flight\\100MEDIA\\A.JPG,7,2,3,4,5,6\n".replace("\\\\", "\\"))
    images = (*(str(tmp_path / f / "a.tif") for f in ("100MEDIA", "101MEDIA")), str(tmp_path / "images" / "b.tif"))
    project = make_project(InitRequest(**{**files, "images": images})).project
    assert [i.name for i in project.images] == ["100MEDIA/a", "101MEDIA/a", "b"]
    assert [project.image(n).center[0] == 7 for n in ("100MEDIA/a", "101MEDIA/a")] == [True, False]
    assert project.stems == {"100MEDIA/a": "100MEDIA_a", "101MEDIA/a": "101MEDIA_a", "b": "b"}


def test_fault_08_an_unreadable_image_among_many_is_left_out_and_listed(files: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "images" / "broken.tif").write_bytes(b"II*\0 and no more")
    (tmp_path / "images" / "empty.tif").write_bytes(b"")
    said: list[str] = []
    result = make_project(InitRequest(**files), SimpleNamespace(talk=said.append))
    assert [i.name for i in result.project.images] == ["a", "b"]
    assert len(result.unusable) == 2
    assert any("left out, 2 files cannot be read: " in line and "broken.tif" in line for line in said)
    alone = {**files, "images": (str(tmp_path / "images" / "broken.tif"),)}
    with pytest.raises(InputError, match=r"broken\.tif"):
        make_project(InitRequest(**alone))


def test_fault_12_stems_that_differ_only_in_what_is_replaced(files: dict[str, Any], tmp_path: Path) -> None:
    raster(tmp_path / "images" / "x 1.tif")
    raster(tmp_path / "images" / "x_1.tif")
    with files["orientation"].open("a") as table:
        table.write("x 1,1,2,3,4,5,6\nx_1,1,2,3,4,5,6\n")
    project = make_project(InitRequest(**files)).project
    assert (project.stems["x 1"], project.stems["x_1"]) == ("x_1", "x_1_2")


def test_fault_13_an_existing_project_is_kept(files: dict[str, Any]) -> None:
    init_project(InitRequest(**files))
    before = InitRequest(**files).path.read_text()
    with pytest.raises(UsageError, match="`overwrite`"):
        init_project(InitRequest(**{**files, "terrain": "12.5"}))
    assert InitRequest(**files).path.read_text() == before
    init_project(InitRequest(**{**files, "terrain": "12.5", "overwrite": True}))
    assert load_project(InitRequest(**files).path).terrain.height == 12.5
    assert [p.name for p in files["folder"].iterdir()] == ["project.toml"]


def test_fault_01_joining_grid_missing_is_noticed_at_once(files: dict[str, Any]) -> None:
    request = InitRequest(
        **{**files, "height_system": None},
        terrain_height_system="EPSG:3855",
        orientation_height_system="ellipsoidal",
    )
    with pytest.raises(HeightSystemError, match=r"us_nga_egm08_25\.tif"):
        init_project(request)
    assert not files["folder"].exists()


def test_stated_height_systems_are_taken_and_not_overruled_by_accident(files: dict[str, Any], tmp_path: Path) -> None:
    files["orientation"].with_suffix(".prj").write_text("EPSG:32632+5773")
    stated = make_project(InitRequest(**files)).project
    assert (stated.terrain.height_system, stated.orientation.height_system) == ("EPSG:5773", "EPSG:5773")
    raster(
        tmp_path / "dtm.tif",
        (20, 20),
        dtype="float32",
        crs="EPSG:32632+5773",
        transform=from_origin(499900, 5400200, 20, 20),
    )
    both = make_project(InitRequest(**{**files, "height_system": None})).project
    assert (both.terrain.height_system, both.orientation.height_system) == ("EPSG:5773", "EPSG:5773")
    with pytest.raises(UsageError, match="both files state theirs"):
        make_project(InitRequest(**{**files, "height_system": "EPSG:3855"}))


def test_fault_20_crs_missing_or_unfit(files: dict[str, Any], tmp_path: Path) -> None:
    side = files["orientation"].with_suffix(".prj")
    side.unlink()
    with pytest.raises(InputError, match=r"ext\.csv: does not state the CRS .*`crs`"):
        make_project(InitRequest(**files))
    assert make_project(InitRequest(**files, crs="EPSG:32632")).project.crs == "EPSG:32632"
    for crs, says in (("EPSG:4326", "geographic"), ("EPSG:2225", "foot"), ("EPSG:32632+5773", "joins")):
        with pytest.raises(InputError, match=says):
            make_project(InitRequest(**files, crs=crs))
    side.write_text("EPSG:4326")
    with pytest.raises(InputError, match="not projected, so angles have no axes"):
        make_project(InitRequest(**files, crs="EPSG:32632"))
    side.write_text("EPSG:32632")
    raster(tmp_path / "dtm.tif", (20, 20), dtype="float32", transform=from_origin(499900, 5400200, 20, 20))
    with pytest.raises(InputError, match="states no CRS"):
        make_project(InitRequest(**files))


def test_fault_20_an_orientation_in_another_crs_is_transformed_angles_included(files: dict[str, Any]) -> None:
    there = make_project(InitRequest(**files)).project
    moved = make_project(InitRequest(**files, crs="EPSG:32633")).project
    step = crs_step("EPSG:32632", "EPSG:32633")
    for a, b in zip(there.images, moved.images):
        np.testing.assert_allclose(step(a.center[:2]), b.center[:2], atol=1e-6)
        assert a.center[2] == b.center[2]
        # A ground point one metre from the centre, by both projects.
        Ra, Rb = (rotation_opk(*np.radians(i.angles)) for i in (a, b))
        point = np.array([0.4, -0.3, -0.8])
        ground = step(np.array(a.center[:2]) + (Ra @ point)[:2]) - step(np.array(a.center[:2]))
        np.testing.assert_allclose((Rb @ point)[:2], ground, atol=2e-3)
        np.testing.assert_allclose((Rb @ point)[2], (Ra @ point)[2], atol=1e-12)
    angle = moved.images[0].angles[2] - there.images[0].angles[2]
    lon, lat = Proj("EPSG:32632")(500010, 5400010, inverse=True)
    gamma = Proj("EPSG:32633").get_factors(lon, lat).meridian_convergence
    assert abs(angle - gamma) < 0.02
    assert abs(gamma) > 4


def test_fault_20_feet_need_a_named_vertical_unit(files: dict[str, Any]) -> None:
    files["orientation"].with_suffix(".prj").write_text("EPSG:2225")
    files["orientation"].write_text(HEAD + "a,6561666.7,1640416.7,900,0,0,0\nb,6561766.7,1640416.7,900,0,0,0\n")
    with pytest.raises(HeightSystemError, match=r"ext\.csv.*EPSG:6360 in US survey feet"):
        make_project(InitRequest(**files, crs="EPSG:26910"))


def test_table_declarations_reach_the_reader(files: dict[str, Any]) -> None:
    files["orientation"].write_text("a;500010,0;5400010;900;0,5;-0,25;100\nb;500020;5400020;901;0;0;300\n")
    form = TableFormat(columns="name,x,y,z,omega,phi,kappa", decimal_comma=True, angle_unit="gon")
    made = make_project(InitRequest(**files, form=form)).project
    np.testing.assert_allclose(made.images[0].angles, (0.45, -0.225, 90), atol=1e-12)
    assert made.orientation.angle_unit == "deg"
    assert made.orientation.rotation == "opk"


def test_cameras_by_name_and_by_size(files: dict[str, Any], tmp_path: Path) -> None:
    two = YAML + YAML.replace("cam:", "other:").replace("[40, 30]\n  focal", "[20, 30]\n  focal")
    files["camera"].write_text(two)
    with pytest.raises(InputError, match="does not say which image has which"):
        make_project(InitRequest(**files))
    table = "name,x,y,z,omega,phi,kappa,camera\na,1,2,3,0,0,0,cam\nb,1,2,3,0,0,0,{}\n"
    files["orientation"].write_text(table.format("other"))
    with pytest.raises(InputError, match=r"b\.tif: 40 × 30 px, but camera 'other' .* has 20 × 30 px"):
        make_project(InitRequest(**files))
    files["orientation"].write_text(table.format("Cam"))
    with pytest.raises(InputError, match=r"ext\.csv:3: image 'b' names camera 'Cam'; .* describes 'cam', 'other'"):
        make_project(InitRequest(**files))
    raster(tmp_path / "images" / "b.tif", (20, 30))
    files["orientation"].write_text(table.format("other"))
    made = make_project(InitRequest(**files)).project
    assert [i.camera for i in made.images] == ["cam", "other"]


def test_film_takes_the_size_of_its_scans(files: dict[str, Any], tmp_path: Path) -> None:
    marks = "{ 1 = [106.0, -106.0], 2 = [-106.0, -106.0], 3 = [-106.0, 106.0], 4 = [106.0, 106.0] }"
    scan = "{ 1 = [39.0, 29.0], 2 = [0.0, 29.0], 3 = [0.0, 0.0], 4 = [39.0, 0.0] }"
    toml = f'crs = "EPSG:32632"\n[cameras.RC30]\ntype = "film"\ncamera_constant_mm = 153.0\nfiducials_mm = {marks}\n'
    for name in "ab":
        toml += (
            f'[[images]]\nname = "{name}"\ncenter = [500010, 5400010, 900]\nangles = [0, 0, 0]\nfiducials = {scan}\n'
        )
    one = tmp_path / "block.toml"
    one.write_text(toml)
    made = init_project(InitRequest(**{**files, "camera": one, "orientation": one}))
    assert load_project(made.path) == made.project
    assert isinstance(made.project.cameras["RC30"], FilmEntry)
    assert [i.size for i in made.project.images] == [(40, 30), (40, 30)]
    assert made.project.images[0].fiducials == {"1": (39, 29), "2": (0, 29), "3": (0, 0), "4": (39, 0)}


def test_opensfm_goes_into_the_terrains_crs_at_the_images_resolution(files: dict[str, Any], tmp_path: Path) -> None:
    lat, lon = 48.75, 9.0
    x, y = Proj("EPSG:32632")(lon, lat)
    camera = {"projection_type": "perspective", "width": 80, "height": 60, "focal": 1.25, "k1": 0.0, "k2": 0.0}
    down = {"camera": "c", "rotation": [np.pi, 0, 0], "translation": [0, 0, 100.0]}
    aside = {"camera": "c", "rotation": [np.pi, 0, 0], "translation": [-2000.0, 0, 100.0]}
    content = [
        {
            "cameras": {"c": camera},
            "shots": {"a.tif": down, "b.tif": aside},
            "reference_lla": {"latitude": lat, "longitude": lon, "altitude": 400.0},
        }
    ]
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps(content))
    said: list[str] = []
    request = InitRequest(**{**files, "camera": path, "orientation": path, "height_system": "ellipsoidal"})
    project = init_project(request, SimpleNamespace(talk=said.append)).project
    assert "(from dtm.tif)" in said[0]
    assert project.crs == "EPSG:32632"
    made = project.cameras["c"]
    assert isinstance(made, FrameEntry)
    assert (made.size, made.pixels.focal, made.pixels.point) == ((40, 30), (50.0, 50.0), (19.5, 14.5))
    a, b = project.images
    np.testing.assert_allclose(a.center, (x, y, 500.0), atol=1e-6)
    np.testing.assert_allclose(a.angles, 0, atol=1e-9)  # on the central meridian
    # 2 km to the east the plumb line leans by 2000 m / 6.39e6 m, and the plane is 0.31 m above the ellipsoid.
    assert abs(b.center[0] - x - 2000 * 0.9996) < 0.3
    assert abs(b.center[2] - 500.313) < 2e-3
    lean = np.degrees(2100 / 6.39e6)
    np.testing.assert_allclose(np.abs(b.angles[1]), lean, rtol=0.06)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"images": ("nothing*.tif",)}, "no file matches"),
        ({"images": ("/vsizip/a.zip/*.tif",)}, "virtual"),
        ({"terrain": "/vsicurl/https://example.org/a.tif"}, "virtual"),
        ({"terrain": "https://example.org/a.tif"}, "addresses"),
        ({"terrain": "missing.tif"}, r"missing\.tif"),
        ({"camera": Path("missing.yaml")}, "cannot be read"),
        ({"orientation": Path("missing.csv")}, "cannot be read"),
    ],
)
def test_fault_09_inputs_that_are_not_there_or_not_plain(
    files: dict[str, Any], change: dict[str, Any], says: str
) -> None:
    with pytest.raises(PhotoplanError, match=says):
        init_project(InitRequest(**{**files, **change}))
    assert not files["folder"].exists()


def test_fault_11_names_of_the_table_write_nothing_elsewhere(files: dict[str, Any], tmp_path: Path) -> None:
    files["orientation"].write_text(
        HEAD + "../../../evil,1,2,3,4,5,6\n/abs/a.tif,500010,5400010,900,0,0,0\nCON,1,2,3,4,5,6\n日本,1,2,3,4,5,6\n"
    )
    before = sorted(p for p in tmp_path.rglob("*"))
    result = init_project(InitRequest(**files))
    assert [i.name for i in result.project.images] == ["a"]
    after = sorted(p for p in tmp_path.rglob("*"))
    assert set(after) - set(before) == {files["folder"], files["folder"] / "project.toml"}


def run(files: dict[str, Any], *more: str) -> Result:
    arguments = [
        str(files["folder"]),
        *("--images", files["images"][0], "--camera", str(files["camera"])),
        *("--orientation", str(files["orientation"]), "--terrain", files["terrain"], *more),
    ]
    # Before click 8.2 a runner mixes both streams unless it is told otherwise.
    apart = {"mix_stderr": False} if "mix_stderr" in signature(CliRunner).parameters else {}
    return CliRunner(**apart).invoke(command, arguments)


def test_the_command_prints_the_path_on_stdout_and_talks_on_stderr(files: dict[str, Any]) -> None:
    result = run(files, "--height-system", "same")
    assert result.exit_code == 0, result.output
    assert result.stdout == f"{files['folder'] / 'project.toml'}\n"
    assert "2 images" in result.stderr
    again = run(files, "--height-system", "same", "--overwrite", "--json", "-q")
    assert json.loads(again.stdout)["images"] == ["a", "b"]
    assert again.stderr == ""
    assert isinstance(run(files).exception, UsageError)
    shutil.rmtree(files["folder"])
    assert isinstance(run(files).exception, HeightSystemError)


def test_images_without_orientation(files: dict[str, Any], tmp_path: Path) -> None:
    for name in ("points.csv", "control.csv", "gnss.csv"):
        (tmp_path / name).write_text("x\n")
    bare = {k: v for k, v in files.items() if k not in ("orientation", "terrain")}
    said: list[str] = []
    request = InitRequest(
        **bare,
        crs="EPSG:32632",
        image_points=(tmp_path / "points.csv",),
        control=(tmp_path / "control.csv",),
        positions=tmp_path / "gnss.csv",
        form=TableFormat(angle_unit="gon", rotation="pok"),
        earth_curvature="strict",
        refraction=True,
    )
    project = init_project(request, SimpleNamespace(talk=said.append)).project
    assert load_project(request.path) == project
    assert "2 images without orientation" in said[0] and "as given" in said[0]
    assert said[1] == "  height systems: control declared the same"
    assert [(i.name, i.center, i.angles) for i in project.images] == [("a", None, None), ("b", None, None)]
    assert project.terrain is None
    assert project.observations.image_points == ("../points.csv",)
    assert project.observations.control == ("../control.csv",)
    assert project.observations.positions == "../gnss.csv"
    assert (project.orientation.angle_unit, project.orientation.rotation) == ("gon", "pok")
    with pytest.raises(InputError, match="has no orientation; `photoplan resect`"):
        _ = project.images[0].pose_numbers
    with pytest.raises(InputError, match=r"states no \[terrain\]"):
        _ = project.ground


def test_terrain_without_orientation_and_orientation_without_terrain(files: dict[str, Any]) -> None:
    alone = make_project(InitRequest(**{**files, "orientation": None}, crs="EPSG:32632")).project
    assert alone.images[0].center is None and alone.ground.height_system == "same"
    oriented = make_project(InitRequest(**{**files, "terrain": None})).project
    assert oriented.terrain is None and oriented.images[0].center is not None


def test_fault_02_and_20_without_orientation_crs_and_heights_are_declared(files: dict[str, Any]) -> None:
    bare = {**files, "orientation": None, "terrain": None}
    with pytest.raises(InputError, match=r"nothing states the CRS .*`crs`"):
        make_project(InitRequest(**bare))
    with pytest.raises(HeightSystemError, match=r"control points and orientation not stated .*`height_system`"):
        make_project(InitRequest(**{**bare, "height_system": None}, crs="EPSG:32632"))
    with pytest.raises(InputError, match=r"nowhere\.csv: no such file"):
        make_project(InitRequest(**bare, crs="EPSG:32632", control=(Path("nowhere.csv"),)))
    with pytest.raises(InputError, match="virtual"):
        make_project(InitRequest(**bare, crs="EPSG:32632", control=(Path("/vsizip/a.zip/c.csv"),)))


def test_fault_12_unoriented_files_with_one_base_name(files: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "more").mkdir()
    raster(tmp_path / "more" / "a.tif")
    both = {**files, "orientation": None, "images": (*files["images"], str(tmp_path / "more" / "*.tif"))}
    project = make_project(InitRequest(**both, crs="EPSG:32632")).project
    assert [i.name for i in project.images] == ["images/a", "b", "more/a"]


def test_film_without_marks_and_cameras_by_size(files: dict[str, Any], tmp_path: Path) -> None:
    marks = "{ 1 = [106.0, -106.0], 2 = [-106.0, -106.0], 3 = [-106.0, 106.0], 4 = [106.0, 106.0] }"
    film = tmp_path / "film.toml"
    film.write_text(f'[cameras.RC30]\ntype = "film"\ncamera_constant_mm = 153.0\nfiducials_mm = {marks}\n')
    bare = {**files, "orientation": None, "terrain": None}
    made = init_project(InitRequest(**{**bare, "camera": film}, crs="EPSG:32632"))
    assert load_project(made.path) == made.project
    assert [(i.size, i.fiducials) for i in made.project.images] == [((40, 30), None)] * 2
    raster(tmp_path / "images" / "b.tif", (20, 30))
    two = YAML + YAML.replace("cam:", "other:").replace("[40, 30]\n  focal", "[20, 30]\n  focal")
    files["camera"].write_text(two)
    assert [i.camera for i in make_project(InitRequest(**bare, crs="EPSG:32632")).project.images] == ["cam", "other"]
    files["camera"].write_text(YAML + YAML.replace("cam:", "other:"))
    with pytest.raises(InputError, match=r"describes 2 cameras \('cam', 'other'\), and 2 of them have the 40 × 30 px"):
        make_project(InitRequest(**{**bare, "images": (str(tmp_path / "images" / "a.tif"),)}, crs="EPSG:32632"))


def test_the_command_without_orientation(files: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("point,image,x,y\n1,a,1,2\n")
    arguments = [str(files["folder"]), "--images", files["images"][0], "--camera", str(files["camera"])]
    more = ["--crs", "EPSG:32632", "--height-system", "EPSG:5773", "--image-points", str(tmp_path / "points.csv")]
    result = CliRunner().invoke(command, [*arguments, *more, "--angle-unit", "gon", "--json", "-q"])
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["height_systems"] == {"terrain": None, "orientation": "EPSG:5773"}
    project = load_project(files["folder"] / "project.toml")
    assert project.orientation.angle_unit == "gon"
    assert project.observations.image_points == ("../points.csv",)
