"""`photoplan mtf --pattern`: figures, table and report of bars, stars and USAF targets; wrong calls; bad pictures."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.command import Here
from tools.patterns import bars, gauss_box, star

TARGET = Path(__file__).resolve().parents[1] / "real" / "usaf1951" / "3.npy"
FREQUENCIES = (0.04, 0.1, 0.16, 0.22, 0.3, 0.4)


def write(path: Path, *pictures: np.ndarray) -> Path:
    rows, columns = pictures[0].shape
    kind = {"width": columns, "height": rows, "count": len(pictures), "dtype": pictures[0].dtype}
    with rasterio.open(path, "w", driver="GTiff", **kind) as file:
        for k, picture in enumerate(pictures):
            file.write(picture, k + 1)
    return path


def grey(picture: np.ndarray, noise: float = 1.0) -> np.ndarray:
    noisy = picture + np.random.default_rng(5).normal(0.0, noise, picture.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def strip(angle: float = 5.0) -> np.ndarray:
    return grey(np.hstack([bars((80, 100), f, angle, 0.7) for f in FREQUENCIES]))


ROIS = [word for k in range(len(FREQUENCIES)) for word in ("--roi", 100 * k, 0, 100, 80)]


@pytest.mark.drawn
def test_bars_in_windows(photoplan: Here, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    file = write(tmp_path / "bars.tif", strip())
    table, report = tmp_path / "out.csv", tmp_path / "out.html"
    call = ("mtf", file, "--pattern", "bars", *ROIS, "--coltman", "--pixel-size", 5, "--linearisation", "linear")
    said = photoplan(*call, "--csv", table, "--report", report, "--json", "-q")
    assert said.code == 0, said.err
    assert said.err == ""
    (image,) = json.loads(said.out)["images"]
    (pattern,) = image["patterns"]
    turn = np.deg2rad(5.0)
    for k, f in enumerate(FREQUENCIES):
        true = float(gauss_box(0.7)(f * np.cos(turn), f * np.sin(turn)))
        print(f, pattern["mtf"]["modulation"][k + 1], true)
        assert pattern["groups"][k]["cycles_per_px"] == pytest.approx(f, abs=1e-4)
        assert pattern["mtf"]["modulation"][k + 1] == pytest.approx(true, rel=0.015)
        assert pattern["contrast_transfer"]["modulation"][k + 1] >= pattern["mtf"]["modulation"][k + 1]
        assert pattern["mtf"]["lp_per_mm"][k + 1] == pytest.approx(200 * f, rel=1e-3)
    assert len(pattern["mtf_coltman"]["modulation"]) == len(FREQUENCIES) + 1
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    assert len(rows) == 3 * (len(FREQUENCIES) + 1)
    assert {row["curve"] for row in rows} == {"contrast transfer", "mtf", "mtf by Coltman's series"}
    assert [group["roi"] for group in pattern["groups"]] == [[100 * k, 0, 100, 80] for k in range(len(FREQUENCIES))]
    assert pattern["roi"] == [0, 0, 100 * len(FREQUENCIES), 80]
    page = report.read_text("utf-8")
    assert page.count("data:image/png") == 2  # the curves, and the bars with the outlines of their windows
    assert page.count("<tr>") == 1 + len(FREQUENCIES)
    assert "\ufffd" not in page  # what is no character, as line ends are in text, is shown as this
    assert photoplan(*call, "--csv", table).code == 2


def test_one_group_needs_levels(photoplan: Here, tmp_path: Path) -> None:
    file = write(tmp_path / "bars.tif", grey(bars((80, 100), 0.3, 5.0, 0.7)))
    call = ("mtf", file, "--pattern", "bars", "--linearisation", "linear")
    said = photoplan(*call)
    assert said.code == 3 and "--levels" in said.err and said.out == ""
    said = photoplan(*call, "--levels", 40, 200, "--json")
    (pattern,) = json.loads(said.out)["images"][0]["patterns"]
    assert pattern["mtf"]["modulation"][1] == pytest.approx(0.359, abs=0.006)
    assert photoplan(*call, "--levels", 200, 40).code == 2


def test_linearisation_is_stated_and_used(photoplan: Here, tmp_path: Path) -> None:
    light = np.hstack([bars((80, 100), f, 5.0, 0.7) for f in (0.04, 0.3)]) / 255.0
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    file = write(tmp_path / "bars.tif", grey(255.0 * encoded, 0.3))
    call = ("mtf", file, "--pattern", "bars", "--roi", 0, 0, 100, 80, "--roi", 100, 0, 100, 80, "--json")
    right = json.loads(photoplan(*call, "--linearisation", "srgb").out)["images"][0]
    assert right["linearisation"].startswith("sRGB")
    assert right["patterns"][0]["mtf"]["modulation"][2] == pytest.approx(0.359, abs=0.006)
    said = photoplan(*call)
    assert "srgb" in said.err
    wrong = json.loads(said.out)["images"][0]["patterns"][0]
    assert abs(wrong["mtf"]["modulation"][2] / 0.359 - 1.0) > 0.03


def test_star_in_a_window_of_one_band(photoplan: Here, tmp_path: Path) -> None:
    picture = np.zeros((220, 260), np.uint8) + 120
    picture[10:210, 40:240] = grey(star((200, 200), (99.7, 101.2), 36, 0.7, over=4), 1.0)
    file = write(tmp_path / "star.tif", picture[::-1].copy(), picture)
    call = ("mtf", file, "--pattern", "star", "--roi", 40, 10, 200, 200, "--band", 2, "--linearisation", "linear")
    said = photoplan(*call, "--json")
    assert said.code == 0, said.err
    (pattern,) = json.loads(said.out)["images"][0]["patterns"]
    assert pattern["sectors"] == 36 and pattern["wave"] == "square" and pattern["band"] == "band 2"
    assert (pattern["col"], pattern["row"]) == pytest.approx((139.7, 111.2), abs=0.03)
    assert pattern["mtf"]["mtf50"] == pytest.approx(0.247, rel=0.02)
    assert len(pattern["directions"]) == 8
    text = photoplan(*call, "--sectors", 36)
    assert "star of 36 square sectors, centre column 139.7" in text.out and "157.5°" in text.out
    said = photoplan(*call, "--sectors", 40)
    assert said.code == 3 and "40 bright sectors are stated, but 36 are counted" in said.err


@pytest.mark.slow
def test_usaf_target(photoplan: Here, tmp_path: Path) -> None:
    file = write(tmp_path / "target.tif", np.load(TARGET))
    table = tmp_path / "out.csv"
    said = photoplan("mtf", file, "--pattern", "usaf", "--group", 2, "--csv", table, "--json")
    assert said.code == 0, said.err
    assert "seems saturated" in said.err
    (pattern,) = json.loads(said.out)["images"][0]["patterns"]
    assert pattern["groups"] == [2, 3, 4, 5] and pattern["resolved_groups"] == [2, 3, 4]
    assert pattern["limit_vertical"]["lp_per_mm"] == 16.0
    assert pattern["limit_horizontal"]["group"] == 4
    finest = [e for e in pattern["elements"] if e["group"] == 5]
    assert finest and not any(e["resolved"] for e in finest)
    rows = list(csv.DictReader(table.open(encoding="utf-8")))
    assert len(rows) == len(pattern["elements"]) and {row["resolved"] for row in rows} == {"yes", "no"}
    assert "groups 2, 3, 4, 5 seen" in photoplan("mtf", file, "--pattern", "usaf", "--group", 2, "-q").out
    assert "largest group" in photoplan("mtf", file, "--pattern", "usaf").err


def test_calls_that_cannot_be_meant(photoplan: Here, tmp_path: Path) -> None:
    file = write(tmp_path / "bars.tif", strip())
    for words, message in (
        (("--sectors", 9), "--pattern"),
        (("--coltman",), "--pattern"),
        (("--pattern", "bars", "--sectors", 9), "--sectors requires --pattern"),
        (("--pattern", "star", "--group", 2), "--group requires --pattern"),
        (("--pattern", "star", "--coltman"), "--coltman requires --pattern"),
        (("--pattern", "usaf", "--levels", 1, 2), "--levels requires --pattern"),
        (("--pattern", "bars", "--grid", 4), "--grid is for edges"),
        (("--pattern", "bars", "--roi", 590, 0, 100, 80), "leaves"),
        (("--pattern", "bars", "--band", 7), "band"),
        (("--pattern", "bars", "--csv", file), "input"),
    ):
        said = photoplan("mtf", file, *words)
        assert said.code == 2 and message in said.err, (words, said)


def test_an_image_that_fails_does_not_stop_the_others(photoplan: Here, tmp_path: Path) -> None:
    good = write(tmp_path / "good.tif", strip())
    empty = write(tmp_path / "empty.tif", np.full((90, 700), 80, np.uint8))
    bright = write(tmp_path / "bright.tif", np.clip(strip().astype(int) * 2, 0, 255).astype(np.uint8))
    said = photoplan("mtf", good, empty, bright, "--pattern", "bars", *ROIS, "--linearisation", "linear")
    assert said.code == 4
    assert "empty.tif" in said.err and "no pattern" in said.err
    assert "bright.tif" in said.err and "saturated or clipped" in said.err
    assert "0.4000 cy/px" in said.out and "empty" not in said.out


def test_images_of_one_name_are_told_apart(photoplan: Here, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "other").mkdir()
    files = [write(tmp_path / part / "bars.tif", strip()) for part in ("", "other")]
    table = tmp_path / "out.csv"
    call = ("mtf", *files, "--pattern", "bars", *ROIS, "--linearisation", "linear", "--csv", table, "--json")
    said = photoplan(*call, "--report", tmp_path / "out.html")
    assert said.code == 0, said.err
    assert [image["image"] for image in json.loads(said.out)["images"]] == [str(file) for file in files]
    assert {row["image"] for row in csv.DictReader(table.open(encoding="utf-8"))} == {str(file) for file in files}
    assert photoplan("mtf", files[0], files[0], "--pattern", "bars", *ROIS).code == 2
