"""XML that is written: names and texts of any kind stay texts, in every writer."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from defusedxml import ElementTree
from tools.command import edit, inside
from tools.small_block import Block, write_block
from tools.small_model import write_small

import photoplan
from photoplan.plain import xml_quoted, xml_text

#: A name that is markup, with characters that XML cannot hold, and what it becomes in XML.
NASTY = "a<b>&amp;\"'--]]>\x01\x1b\ufffe é"
SHOWN = "a<b>&amp;\"'--]]>\ufffd\ufffd\ufffd é"
#: The same without what names of files cannot have on all systems.
FILE = "a&amp;'--é" if sys.platform == "win32" else "a<b>&amp;'--é"


def svg(folder: Path) -> tuple[Path, list[str], list[str]]:
    """Labels, and the name of the picture below."""
    block = write_block(folder)
    with rasterio.open(block.terrain) as file:
        x, y = file.xy(file.height // 2, file.width // 2)
    point = {"type": "Feature", "properties": {"name": NASTY}, "geometry": {"type": "Point", "coordinates": [x, y]}}
    spots = folder / "spots.geojson"
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}}
    spots.write_text(json.dumps({"type": "FeatureCollection", "features": [point], "crs": crs}))
    made = folder / "made.svg"
    words = ["--from", x - 40, y - 60, "--height", 60, "--look-at", x, y, "--size", 1200, 800, "--samples", 1]
    said = inside("view", block.terrain, *words, "--lines", f"{spots}@label=name", "--svg", made,
                  "-o", folder / f"{FILE}.png", "-q")  # fmt: skip
    assert said.code == 0, said.err
    root = ElementTree.fromstring(made.read_bytes())
    ns = {"s": "http://www.w3.org/2000/svg"}
    texts = [each.text for each in root.findall(".//s:text", ns)]
    return made, [*texts, *(each.get("href") for each in root.findall(".//s:image", ns))], [SHOWN, f"{FILE}.png"]


def stacked(folder: Path) -> tuple[Path, list[str], list[str]]:
    """Bands of a VRT by names of images."""
    block = named(folder)
    said = inside("ortho", block.project, "--resolution", 4, "--stack", FILE, "-q")
    assert said.code == 0, said.err
    (made,) = (folder / "products").glob("*.vrt")
    with rasterio.open(made) as file:
        assert any(each and "a<b>" in each for each in file.descriptions) and file.read(1).any()
    titles = [each.text for each in ElementTree.fromstring(made.read_bytes()).iter("Description")]
    return made, titles, [f"{SHOWN} 1"]


def sheets(folder: Path) -> tuple[Path, list[str], list[str]]:
    """Sheets of a VRT by the name of the mosaic."""
    block = named(folder)
    said = inside("mosaic", block.project, "--resolution", 4, "--sheets", 80, "--name", FILE, "-q")
    assert said.code == 0, said.err
    (made,) = (folder / "products").glob("*.vrt")
    names = [each.text for each in ElementTree.fromstring(made.read_bytes()).iter("SourceFilename")]
    assert all((made.parent / name).is_file() for name in names)
    return made, names, []


def metashape(folder: Path) -> tuple[Path, list[str], list[str]]:
    """Labels of images and sensors."""
    block = named(folder)
    made = folder / "cameras.xml"
    said = inside("convert", block.project, "--to", "metashape", "-o", made, "-q")
    assert said.code == 0, said.err
    root = ElementTree.fromstring(made.read_bytes())
    return made, [each.get("label") for each in (*root.iter("camera"), *root.iter("sensor"))], [SHOWN]


def landxml(folder: Path) -> tuple[Path, list[str], list[str]]:
    """The name of the surface is that of the file."""
    folder.mkdir(exist_ok=True)
    model = folder / f"{FILE}.gpkg"
    write_small(model)
    made = folder / f"{FILE}.xml"
    said = inside("dtm", "export", model, "-o", made, "-q")
    assert said.code == 0, said.err
    root = ElementTree.fromstring(made.read_bytes())
    return made, [each.get("name") for each in root.iter() if each.tag.endswith("Surface")], [FILE]


WRITERS: dict[str, Callable[[Path], tuple[Path, list[str], list[str]]]] = {
    "products/view/content.py": svg,
    "io/product.py": stacked,
    "io/product.py: sheets": sheets,
    "io/orientation/structure_from_motion.py": metashape,
    "io/terrain/model_write.py": landxml,
}


def named(folder: Path) -> Block:
    """A block whose first image has a nasty name."""
    block = write_block(folder)
    edit(block.project, 'name = "one"', f"name = {json.dumps(NASTY, ensure_ascii=True)}")
    return block


@pytest.mark.parametrize("writer", WRITERS)
def test_names_stay_texts(writer: str, tmp_path: Path) -> None:
    """What is written can be parsed, and holds the name as a text."""
    made, found, wanted = WRITERS[writer](tmp_path / "block")
    assert set(wanted) <= set(found), found
    assert made.stat().st_size > 0


def test_every_writer_of_xml_is_here() -> None:
    """Code with markup in formatted texts, but for the HTML of reports, whose tests are those of hostile folders."""
    top = Path(photoplan.__file__).parent
    found = set()
    for path in top.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            parts = (
                [part.value for part in node.values if isinstance(part, ast.Constant)]
                if isinstance(node, ast.JoinedStr)
                else []
            )
            if any("</" in str(part) or "/>" in str(part) for part in parts):
                found.add(path.relative_to(top).as_posix())
    assert {each for each in found if not each.startswith("report/")} == {each.partition(":")[0] for each in WRITERS}


def test_escaped_texts_are_read_back() -> None:
    allowed = "".join(map(chr, (*range(0x20, 0xD800), 0x10000, 0x10FFFF, 9, 10, 13)))
    root = ElementTree.fromstring(f"<a b={xml_quoted(allowed)}>{xml_text(allowed)}</a>".encode())
    assert root.text == allowed and root.get("b") == allowed
    refused = "".join(map(chr, (*range(9), 11, 12, *range(14, 32), 0xD800, 0xDFFF, 0xFFFE, 0xFFFF)))
    root = ElementTree.fromstring(f"<a b={xml_quoted(refused)}>{xml_text(refused)}</a>".encode())
    assert root.text == root.get("b") == "\ufffd" * len(refused)
    assert np.unique(list(root.text)).tolist() == ["\ufffd"]
