"""`photoplan mtf` on scenes of known sharpness: figures, JSON, table, report, and every fault by its name."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.edge_scenes import blocks, half_plane, mtf50_of, noisy
from tools.optics import stray
from tools.recorded import recorded
from tools.thinned import some

pytestmark = pytest.mark.usefixtures("searched_once")

SIZE = (330, 220)
TOPS = {"uint8": 255, "uint16": 65535, "int16": 32767}
CUT_OFF = [(t, *ends) for t in ("uint8", "uint16", "float32") for ends in ((0.0, 0.695), (0.0, 0.62), (0.33, 1.0))]


def write(path: Path, pixels: np.ndarray, **more: Any) -> Path:
    """Pixels (rows, columns) or (bands, rows, columns)."""
    bands = pixels[None] if pixels.ndim == 2 else pixels
    size = {"count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
    with rasterio.open(path, "w", driver="GTiff", dtype=bands.dtype, **size, **more) as file:
        file.write(bands)
    return path


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    return blocks(SIZE, 10.0, 0.8, 3)


@pytest.fixture(scope="module")
def image(scene: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("mtf") / "blocks.tif", noisy(scene, 50, 4, "uint16"))


def result(photoplan: Here, *words: object) -> dict[str, Any]:
    said = photoplan("mtf", *words, "--json", "-q")
    assert said.code == 0, said.err
    assert said.err == ""
    return json.loads(said.out)


def refused(photoplan: Here, *words: object, code: int = 3) -> str:
    """What is said where no edge can be measured; never a figure."""
    said = photoplan("mtf", *words)
    assert said.code == code, said
    assert "MTF50" not in said.out
    return said.err


class TestFigures:
    def test_a_wide_window_is_used(self, tmp_path: Path, photoplan: Here) -> None:
        """8 % of the light spread by exp(−r / 8 px): 40 pixels to each side hold what 13 do not."""
        optics = stray(0.08, 8.0, 0.6)
        light = 0.2 + 0.6 * optics.image((140, 150), 7.0, (74.3, 70.2))
        image = write(tmp_path / "stray.tif", noisy(light, 200, 1, "uint16", 0.6))
        words = (image, "--linearisation", "linear", "--grid", 1, "--least-length", 60, "--roi", 0, 0, 150, 140)
        near, far = (result(photoplan, *words, "--half-width", half)["images"][0]["edges"][0] for half in (13, 40))
        assert near["window"] == pytest.approx([-13, 13], abs=0.1) and far["window"] == pytest.approx(
            [-40, 40], abs=0.1
        )
        assert far["half_width"] == 40 and far["beyond"] < 0.5 * near["beyond"]
        assert far["mtf50"] == pytest.approx(optics.mtf50(7.0), rel=0.015)

    def test_a_scene_of_known_sharpness(self, image: Path, photoplan: Here) -> None:
        """Sides of random rectangles, SNR 50: MTF50 of the mean within 1.5 %, its interval around the truth."""
        made = result(photoplan, image, "--linearisation", "linear", "--most-edges", 14, "--grid", 2)["images"][0]
        truth = mtf50_of(0.8, 10.0)
        total = made["summary"][0]
        low, high = total["mtf50_interval"]
        print(f"MTF50 {total['mtf50']:.4f} [{low:.4f}, {high:.4f}], truth {truth:.4f}, {total['edges']} edges")
        assert total["mtf50"] == pytest.approx(truth, rel=0.015)
        assert low - 0.001 < truth < high + 0.001
        assert made["edges_found"] == 24 and len(made["edges"]) == 14
        edge = made["edges"][0]
        assert {"col", "row", "angle_deg", "mtf50", "mtf50_interval", "fwhm", "overshoot", "undershoot"} <= set(edge)
        assert edge["mtf50_interval"][0] < edge["mtf50"] < edge["mtf50_interval"][1]
        assert edge["direction"] in ("x", "y") and edge["band"] == "band 1" and not edge["aligned"]
        assert made["enhancement"]["enhanced"] is False
        # The best Gaussian is nearly that of the optics and the pixel together.
        assert total["gaussian"]["fwhm"] == pytest.approx(2.3548 * np.hypot(0.8, 12**-0.5), rel=0.02)
        assert total["gaussian"]["rms_difference"] < 0.01
        assert {g["direction"] for g in made["summary"]} == {None, "x", "y"}
        cells = [g["cell"] for g in made["summary"] if g["cell"] and g["direction"] is None]
        assert len(cells) == 4 and cells[0]["bounds"] == [-0.5, -0.5, 164.5, 109.5]

    @pytest.mark.parametrize(
        "kind",
        [
            pytest.param("uint8", marks=pytest.mark.slow),
            pytest.param("int16", marks=pytest.mark.slow),
            pytest.param("float32", marks=pytest.mark.slow),
            "uint12",
        ],
    )
    def test_fault_24_other_types(self, scene: np.ndarray, tmp_path: Path, photoplan: Here, kind: str) -> None:
        """8, 12 and 15 bits and floats give the same sharpness."""
        path = write(tmp_path / "a.tif", noisy(scene, 50, 4, kind), **({"nbits": 12} if kind == "uint12" else {}))
        made = result(photoplan, path, "--linearisation", "linear", "--most-edges", 5, "--grid", 1)["images"][0]
        print(f"{kind}: {made['summary'][0]['mtf50']:.4f}")
        assert made["summary"][0]["mtf50"] == pytest.approx(mtf50_of(0.8, 10.0), rel=0.02)

    def test_aligned_and_flight_direction(self, tmp_path: Path, photoplan: Here) -> None:
        """An upright edge shows x: along a flight in x, across one in y; parallel to columns, and so said."""
        path = write(
            tmp_path / "a.tif", noisy(0.25 + 0.5 * half_plane((80, 70), (39.6, 35), 0.0, 0.8), 50, 1, "uint16")
        )
        for flight, words in (("x", "along"), ("y", "across")):
            said = photoplan("mtf", path, "--linearisation", "linear", "--flight", flight, "--json")
            assert said.code == 0, said.err
            (edge,) = json.loads(said.out)["images"][0]["edges"]
            assert (edge["direction"], edge["flight_direction"], edge["aligned"]) == ("x", words, True)
            assert edge["sampling"] == "few phases"
            assert "parallel to rows or columns" in said.err
            assert edge["mtf50"] == pytest.approx(mtf50_of(0.8), rel=0.04)

    def test_windows_are_measured_as_given(self, image: Path, photoplan: Here) -> None:
        every = result(photoplan, image, "--linearisation", "linear", "--most-edges", 6)["images"][0]["edges"]
        wanted = [every[0], every[5]]
        rois = [(round(e["col"]) - 25, round(e["row"]) - 25, 50, 50) for e in wanted]
        words = [w for roi in rois for w in ("--roi", *(max(0, v) for v in roi))]
        edges = result(photoplan, image, "--linearisation", "linear", *words)["images"][0]["edges"]
        assert len(edges) == 2
        for edge, other in zip(edges, wanted):
            assert edge["mtf50"] == pytest.approx(other["mtf50"], rel=0.05)

    def test_channels(self, tmp_path: Path, photoplan: Here) -> None:
        """Red softer than green: each band gets its own MTF50, the luminance lies between."""
        layers = [0.25 + 0.5 * half_plane((80, 70), (39.6, 35), 9.0, s) for s in (1.2, 0.7, 0.7)]
        pixels = np.stack([noisy(layer, 60, k, "uint16") for k, layer in enumerate(layers)])
        path = write(tmp_path / "rgb.tif", pixels, photometric="RGB")
        made = result(photoplan, path, "--linearisation", "linear", "--band", "all")["images"][0]
        by_band = {g["band"]: g["mtf50"] for g in made["summary"] if g["cell"] is None and g["direction"] is None}
        assert list(by_band) == ["luminance", "band 1", "band 2", "band 3"]
        assert by_band["band 1"] == pytest.approx(mtf50_of(1.2, 9.0), rel=0.03)
        assert by_band["band 2"] == pytest.approx(mtf50_of(0.7, 9.0), rel=0.03)
        assert by_band["band 1"] < by_band["luminance"] < by_band["band 2"]
        assert {e["band"] for e in made["edges"] if e["number"] == 1} == set(by_band)
        only = result(photoplan, path, "--linearisation", "linear", "--band", 1)["images"][0]
        assert only["summary"][0]["mtf50"] == pytest.approx(by_band["band 1"], rel=0.02)

    def test_linearisation_is_stated_and_matters(self, tmp_path: Path, photoplan: Here) -> None:
        """An sRGB image: right as sRGB and by a table of the curve, off as linear, of which a warning is given."""
        light = 0.06 + 0.8 * half_plane((80, 70), (39.6, 35), 9.0, 0.8)
        encoded = 1.055 * light ** (1 / 2.4) - 0.055
        path = write(tmp_path / "a.tif", noisy(encoded, 80, 2, "uint8"))
        grey = np.arange(256) / 255
        curve = np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
        table = tmp_path / "curve.txt"
        table.write_text("\n".join(f"{k} {v:.8f}" for k, v in enumerate(curve)))
        right = mtf50_of(0.8, 9.0)
        for how, words in (("srgb", "sRGB"), (table, "table of 256")):
            made = result(photoplan, path, "--linearisation", how)
            assert words in made["linearisation"] and words in made["images"][0]["linearisation"]
            assert made["summary"][0]["mtf50"] == pytest.approx(right, rel=0.02)
        said = photoplan("mtf", path)
        assert "linear: grey values are taken as light" in said.out
        assert "moves MTF50 by about 12 %" in said.err
        quiet = photoplan("mtf", path, "--json", "-q")
        assert "moves MTF50 by about 12 %" in quiet.err, "a doubt is printed with -q too"
        off = json.loads(quiet.out)["summary"][0]["mtf50"]
        print(f"sRGB {right:.4f}, as linear {off:.4f}: {100 * (off / right - 1):.1f} %")
        assert abs(off / right - 1) > 0.02

    def test_laboratory_values_and_millimetres(self, image: Path, tmp_path: Path, photoplan: Here) -> None:
        lab = tmp_path / "lab.csv"
        lab.write_text("cycles_per_mm,modulation\n20,0.9\n40,0.6\n")
        words = (image, "--linearisation", "linear", "--most-edges", 4, "--lab", lab)
        made = result(photoplan, *words, "--pixel-size", 6.5)
        total = made["summary"][0]
        assert total["laboratory"]["cycles_per_px"] == pytest.approx([0.13, 0.26])
        assert total["laboratory"]["laboratory"] == [0.9, 0.6]
        truth = np.exp(-2 * (np.pi * 0.8 * np.array([0.13, 0.26])) ** 2) * np.sinc([0.13, 0.26])
        assert total["laboratory"]["measured"] == pytest.approx(truth, abs=0.02)
        assert total["mtf50_cycles_per_mm"] == pytest.approx(total["mtf50"] / 0.0065)
        assert "--pixel-size" in refused(photoplan, *words)

    def test_several_images_together(self, image: Path, tmp_path: Path, photoplan: Here) -> None:
        other = write(tmp_path / "b.tif", noisy(blocks((220, 110), -20.0, 0.8, 5), 50, 6, "uint16"))
        flat = write(tmp_path / "flat.tif", np.full((60, 60), 9000, np.uint16))
        said = photoplan("mtf", image, other, flat, "--linearisation", "linear", "--most-edges", 3, "--json")
        assert said.code == 4
        made = json.loads(said.out)
        assert len(made["images"]) == 2 and made["failed"][0]["image"] == "flat.tif"
        assert made["summary"][0]["edges"] == 6
        assert "1 of 3 images failed" in said.err and "no edge found" in said.err


class TestOutputs:
    @pytest.mark.drawn
    def test_report_and_table(self, image: Path, tmp_path: Path, photoplan: Here) -> None:
        pytest.importorskip("matplotlib")
        page, table = tmp_path / "r.html", tmp_path / "r.csv"
        words = (image, "--linearisation", "linear", "--most-edges", 4, "--report", page, "--csv", table)
        said = photoplan("mtf", *words)
        assert said.code == 0, said.err
        assert said.out.splitlines()[-2:] == [str(table), str(page)]
        text = page.read_text()
        assert text.count("data:image/png") == 4 and "Linearisation: linear" in text
        rows = list(csv.DictReader(table.open()))
        assert len(rows) == 4
        assert recorded(tmp_path / "r.run.json", "mtf", image)["settings"]["most_edges"] == 4
        assert float(rows[0]["mtf50_low"]) < float(rows[0]["mtf50"]) < float(rows[0]["mtf50_high"])
        assert "exists already" in refused(photoplan, *words, code=2)
        assert photoplan("mtf", *words[:-4], "--csv", table, "--overwrite", "-q").code == 0

    def test_fault_13_outputs_are_no_inputs(self, image: Path, photoplan: Here) -> None:
        before = image.read_bytes()
        assert "is the input" in refused(photoplan, image, "--csv", image, "--overwrite", code=2)
        assert image.read_bytes() == before


class TestFaults:
    def test_fault_08_a_truncated_image(self, image: Path, tmp_path: Path, photoplan: Here) -> None:
        path = tmp_path / "cut.tif"
        path.write_bytes(image.read_bytes()[:90_000])
        said = refused(photoplan, path, "--linearisation", "linear")
        assert str(path) in said and "damaged or cut off" in said

    def test_fault_08_no_image(self, tmp_path: Path, photoplan: Here) -> None:
        path = tmp_path / "a.tif"
        path.write_bytes(b"no image")
        assert str(path) in refused(photoplan, path)

    @pytest.mark.parametrize(
        ("text", "says"),
        [
            ("0 0\n1 x\n", ":2: column 2 = 'x' is not a number"),
            ("0 0\n255 1\n", "hold"),
            ("0 0\n0 1\n", "increase"),
            ("", "no line"),
        ],
    )
    def test_fault_18_tables(self, image: Path, tmp_path: Path, photoplan: Here, text: str, says: str) -> None:
        table = tmp_path / "t.txt"
        table.write_text(text)
        assert says in refused(photoplan, image, "--linearisation", table)

    @pytest.mark.parametrize(
        ("dtype", "options", "message"),
        [
            ("uint8", {"nbits": 1}, "1-bit image"),
            ("float64", {}, "pixels of type float64"),
            ("uint8", {"photometric": "CMYK"}, "CMYK"),
        ],
    )
    def test_fault_24_refused_by_name(
        self, tmp_path: Path, photoplan: Here, dtype: str, options: dict[str, object], message: str
    ) -> None:
        pixels = np.zeros((4 if "photometric" in options else 1, 60, 60), dtype)
        assert message in refused(photoplan, write(tmp_path / "a.tif", pixels, **options))

    def test_fault_24_a_palette_becomes_colours(self, tmp_path: Path, photoplan: Here) -> None:
        """256 greys behind shuffled indices: measured as the greys that they stand for."""
        grey = noisy(0.25 + 0.5 * half_plane((80, 70), (39.6, 35), 9.0, 0.8), 50, 1, "uint8")
        order = np.random.default_rng(0).permutation(256)
        path = write(tmp_path / "p.tif", np.argsort(order)[grey].astype(np.uint8), photometric="palette")
        with rasterio.open(path, "r+") as file:
            file.write_colormap(1, {k: (int(v), int(v), int(v), 255) for k, v in enumerate(order)})
        made = result(photoplan, path, "--linearisation", "linear")
        assert made["summary"][0]["mtf50"] == pytest.approx(mtf50_of(0.8, 9.0), rel=0.02)

    def test_no_edge(self, tmp_path: Path, photoplan: Here) -> None:
        rng = np.random.default_rng(1)
        path = write(tmp_path / "a.tif", rng.normal(9000, 300, (120, 120)).astype(np.uint16))
        assert "no edge found" in refused(photoplan, path)

    @pytest.mark.parametrize("top", some([255, 4095, 65535], 0, 1))
    def test_saturated(self, tmp_path: Path, photoplan: Here, top: int) -> None:
        """Clipped at the end of 8, 12 (in 16) and 16 bits: no figure, and why."""
        light = 0.3 + 0.9 * half_plane((80, 70), (39.6, 35), 9.0, 0.8)
        noise = np.random.default_rng(1).normal(0, 0.01, light.shape)
        pixels = np.clip(np.round((light + noise) * top), 0, top).astype(np.uint8 if top == 255 else np.uint16)
        path = write(tmp_path / "a.tif", pixels)
        assert "1 saturated" in refused(photoplan, path, "--linearisation", "linear")
        assert "1 saturated" in refused(photoplan, path, "--linearisation", "linear", "--roi", 5, 5, 70, 60)

    @pytest.mark.parametrize(("kind", "low", "high"), some(CUT_OFF, 0, 4, 8))
    def test_cut_off_within_the_type(self, tmp_path: Path, photoplan: Here, low: float, high: float, kind: str) -> None:
        """A sensor that is full, or black that is cut off, at no end of the type: MTF50 would be 4 to 30 % too large.

        Pixels without value at the end of the type do not hide it.
        """
        light = 0.3 + 0.4 * half_plane((80, 70), (39.6, 35), 9.0, 0.8)
        light = np.clip(light + np.random.default_rng(1).normal(0, 0.01, light.shape), low, high)
        pixels = (light * TOPS.get(kind, 1.0)).astype(kind)
        pixels[:2] = TOPS.get(kind, -9.0)
        path = write(tmp_path / "a.tif", pixels, nodata=float(pixels[0, 0]))
        assert "1 saturated" in refused(photoplan, path, "--linearisation", "linear")

    def test_cut_off_in_a_small_part_of_an_image(self, tmp_path: Path, photoplan: Here) -> None:
        """Too few pixels of a tile to stand out in it: the edge itself is looked at again."""
        light = np.full((900, 1000), 0.3)
        light[400:470, 500:580] += 0.4 * half_plane((80, 70), (39.6, 35), 9.0, 0.8)
        light += np.random.default_rng(1).normal(0, 0.01, light.shape)
        path = write(tmp_path / "a.tif", np.round(np.clip(light, 0, 0.65) * 65535).astype(np.uint16))
        assert "saturated" in refused(photoplan, path, "--linearisation", "linear")

    def test_even_areas_are_not_cut_off_where_the_image_is_brighter_elsewhere(
        self, tmp_path: Path, photoplan: Here
    ) -> None:
        light = 0.3 + 0.4 * half_plane((80, 70), (39.6, 35), 9.0, 0.8)
        noise = np.random.default_rng(1).normal(0, 0.01, light.shape)
        pixels = np.round((light + np.where(light < 0.5, noise, 0.0)) * 255).astype(np.uint8)
        wide = np.concatenate([pixels, np.full((70, 60), 190, np.uint8)], axis=1)
        wide[10:60, 110:] = 250
        path = write(tmp_path / "a.tif", wide)
        assert result(photoplan, path, "--linearisation", "linear", "--roi", 5, 5, 70, 60)["images"]

    @pytest.mark.parametrize("unit", [1e-14, 1e12])
    def test_any_unit_of_light(self, tmp_path: Path, photoplan: Here, unit: float) -> None:
        """Radiances are as small, and as large, as their unit makes them."""
        light = half_plane((80, 70), (39.6, 35), 9.0, 0.8) + np.random.default_rng(1).normal(0, 0.01, (70, 80))
        path = write(tmp_path / "a.tif", (light * unit).astype(np.float32))
        assert result(photoplan, path)["summary"][0]["mtf50"] == pytest.approx(mtf50_of(0.8, 9.0), rel=0.02)

    def test_texture(self, tmp_path: Path, photoplan: Here) -> None:
        grain = np.kron(np.random.default_rng(3).uniform(-0.15, 0.15, (14, 16)), np.ones((5, 5)))[:70, :80]
        light = 0.25 + half_plane((80, 70), (39.6, 35), 9.0, 0.8) * (0.5 + grain)
        said = refused(photoplan, write(tmp_path / "a.tif", noisy(light, 50, 1, "uint16")))
        assert "no edge found" in said
        assert "with texture beside them" in said

    def test_fault_22_invalid_pixels_do_not_count(self, scene: np.ndarray, tmp_path: Path, photoplan: Here) -> None:
        """A hole of nodata makes no edges; those far from it are measured."""
        pixels = noisy(scene, 50, 4, "uint16")
        pixels[60:160, 100:220] = 0
        path = write(tmp_path / "a.tif", pixels, nodata=0)
        made = result(photoplan, path, "--linearisation", "linear", "--most-edges", 10, "--grid", 1)["images"][0]
        assert made["edges"]
        for edge in made["edges"]:
            for x, y in edge["ends"]:
                assert not (99 < x < 221 and 59 < y < 161)
        assert made["summary"][0]["mtf50"] == pytest.approx(mtf50_of(0.8, 10.0), rel=0.015)

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            (("--band", "7"), "--band 7; the file has bands 1 to 1"),
            (("--band", "red"), "--band red"),
            (("--roi", "300", "0", "100", "100"), "leaves"),
            (("--grid", "0"), "--grid 0"),
            (("--most-edges", "0"), "--most-edges 0"),
            (("--pixel-size", "-1"), "--pixel-size -1"),
            (("--half-width", "500"), "--half-width 500"),
            (("--least-length", "1"), "--least-length"),
            (("--sectors", "36"), "--pattern"),
        ],
    )
    def test_wrong_use(self, image: Path, photoplan: Here, words: tuple[str, ...], says: str) -> None:
        assert says in refused(photoplan, image, *words, code=2)

    def test_a_linearisation_that_is_no_file(self, image: Path, photoplan: Here) -> None:
        assert "linearisation gamma: is no file" in refused(photoplan, image, "--linearisation", "gamma", code=3)

    def test_an_image_given_twice(self, image: Path, photoplan: Here) -> None:
        assert "given twice" in refused(photoplan, image, image, code=2)


class TestReference:
    """MTF50 of mtf_mapper 0.7.38 under the same linearisation, by the automatic command (README of `slanted_edges`)."""

    @pytest.mark.parametrize(
        ("name", "srgb", "linear"),
        some(
            [
                ("sfrmat3/h_edge_mono.tif", 0.2026, 0.2006),
                ("splund/x2084_y0616_F2.png", 0.3345, 0.2980),
                ("splund/x2088_y0616_F2_8.png", 0.5038, 0.4734),
            ],
            1,
        ),
    )
    def test_real_edges(self, shared: Path, photoplan: Here, name: str, srgb: float, linear: float) -> None:
        path = shared / "data" / "slanted_edges" / name
        for how, reference in (("srgb", srgb), ("linear", linear)):
            measured = result(photoplan, path, "--linearisation", how, "--band", 1)["summary"][0]["mtf50"]
            print(f"{name} {how}: {measured:.4f}, reference {reference}: {100 * (measured / reference - 1):+.1f} %")
            assert measured == pytest.approx(reference, rel=0.02)


def test_an_image_without_any_value_is_refused_without_warnings(tmp_path: Path, photoplan: Here, recwarn) -> None:
    said = refused(photoplan, write(tmp_path / "nan.tif", np.full((60, 80), np.nan, np.float32)))
    assert "no edge found" in said
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]
