"""Series files: patterns of names, tables, times, regions, and what is refused with the entry."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from tools.camera_model import write_frame

from photoplan.errors import InputError
from photoplan.io.series import (
    Plane,
    StatisticsEntry,
    find_files,
    plane_mask,
    plane_pixels,
    read_series,
    read_statistics,
    series_planes,
)

PIXELS = np.arange(48, dtype=np.uint8).reshape(6, 8)


def series(folder: Path, text: str):
    file = folder / "series.toml"
    file.write_text(text, "utf-8")
    return read_series(file)


def refused(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as error:
        series(folder, text)
    return str(error.value)


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    for name in (
        "d1_500nm_25ms_a.tif",
        "d1_500nm_2.5ms_b.tif",
        "d1_600nm_100ms_c.tif",
        "dark_100ms_2019-02-08-171146.tif",
    ):
        write_frame(tmp_path / "in" / name, PIXELS)
    return tmp_path


def test_values_come_from_the_name(frames: Path):
    found = series(frames, '[[frames]]\nkind = "scene"\nfiles = "in/d1_{wavelength}nm_{exposure}ms_*.tif"\n')
    assert [(f.wavelength_nm, f.exposure_ms) for f in found.frames] == [(500, 2.5), (500, 25), (600, 100)]
    assert found.size == (8, 6) and found.dtype == "uint8" and found.saturation_dn == 255


def test_units_and_times_in_names(frames: Path):
    write_frame(frames / "x_1500us.tif", PIXELS)
    patterns = '["in/dark_{exposure}ms_{time:%Y-%m-%d-%H%M%S}.tif", "x_{exposure_us}us.tif"]'
    text = f'[[frames]]\nkind = "dark"\nfiles = {patterns}\n'
    first, second = series(frames, text).frames
    assert first.time_s == 1549645906  # 2019-02-08 17:11:46 UTC
    assert second.exposure_ms == 1.5


def test_time_in_a_name_ends_where_its_form_ends(frames: Path):
    write_frame(frames / "x_25ms_2019-02-08-171146-0003.tif", PIXELS)
    text = '[[frames]]\nkind = "dark"\nfiles = "x_{exposure}ms_{time:%Y-%m-%d-%H%M%S}-*.tif"\n'
    (frame,) = series(frames, text).frames
    assert (frame.time_s, frame.exposure_ms) == (1549645906, 25)


def test_name_counts_before_entry_and_table_before_name(frames: Path):
    (frames / "values.csv").write_text(
        "file;exposure_ms;temperature_c;lamp\nd1_600nm_100ms_c.tif;99,5;20,5;A\n", "utf-8"
    )
    text = '[[frames]]\nkind = "scene"\nexposure_ms = 1.0\nwavelength_nm = 400.0\ntable = "values.csv"\n'
    (frame,) = series(frames, text + 'files = "in/d1_{wavelength}nm_100ms_c.tif"\n').frames
    assert (frame.exposure_ms, frame.wavelength_nm, frame.temperature_c) == (99.5, 600, 20.5)
    assert frame.values == {"lamp": "A"}


def test_iso_date_and_seconds(frames: Path):
    entry = '[[frames]]\nkind = "drift"\nfiles = "in/d1_500nm_25ms_a.tif"\ntime_s = '
    assert series(frames, entry + '"1970-01-01T01:00:00"\n').frames[0].time_s == 3600
    assert series(frames, entry + "12.5\n").frames[0].time_s == 12.5
    assert "no-date" in refused(frames, entry + '"no-date"\n')


def test_photons_from_irradiance(frames: Path):
    text = (
        '[camera]\npixel_size_um = 5.0\n[[frames]]\nkind = "flat"\nfiles = "in/d1_500nm_25ms_a.tif"\n'
        "wavelength_nm = 500.0\nexposure_ms = 10.0\nirradiance_uw_cm2 = 1.0\n"
    )
    # EMVA 1288: 50.34 · A [µm²] · t [ms] · λ [µm] · E [µW/cm²] photons.
    assert series(frames, text).frames[0].photons_per_pixel == pytest.approx(50.34 * 25 * 10 * 0.5 * 1, rel=1e-4)


def test_roi_and_mask(frames: Path):
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4, 2:4] = 255
    write_frame(frames / "mask.tif", mask)
    text = '[[frames]]\nkind = "scene"\nfiles = "in/d1_500nm_25ms_a.tif"\nroi = [1, 2, 4, 3]\nmask = "mask.tif"\n'
    found = series(frames, text)
    (plane,) = series_planes(found)
    assert (plane_pixels(found.frames[0], plane) == PIXELS[2:5, 1:5]).all()
    counts = plane_mask(found.frames[0].group, plane)
    assert counts is not None and counts.sum() == 4
    assert plane.to_image(found.frames[0].group.window, 1, 0) == (2, 2)


def test_planes_of_a_bayer_pattern_are_the_same_colours_in_any_roi(frames: Path):
    colours = np.array([["R", "G1"], ["G2", "B"]])
    for roi in ("[0, 0, 8, 6]", "[1, 0, 6, 6]", "[0, 1, 6, 4]", "[3, 1, 4, 4]"):
        text = f'[camera]\nbayer = "RGGB"\n[[frames]]\nkind = "scene"\nfiles = "in/d1_500nm_25ms_a.tif"\nroi = {roi}\n'
        found = series(frames, text)
        for plane in series_planes(found):
            pixels = plane_pixels(found.frames[0], plane)
            rows, cols = np.divmod(pixels, 8)
            assert set(colours[rows % 2, cols % 2].ravel()) == {plane.name}
            window = found.frames[0].group.window
            x, y = plane.to_image(window, 1, 1)
            assert pixels[1, 1] == PIXELS[int(y), int(x)]


def test_other_bayer_patterns():
    for pattern, place in (("BGGR", (1, 1)), ("GRBG", (0, 1)), ("GBRG", (1, 0))):
        camera = type("C", (), {"bayer": pattern})
        planes = series_planes(type("S", (), {"camera": camera, "bands": 1})())
        assert {p.name: (p.row, p.col) for p in planes}["R"] == place
        assert [p.name for p in planes] == ["R", "G1", "G2", "B"]


def test_bands_are_planes_and_bayer_bands_are_refused(frames: Path):
    write_frame(frames / "rgb.tif", np.stack([PIXELS, PIXELS + 1, PIXELS + 2]))
    text = '[[frames]]\nkind = "scene"\nfiles = "rgb.tif"\n'
    found = series(frames, text)
    assert [p.name for p in series_planes(found)] == ["band 1", "band 2", "band 3"]
    assert (plane_pixels(found.frames[0], Plane("band 3", 2)) == PIXELS + 2).all()
    with pytest.raises(InputError, match="3 bands"):
        series_planes(series(frames, '[camera]\nbayer = "RGGB"\n' + text))


ONE = '[[frames]]\nkind = "scene"\nfiles = "in/d1_500nm_25ms_a.tif"\n'
REFUSED = {
    "no frames": ("[camera]\nbits = 8\n", "holds no [[frames]]"),
    "pattern without files": ('[[frames]]\nkind = "dark"\nfiles = "in/nothing_*.tif"\n', "match nothing"),
    "missing file": ('[[frames]]\nkind = "dark"\nfiles = "in/nothing.tif"\n', "match nothing"),
    "missing folder": ('[[frames]]\nkind = "dark"\nfiles = "out/*.tif"\n', "no folder"),
    "unknown kind": (ONE.replace("scene", "picture"), "allowed are dark"),
    "unknown entry": (ONE + "exposre_ms = 2.0\n", "unknown entry"),
    "number as text": (ONE + 'exposure_ms = "2"\n', "exposure_ms"),
    "negative exposure": (ONE + "exposure_ms = -2.0\n", "exposure_ms"),
    "not a number": (ONE + "temperature_c = nan\n", "temperature_c"),
    "roi outside": (ONE + "roi = [4, 4, 5, 1]\n", "leaves the image"),
    "field twice": ('[[frames]]\nkind = "dark"\nfiles = "in/{exposure}_{exposure}.tif"\n', "stands twice"),
    "field in folder": ('[[frames]]\nkind = "dark"\nfiles = "{exposure}/a.tif"\n', "last part"),
    "steps of a scene": (ONE + "steps = [{ density = 0.1, roi = [0, 0, 2, 2] }]\n", "belong to kind wedge"),
    "brightest exposure alone": (ONE + "brightest_exposure_ms = 2.0\n", "needs brightest"),
    "time twice": (ONE + 'time_s = 1.0\ntime_from = "exif"\n', "either time_s or time_from"),
    "no EXIF time": (ONE + 'time_from = "exif"\n', "no time in EXIF"),
    "file twice": (ONE + ONE, "both take d1_500nm_25ms_a.tif"),
    "virtual path": ('[[frames]]\nkind = "dark"\nfiles = "/vsicurl/http://x/a.tif"\n', "virtual file systems"),
    "address": ('[[frames]]\nkind = "dark"\nfiles = "https://x/a_*.tif"\n', "addresses"),
    "absurd pattern": (f'[[frames]]\nkind = "dark"\nfiles = "{"*a" * 20}"\n', "4 stars"),
    "not TOML": ("[[frames]\n", "not valid TOML"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_the_entry(frames: Path, case: str):
    text, words = REFUSED[case]
    message = refused(frames, text)
    assert words in message
    assert "series.toml" in message or "input" in message


@pytest.mark.parametrize(
    ("what", "pixels"),
    [
        ("size", PIXELS[:4]),
        ("type of pixels", PIXELS.astype(np.uint16)),
        ("number of bands", np.stack([PIXELS, PIXELS, PIXELS])),
    ],
)
def test_frames_that_differ_are_named(frames: Path, what: str, pixels: np.ndarray):
    write_frame(frames / "other.tif", pixels)
    message = refused(frames, ONE + '[[frames]]\nkind = "dark"\nfiles = "other.tif"\n')
    assert what in message and "other.tif" in message and "frames[2]" in message


def test_mask_of_another_size_or_without_pixels(frames: Path):
    write_frame(frames / "mask.tif", PIXELS[:4])
    assert "mask mask.tif has size" in refused(frames, ONE + 'mask = "mask.tif"\n')
    write_frame(frames / "mask.tif", np.zeros((6, 8), np.uint8))
    found = series(frames, ONE + 'mask = "mask.tif"\n')
    with pytest.raises(InputError, match="leaves no pixel"):
        plane_mask(found.frames[0].group, Plane("", 0))


def test_fault_24_float_with_nan_and_one_bit_are_refused_by_name(frames: Path):
    values = PIXELS.astype(np.float32)
    values[2, 3] = np.nan
    write_frame(frames / "float.tif", values)
    found = series(frames, '[[frames]]\nkind = "scene"\nfiles = "float.tif"\n')
    assert found.saturation_dn == np.inf
    with pytest.raises(InputError, match="without a value"):
        plane_pixels(found.frames[0], Plane("", 0))
    write_frame(frames / "double.tif", PIXELS.astype(np.float64))
    assert "float64" in refused(frames, '[[frames]]\nkind = "scene"\nfiles = "double.tif"\n')


def test_fault_24_twelve_and_sixteen_bits(frames: Path):
    write_frame(frames / "s.tif", PIXELS.astype(np.uint16) * 80)
    entry = '[[frames]]\nkind = "scene"\nfiles = "s.tif"\n'
    assert series(frames, entry).saturation_dn == 65535
    assert series(frames, "[camera]\nbits = 12\n" + entry).saturation_dn == 4095
    assert series(frames, "[camera]\nbits = 12\nsaturation_dn = 4000.0\n" + entry).saturation_dn == 4000


def test_fault_08_damaged_frames_are_named(frames: Path):
    file = frames / "in" / "d1_500nm_25ms_a.tif"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) - 30])
    with pytest.raises(InputError, match="d1_500nm_25ms_a"):
        plane_pixels(series(frames, ONE).frames[0], Plane("", 0))
    file.write_bytes(b"")
    assert "d1_500nm_25ms_a" in refused(frames, ONE)
    file.write_text("<VRTDataset/>")
    assert "d1_500nm_25ms_a" in refused(frames, ONE)


TABLES = {
    "header only": ("file,exposure_ms\n", "no line"),
    "no file column": ("name,exposure_ms\na.tif,1\n", "must be called file"),
    "not a number": ("file,exposure_ms\nd1_500nm_25ms_a.tif,nan\n", ":2: exposure_ms"),
    "decimal comma": ("file,exposure_ms\nd1_500nm_25ms_a.tif,1,5\n", "decimal commas"),
    "ragged": ("file,exposure_ms\nd1_500nm_25ms_a.tif\n", ":2: 1 columns"),
    "twice": ("file,exposure_ms\nd1_500nm_25ms_a.tif,1\nd1_500nm_25ms_a.tif,2\n", ":3: file"),
    "column twice": ("file,exposure_ms,exposure_ms\nd1_500nm_25ms_a.tif,1,2\n", "stands twice"),
    "no line for a frame": ("file,exposure_ms\nb.tif,1\n", "no line for d1_500nm_25ms_a.tif"),
    "negative": ("file,exposure_ms\nd1_500nm_25ms_a.tif,-1\n", "must not be negative"),
}


@pytest.mark.parametrize("case", TABLES)
def test_fault_18_tables_of_conditions(frames: Path, case: str):
    text, words = TABLES[case]
    (frames / "t.csv").write_text(text, "utf-8")
    assert words in refused(frames, ONE + 'table = "t.csv"\n')


def test_fault_18_table_with_byte_order_mark_and_crlf(frames: Path):
    (frames / "t.csv").write_bytes(b"\xef\xbb\xbffile;exposure_ms\r\nd1_500nm_25ms_a.tif;1,5\r\n")
    assert series(frames, ONE + 'table = "t.csv"\n').frames[0].exposure_ms == 1.5


STATISTICS = {
    "kind": ("kind,mean,variance\nbias,1,1\n", ":2: kind"),
    "column": ("kind,mean\nflat,1\n", "variance needed"),
    "number": ("kind,mean,variance\nflat,1,x\n", ":2: variance"),
    "negative": ("kind,mean,variance\nflat,1,-1\n", "not negative"),
    "empty": ("kind,mean,variance\nflat,,1\n", "mean or variance is empty"),
}


@pytest.mark.parametrize("case", STATISTICS)
def test_fault_18_reduced_figures(tmp_path: Path, case: str):
    text, words = STATISTICS[case]
    (tmp_path / "s.csv").write_text(text, "utf-8")
    with pytest.raises(InputError, match=words):
        read_statistics(tmp_path / "s.csv", StatisticsEntry(file="s.csv", pixels=100))


def test_reduced_figures_of_a_table(tmp_path: Path):
    text = "kind,exposure_ms,photons,mean,variance,pixels\nflat,2,100,50,5,10000\ndark,2,,10,1,10000\n"
    (tmp_path / "s.csv").write_text(text, "utf-8")
    flat, dark = read_statistics(tmp_path / "s.csv", StatisticsEntry(file="s.csv"))
    assert (flat.kind, flat.photons_per_pixel, flat.mean, flat.pixels) == ("flat", 100, 50, 10000)
    assert dark.photons_per_pixel is None and dark.frames == 2
    (tmp_path / "s.csv").write_text("kind,mean,variance\nflat,1,1\n", "utf-8")
    with pytest.raises(InputError, match="number of pixels"):
        read_statistics(tmp_path / "s.csv", StatisticsEntry(file="s.csv"))


def test_dictionary_of_another_kind_is_refused(tmp_path: Path):
    entry = StatisticsEntry(file="d.txt", format="emva1288")
    for text in (
        "{}",
        "{'temporal': __import__('os')}",
        "{'temporal': {'bright': {1: {2: 3}}}, 'width': 2, 'height': 2}",
    ):
        (tmp_path / "d.txt").write_text(text)
        with pytest.raises(InputError):
            read_statistics(tmp_path / "d.txt", entry)


def test_patterns_do_not_leave_plain_files(tmp_path: Path):
    (tmp_path / "a.tif").mkdir()
    os.mkfifo(tmp_path / "b.tif")
    assert find_files(tmp_path, "*.tif", "here") == {}


def test_every_entry_is_explained_on_the_reference_page():
    from photoplan.io.series import FIELDS, KINDS, SeriesEntry

    schema = SeriesEntry.model_json_schema()
    entries = {name for table in schema["$defs"].values() for name in table.get("properties", {})}
    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "characterise.md").read_text("utf-8")
    in_braces = {"density", "roi", "direction", "bright"}
    assert not {e for e in entries if f"`{e}`" not in page and not (e in in_braces and f"{e} = " in page)}
    assert not {kind for kind in KINDS if f"`{kind}`" not in page}
    assert {"exposure_us", "exposure_s"} < set(FIELDS)


def test_every_analysis_is_explained_on_the_reference_page():
    from photoplan.products.characterise.registry import ANALYSES

    page = (Path(__file__).resolve().parents[2] / "docs" / "reference" / "characterise.md").read_text("utf-8")
    assert not [analysis.name for analysis in ANALYSES if f"| `{analysis.name}` |" not in page]
