"""Coordinates against their CRS: areas of use, axes and missing fixes, judged alike for files, tables and options."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from tools.command import inside
from tools.landxml import write_landxml

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.bounds import area_fault, area_note, beyond_area, is_no_fix
from photoplan.geometry.crs import crs_step, grid_rotation, is_left_handed, require_projected_metres
from photoplan.geometry.pose import Pose
from photoplan.io.image_metadata import read_image_metadata
from photoplan.io.points import read_ground_points, read_observed_positions

IMAGES = Path(__file__).parents[1] / "data/drone_positions"
LEFT = ("EPSG:5513", "EPSG:2065", "+proj=utm +zone=32 +axis=wnu", "+proj=tmerc +lon_0=15 +axis=esu")
RIGHT = ("EPSG:5514", "EPSG:2193", "EPSG:2046", "EPSG:2056", "EPSG:31256", "EPSG:3031", "EPSG:3413", "EPSG:5041",
         "EPSG:32661", "EPSG:2180", "EPSG:3006", "+proj=utm +zone=32 +axis=wsu")  # fmt: skip


@pytest.mark.parametrize("crs", LEFT)
def test_left_handed_systems_are_refused(crs: str) -> None:
    assert is_left_handed(crs)
    with pytest.raises(InputError, match=r"left-handed .* X to the east and Y to the north"):
        require_projected_metres(crs)


@pytest.mark.parametrize("crs", RIGHT)
def test_other_orders_and_directions_of_axes_are_not(crs: str) -> None:
    assert not is_left_handed(crs)
    require_projected_metres(crs)


def test_attitudes_of_images_in_a_left_handed_system(tmp_path: Path) -> None:
    """Whether the system is what is wanted or what a table is in; positions alone can be transformed."""
    shutil.copy(IMAGES / "prague.jpg", tmp_path)
    said = inside("convert", tmp_path / "prague.jpg", "--to", "csv", "--crs", "EPSG:5513", "-o", tmp_path / "o.csv")
    assert said.code == 3 and "left-handed" in said.err and "(EPSG:5514)" in said.err
    assert not (tmp_path / "o.csv").exists()
    there = inside("convert", tmp_path / "prague.jpg", "--to", "csv", "--crs", "EPSG:5514", "-o", tmp_path / "p.csv")
    assert there.code == 0 and float((tmp_path / "p.csv").read_text().split(",")[-1]) == pytest.approx(-47.85, abs=0.01)
    table = tmp_path / "t.csv"
    table.write_text("name,x,y,z,omega,phi,kappa\na,1052449.77,745651.11,510,0,0,42.15\n")
    (tmp_path / "t.prj").write_text("EPSG:5513")
    said = inside("convert", table, "--to", "csv", "--crs", "EPSG:5514", "-o", tmp_path / "q.csv")
    assert said.code == 3 and "left-handed" in said.err
    step = crs_step("EPSG:5513", "EPSG:5514")
    np.testing.assert_allclose(step([1052449.77, 745651.11]), [-745651.11, -1052449.77], atol=1e-3)
    with pytest.raises(InputError, match="left-handed"):
        grid_rotation(step, [1052449.77, 745651.11])


def control_project(folder: Path, header: str, beyond: str = "") -> Path:
    """An image over eight control points of a gcp_list.txt whose first line is `header`; zone 32, around 500 000."""
    camera = FrameCamera(
        Interior.digital((600, 400), (500.0, 500.0)), NoLens(), Pose.from_angles((5e5, 5.2e6, 250.0), (0, 0, 0))
    )
    rng = np.random.default_rng(1)
    XYZ = np.column_stack([5e5 + rng.uniform(-60, 60, 8), 5.2e6 + rng.uniform(-40, 40, 8), rng.uniform(98, 105, 8)])
    xy = project(camera, XYZ)
    rows = [" ".join(f"{v:.3f}" for v in (*P, *p)) + f" img.tif P{k}" for k, (P, p) in enumerate(zip(XYZ, xy))]
    (folder / "gcp_list.txt").write_text("\n".join([header, *rows]) + "\n")
    (folder / "project.toml").write_text(
        f'format = 1\ncrs = "EPSG:32632"\n{beyond}[orientation]\nheight_system = "EPSG:5773"\n[observations]\n'
        'image_points = ["gcp_list.txt"]\ncontrol = ["gcp_list.txt"]\nsigma_control = [0.02, 0.03]\n'
        '[cameras.cam]\ntype = "frame"\nsize = [600, 400]\nfocal_px = 500\n'
        '[[images]]\nname = "img"\nfile = "img.tif"\ncamera = "cam"\n'
    )
    return folder / "project.toml"


@pytest.mark.parametrize(
    ("header", "fits"),
    [
        ("+proj=utm +zone=36 +datum=WGS84 +units=m +no_defs", "EPSG:32636"),
        ("WGS84 UTM 32S", "EPSG:32732"),
        ("EPSG:32629", "EPSG:32629"),
        ("EPSG:32756", "EPSG:32756"),
    ],
)
def test_control_of_another_zone_or_hemisphere(tmp_path: Path, header: str, fits: str) -> None:
    """It was a resection with coordinates two thousand kilometres away and success."""
    file = control_project(tmp_path, header)
    for command in ("resect", "adjust"):
        said = inside(command, file)
        assert said.code == 3, said.err
        assert re.search(
            rf"gcp_list.txt: control point 'P\d' .*outside the area of EPSG:32632.*{fits} fits there", said.err
        )
    meant = inside("resect", control_project(tmp_path, header, "beyond_area = true\n"))
    assert ("outside the area" not in meant.err) and (meant.code == 0 or "has no place" not in meant.err)


def test_a_neighbouring_zone_is_used_with_a_note(tmp_path: Path) -> None:
    said = inside("resect", control_project(tmp_path, "EPSG:32633"))
    assert said.code == 0, said.err
    assert "lies 2" in said.out + said.err and "EPSG:32633 fits there" in said.out + said.err
    quiet = inside("resect", control_project(tmp_path, "EPSG:32632"))
    assert quiet.code == 0 and "outside the area" not in quiet.out + quiet.err


def test_heights_of_control_in_another_system_than_the_project(tmp_path: Path) -> None:
    """They were used as they stood, metres or decametres off; now they are converted or refused."""
    file = control_project(tmp_path, "EPSG:32632+5703")
    for header in ("EPSG:32632+5703", "EPSG:4979"):
        control_project(tmp_path, "EPSG:32632")
        text = (tmp_path / "gcp_list.txt").read_text().split("\n", 1)[1]
        (tmp_path / "gcp_list.txt").write_text(f"{header}\n{text}")
        said = inside("resect", file)
        assert said.code == 3 and "gcp_list.txt" in said.err
    control = tmp_path / "c.csv"
    rows = [line.split() for line in text.strip().split("\n")]
    control.write_text("name,x,y,z\n" + "".join(f"{r[6]},{r[0]},{r[1]},{r[2]}\n" for r in rows))
    for stated in ("EPSG:32632+5703", CRS("EPSG:32632").to_3d().to_wkt()):
        control.with_suffix(".prj").write_text(stated)
        with pytest.raises(HeightSystemError, match=r"c\.csv: the file states heights .*, the project EGM96 height"):
            read_ground_points(control, crs="EPSG:32632", height_system="EPSG:5773")
    for stated, wanted in (("EPSG:32632+5773", "EPSG:5773"), ("EPSG:32632+5773", None), ("EPSG:32632", "EPSG:5773"),
                           ("EPSG:32632+8228", "EPSG:5703"), ("EPSG:32632+5773", "same")):  # fmt: skip
        control.with_suffix(".prj").write_text(stated)
        found = read_ground_points(control, crs="EPSG:32632", height_system=wanted)
        metres = 0.3048 if "8228" in stated else 1.0
        assert found.XYZ[:, 2] == pytest.approx([float(r[2]) * metres for r in rows])
    control.write_text("name,x,y,z,omega,phi,kappa\na,500000,5200000,900,0,0,0\n")
    control.with_suffix(".prj").write_text("EPSG:32632+5703")
    with pytest.raises(HeightSystemError, match="the project EGM96"):
        read_observed_positions(control, crs="EPSG:32632", height_system="EPSG:5773")


GEOID = """
import sys; from pathlib import Path; from pyproj import datadir
from tools.geoid import write_geoid
datadir.append_data_dir(sys.argv[1]); write_geoid(Path(sys.argv[1]), "EPSG:32632", (5e5, 5.2e6))
from photoplan.io.points import read_ground_points
print(read_ground_points(Path(sys.argv[1]) / "c.csv", crs="EPSG:32632", height_system="EPSG:5773").XYZ[:, 2].tolist())
"""


def test_ellipsoidal_heights_of_control_are_converted(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("name,x,y,z\na,500000,5200000,147\nb,500010,5200000,\n")
    (tmp_path / "c.prj").write_text(CRS("EPSG:32632").to_3d().to_wkt())
    words = [sys.executable, "-c", GEOID, str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert done.stdout.strip() == "[100.0, nan]", done.stderr


@pytest.mark.parametrize(
    ("factors", "shift", "says"),
    [((1, 1), (32e6, 0), "begin with 32, the number of the zone"), ((1e3, 1e3), (0, 0), "are they millimetres")],
)
def test_places_that_a_map_does_not_have_are_guessed_at(
    tmp_path: Path, factors: tuple[float, float], shift: tuple[float, float], says: str
) -> None:
    file = control_project(tmp_path, "EPSG:32632")
    first, *rows = (tmp_path / "gcp_list.txt").read_text().strip().split("\n")
    moved = [f"{float(x) * factors[0] + shift[0]} {float(y) * factors[1] + shift[1]} {rest}"
             for x, y, rest in (row.split(" ", 2) for row in rows)]  # fmt: skip
    (tmp_path / "gcp_list.txt").write_text("\n".join([first, *moved]))
    said = inside("resect", file)
    assert said.code == 3 and says in said.err, said.err


def test_images_without_a_fix(tmp_path: Path) -> None:
    """EXIF 0, 0 as XMP 0, 0: no position, and a note; it was a place in the Gulf of Guinea."""
    assert is_no_fix(0.0, 0.0) and not is_no_fix(0.0, 9.0)
    stated = read_image_metadata(IMAGES / "without_fix.jpg")
    assert stated.position is None and stated.no_fix
    for name in ("without_fix.jpg", "zone_32.jpg"):
        shutil.copy(IMAGES / name, tmp_path)
    out = tmp_path / "o.csv"
    said = inside("convert", tmp_path, "--to", "csv", "--crs", "EPSG:32632", "-o", out)
    assert said.code == 0 and "1 image states latitude 0 and longitude 0" in said.err and "without_fix.jpg" in said.err
    assert [line.split(",")[0] for line in out.read_text().splitlines()] == ["name", "zone_32.jpg"]
    alone = inside(
        "convert", tmp_path / "without_fix.jpg", "--to", "csv", "--crs", "EPSG:32632", "-o", tmp_path / "p.csv"
    )
    assert alone.code == 3 and "latitude 0 and longitude 0" in alone.err


def test_images_of_another_place_than_the_map(tmp_path: Path) -> None:
    shutil.copy(IMAGES / "zone_32.jpg", tmp_path)
    words = ("convert", tmp_path / "zone_32.jpg", "--to", "csv", "--crs")
    said = inside(*words, "EPSG:32645", "-o", tmp_path / "o.csv")
    assert said.code == 3 and "EPSG:32632 fits there" in said.err and "--beyond-area" in said.err
    meant = inside(*words, "EPSG:32645", "-o", tmp_path / "o.csv", "--beyond-area")
    assert meant.code == 0, meant.err
    near = inside(*words, "EPSG:32633", "-o", tmp_path / "p.csv")
    assert near.code == 0 and "EPSG:32632 fits there" in near.err


@pytest.mark.parametrize("kind", ["xml", "csv"])
def test_terrain_of_another_place_than_the_map(tmp_path: Path, kind: str) -> None:
    """A LandXML file whose code is another zone's, and a table with a declared one: X and Y exchanged."""
    rng = np.random.default_rng(0)
    XYZ = np.column_stack([5.2e6 + rng.uniform(0, 50, 40), 5e5 + rng.uniform(0, 50, 40), rng.uniform(90, 91, 40)])
    file = tmp_path / f"points.{kind}"
    if kind == "xml":
        write_landxml(file, XYZ, crs="32632")
    else:
        file.write_text("x,y,z\n" + "".join(f"{x:.3f},{y:.3f},{z:.3f}\n" for x, y, z in XYZ))
    crs = () if kind == "xml" else ("--crs", "EPSG:32632")
    words = ("dtm", "build", file, "-o", tmp_path / "m.gpkg", "--height-system", "ellipsoidal", "--dry-run", *crs)
    said = inside(*words)
    assert said.code == 3 and "are X and Y exchanged? Exchanged they lie inside" in said.err, said.err
    assert inside(*words, "--beyond-area").code == 0


def test_areas_are_judged_in_kilometres() -> None:
    """Northern Norway is mapped in zone 33 as a whole; near the pole degrees are short."""
    step = crs_step("EPSG:4326", "EPSG:25833")
    assert area_fault("EPSG:25833", step([31.0, 70.4])) is None
    assert 400 < beyond_area("EPSG:25833", step([31.0, 70.4]))[0] < 600
    assert "EPSG:25835 fits" in (area_note("EPSG:25833", step([29.0, 60.0])) or "")
    # Across 180°, in systems of other meridians and units, without a code, and of the whole earth.
    assert beyond_area("EPSG:32701", crs_step("EPSG:4326", "EPSG:32701")([179.9, -17.0]))[0] < 15
    assert beyond_area("EPSG:27561", [600_000.0, 200_000.0])[0] == 0
    assert beyond_area("+proj=utm +zone=32 +ellps=GRS80", [2_321_115.0, 5_200_000.0])[0] > 1000
    assert beyond_area("EPSG:3857", [0.0, 0.0])[0] == 0
    assert "2 of 3 places" in (area_fault("EPSG:2056", [[2.6e6, 1.2e6], [6e5, 2e5], [6e5, 2e5]], "abc") or "")
