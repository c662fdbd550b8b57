"""Rational polynomials of an image of another size: refused with what would fit, or noted; crops are taken."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy
from tools.command import inside
from tools.rpc_files import as_text, tagged
from tools.rpc_images import functions

from photoplan.cameras.rpc import RationalFunctions
from photoplan.io.camera.satellite import read_rpc, rpc_in
from photoplan.products.describe import describe

FULL = (600, 400)


def of(
    size: tuple[int, int], span: tuple[int, int] | None = None, first: tuple[float, float] = (0, 0)
) -> RationalFunctions:
    """Smooth polynomials for a range of sample and line that begins at `first`."""
    full = functions()
    coefficients = full.coefficients.copy()
    coefficients[:, 4:] *= 0.1
    w, h = span or size
    offset = (first[0] + w / 2 - 0.5, first[1] + h / 2 - 0.5)
    return replace(full, coefficients=coefficients, image_scale=(w / 2, h / 2), image_offset=offset)


@pytest.mark.parametrize(
    ("size", "rpc", "kind"),
    [
        (FULL, of(FULL), "whole"),
        (FULL, of(FULL, (606, 402), (-3, -1)), "whole"),
        (FULL, of(FULL, (660, 440), (-30, -20)), "whole"),  # ranges with a margin
        ((150, 100), of(FULL), "scaled"),
        ((300, 200), of(FULL), "scaled"),
        ((582, 388), of(FULL), "scaled"),
        ((1200, 800), of(FULL), "scaled"),
        ((151, 101), of((601, 401)), "scaled"),
        ((150, 100), of(FULL, FULL, (-200, -150)), "part"),  # a crop whose polynomials count from its corner
        ((300, 400), of(FULL), "corner"),
        ((150, 200), of(FULL), "corner"),
        ((400, 600), of(FULL), "outside"),  # turned by 90°
        ((150, 100), of(FULL, FULL, (900, 0)), "outside"),
        ((600, 440), of(FULL), "beyond"),
    ],
)
def test_how_an_image_lies_in_the_range(size: tuple[int, int], rpc: RationalFunctions, kind: str) -> None:
    assert rpc.fit(size).kind == kind


def test_public_files_are_taken(shared: Path) -> None:
    """Crops of Pléiades with scales of their own, and a crop of QuickBird."""
    folder = shared / "data"
    for file, kind in (("pleiades_triplet_s2p/img_01.tif", "unknown"), ("ngi_dmc/rpc_qb2/qb2_basic1b.tif", "part")):
        found = rpc_in(folder / file)
        assert found is not None
        with rasterio.open(folder / file) as image:
            assert found.functions.fit((image.width, image.height)).kind == kind
    folder = shared / "data/pleiades_line_model"
    assert read_rpc(folder / "PHRDIMAP_P1BP--2018122638935449CP.XML").functions.fit((40000, 38247)).kind == "whole"


def test_a_scale_keeps_the_corners_of_pixels() -> None:
    full = of(FULL)
    ground = np.array([[16.35, 48.21, 320.0], [16.4, 48.17, 250.0]])
    np.testing.assert_allclose(full.scaled(0.25)(ground) + 0.5, 0.25 * (full(ground) + 0.5), atol=1e-9)


def project(folder: Path, size: tuple[int, int], *more: str, rpc: RationalFunctions | None = None) -> Path:
    about = {"driver": "GTiff", "width": size[0], "height": size[1], "count": 1, "dtype": "uint8"}
    with rasterio.open(folder / "a.tif", "w", **about) as file:
        file.write(np.random.default_rng(1).integers(50, 200, (1, size[1], size[0]), dtype=np.uint8))
    (folder / "a_RPC.TXT").write_text(as_text(rpc or of(FULL)))
    path = folder / "project.toml"
    path.write_text(
        'format = 1\ncrs = "EPSG:32633"\n[terrain]\nheight = 300.0\nheight_system = "ellipsoidal"\n[[images]]\n'
        'name = "a"\n'
        'file = "a.tif"\nrpc = "a_RPC.TXT"\n' + "\n".join(more) + "\n"
    )
    return path


def test_a_reduced_image_is_refused_until_its_scale_is_stated(tmp_path: Path) -> None:
    path = project(tmp_path, (150, 100))
    said = inside("check", path)
    assert said.code == 3
    assert "150 × 100 pixels, but the polynomials of a_RPC.TXT hold for 600 × 400" in said.err
    assert "set scale = 0.25" in said.err
    whole = inside("check", project(tmp_path, FULL), "--json")
    scaled = inside("check", project(tmp_path, (150, 100), "scale = 0.25"), "--json")
    corner = inside("check", project(tmp_path, (150, 100), "scale = 1"), "--json")
    assert [said.code for said in (whole, scaled, corner)] == [0, 0, 0]
    footprints = [np.array(json.loads(said.out)["images"][0]["footprint"]) for said in (whole, scaled)]
    np.testing.assert_allclose(*footprints, rtol=0.02)
    assert "scaled by 0.25" in scaled.out
    assert "from its first pixel on" not in scaled.out


def test_a_part_at_the_corner_is_noted_and_another_image_refused(tmp_path: Path) -> None:
    said = inside("check", project(tmp_path, (150, 200)))
    assert said.code == 0
    assert "hold for 600 × 400 from its first pixel on; if it was cut out elsewhere" in " ".join(
        (said.out + said.err).split()
    )
    said = inside("check", project(tmp_path, (400, 600)))
    assert (said.code, "much of the image lies outside" in said.err) == (3, True)
    said = inside("check", project(tmp_path, (150, 100), "shift = [-300.0, -200.0]"))
    assert said.code == 0


def test_init_warns_of_the_size_and_refuses_polynomials_that_disagree(tmp_path: Path) -> None:
    project(tmp_path, (150, 100))
    words = ("--images", tmp_path / "a.tif", "--height-system", "ellipsoidal", "--crs", "EPSG:32633")
    said = inside("init", tmp_path / "p", *words)
    assert said.code == 0
    assert "warning: a.tif: 150 × 100 pixels, but the polynomials" in said.err
    tagged(tmp_path / "a.tif", of(FULL), np.full((1, 400, 600), 7, np.uint8))
    assert inside("init", tmp_path / "q", *words).code == 0
    (tmp_path / "a_RPC.TXT").write_text(as_text(replace(of(FULL), ground_offset=(16.38, 48.2, 300.0))))
    said = inside("init", tmp_path / "r", *words)
    assert said.code == 3
    assert "its tags and a_RPC.TXT beside it state other polynomials" in said.err


def geom(rpc: RationalFunctions, form: str = "B", prefix: str = "") -> str:
    """A keyword list of OSSIM; terms in the order of RPC00A or RPC00B."""
    order = list(range(20))
    if form == "A":
        # RPC00A after STDI-0002: 1 L P H LP LH PH LPH L2 P2 H2 L3 L2P L2H LP2 P3 P2H LH2 PH2 H3.
        powers_b = "1 L P H LP LH PH LL PP HH LPH LLL LPP LHH LLP PPP PHH LLH PPH HHH"
        powers_a = "1 L P H LP LH PH LPH LL PP HH LLL LLP LLH LPP PPP PPH LHH PHH HHH"
        order = [powers_b.split().index(p) for p in powers_a.split()]
    lines = [f"{prefix}polynomial_format:  {form}", f"{prefix}type:  ossimRpcModel", "number_lines:  400"]
    names = ("samp", "line", "long", "lat", "height")
    for what, values in (
        ("off", (*rpc.image_offset, *rpc.ground_offset)),
        ("scale", (*rpc.image_scale, *rpc.ground_scale)),
    ):
        lines += [f"{prefix}{name}_{what}:  {value!r}" for name, value in zip(names, values)]
    for group, row in zip(("samp_num", "samp_den", "line_num", "line_den"), rpc.coefficients):
        lines += [f"{prefix}{group}_coeff_{k:02d}:  {float(row[b])!r}" for k, b in enumerate(order)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("form", "prefix"), [("B", ""), ("A", ""), ("B", "support_data.")])
def test_keyword_lists_of_ossim(tmp_path: Path, form: str, prefix: str) -> None:
    path = tmp_path / "a.geom"
    path.write_text(geom(of(FULL), form, prefix))
    np.testing.assert_array_equal(read_rpc(path).functions.coefficients, of(FULL).coefficients)
    assert read_rpc(path).functions.image_offset == of(FULL).image_offset
    assert "OSSIM" in str(describe(path))
    # By content: the suffix of a text does not matter.
    path.rename(tmp_path / "b.txt")
    np.testing.assert_array_equal(read_rpc(tmp_path / "b.txt").functions.coefficients, of(FULL).coefficients)


def test_keyword_lists_of_other_models_are_refused_for_what_they_are(tmp_path: Path) -> None:
    path = tmp_path / "a.geom"
    path.write_text("type:  ossimSpot5Model\nsensor:  HRG1\nnumber_lines:  6000\n")
    for words in (("info", path),):
        said = inside(*words)
        assert said.code == 3
        assert "a sensor model of ossimSpot5Model of OSSIM and no rational polynomials" in said.err
    path.write_text(geom(of(FULL)).replace("polynomial_format:  B", "polynomial_format:  C"))
    assert "it must be A or B" in inside("info", path).err


def test_nitf_images_bring_their_polynomials(tmp_path: Path) -> None:
    rpc, path = of(FULL), project(tmp_path, FULL)
    tagged(tmp_path / "t.tif", rpc, np.random.default_rng(2).integers(0, 255, (1, 400, 600), dtype=np.uint8))
    copy(tmp_path / "t.tif", tmp_path / "a.ntf", driver="NITF", RPC00B="YES")
    for beside in tmp_path.glob("a.ntf.*"):
        beside.unlink()
    found = rpc_in(tmp_path / "a.ntf")
    assert found is not None
    ground = np.array([[16.35, 48.21, 320.0]])
    np.testing.assert_allclose(found.functions(ground), rpc(ground), atol=0.6)  # RPC00B has few digits
    text = path.read_text().replace('"a.tif"', '"a.ntf"').replace('"a_RPC.TXT"', '"tags"')
    path.write_text(text)
    said = inside("ortho", path, "-o", tmp_path / "out", "--resolution", "100")
    assert said.code == 0, said.err
    assert "NITF" in inside("info", tmp_path / "a.ntf").out
