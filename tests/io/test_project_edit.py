"""Results written into a project file that a person wrote: only what changes, and never a file that cannot be read."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
import tomlkit

from photoplan.errors import InputError
from photoplan.io.project import edit
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project

WRITTEN = """# The block of 1987.
format = 1
crs = "EPSG:31256"  # Vienna

[terrain]  # measured in 2001
file   = 'dtm.tif'
height_system = "same"

[cameras."RC 10"]
type = "film"   # report of 1986
camera_constant_mm = 153.12
size = [2300, 2300]
fiducials_mm = { 1 = [106.0, -106.0], 2 = [-106.0, -106.0], 3 = [-106.0, 106.0], 4 = [106.0, 106.0] }

[[images]]
name = "a"
file = "a.tif"
camera = "RC 10"
center = [1.0, 2.0, 1500.0]   # from the flight plan
angles = [0.0, 0.0, 90.0]

# The second strip begins here.
[[images]]
name = "b \\"2\\""
file = "b.tif"
camera = "RC 10"
"""
B = 'b "2"'
MARKS = {"1": (2182.25, 2253.0), "2": (62.0, 2248.5), "3": (68.0, 131.5), "4": (2189.0, 141.0)}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "project.toml"
    path.write_text(WRITTEN)
    return path


def lines_of(path: Path) -> tuple[list[str], list[str]]:
    """Lines that were taken away and that were added."""
    before, after = WRITTEN.splitlines(), path.read_text().splitlines()
    return [x for x in before if x not in after], [x for x in after if x not in before]


def test_only_what_changes_changes(path: Path) -> None:
    pose = {"center": (10.5, 20.25, 1480.125), "angles": [0.1, -0.2, 91.0], "sigma_center": (0.1, 0.1, 0.2)}
    changes = ProjectChanges(
        images={"a": pose, B: {"fiducials": MARKS}},
        cameras={"RC 10": {"camera_constant_mm": 153.2, "interior": "bilinear"}},
        tables={"orientation": {"angle_unit": "gon"}, "observations": {"control": ["points.csv"]}},
    )
    project = edit_project(path, changes)
    assert load_project(path) == project
    a, b = project.images
    assert (a.center, a.angles, a.sigma_center) == ((10.5, 20.25, 1480.125), (0.1, -0.2, 91.0), (0.1, 0.1, 0.2))
    assert b.fiducials == MARKS
    assert project.orientation.angle_unit == "gon"
    assert project.observations.control == ("points.csv",)
    gone, new = lines_of(path)
    assert [line.split(" =")[0] for line in gone] == ["camera_constant_mm", "center", "angles"]
    assert len(new) == 3 + 3 + 2 * 2  # changed, added to tables that there are, two tables with one entry each
    for comment in ("# The block of 1987.", "# Vienna", "# measured in 2001", "# report of 1986", "# The second strip"):
        assert comment in path.read_text()


def test_new_entries_stand_before_the_comments_of_the_next_table() -> None:
    document = tomlkit.parse("[a]\nx = 1  # one\n\n# Defaults of b\n[b]\n# z = 3\n")
    edit._set(document.item("a"), {"y": [2.0, 3.0]})
    assert document.as_string().startswith("[a]\nx = 1  # one\ny = [2.0, 3.0]\n\n# Defaults of b\n[b]\n")


def test_tables_of_an_image_stay_in_its_image(path: Path) -> None:
    edit_project(path, ProjectChanges(images={"a": {"fiducials": MARKS}}))
    first, second = tomllib.loads(path.read_text())["images"]
    assert first["fiducials"] == {n: list(at) for n, at in MARKS.items()}
    assert set(second) == {"name", "file", "camera"}
    (line,) = [line for line in path.read_text().splitlines() if line.startswith("fiducials = ")]
    assert line.count("[") == 4


def test_what_is_equal_is_not_written(path: Path) -> None:
    stamp = path.stat().st_mtime_ns
    same = {"center": (1.0, 2.0, 1500.0), "angles": [0, 0, 90]}
    edit_project(path, ProjectChanges(images={"a": same}, cameras={"RC 10": {"size": (2300, 2300)}}))
    assert path.read_text() == WRITTEN
    assert path.stat().st_mtime_ns == stamp
    assert not path.with_suffix(".previous.toml").exists()


def test_entries_are_taken_away_and_the_file_before_is_kept(path: Path) -> None:
    edited = edit_project(path, ProjectChanges(images={"a": {"center": None, "angles": None, "fiducials": None}}))
    assert edited.images[0].center is None
    assert lines_of(path)[1] == []
    assert path.with_suffix(".previous.toml").read_text() == WRITTEN
    once = path.read_text()
    edit_project(path, ProjectChanges(images={"a": {"center": (1, 2, 3), "angles": (4, 5, 6)}}))
    assert path.with_suffix(".previous.toml").read_text() == WRITTEN
    assert path.with_suffix(".previous-2.toml").read_text() == once
    assert len(list(path.parent.iterdir())) == 3


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (ProjectChanges(images={"c": {"center": (1, 2, 3)}}), "image 'c' is not in the project"),
        (ProjectChanges(cameras={"RC": {"interior": "affine"}}), "camera 'RC' is not in the project"),
        (ProjectChanges(images={"a": {"center": None}}), "center and angles go together"),
        (ProjectChanges(images={"a": {"centre": (1, 2, 3)}}), r"images\[1\].centre: unknown entry"),
        (ProjectChanges(images={"a": {"center": (1.0, 2.0, float("nan"))}}), r"images\[1\].center\[3\]: nan given"),
        (ProjectChanges(images={B: {"fiducials": {"9": (1.0, 2.0)}}}), "fiducial marks 9 are not among those"),
        (ProjectChanges(cameras={"RC 10": {"interior": "projective"}}), "interior: 'projective' given"),
        (ProjectChanges(tables={"orientation": {"angle_unit": "grad"}}), "angle_unit: 'grad' given"),
    ],
)
def test_what_is_not_allowed_is_not_written(path: Path, changes: ProjectChanges, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        edit_project(path, changes)
    assert str(path) in str(error.value)
    assert path.read_text() == WRITTEN
    assert [p.name for p in path.parent.iterdir()] == ["project.toml"]


def test_files_that_are_no_project(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    with pytest.raises(InputError, match="cannot be read"):
        edit_project(path, ProjectChanges())
    path.write_text("format = [")
    with pytest.raises(InputError, match="not valid TOML"):
        edit_project(path, ProjectChanges())
    path.write_text('format = 1\ncrs = "EPSG:31256"\nimages = 5\n')
    with pytest.raises(InputError, match=r"\[\[images\]\]"):
        edit_project(path, ProjectChanges(images={"a": {}}))
    path.write_text('format = 1\ncrs = "EPSG:31256"\nimages = [3, "x"]\ncameras = 5\n')
    with pytest.raises(InputError, match=r"p\.toml"):
        edit_project(path, ProjectChanges(images={"a": {"center": (1, 2, 3)}}))
    with pytest.raises(InputError, match=r"p\.toml"):
        edit_project(path, ProjectChanges(cameras={"RC": {"size": (1, 2)}}))


def test_a_folder_with_the_name_of_the_file_before_stays(path: Path) -> None:
    path.with_suffix(".previous.toml").mkdir()
    edit_project(path, ProjectChanges(images={B: {"fiducials": MARKS}}))
    assert path.with_suffix(".previous-2.toml").read_text() == WRITTEN


def test_windows_line_ends_stay(path: Path) -> None:
    path.write_bytes(WRITTEN.replace("\n", "\r\n").encode())
    edit_project(path, ProjectChanges(images={B: {"fiducials": MARKS}}))
    content = path.read_bytes()
    assert load_project(path).images[1].fiducials == MARKS
    assert content.count(b"\r\n") == content.count(b"\n") == WRITTEN.count("\n") + 1
