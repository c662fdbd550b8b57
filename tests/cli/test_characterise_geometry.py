"""`photoplan characterise`: fall-off, drift, gain control, jitter, warm-up and stage from files on disk."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from tools.camera_series import disc_frame, edge_frame, write_series
from tools.command import Here, Said

from photoplan.geometry.grid import Window
from photoplan.project.steps import read_fall_off
from photoplan.quality.camera.fall_off import FallOffModel, correct_fall_off

SIZE = (160, 120)
B4 = """name;stage_x;stage_y;x;y
1;-3250;2250;444,20;402,38
2;0;2250;253,76;399,44
3;3250;2250;63,32;396,81
4;3250;0;64,96;237,61
5;0;0;255,25;240,34
6;-3250;0;445,45;243,35
7;-3250;-2250;447,11;84,42
8;0;-2250;256,56;81,73
9;3250;-2250;66,39;78,87
"""


Values = dict[tuple[str, str], tuple[float, float]]


def run(here: Here, folder: Path, text: str, *options: object) -> Said:
    (folder / "series.toml").write_text(text)
    return here("characterise", folder / "series.toml", "-q", *options)


def figures(here: Here, folder: Path, text: str, name: str, *options: object) -> tuple[Values, Any]:
    """Values with sigmas of an analysis by name and condition, and its whole result."""
    said = run(here, folder, text, "--only", name, "--json", *options)
    assert said.code == 0, said.err
    found = json.loads(said.out)["analyses"][0]
    return {(f["name"], f.get("at", "")): (f["value"], f["sigma"]) for f in found["figures"]}, found


def refused(here: Here, folder: Path, text: str, name: str) -> str:
    said = run(here, folder, text, "--only", name)
    assert said.code in (3, 4), said.err
    return said.err


def test_appendix_b_from_a_table(photoplan: Here, tmp_path: Path) -> None:
    """Behr 1989, fig. B.4; the table has decimal commas."""
    (tmp_path / "b4.csv").write_text(B4)
    text = '[[positions]]\nfile = "b4.csv"\nkind = "stage"\nname = "upper"\n'
    found, whole = figures(photoplan, tmp_path, text, "stage", "--csv", tmp_path / "out")
    want = {"pixel_size_x": 17.07, "pixel_size_y": 14.16, "rotation_x_gon": 200.94, "rotation_y_gon": 100.59}
    want |= {"mean_error_x_px": 0.10, "mean_error_y_px": 0.13, "m0_px": 0.12, "shear_gon": 0.35}
    for name, value in want.items():
        print(f"{name}: {found[name, 'upper'][0]:.4f}, printed {value}")
        assert round(found[name, "upper"][0], 2) == value, name
    text_file = (tmp_path / "out" / "stage_calibration_1.txt").read_text()
    assert "255.22" in text_file and "240.55" in text_file and "M0 = 0.12" in text_file
    rows = whole["tables"]["matrices"]["rows"]
    np.testing.assert_allclose(rows[0][2], -0.0585689723, atol=6e-7)
    np.testing.assert_allclose(rows[1][2], -17.0715661833, atol=2e-4)


def test_stage_from_images(photoplan: Here, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    stage = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)], float) * 500
    frames = [disc_frame(rng, SIZE, [(80 + 0.08 * x + 0.002 * y, 60 - 0.001 * x - 0.06 * y, 7)]) for x, y in stage]
    write_series(tmp_path, "s", frames, {"stage_x": stage[:, 0], "stage_y": stage[:, 1]})
    text = '[[frames]]\nfiles = "s_*.tif"\nkind = "stage"\ntable = "s.csv"\nname = "s"\n'
    found, _ = figures(photoplan, tmp_path, text, "stage")
    for axis, want in (("x", 1 / np.hypot(0.08, 0.001)), ("y", 1 / np.hypot(0.002, 0.06))):
        value, sigma = found[f"pixel_size_{axis}", "s"]
        assert abs(value - want) < 5 * sigma and sigma / want < 1e-3
    assert found["m0_px", "s"][0] < 0.02
    write_series(tmp_path, "s", frames, {"stage_x": stage[:, 0]})
    assert "lacks stage_x or stage_y" in refused(photoplan, tmp_path, text, "stage")


def test_fall_off_gives_a_correction_file_that_levels_images(photoplan: Here, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    model = FallOffModel(SIZE, (84.0, 57.0), 180.0, ((2, 0), (1, 1)), (-0.1, 0.05))
    light = model.relative(np.arange(160.0)[None], np.arange(120.0)[:, None])
    shape = light.shape
    flats = [190 * light + 10 + rng.normal(0, 1.5, shape) for _ in range(8)]
    write_series(tmp_path, "flat", flats, {"exposure_ms": [5] * 8})
    write_series(tmp_path, "dark", [10 + rng.normal(0, 1.5, shape) for _ in range(8)], {"exposure_ms": [5] * 8})
    text = "[camera]\nfocal_px = 180.0\nprincipal_point_px = [84.0, 57.0]\n"
    for kind in ("flat", "dark"):
        text += f'[[frames]]\nfiles = "{kind}_*.tif"\nkind = "{kind}"\ntable = "{kind}.csv"\n'
    found, whole = figures(photoplan, tmp_path, text, "fall_off", "--csv", tmp_path / "out")
    want = 100 * (1 - model.relative(np.array(0.0), np.array(0.0)))
    value, sigma = found["corner_percent", "upper left"]
    print(f"\ncorner {value:.2f} ± {sigma:.2f} %, put in {want:.2f} %")
    assert abs(value - want) < 5 * sigma and sigma < 0.3
    natural = 100 * (1 - model.natural(np.array(0.0), np.array(0.0)))
    assert found["natural_percent", "upper left"][0] == pytest.approx(natural, abs=0.01)
    assert "dark 5 ms subtracted" in whole["notes"][0]
    correction = read_fall_off(tmp_path / "out" / "fall_off_model.toml")
    assert correction.dark == pytest.approx(10.0, abs=0.1)
    level, _ = correct_fall_off(np.round(flats[0]).astype(np.uint8), Window(0, 0, *SIZE), correction)
    blocks = level.reshape(6, 20, 8, 20).mean(axis=(1, 3))
    assert np.ptp(flats[0].reshape(6, 20, 8, 20).mean(axis=(1, 3))) > 60 > 100 * np.ptp(blocks) / blocks.mean()
    with rasterio.open(tmp_path / "out" / "fall_off_gain.tif") as dataset:
        gains = dataset.read(1)
    assert gains.dtype == np.float32 and gains.shape == shape
    np.testing.assert_allclose(gains * light, 1.0, atol=0.01)


def test_fall_off_of_unknown_camera_constant_states_no_parts(photoplan: Here, tmp_path: Path) -> None:
    model = FallOffModel(SIZE, (79.5, 59.5), 150.0, ((2, 0),), (-0.1,))
    light = model.relative(np.arange(160.0)[None], np.arange(120.0)[:, None])
    noise = np.random.default_rng(3).normal(0, 1, light.shape)
    write_series(tmp_path, "flat", [200 * light + noise], {"exposure_ms": [5]})
    found, whole = figures(photoplan, tmp_path, '[[frames]]\nfiles = "flat_*.tif"\nkind = "flat"\n', "fall_off")
    assert not any(name == "natural_percent" for name, _ in found)
    assert "not told apart" in whole["refused"]["natural and artificial part"]
    bright = '[camera]\nsaturation_dn = 150.0\n[[frames]]\nfiles = "flat_*.tif"\nkind = "flat"\n'
    assert "all flat frames are saturated" in refused(photoplan, tmp_path, bright, "fall_off")


def test_fall_off_of_a_bayer_pattern_and_a_roi(photoplan: Here, tmp_path: Path) -> None:
    """Planes have every second pixel, from another first one each; the roi begins at odd places."""
    rng = np.random.default_rng(10)
    model = FallOffModel((200, 160), (104.0, 77.0), 250.0, ((2, 0), (1, 1)), (-0.05, 0.06))
    light = 220 * model.relative(np.arange(200.0)[None], np.arange(160.0)[:, None])
    light[0::2, 0::2] *= 0.6
    light[1::2, 1::2] *= 0.4
    write_series(tmp_path, "f", [light + rng.normal(0, 1.0, light.shape) for _ in range(6)], {"n": range(6)})
    text = '[camera]\nfocal_px = 250.0\nprincipal_point_px = [104.0, 77.0]\nbayer = "RGGB"\n'
    text += '[[frames]]\nfiles = "f_*.tif"\nkind = "flat"\nroi = [7, 5, 190, 150]\nvalues = { degree = 4 }\n'
    _, whole = figures(photoplan, tmp_path, text, "fall_off", "--csv", tmp_path / "out")
    for plane, (column, row) in {"R": (0, 0), "G1": (1, 0), "G2": (0, 1), "B": (1, 1)}.items():
        rows = [r for r in whole["tables"]["corners"]["rows"] if r[0] == plane]
        for corner, x, y in (("upper left", column, row), ("lower right", 198 + column, 158 + row)):
            want = 100 * (1 - model.relative(np.array(float(x)), np.array(float(y))))
            value, sigma = next(r[2:4] for r in rows if r[1] == corner)
            assert abs(value - want) < 5 * sigma and sigma < 0.3, (plane, corner)
        assert (tmp_path / "out" / f"fall_off_gain_{plane}.tif").exists()


def test_drift_has_the_figures_of_table_4_1(photoplan: Here, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    lamp = 150 + np.arange(24) * 0.8 + rng.normal(0, 0.3, 24)
    frames = [np.full((20, 20), v) + rng.normal(0, 2, (20, 20)) for v in lamp]
    times = np.arange(24) * 60.0
    write_series(tmp_path, "d", frames, {"time_s": times})
    text = '[[frames]]\nfiles = "d_*.tif"\nkind = "drift"\ntable = "d.csv"\nname = "left"\n'
    found, _ = figures(photoplan, tmp_path, text, "drift")
    middle = np.array([np.clip(np.rint(f), 0, 255)[7:13, 7:13].mean() for f in frames])
    assert found["mean_dn", "left"][0] == pytest.approx(middle.mean())
    assert found["minimum_dn", "left"][0] == pytest.approx(middle.min())
    assert found["maximum_dn", "left"][0] == pytest.approx(middle.max())
    assert found["sigma_dn", "left"][0] == pytest.approx(middle.std(ddof=1))
    assert found["largest_step_dn", "left"][0] == pytest.approx(np.abs(np.diff(middle)).max())
    assert found["pixel_noise_of_mean_dn", "left"][0] == pytest.approx(2 / 6, rel=0.2)
    trend, sigma = found["trend_dn_per_hour", "left"]
    assert abs(trend - 48.0) < 4 * sigma
    write_series(tmp_path, "d", frames, {"time_s": [*times[:5], 30.0, *times[6:]]})
    assert "does not come after" in refused(photoplan, tmp_path, text, "drift")
    assert "d_0.tif has no time" in refused(photoplan, tmp_path, text.replace('table = "d.csv"\n', ""), "drift")


def test_gain_control_after_both_steps(photoplan: Here, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(40) * 0.2
    dark = np.where(t < 1, 150.0, 77 - 17 * np.exp(-(t - 1) / 1.5))
    bright = np.where(t < 1, 60.0, 180.0)
    for name, course, noise in (("a", dark, 4.0), ("b", bright, 2.0)):
        frames = [np.full((16, 16), v) + rng.normal(0, noise, (16, 16)) for v in course]
        write_series(tmp_path, name, frames, {"time_s": t})
    text = "".join(
        f'[[frames]]\nfiles = "{n}_*.tif"\nkind = "step"\ntable = "{n}.csv"\nname = "{n}"\n' for n in ("a", "b")
    )
    found, whole = figures(photoplan, tmp_path, text, "gain_control")
    change, sigma = found["change_dn", "a"]
    print(f"\nchange {change:.2f} ± {sigma:.2f}, put in 17")
    assert abs(change - 17) < 4 * sigma
    assert found["pixel_noise_after_dn", "a"][0] == pytest.approx(4.0, rel=0.1)
    assert found["pixel_noise_after_dn", "b"][0] == pytest.approx(2.0, rel=0.1)
    assert "no significant change" in whole["refused"]["change by the gain control, b"]
    assert found["asymmetry_dn", ""][0] == pytest.approx(17, abs=1.5)


@pytest.mark.parametrize("full", [255.0, 200.0])
def test_a_saturated_transition_is_refused(photoplan: Here, tmp_path: Path, full: float) -> None:
    """Also where the camera is full below the largest grey value, which step frames alone do not state."""
    rng = np.random.default_rng(5)
    t = np.arange(40) * 0.2
    course = np.where(t < 1, 60.0, full + 4 - 17 * np.exp(-(t - 1) / 1.5))
    frames = [np.minimum(np.full((16, 16), v) + rng.normal(0, 2, (16, 16)), full) for v in course]
    write_series(tmp_path, "a", frames, {"time_s": t})
    text = '[[frames]]\nfiles = "a_*.tif"\nkind = "step"\ntable = "a.csv"\nname = "a"\n'
    said = refused(photoplan, tmp_path, text, "gain_control")
    assert "is saturated in the window" in said and "take the series with less light" in said.casefold()
    assert (f"cut off at {full:g} DN" in said) == (full < 255)


PLUMB = """
[camera]
line_frequency_hz = 15625.0
interlaced = true
[[frames]]
files = "p_*.tif"
kind = "plumb"
[[frames.edges]]
name = "left"
roi = [10, 0, 50, 400]
[[frames.edges]]
name = "right"
roi = [80, 0, 60, 400]
[[frames.edges]]
name = "control"
roi = [0, 400, 160, 40]
direction = "horizontal"
"""


def plumb_frame(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = np.arange(400.0)
    common = rng.normal(0, 0.1, 400) + 0.2 * np.sin(2 * np.pi * t / 120 + seed) + 0.1 * (t % 2)
    top = edge_frame(rng, (160, 400), [35 + 0.01 * t + common, 110 + 0.01 * t + common])
    bottom = edge_frame(rng, (40, 160), [18 + 0.01 * np.arange(160)]).T
    return np.vstack([top, bottom])


def test_line_jitter_of_two_edges_and_a_control(photoplan: Here, tmp_path: Path) -> None:
    write_series(tmp_path, "p", [plumb_frame(6), plumb_frame(7)], {"n": [0, 1]})
    out = tmp_path / "out"
    outputs = ("--csv", out, "--report", tmp_path / "r.html")
    found, _ = figures(photoplan, tmp_path, PLUMB, "line_jitter", *outputs)
    value, sigma = found["field_offset_px", "left"]
    assert value == pytest.approx(0.1, abs=0.03)
    value, sigma = found["amplitude_px", "left, oscillation 1"]
    assert abs(value - 0.2) < 4 * sigma
    # 120 rows of an interlaced image are 60 lines of a field of 64 µs.
    assert found["frequency_hz", "left, oscillation 1"][0] == pytest.approx(260.4, rel=0.02)
    assert found["random_correlation", "left and right"][0] > 0.9
    assert found["random_common_px", "left and right"][0] == pytest.approx(0.1, rel=0.1)
    assert found["sigma_px", "control"][0] < 0.03 < found["jitter_px", "left"][0]
    lines = (out / "line_jitter_lines_1.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * (400 + 400 + 160)
    assert "Edge left" in (tmp_path / "r.html").read_text()
    far = PLUMB.replace("roi = [80, 0, 60, 400]", "roi = [120, 0, 60, 400]")
    assert "leaves the image" in refused(photoplan, tmp_path, far, "line_jitter")
    empty = PLUMB.replace("roi = [80, 0, 60, 400]", "roi = [120, 0, 40, 400]")
    assert "edge right: no edge in" in refused(photoplan, tmp_path, empty, "line_jitter")
    bright = PLUMB.replace("[camera]", "[camera]\nsaturation_dn = 165.0")
    assert "saturated" in refused(photoplan, tmp_path, bright, "line_jitter")


def warm_frames() -> tuple[list[np.ndarray], np.ndarray]:
    rng = np.random.default_rng(8)
    t = np.repeat(np.arange(0, 6000, 400.0), 2)
    marks = np.array([[40.0, 40], [120, 80]])
    frames = []
    for d in 1 - np.exp(-t / 1500):
        frames.append(
            disc_frame(rng, SIZE, [(*(m + [0.3 * d, -0.2 * d] + 1e-3 * d * (m - [80, 60])), 8) for m in marks])
        )
    return frames, t


def test_warm_up_of_two_targets(photoplan: Here, tmp_path: Path) -> None:
    frames, t = warm_frames()
    write_series(tmp_path, "w", frames, {"time_s": t})
    text = """
[[frames]]
files = "w_*.tif"
kind = "target"
table = "w.csv"
name = "w"
[[frames.targets]]
name = "a"
roi = [10, 10, 60, 60]
[[frames.targets]]
name = "b"
roi = [90, 50, 60, 60]
"""
    found, _ = figures(photoplan, tmp_path, text, "warm_up")
    for name, want in (("shift_x_drift_px", 0.3), ("shift_y_drift_px", -0.2), ("scale_drift_ppm", 1000.0)):
        value, sigma = found[name, "w"]
        print(f"{name}: {value:.4g} ± {sigma:.2g}, put in {want}")
        assert abs(value - want) < 5 * sigma
    assert found["shift_x_time_s", "w"][0] == pytest.approx(1500, rel=0.1)
    assert 0 < found["repeat_sigma_x_px", "w"][0] < 0.02
    one = text[: text.rindex("[[frames.targets]]")]
    _, whole = figures(photoplan, tmp_path, one, "warm_up")
    assert any("cannot be told from a shift" in note for note in whole["notes"])
    asked = one.replace('name = "w"', 'name = "w"\nvalues = { model = "similarity" }')
    assert "it needs 2" in refused(photoplan, tmp_path, asked, "warm_up")
    none = text.replace("roi = [90, 50, 60, 60]", "roi = [0, 80, 40, 40]")
    assert "target b is not found in" in refused(photoplan, tmp_path, none, "warm_up")


def test_warm_up_from_a_table(photoplan: Here, tmp_path: Path) -> None:
    t = np.arange(0, 6000, 300.0)
    d = 1 - np.exp(-t / 1500)
    rng = np.random.default_rng(9)
    rows = [
        f"{time},{n},{x + 0.3 * k + rng.normal(0, 0.002):.5f},{y + rng.normal(0, 0.002):.5f}"
        for time, k in zip(t, d)
        for n, x, y in (("a", 100, 100), ("b", 400, 300))
    ]
    (tmp_path / "p.csv").write_text("\n".join(["time_s,target,x,y", *rows]) + "\n")
    text = '[[positions]]\nfile = "p.csv"\nkind = "target"\n'
    found, _ = figures(photoplan, tmp_path, text, "warm_up")
    value, sigma = found["shift_x_drift_px", "p"]
    assert abs(value - 0.3) < 5 * sigma
    (tmp_path / "p.csv").write_text("\n".join(["time_s,target,x,y", *rows[::-1]]) + "\n")
    assert "sort the lines by time" in refused(photoplan, tmp_path, text, "warm_up")
    (tmp_path / "p.csv").write_text("time_s,target,x,y\n0,a,1,nan\n")
    assert "p.csv:2: y is 'nan'" in refused(photoplan, tmp_path, text, "warm_up")
    (tmp_path / "p.csv").write_text("target,x,y\na,1,2\n")
    assert "also need time_s" in refused(photoplan, tmp_path, text, "warm_up")
