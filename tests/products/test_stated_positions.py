"""Positions of receivers, in images or in files of orientations, check the poses: wherever these are read or used."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import Transformer
from tools.small_block import BASE, CRS, NAMES, X0, Y0, Z0, Block, make_project
from tools.stated_position import state_position

from photoplan.errors import GeometryError
from photoplan.io.orientation.block import TableFormat
from photoplan.io.orientation.structure_from_motion import read_metashape
from photoplan.io.project.file import load_project
from photoplan.products.check import check_project
from photoplan.products.convert import ConvertRequest, convert_orientation
from photoplan.products.init import InitRequest, init_project
from photoplan.products.orthophoto.plan import plan_orthophotos
from photoplan.products.plausibility import common_differences, differences

TO_EARTH = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True)


def state_all(block: Block, east: float) -> None:
    """Positions of all images, so many metres east of the projection centres."""
    for k, image in enumerate(block.images):
        lon, lat = TO_EARTH.transform(X0 + k * BASE + east, Y0)
        state_position(image, lat, lon, Z0)


def test_ortho_refuses_what_is_far_from_its_files_position(small: Block) -> None:
    make_project(small)
    state_all(small, 2.0)
    project = load_project(small.project)
    assert check_project(project).implausible == ()
    assert plan_orthophotos(project, resolution=2.0).products
    lon, lat = TO_EARTH.transform(X0 + BASE + 5000, Y0)
    state_position(small.images[1], lat, lon, Z0)
    project = load_project(small.project)
    (fault,) = check_project(project).implausible
    assert fault.startswith("two: its file states a GPS position 5 km away")
    with pytest.raises(GeometryError, match=r"image 'two': its file states a GPS position 5 km away.*1 of 3 images"):
        plan_orthophotos(project, resolution=2.0)
    assert plan_orthophotos(project, ["one"], resolution=2.0).products
    assert len(plan_orthophotos(project, resolution=2.0, force=True).products) == 3


def _init(block: Block, orientation: Path) -> list[str]:
    said: list[str] = []
    pattern = str(block.folder / "images" / "*.tif")
    made = InitRequest(block.folder / "made", (pattern,), block.camera, orientation, "100", CRS, "same", overwrite=True)
    init_project(made, SimpleNamespace(talk=said.append))
    return [line.strip() for line in said if line.strip().startswith("warning")]


def test_init_compares_a_table_with_the_images(small: Block) -> None:
    state_all(small, 2.0)
    assert _init(small, small.orientation) == []
    state_all(small, 40_000.0)
    (line,) = _init(small, small.orientation)
    assert "3 of 3 projection centres lie more than 1 km from the GPS positions" in line
    assert "40 km)" in line


@pytest.mark.parametrize("format", ["csv", "bingo", "patb"])
def test_convert_compares_lists_with_images_beside_them(small: Block, tmp_path: Path, format: str) -> None:
    """Lists state no files: images of the same names that lie beside them are looked at."""
    here = tmp_path / "list"
    here.mkdir()
    form = TableFormat(direction="camera-to-ground")
    source = here / "list.txt"
    convert_orientation(
        ConvertRequest(small.orientation, format, source, crs=CRS, camera=small.camera, matrix="camera-to-ground")
    )
    request = ConvertRequest(source, "opk", here / "a.txt", format=format, form=form, crs=CRS, overwrite=True)
    if format == "bingo":
        request = ConvertRequest(source, "opk", here / "a.txt", format=format, crs=CRS, overwrite=True)
    for east, wrong in ((2.0, False), (3000.0, True)):
        state_all(small, east)
        for image in small.images:
            shutil.copy(image, here)
        notes = [n for n in convert_orientation(request).notes if "GPS" in n]
        assert [("3 of 3 projection centres lie more than 1 km" in n) for n in notes] == [True] * wrong


def _metashape(folder: Path, crs: str, places: list[tuple[float, float]], enabled: str = "1") -> Path:
    """A file of cameras at the poses of `small_block`, in the axes of a map, with positions measured by a receiver."""
    table = folder / "table.csv"
    lines = [f"{n},{X0 + k * BASE},{Y0},{Z0},0,0,0" for k, n in enumerate(NAMES)]
    table.write_text("name,x,y,z,omega,phi,kappa\n" + "\n".join(lines) + "\n")
    camera = folder / "camera.yaml"
    camera.write_text("small:\n  type: pinhole\n  im_size: [200, 150]\n  focal_len: 200\n  sensor_size: [200, 150]\n")
    path = folder / "cameras.xml"
    convert_orientation(ConvertRequest(table, "metashape", path, crs=crs, camera=camera, overwrite=True))
    text = path.read_text()
    for name, (x, y) in zip(NAMES, places):
        at = text.index("</camera>", text.index(f'label="{name}'))
        text = f'{text[:at]}<reference x="{x!r}" y="{y!r}" z="400" enabled="{enabled}"/>{text[at:]}'
    path.write_text(text)
    return path


def test_positions_in_a_metashape_file_check_its_poses(small: Block, tmp_path: Path) -> None:
    near = [(X0 + k * BASE + 3.0, Y0 - 1.0) for k in range(3)]
    path = _metashape(tmp_path, CRS, near)
    table = read_metashape(path, TableFormat()).table
    assert table.positions is not None
    lon, lat = TO_EARTH.transform(*np.array(near).T)
    np.testing.assert_allclose(table.positions[:, :2], np.column_stack([lat, lon]), atol=1e-9)
    assert _init(small, path) == []
    far = [(x + 7000.0, y) for x, y in near]
    (line,) = _init(small, _metashape(tmp_path, CRS, far))
    assert "3 of 3 projection centres" in line and "7 km" in line
    assert _init(small, _metashape(tmp_path, CRS, far, enabled="0")) == []


def test_what_all_images_share_is_told() -> None:
    rng = np.random.default_rng(0)
    centers = rng.uniform(0, 800, (12, 2)) + np.array([500_000, 5_300_000])
    stated = centers + rng.normal(0, 3.0, centers.shape)
    names = [str(k) for k in range(12)]
    assert differences(names, centers, stated) == ()
    turn = np.radians(2.0)
    turned = (centers - centers[0]) @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]] + centers[0]
    (said,) = common_differences(turned, stated)
    found = float(said.split("turned by ")[1].split("°")[0])
    assert found == pytest.approx(2.0, abs=0.5)
    (said,) = common_differences(centers + np.array([120.0, 40.0]), stated)
    assert "lie 126 m from" in said or "lie 127 m from" in said
    # As much by chance: nothing that all share.
    rough = centers + rng.normal(0, 60.0, centers.shape) + np.array([55.0, 0.0])
    assert common_differences(centers, rough) == ()
    one = stated.copy()
    one[4] += 9000.0
    (said,) = differences(names, centers, one)
    assert "1 of 12 projection centres" in said and "image '4' 12.7 km" in said
