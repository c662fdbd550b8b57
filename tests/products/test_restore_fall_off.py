"""Light fall-off corrected before the filter: flat comes out flat, for any tiles and with other corrections."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from scipy import ndimage
from tools.command import Here
from tools.thinned import some

from photoplan.geometry.grid import Window
from photoplan.io.quality_files import FallOffEntry, TermEntry, fall_off_text
from photoplan.products.characterise.response import correction_text
from photoplan.products.restore import RestoreReport, RestoreRequest, plan_restoration, restore_images
from photoplan.project.steps import restoration_of
from photoplan.quality.camera.fall_off import FallOffModel, FallOffSettings, fit_fall_off
from photoplan.quality.colour import BandModel, ChromaticModel
from photoplan.quality.curves import Linearisation
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter

SIZE, POINT, FOCAL = (350, 280), (180.0, 135.0), 400.0
TERMS = {(2, 0): -0.08, (4, 0): -0.10, (1, 1): 0.05, (2, 2): 0.02}
WEIGHTS = np.array([[0.02, -0.15, 0.01], [-0.2, 1.62, -0.14], [0.03, -0.16, -0.03]])
NONE = RestorationFilter((FilterKernel(np.ones((1, 1))),), description="none")
SHARPER = RestorationFilter((FilterKernel(WEIGHTS),), description="sharper")
SRGB = Linearisation("srgb")


@pytest.fixture
def photoplan(capsys: pytest.CaptureFixture[str]) -> Here:
    return Here(capsys)


def brightness(dark: float = 0.0) -> np.ndarray:
    model = FallOffModel(SIZE, POINT, FOCAL, tuple(TERMS), tuple(TERMS.values()), dark)
    return model.relative(np.arange(SIZE[0], dtype=float)[None, :], np.arange(SIZE[1], dtype=float)[:, None])


def model_file(folder: Path, dark: float = 0.0, size: tuple[int, int] = SIZE, name: str = "model.toml") -> Path:
    terms = tuple(TermEntry(n=n, m=m, coefficient=value) for (n, m), value in TERMS.items())
    entry = FallOffEntry(
        format="photoplan light fall-off 1",
        size=size,
        principal_point_px=POINT,
        camera_constant_px=FOCAL,
        dark_dn=dark,
        terms=terms,
    )
    (folder / name).write_text(fall_off_text(entry))
    return folder / name


def write(path: Path, values: np.ndarray, dtype: str = "uint8", **form: object) -> Path:
    bands = np.asarray(values)[None] if np.ndim(values) == 2 else values
    if dtype != "float32":
        bands = np.clip(np.rint(bands), 0, np.iinfo(dtype).max)
    height, width = bands.shape[1:]
    shape = {"width": width, "height": height, "count": bands.shape[0], "dtype": dtype}
    with rasterio.open(path, "w", driver="GTiff", **shape, **form) as file:
        file.write(bands.astype(dtype))
    return path


def restored(image: Path, model: Path, filter_: RestorationFilter = NONE, **how: object) -> np.ndarray:
    with rasterio.open(made(image, model, filter_, **how).images[0].path) as file:
        return file.read()


def made(image: Path, model: Path, filter_: RestorationFilter = NONE, **how: object) -> RestoreReport:
    report = restore_images(RestoreRequest((image,), filter_, fall_off=model, quicklook=False, overwrite=True, **how))
    assert not report.failed, report.failed
    return report


def texture() -> np.ndarray:
    return 120 + 40 * ndimage.gaussian_filter(np.random.default_rng(5).normal(size=SIZE[::-1]), 1.5) / 0.18


@pytest.mark.parametrize(("dtype", "level"), some([("uint8", 180.0), ("uint16", 30_000.0), ("float32", 0.7)], 0, 2))
def test_fall_off_put_in_comes_out_flat_to_the_rounding(tmp_path: Path, dtype: str, level: float) -> None:
    image = write(tmp_path / "flat.tif", level * brightness(), dtype)
    out = restored(image, model_file(tmp_path), dtype=("float32" if dtype == "float32" else "same"))
    gain = 1.0 / brightness().min()
    spread = np.ptp(level * brightness()) / level
    worst = np.abs(out - level).max()
    print(f"{dtype}: fall-off {100 * spread:.1f} %, gain up to {gain:.2f}, after correction {worst / level:.1e}")
    assert out.dtype == dtype and spread > 0.4
    assert worst <= (1e-6 * level if dtype == "float32" else 0.5 * gain + 0.501)


def test_a_fitted_model_corrects_to_its_residual(tmp_path: Path) -> None:
    """Measured in one flat image, used for another: what is left is noise and the residual that the fit states."""
    rng = np.random.default_rng(8)
    flats = [20_000.0 * brightness() + rng.normal(0, 100.0, SIZE[::-1]) for _ in range(2)]
    fit = fit_fall_off(flats[0], FallOffSettings("given", FOCAL, POINT))
    (tmp_path / "model.toml").write_text(correction_text(fit, "", "gain.tif", 4))
    out = restored(write(tmp_path / "flat.tif", flats[1], "uint16"), tmp_path / "model.toml")[0]
    side = 35
    blocks = out.reshape(SIZE[1] // side, side, SIZE[0] // side, side).mean((1, 3)) / 20_000.0
    rms, noise = blocks.std(), 100.0 / 20_000.0 / side * (1.0 / brightness()).mean()
    print(f"blocks after correction {rms:.2e}, noise {noise:.2e}, residual of the fit {fit.residual_rms:.2e}")
    assert rms < 1.3 * noise and rms < fit.residual_rms
    assert np.abs(blocks - 1.0).max() < 6 * noise


def test_gain_is_applied_to_light_not_to_srgb_values(tmp_path: Path) -> None:
    light = np.linspace(0.1, 0.6, SIZE[0])[None, :] * np.ones(SIZE[::-1])
    encoded = 65535 * SRGB.to_values(light * brightness())
    out = restored(write(tmp_path / "a.tif", encoded, "uint16"), model_file(tmp_path), linearisation="srgb")[0]
    expected = 65535 * SRGB.to_values(light)
    print("largest difference", np.abs(out - expected).max())
    assert np.abs(out - expected).max() < 2.0
    wrong = restored(tmp_path / "a.tif", model_file(tmp_path))[0]
    assert np.abs(wrong - expected).max() > 3000


def test_dark_is_taken_off_and_decoded_by_the_same_curve(tmp_path: Path) -> None:
    grey, light = np.array([0.0, 100.0, 1000.0, 4095.0]), np.array([0.0, 10.0, 60.0, 500.0])
    (tmp_path / "table.csv").write_text("grey,light\n" + "\n".join(f"{g:g},{v:g}" for g, v in zip(grey, light)))
    scene = np.linspace(50.0, 300.0, SIZE[1])[:, None] * np.ones(SIZE[::-1])
    dark = np.interp(200.0, grey, light)
    seen = np.interp(scene * brightness() + dark, light, grey)
    image, model = write(tmp_path / "a.tif", seen, "float32"), model_file(tmp_path, dark=200.0)
    out = restored(image, model, linearisation=str(tmp_path / "table.csv"))[0]
    assert np.abs(out - np.interp(scene + dark, light, grey)).max() < 0.01
    linear = write(tmp_path / "b.tif", scene * brightness() + 200.0, "float32")
    assert np.abs(restored(linear, model)[0] - (scene + 200.0)).max() < 1e-3


def test_with_a_filter_nothing_is_rounded_in_between(tmp_path: Path) -> None:
    image = write(tmp_path / "a.tif", texture() * brightness())
    with rasterio.open(image) as file:
        light = file.read(1) / brightness()
    exact = ndimage.convolve(light, WEIGHTS)[2:-2, 2:-2]
    out = restored(image, model_file(tmp_path), SHARPER)[0, 2:-2, 2:-2]
    assert np.abs(out - np.clip(exact, 0, 255)).max() <= 0.501
    floats = restored(image, model_file(tmp_path), SHARPER, dtype="float32")[0, 2:-2, 2:-2]
    assert np.abs(floats - exact).max() < 1e-3


def test_what_becomes_brighter_than_the_type_is_counted(tmp_path: Path) -> None:
    image = write(tmp_path / "a.tif", np.full(SIZE[::-1], 200.0))
    (done,) = made(image, model_file(tmp_path)).images
    over = np.count_nonzero(np.rint(200.0 / brightness()) > 255)
    assert over > 0.0255 * SIZE[0] * SIZE[1] and done.above == (over,) and done.below == (0,)
    srgb = 255 * SRGB.to_values(SRGB.to_linear(np.array(200 / 255.0)) / brightness())
    (done,) = made(image, model_file(tmp_path), linearisation="srgb").images
    assert done.above == (np.count_nonzero(np.rint(srgb) > 255),)


@pytest.mark.parametrize("linearisation", some(["linear", "srgb"], 1))
def test_tiles_do_not_matter_with_filter_colours_and_gaps(tmp_path: Path, linearisation: str) -> None:
    bands = np.stack([texture() * brightness() * share for share in (0.8, 1.0, 1.1)])
    image = write(tmp_path / "a.tif", bands)
    gap = np.ones(SIZE[::-1], bool)
    gap[150:170, 248:265] = False
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(image, "r+") as file:
        file.write_mask(gap)
    colours = ChromaticModel(SIZE, 2, (BandModel(1, ((0, 0, 0.7, -0.4), (1, 0, 1.3, 0.0))),))
    request = RestoreRequest(
        (image,), SHARPER, fall_off=model_file(tmp_path), chromatic=colours, linearisation=linearisation
    )
    (job,) = plan_restoration(request).jobs
    whole, valid = job.reader.read(Window(0, 0, *SIZE))
    assert valid is not None and np.array_equal(valid, gap) | (valid <= gap).all()
    for part in Window(0, 0, *SIZE).tiles(93):
        some, ok = job.reader.read(part)
        rows, cols = slice(part.row, part.stop[1]), slice(part.col, part.stop[0])
        assert np.array_equal(some, whole[:, rows, cols])
        assert np.array_equal(np.ones(some.shape[1:], bool) if ok is None else ok, valid[rows, cols])
    files = [restored(image, request.fall_off, SHARPER, chromatic=colours, linearisation=linearisation, workers=w,
                      output=tmp_path / str(w)) for w in (1, 3)]  # fmt: skip
    assert np.array_equal(files[0], files[1]) and np.array_equal(files[0][:, valid], whole[:, valid])


def test_light_is_corrected_before_colours(tmp_path: Path) -> None:
    """A flat image stays flat where a band is displaced: the gain is that of the place where it was seen."""
    image = write(tmp_path / "a.tif", np.stack([0.5 * brightness()] * 2), "float32")
    colours = ChromaticModel(SIZE, 2, (BandModel(1, ((0, 0, 12.0, -9.0),)),))
    out = restored(image, model_file(tmp_path), chromatic=colours)
    assert np.abs(out - 0.5).max() < 1e-5
    assert np.abs(np.diff(brightness(), axis=1)).max() * 12 > 0.01


def test_bands_without_filter_are_corrected_too(tmp_path: Path) -> None:
    image = write(tmp_path / "a.tif", np.stack([texture() * brightness()] * 2))
    one = restored(image, model_file(tmp_path), SHARPER, bands=(1,), linearisation="srgb", output=tmp_path / "one")
    none = restored(image, model_file(tmp_path), linearisation="srgb", output=tmp_path / "none")
    assert np.array_equal(one[1], none[1]) and not np.array_equal(one[0], none[0])


class TestRuns:
    def test_another_size_is_refused(self, photoplan: Here, tmp_path: Path) -> None:
        image = write(tmp_path / "a.tif", texture()[:, :-1])
        said = photoplan("restore", image, "--filter", "none", "--fall-off", model_file(tmp_path))
        assert said.code == 3 and "349 × 280" in said.err and "350 × 280" in said.err
        assert not (tmp_path / "restored" / "a_restored.tif").exists()

    def test_models_that_cannot_be_used(self, photoplan: Here, tmp_path: Path) -> None:
        image = write(tmp_path / "a.tif", texture())
        said = photoplan("restore", image, "--filter", "none", "--fall-off", tmp_path / "missing.toml")
        assert said.code == 3 and "missing.toml" in said.err
        text = model_file(tmp_path).read_text().replace("coefficient = -0.1\n", "coefficient = -9.0\n")
        (tmp_path / "dark.toml").write_text(text)
        said = photoplan("restore", image, "--filter", "none", "--fall-off", tmp_path / "dark.toml")
        assert said.code == 3 and "dark.toml" in said.err and "brightness inside the image" in said.err

    def test_record_talk_and_a_changed_model(self, photoplan: Here, tmp_path: Path) -> None:
        image, model = write(tmp_path / "a.tif", texture() * brightness()), model_file(tmp_path)
        words = ("restore", image, "--filter", "none", "--no-quicklook", "--workers", 1, "--fall-off", model)
        said = photoplan(*words)
        assert said.code == 0, said.err
        gain = 1.0 / brightness().min()
        assert f"a.tif: light fall-off corrected by model.toml: gain up to {gain:.3g}" in said.err
        assert "noise grows 1 times" not in said.err
        folder = tmp_path / "restored"
        assert sorted(p.name for p in folder.iterdir()) == ["a_restored.run.json", "a_restored.tif"]
        record = json.loads((folder / "a_restored.run.json").read_text())
        assert record["fall_off"]["largest_gain"] == pytest.approx(gain, rel=1e-3)
        assert model.resolve() in [(folder / each["path"]).resolve() for each in record["inputs"]]
        key = record["key"]
        again = photoplan(*words)
        assert again.code == 2 and "exists" in again.err
        model.write_text(model.read_text().replace("-0.08", "-0.06"))
        (job,) = plan_restoration(RestoreRequest((image,), NONE, fall_off=model, overwrite=True)).jobs
        assert job.key != key
        said = photoplan(*words, "--overwrite")
        assert said.code == 0 and json.loads((folder / "a_restored.run.json").read_text())["key"] == job.key

    def test_without_the_option_nothing_changes(self, tmp_path: Path) -> None:
        """The key and the record of runs without a correction hold nothing of it."""
        image = write(tmp_path / "a.tif", texture())
        (job,) = plan_restoration(RestoreRequest((image,), SHARPER)).jobs
        assert len(job.reader.steps) == 1 and not restoration_of(job.reader).restorer.light_given

    def test_no_filter_and_an_aperture_contradict_each_other(self, photoplan: Here, tmp_path: Path) -> None:
        image = write(tmp_path / "a.tif", texture())
        said = photoplan("restore", image, "--filter", "none", "--aperture", "square")
        assert said.code == 2 and "exclude each other" in said.err

    def test_the_report_says_it(self, photoplan: Here, tmp_path: Path) -> None:
        image, model = write(tmp_path / "a.tif", texture() * brightness()), model_file(tmp_path)
        words = ("restore", image, "--filter", "none", "--fall-off", model, "--report", tmp_path / "r.html")
        said = photoplan(*words, "--no-quicklook")
        assert said.code == 0, said.err
        html = (tmp_path / "r.html").read_text("utf-8")
        assert "There is no filter" in html and "light fall-off corrected by model.toml" in html
        said = photoplan(*words[:-1], model.with_name("model.html"), "--overwrite", "--dry-run")
        assert said.code == 0 and not (tmp_path / "model.html").exists()
