"""`photoplan fiducials`: marks of scans and of a project's images, with JSON, pictures and exit codes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.mark_scans import ARM, CORNERS, FREE, LINE, RADIUS, Simulated, simulate
from tools.recorded import recorded

from photoplan.io.project.file import load_project
from photoplan.io.project.model import fiducial_fit

MARKS = (
    f'marks = {{ type = "ring_cross", diameter = {2 * RADIUS + LINE}, width = {LINE}, arm = {ARM}, '
    f"cross_width = {2 * LINE / 3}, free = {FREE}, rotation = 45.0, margin = 0.1 }}"
)
CAMERA = "\n".join(
    [
        "[cameras.film]",
        'type = "film"',
        "camera_constant_mm = 50.0",
        "fiducials_mm = { " + ", ".join(f"{n} = [{x}, {y}]" for n, (x, y) in CORNERS.items()) + " }",
        MARKS,
        "",
    ]
)
PROJECT = """# A comment that stays.
format = 1
crs = "EPSG:32633"

{camera}
[cameras.phone]
type = "frame"
size = [100, 80]
focal_px = 90.0

[[images]]
name = "a"
file = "a.tif"
camera = "film"  # one more

[[images]]
name = "b"
file = "b.tif"
camera = "film"

[[images]]
name = "digital"
file = "digital.tif"
camera = "phone"
"""


def write(path: Path, grey: np.ndarray, dtype: str = "uint8", bands: int = 1, **more: object) -> Path:
    scale = {"uint8": 1, "uint16": 200}[dtype]
    pixels = np.clip(np.round(grey * scale), 0, np.iinfo(dtype).max).astype(dtype)
    size = {"height": grey.shape[0], "width": grey.shape[1]}
    tiled = {"tiled": True, "blockxsize": 128, "blockysize": 128}
    with rasterio.open(path, "w", driver="GTiff", count=bands, dtype=dtype, **size, **tiled, **more) as file:
        for band in range(bands):
            file.write(pixels, band + 1)
        file.update_tags(TIFFTAG_XRESOLUTION=254, TIFFTAG_YRESOLUTION=254, TIFFTAG_RESOLUTIONUNIT=2)
    return path


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, dict[str, tuple[float, float]]]]:
    """Two good scans, one without marks, a camera, a project; and where the marks of the good ones are."""
    folder = tmp_path_factory.mktemp("scans")
    truth = {}
    for name, made, dtype, bands in (
        ("a", Simulated(small_turn=0.8), "uint8", 3),
        ("b", Simulated(small_turn=-0.6, negative=True, covered=("2",)), "uint16", 1),
    ):
        grey, truth[name] = simulate(made, 11)
        write(folder / f"{name}.tif", grey, dtype, bands)
    grey, _ = simulate(Simulated(covered=tuple(CORNERS)), 12)
    write(folder / "none.tif", grey)
    (folder / "camera.toml").write_text(CAMERA)
    return folder, truth


def test_json_says_marks_affine_and_what_was_found(scans, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    folder, truth = scans
    said = photoplan("fiducials", folder / "a.tif", "--camera", folder / "camera.toml", "--json")
    assert said.code == 0
    (image,) = json.loads(said.out)["images"]
    assert image["size"] == [660, 660]
    assert image["grey"] == "luminance of bands 1 to 3"
    assert image["pixel_um"] == pytest.approx(100, abs=0.1)
    for mark in image["marks"]:
        assert (mark["x"], mark["y"]) == pytest.approx(truth["a"][mark["name"]], abs=0.1)
        assert min(mark["sigma"]) > 0.003 and max(mark["sigma"]) < 0.06
        assert 0.8 < mark["correlation"] < 1
        assert mark["paraboloid"] == pytest.approx(mark["matching"], abs=0.3)
    affine = image["affine"]
    a1, a2, a3, a4, a5, a6 = affine["parameters"]
    for name, (x, y) in CORNERS.items():
        assert (a1 * x + a2 * y + a3, a4 * x + a5 * y + a6) == pytest.approx(truth["a"][name], abs=0.1)
    assert set(affine["residuals_um"]) == set(CORNERS)
    assert 0 < affine["sigma0_um"] < 10
    assert affine["redundancy"] == 2


def test_marks_that_are_turned_are_tried_and_named(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    """A description without `rotation`, though the crosses lie diagonal."""
    folder, truth = scans
    (tmp_path / "camera.toml").write_text(CAMERA.replace(", rotation = 45.0", ""))
    said = photoplan("fiducials", folder / "a.tif", "--camera", tmp_path / "camera.toml", "--json")
    assert said.code == 0, said.err
    (image,) = json.loads(said.out)["images"]
    assert any("turned by 45°: add 45 to the entry rotation" in note for note in image["notes"]), image["notes"]
    for mark in image["marks"]:
        assert (mark["x"], mark["y"]) == pytest.approx(truth["a"][mark["name"]], abs=0.1)


def test_marks_that_are_turned_and_of_another_size_are_named(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    """A description without `rotation`, of marks a quarter too large: neither change alone fits."""
    folder, truth = scans
    large = (
        f'marks = {{ type = "ring_cross", diameter = {1.25 * (2 * RADIUS + LINE)}, width = {1.25 * LINE}, '
        f"arm = {1.25 * ARM}, cross_width = {2.5 * LINE / 3}, free = {1.25 * FREE}, margin = 0.1 }}"
    )
    (tmp_path / "camera.toml").write_text(CAMERA.replace(MARKS, large))
    words = ("--camera", tmp_path / "camera.toml", "--scan-resolution", "100um", "--json")
    said = photoplan("fiducials", folder / "a.tif", *words)
    assert said.code == 0, said.err
    (image,) = json.loads(said.out)["images"]
    assert any("turned by 45° and 0.8 times as large: add 45" in note for note in image["notes"]), image["notes"]
    for mark in image["marks"]:
        assert (mark["x"], mark["y"]) == pytest.approx(truth["a"][mark["name"]], abs=0.2)


def test_lines_name_every_mark_and_what_is_missing(scans, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    folder, _ = scans
    said = photoplan("fiducials", folder / "b.tif", "--camera", folder / "camera.toml")
    assert said.code == 0
    assert "3 of 4 marks" in said.out
    assert "negative" in said.out
    assert "no check: three marks" in said.out
    assert "not found near" in said.out
    assert "no redundancy" in said.err
    quiet = photoplan("fiducials", folder / "b.tif", "--camera", folder / "camera.toml", "-q")
    assert "nothing checks them" in quiet.err, "a doubt is printed with -q too"


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ("gone.tif", "there is no such file"),
        pytest.param("none.tif", "fiducial marks found", marks=pytest.mark.slow),
    ],
)
def test_an_image_that_fails_does_not_stop_the_others(scans, photoplan: Here, bad: str, reason: str) -> None:  # type: ignore[no-untyped-def]
    folder, _ = scans
    said = photoplan("fiducials", folder / bad, folder / "a.tif", "--camera", folder / "camera.toml", "--json")
    assert said.code == 4
    answer = json.loads(said.out)
    assert [i["image"] for i in answer["images"]] == ["a.tif"]
    assert [f["image"] for f in answer["failed"]] == [bad]
    assert "1 of 2 images failed" in said.err
    assert reason in said.err


@pytest.mark.drawn
def test_pictures_are_drawn_and_not_replaced(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    pytest.importorskip("matplotlib")
    folder, _ = scans
    words = ("fiducials", folder / "b.tif", "--camera", folder / "camera.toml", "--pictures", tmp_path / "new")
    said = photoplan(*words)
    assert said.code == 0, said.err
    picture = tmp_path / "new" / "b.fiducials.png"
    assert str(picture) in said.out
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert photoplan(*words).code == 2
    assert photoplan(*words, "--overwrite").code == 0


@pytest.mark.drawn
@pytest.mark.slow
def test_pictures_show_where_marks_were_sought_and_not_found(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    pytest.importorskip("matplotlib")
    folder, _ = scans
    said = photoplan("fiducials", folder / "none.tif", "--camera", folder / "camera.toml", "--pictures", tmp_path)
    assert said.code == 3
    picture = tmp_path / "none.fiducials.png"
    assert f"none.tif: where its marks were sought: {picture}" in said.err
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_missing_library_is_told_before_any_work(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    folder, _ = scans
    words = ("fiducials", folder / "none.tif", "--camera", folder / "camera.toml", "--pictures", tmp_path / "new")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib.figure", None)
        said = photoplan(*words)
    assert said.code == 2 and "a picture needs matplotlib; install it with: pip install 'photoplan[report]'" in said.err
    assert not (tmp_path / "new").exists()


def a_project(folder: Path, tmp_path: Path) -> Path:
    for name in ("a", "b"):
        (tmp_path / f"{name}.tif").symlink_to(folder / f"{name}.tif")
    path = tmp_path / "project.toml"
    path.write_text(PROJECT.format(camera=CAMERA))
    return path


def test_a_project_receives_the_marks_and_the_size(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    folder, truth = scans
    path = a_project(folder, tmp_path)
    before = path.read_text()
    dry = photoplan("fiducials", path, "--dry-run", "--json")
    assert dry.code == 0, dry.err
    assert path.read_text() == before
    said = photoplan("fiducials", path, "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["project"] == str(path)
    project = load_project(path)
    for name in ("a", "b"):
        image = project.image(name)
        assert image.size == (660, 660)
        assert image.fiducials is not None
        for mark, at in image.fiducials.items():
            assert at == pytest.approx(truth[name][mark], abs=0.15)
        fit = fiducial_fit(project.cameras["film"], image)  # type: ignore[arg-type]
        assert len(fit.names) == len(image.fiducials)
    assert set(project.image("b").fiducials or ()) == {"1", "3", "4"}
    assert project.image("digital").fiducials is None
    text = path.read_text()
    assert "# A comment that stays." in text
    record = recorded(path.with_name(f"{path.stem}.fiducials.run.json"), "fiducials", path)
    assert record["inputs"][0]["size"] == len(before.encode())  # the project as it was read
    assert "# one more" in text


def test_images_of_a_project_are_chosen(scans, tmp_path: Path, photoplan: Here) -> None:  # type: ignore[no-untyped-def]
    folder, _ = scans
    path = a_project(folder, tmp_path)
    assert photoplan("fiducials", path, "--images", "a", "-q").code == 0
    assert load_project(path).image("b").fiducials is None
    said = photoplan("fiducials", path, "--images", "digital")
    assert (said.code, "is digital" in said.err) == (2, True)


def test_a_mirrored_scan_does_not_enter_a_project_that_says_it_is_not(
    scans,
    tmp_path: Path,
    photoplan: Here,  # type: ignore[no-untyped-def]
) -> None:
    folder, _ = scans
    path = a_project(folder, tmp_path)
    said = photoplan("fiducials", path, "--images", "a", "--mirrored", "yes")
    assert said.code == 3
    assert "mirrored = false; correct that entry" in said.err
    assert load_project(path).image("a").fiducials is None


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (("{a}",), 2, "--camera FILE, which describes the fiducial marks, or a project file is required"),
        (("{a}", "{a}", "--camera", "{camera}"), 2, "is set twice"),
        (("{a}", "--camera", "{camera}", "--camera-name", "zeiss"), 2, "no film camera 'zeiss'"),
        (("{a}", "--camera", "{camera}", "--images", "a"), 2, "--images requires a project"),
        (("{a}", "--camera", "{camera}", "--scan-resolution", "fine"), 2, "scan resolution 'fine'"),
        (("{a}", "--camera", "{camera}", "--band", "4"), 3, "band 4; the file has 3"),
        (("{a}", "--camera", "{camera}", "--rotation", "45"), 2, "45"),
        (("{a}", "--camera", "{bare}"), 3, "look like is not described"),
        (("{project}", "--camera", "{camera}"), 2, "describes its cameras itself"),
    ],
)
def test_wrong_use_is_named(scans, tmp_path: Path, photoplan: Here, words, code, says) -> None:  # type: ignore[no-untyped-def]
    folder, _ = scans
    bare = tmp_path / "bare.toml"
    bare.write_text(CAMERA.replace(MARKS, ""))
    places = {"a": folder / "a.tif", "camera": folder / "camera.toml", "bare": bare, "project": tmp_path / "p.toml"}
    said = photoplan("fiducials", *(w.format(**places) for w in words))
    assert said.code == code
    assert says in said.err
