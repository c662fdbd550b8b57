"""Full-frame scans of real film: corner marks (ring with diagonal cross), nominal ±106 mm, found unaided."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tools.command import Here
from tools.thinned import some

CAMERA = """
[cameras.uag]
type = "film"
camera_constant_mm = 153.2
fiducials_mm = { 1 = [-106.0, -106.0], 2 = [106.0, -106.0], 3 = [106.0, 106.0], 4 = [-106.0, 106.0] }
marks = { type = "ring_cross", diameter = 1.9, width = 0.17, arm = 1.8, cross_width = 0.12, free = 0.4, rotation = 45 }
"""

#: File, largest residual in µm that is allowed, and the middles of the rings as read from enlarged pictures by eye.
SCANS = {
    "act1997_run25_028_400dpi": (12.0, [(217.5, 3545.0), (3559.5, 3537.0), (3548.5, 203.0), (207.5, 211.0)]),
    "act1989_run20_157_300dpi": (70.0, [(175.0, 2767.0), (2677.5, 2757.0), (2668.0, 263.5), (166.5, 276.5)]),
    "act1993_run37_067_300dpi": (70.0, [(161.0, 2804.5), (2667.0, 2798.5), (2663.5, 305.5), (157.0, 315.0)]),
    # 200 dpi: all marks are right, it is this scanner that is not true to a tenth of a millimetre.
    "act1985_run12_030_200dpi": (160.0, [(103.5, 1766.5), (1769.0, 1767.5), (1772.0, 97.5), (108.0, 92.0)]),
}


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    """The command, called inside this process."""
    return Here(capsys)


@pytest.fixture(scope="module")
def camera(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "camera.toml"
    path.write_text(CAMERA)
    return path


@pytest.mark.drawn
@pytest.mark.parametrize("name", some(SCANS, 0))
@pytest.mark.slow
def test_four_corner_marks_are_found_unaided(
    name: str, shared: Path, camera: Path, tmp_path: Path, photoplan: Here
) -> None:
    allowed, seen = SCANS[name]
    file = shared / "data" / "film_act_canberra" / f"{name}.jpg"
    said = photoplan("fiducials", file, "--camera", camera, "--json", "--pictures", tmp_path)
    assert said.code == 0, said.err
    (image,) = json.loads(said.out)["images"]
    assert [m["name"] for m in image["marks"]] == ["1", "2", "3", "4"]
    assert not image["missing"]
    assert np.abs(np.subtract([(m["x"], m["y"]) for m in image["marks"]], seen)).max() < 1.0
    residuals = np.array(list(image["affine"]["residuals_um"].values()))
    assert np.hypot(*residuals.T).max() <= allowed
    assert all(m["method"] == "matching" and m["correlation"] > 0.75 for m in image["marks"])
    assert all(max(m["sigma"]) < 0.15 for m in image["marks"])
    assert (image["rotation"], image["mirrored"], image["negative"]) == (0, False, False)
    assert "every one of these rotations" in said.err
    assert (tmp_path / f"{name}.fiducials.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_scan_of_unknown_resolution_gives_the_same_places(shared: Path, camera: Path, photoplan: Here) -> None:
    file = shared / "data" / "film_act_canberra" / "act1985_run12_030_200dpi.jpg"
    places = []
    for more in ((), ("--scan-resolution", "600dpi")):
        said = photoplan("fiducials", file, "--camera", camera, "--json", *more)
        assert said.code == 0, said.err
        (image,) = json.loads(said.out)["images"]
        places.append([(m["x"], m["y"]) for m in image["marks"]])
    assert "do not fit the marks; other sizes were tried" in said.err
    np.testing.assert_allclose(places[0], places[1], atol=0.02)


@pytest.mark.slow
def test_wrong_pattern_is_refused_rather_than_misplaced(
    shared: Path, camera: Path, tmp_path: Path, photoplan: Here
) -> None:
    wrong = tmp_path / "wrong.toml"
    lines = [line for line in CAMERA.splitlines() if not line.startswith("marks")]
    wrong.write_text("\n".join([*lines, 'marks = { type = "cross", arm = 3.0, width = 0.4 }']))
    file = shared / "data" / "film_act_canberra" / "act1993_run37_067_300dpi.jpg"
    said = photoplan("fiducials", file, "--camera", wrong)
    assert said.code == 3
    assert "of 4 fiducial marks found, three are needed" in said.err
