"""Rational polynomials from the files that satellite images are delivered with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.rpc_files import as_digitalglobe, as_dimap, as_rpb, as_text, tagged
from tools.rpc_images import functions

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError
from photoplan.io.camera.satellite import is_rpc, read_rpc, rpc_beside, rpc_in
from photoplan.io.raster_info import read_info
from photoplan.products.describe import describe

RPC = functions()
FORMS: dict[str, Callable[[RationalFunctions], str]] = {
    "scene_RPC.TXT": as_text,
    "scene.rpc": as_text,
    "scene.RPB": as_rpb,
    "scene.XML": as_digitalglobe,
    "RPC_scene.XML": as_dimap,
}


def equal(a: RationalFunctions, b: RationalFunctions, digits: float = 0.0) -> bool:
    numbers = [
        np.concatenate([f.image_offset, f.image_scale, f.ground_offset, f.ground_scale, f.coefficients.ravel()])
        for f in (a, b)
    ]
    return bool((np.abs(numbers[0] - numbers[1]) <= digits * np.abs(numbers[0])).all())


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return tagged(tmp_path / "IMG_scene_R1C1.TIF", RPC, np.zeros((1, 20, 30), np.uint8))


@pytest.mark.parametrize("name", FORMS)
def test_every_format_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FORMS[name](RPC))
    assert is_rpc(tmp_path / name)
    assert equal(read_rpc(tmp_path / name).functions, RPC, 1e-15)
    facts = describe(tmp_path / name)
    assert "RPC00B" in facts["rational polynomials"]
    assert "longitude 16.37" in facts["middle"]


def test_an_image_holds_its_own(image: Path) -> None:
    assert equal(read_rpc(image).functions, RPC, 1e-14)
    assert "tags" in describe(image)["rational polynomials"]


@pytest.mark.parametrize("name", ["scene_RPC.TXT", "scene.RPB"])
def test_gdal_reads_the_same_from_files_beside_the_image(tmp_path: Path, name: str) -> None:
    image = tmp_path / "scene.tif"
    with rasterio.open(image, "w", driver="GTiff", width=30, height=20, count=1, dtype="uint8"):
        pass
    (tmp_path / name).write_text(FORMS[name](RPC))
    with rasterio.open(image) as file:
        theirs = file.rpcs
    mine = read_rpc(tmp_path / name).functions
    assert mine.image_offset == pytest.approx((theirs.samp_off, theirs.line_off), abs=1e-9)
    assert mine.coefficients[2] == pytest.approx(theirs.line_num_coeff, rel=1e-12)
    assert rpc_in(image) is None
    assert rpc_beside(image) == [tmp_path / name]
    assert name in describe(image)["rational polynomials"]


def test_rows_and_columns_of_dimap_begin_with_one(tmp_path: Path) -> None:
    (tmp_path / "RPC_a.XML").write_text(as_dimap(RPC, 1))
    (tmp_path / "RPC_b.XML").write_text(as_dimap(RPC, 0))
    for name in ("RPC_a.XML", "RPC_b.XML"):
        assert read_rpc(tmp_path / name).functions.image_offset == pytest.approx(RPC.image_offset, abs=1e-12)
    plain = as_dimap(RPC, 0).replace("<FIRST_ROW>0", "<FIRST_ROW>1").replace("<FIRST_COL>0", "<FIRST_COL>1")
    (tmp_path / "RPC_c.XML").write_text(plain)
    assert read_rpc(tmp_path / "RPC_c.XML").functions.image_offset == pytest.approx(
        (RPC.image_offset[0] - 1, RPC.image_offset[1] - 1)
    )


def test_pleiades_neo_names_what_models_do_and_counts_from_zero(tmp_path: Path) -> None:
    text = as_dimap(RPC, 0)
    for old, new in (("Inverse_Model", "GroundtoImage_Values"), ("Direct_Model_V", "ImagetoGround_V")):
        assert f"<{old}" in text
        text = text.replace(old, new)
    (tmp_path / "RPC_PNEO.XML").write_text(text)
    assert equal(read_rpc(tmp_path / "RPC_PNEO.XML").functions, RPC, 1e-12)


def test_a_delivery_of_pleiades_is_found_by_its_name(image: Path) -> None:
    assert rpc_beside(image) == []
    (image.parent / "RPC_scene.XML").write_text(as_dimap(RPC))
    assert rpc_beside(image) == [image.parent / "RPC_scene.XML"]


def changed(name: str, old: str, new: str) -> str:
    text = FORMS[name](RPC)
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("scene_RPC.TXT", changed("scene_RPC.TXT", "SAMP_DEN_COEFF_7:", "X:"), "SAMP_DEN_COEFF: 19 values"),
        ("scene_RPC.TXT", changed("scene_RPC.TXT", "LINE_OFF:", "LINE_OFF: 5\nLINE_OFF:"), "LINE_OFF is given twice"),
        ("scene_RPC.TXT", changed("scene_RPC.TXT", "LAT_SCALE: 0.1", "LAT_SCALE: 0"), "scales .* none of them is 0"),
        ("scene_RPC.TXT", changed("scene_RPC.TXT", "HEIGHT_OFF: 300.0", "HEIGHT_OFF: nan"), "HEIGHT_OFF: .*finite"),
        ("scene_RPC.TXT", changed("scene_RPC.TXT", "LINE_OFF: 2199.5", "LINE_OFF: x"), "LINE_OFF: 'x' given"),
        ("scene_RPC.TXT", "nothing of it", "LINE_OFF"),
        ("scene.RPB", changed("scene.RPB", "lineNumCoef = (", "lineNumCoef = ( 1,"), "LINE_NUM_COEFF: 21 values"),
        ("scene.RPB", changed("scene.RPB", "longScale", "longScala"), "LONG_SCALE missing"),
        ("scene.XML", changed("scene.XML", "<SAMPOFFSET>1499.5", "<SAMPOFFSET>1e999"), "SAMP_OFF: .*finite"),
        ("scene.XML", "<a><b/></a>", "<a> without rational polynomials"),
        ("scene.XML", "<!DOCTYPE a [<!ENTITY b 'c'>]><isd>&b;</isd>", "document type or entities"),
        ("RPC_scene.XML", "<D><Global_RFM/></D>", "no Inverse_Model"),
        (
            "RPC_scene.XML",
            changed("RPC_scene.XML", "LINE_DEN_COEFF_20>", "Z>").replace("/LINE_DEN_COEFF_20", "/Z"),
            "19",
        ),
    ],
)
def test_fault_10_18_wrong_numbers_are_named(tmp_path: Path, name: str, text: str, told: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=told) as error:
        read_rpc(tmp_path / name)
    assert name in str(error.value)


def test_information_of_another_document_says_what_it_is_without(tmp_path: Path) -> None:
    """The general metadata of EnMAP, or of SPOT 5, are no virtual raster."""
    (tmp_path / "a.xml").write_text("<level_X><a/></level_X>")
    with pytest.raises(InputError, match="<level_X> without rational polynomials"):
        describe(tmp_path / "a.xml")


def test_an_image_without_them_says_what_may_be_given(tmp_path: Path) -> None:
    image = tmp_path / "plain.tif"
    with rasterio.open(image, "w", driver="GTiff", width=30, height=20, count=1, dtype="uint8"):
        pass
    with pytest.raises(InputError, match=r"holds no rational polynomials.*\.rpb"):
        read_rpc(image)


def test_fault_18_a_damaged_file_beside_an_image_is_named(tmp_path: Path) -> None:
    """GDAL reads `NAME_RPC.TXT` of its own accord, and complains when something else is asked."""
    image = tmp_path / "scene.tif"
    with rasterio.open(image, "w", driver="GTiff", width=30, height=20, count=1, dtype="uint8"):
        pass
    (tmp_path / "scene_RPC.TXT").write_text(changed("scene_RPC.TXT", "LAT_SCALE", "LATSCALE"))
    with pytest.raises(InputError, match=r"scene\.tif: .*scene_RPC\.TXT .*missing LAT_SCALE.*mend or remove"):
        read_info(image)
