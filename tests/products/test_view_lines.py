"""Lines and labels over views: files, styles, contours, SVG, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from tools.command import inside
from tools.small_block import X0, Y0, Block, write_block

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.products.run import Run
from photoplan.products.view.content import Letters, Overlay, dashed, placed
from photoplan.products.view.make import ViewResult, draw, make_view, plan_view
from photoplan.requests.view import CameraRequest, ContentRequest, LinesRequest, LookRequest, ViewRequest

STAND = CameraRequest(position=(X0 - 80, Y0 - 60), height=40.0, look_at=(X0 + 20, Y0 + 10), size=(240, 160))
LOOK = LookRequest((ContentRequest("shade"),), samples=1)
CRS = "EPSG:32633"


def block_letters(text: str) -> Letters:
    return Letters(np.ones((6, 3 * len(text)), np.float32), 5.0)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Block:
    return write_block(tmp_path_factory.mktemp("lines") / "block")


@pytest.fixture(scope="module")
def ways(small: Block, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two lines with styles of their own, and points with names."""
    path = tmp_path_factory.mktemp("ways") / "ways.gpkg"
    east = np.linspace(-70, 90, 5)
    two = [shapely.LineString(np.column_stack([X0 + east, np.full(5, Y0 + shift)])) for shift in (0.0, 20.0)]
    columns = {"colour": np.array(["#ff0000", None], object), "thick": np.array([2.0, 4.0])}
    write(path, "ways", "LineString", two, columns)
    spots = [shapely.Point(X0 + x, Y0 + y) for x, y in ((0, 0), (20, -8), (30, 10), (-2000, 0))]
    write(path, "spots", "Point", spots, {"name": np.array(["a & <b>", "near", "third", "far"], object)})
    return path


def write(path: Path, layer: str, kind: str, shapes: list, columns: dict, crs: str = CRS) -> None:
    pyogrio.raw.write(
        str(path), shapely.to_wkb(shapes), list(columns.values()), list(columns), layer=layer, geometry_type=kind,
        crs=crs, append=path.exists(), driver="GPKG" if path.suffix == ".gpkg" else "GeoJSON",
    )  # fmt: skip


def drawn(small: Block, *texts: str) -> Overlay:
    lines = tuple(map(LinesRequest.parse, texts))
    plan = plan_view(ViewRequest(small.terrain, STAND, look=LOOK, lines=lines, lettering=block_letters))
    overlay = draw(plan, plan.camera)
    assert overlay is not None
    return overlay


def made(small: Block, out: Path, *texts: str, **more: object) -> tuple[ViewResult, np.ndarray]:
    lines = tuple(map(LinesRequest.parse, texts))
    request = ViewRequest(small.terrain, STAND, output=out, look=LOOK, lines=lines, lettering=block_letters, **more)
    result = make_view(plan_view(request), Run(overwrite=True))
    with rasterio.open(out) as file:
        return result, file.read().astype(int)


def test_lines_are_drawn_in_the_style_of_the_option_or_of_an_attribute(small: Block, ways: Path) -> None:
    first, second = (stroke.style for stroke in drawn(small, f"{ways}:ways@width=thick").layers)
    assert (first.colour, first.width, second.colour, second.width) == ((255, 0, 0), 2.0, (213, 94, 0), 4.0)
    (only,) = (s.style for s in drawn(small, f"{ways}:ways@colour=#010203,width=3,dash=6-3").layers)
    assert (only.colour, only.width, only.dash) == ((1, 2, 3), 3.0, (6.0, 3.0))


def test_pixels_beside_lines_stay_as_they_are_and_tiles_make_no_difference(small: Block, ways: Path, tmp_path) -> None:
    _, plain = made(small, tmp_path / "a.png")
    result, picture = made(
        small, tmp_path / "b.png", f"{ways}:ways@colour=#ff00ff", f"{ways}:spots@label=name", svg=tmp_path / "b.svg"
    )
    changed = (plain != picture).any(axis=0)
    assert 300 < changed.sum() < 0.3 * changed.size
    assert ((picture[0] == 255) & (picture[1] == 0) & (picture[2] == 255)).sum() > 20
    overlay = drawn(small, f"{ways}:ways@colour=#ff00ff", f"{ways}:spots@label=name")
    whole, parts = plain.astype(np.uint8), plain.astype(np.uint8)
    overlay.paint(whole, Window(0, 0, 240, 160))
    for part in Window(0, 0, 240, 160).tiles(71):
        overlay.paint(parts[:, *part.slices(Window(0, 0, 240, 160))], part)
    np.testing.assert_array_equal(whole, parts)
    np.testing.assert_array_equal(whole, picture)
    record = json.loads((tmp_path / "b.run.json").read_text())
    assert record["product"]["drawn"] == {"features": 6, "seen": 5, "labels": 3, "unplaced": 0}
    assert any(Path(each["path"]).name == "ways.gpkg" for each in record["inputs"]) and result.drawn is not None


def test_the_svg_holds_the_same_lines_and_texts_over_the_picture(small: Block, ways: Path, tmp_path: Path) -> None:
    made(small, tmp_path / "c.png", f"{ways}:ways@dash=5-2", f"{ways}:spots@label=name,distance=yes",
         svg=tmp_path / "c.svg")  # fmt: skip
    root = ElementTree.parse(tmp_path / "c.svg").getroot()
    ns = {"s": "http://www.w3.org/2000/svg"}
    assert root.get("width") == "240" and root.find("s:image", ns).get("href") == "c.png"
    texts = [each.text for each in root.findall(".//s:text", ns)]
    assert len(texts) == 3 and any(re.fullmatch(r"a & <b> · \d+ m", text) for text in texts)
    overlay = drawn(small, f"{ways}:ways@dash=5-2", f"{ways}:spots@label=name,distance=yes")
    paths = root.findall(".//s:path", ns)
    assert len(paths) == sum(len(stroke.pieces) for stroke in overlay.layers)
    assert root.findall("s:g", ns)[0].get("stroke-dasharray") == "5 2"


def test_contours_are_drawn_where_the_ground_has_their_height(small: Block) -> None:
    overlay = drawn(small, "contours:5")
    plan = plan_view(ViewRequest(small.terrain, STAND))
    seen = plan.address.open().surface.at(
        plan.camera.target, np.concatenate([p for s in overlay.layers for p in s.pieces])
    )
    H = seen.XYZ[seen.owner >= 0, 2]
    # A vertex is good to a few hundredths of a pixel, which on a slope that is seen from its edge is much in height.
    assert len(H) > 100 and np.median(np.abs(H / 5 - np.rint(H / 5))) < 0.01


def test_labels_keep_away_from_each_other_and_from_marks() -> None:
    rng = np.random.default_rng(4)
    at = rng.uniform((20, 60), (380, 200), (40, 2))
    labels, leaders = placed([("abcdef", xy) for xy in at], at, block_letters, (400, 200))
    boxes = np.array([(a.column, a.row, a.column + 18, a.row + 6) for a in labels])
    assert 10 < len(labels) < 40 and len(leaders) == len(labels)
    for i, (left, top, right, bottom) in enumerate(boxes):
        assert left >= 0 and top >= 0 and right <= 400
        others = np.delete(boxes, i, axis=0)
        assert not (
            (others[:, 0] < right) & (others[:, 2] > left) & (others[:, 1] < bottom) & (others[:, 3] > top)
        ).any()
        assert not ((at > (left, top)) & (at < (right, bottom))).all(axis=1).any()
        for leader in leaders:
            assert not (left < leader[0, 0] < right and leader[0, 1] < bottom and leader[1, 1] > top)


def test_dashes_have_their_lengths_round_corners() -> None:
    corner = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)])
    cut = dashed(corner, (6.0, 3.0))
    lengths = [np.hypot(*np.diff(each, axis=0).T).sum() for each in cut]
    assert lengths == pytest.approx([6, 6, 2]) and cut[1].tolist() == [[9, 0], [10, 0], [10, 5]]


def test_geojson_is_wgs_84_and_what_states_no_crs_is_not_guessed(small: Block, ways: Path, tmp_path: Path) -> None:
    from photoplan.geometry.crs import crs_step

    lon, lat = crs_step(CRS, "EPSG:4326", (X0 - 10, Y0 - 10, X0 + 10, Y0 + 10))(np.array([X0, Y0]))
    path, local = tmp_path / "p.geojson", tmp_path / "q.geojson"
    for file, at in ((path, (lon, lat)), (local, (X0, Y0))):
        feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": at}}
        file.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    here, there = (drawn(small, text).layers[0].pieces[0] for text in (str(path), f"{local}@crs={CRS}"))
    np.testing.assert_allclose(here, there, atol=0.01)
    with pytest.raises(InputError, match="states no CRS"):
        drawn(small, str(local))


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ("@colour=pinkish", InputError, "allowed are #rrggbb"),
        ("@width=1e9", InputError, "0.1 to 200"),
        ("@dash=3", InputError, "strokes and gaps"),
        ("@label=nobody", InputError, "no such attribute"),
        ("@shade=3", UsageError, "must be KEY=VALUE"),
        ("@width=nan", InputError, "0.1 to 200"),
    ],
)
def test_what_cannot_be_drawn_is_said(small: Block, ways: Path, options: str, error: type, said: str) -> None:
    with pytest.raises(error, match=said):
        drawn(small, f"{ways}:spots{options}")


def test_files_that_cannot_be_used_are_said(small: Block, ways: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="its layers are ways, spots"):
        drawn(small, str(ways))
    with pytest.raises(UsageError, match="no such file"):
        LinesRequest.parse("nothing.gpkg")
    with pytest.raises(UsageError, match="`svg` requires `lines`"):
        ViewRequest(small.terrain, STAND, svg=tmp_path / "a.svg")
    svg = tmp_path / "x.svg"
    svg.touch()
    with pytest.raises(UsageError, match=r"x.svg: exists already"):
        made_once(small, tmp_path / "x.png", svg, f"{ways}:ways")


def made_once(small: Block, out: Path, svg: Path, text: str) -> None:
    lines = (LinesRequest.parse(text),)
    make_view(plan_view(ViewRequest(small.terrain, STAND, output=out, look=LOOK, lines=lines, svg=svg)), Run())


def test_the_command_draws_labels_with_real_letters(small: Block, ways: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    words = f"--from {X0 - 80} {Y0 - 60} --height 40 --look-at {X0 + 20} {Y0 + 10} --size 400 260 --samples 1".split()
    lines = ["--lines", f"{ways}:spots@label=name,height=yes", "--text-size", 9, "--svg", tmp_path / "d.svg"]
    said = inside("view", small.terrain, *words, *lines, "-o", tmp_path / "d.png", "--json")
    assert said.code == 0 and json.loads(said.out)["drawn"]["labels"] == 3
    texts = re.findall(r"<text[^>]*>([^<]*)<", (tmp_path / "d.svg").read_text())
    assert any(re.fullmatch(r"third \d+ m", text) for text in texts)
    with rasterio.open(tmp_path / "d.png") as file:
        dark = (file.read().max(axis=0) < 40).sum()
    assert dark > 40
