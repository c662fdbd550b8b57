"""Images aligned by a chromatic model: measured, kept in a file, corrected by windows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.formed import form_image
from tools.thinned import some

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader, write_whole_image
from photoplan.products.measured_filter import (
    ChromaticRequest,
    load_chromatic,
    measure_chromatic,
    model_figures,
    model_lines,
    save_chromatic,
)
from photoplan.project.align import AlignStep
from photoplan.project.steps import SteppedReader
from photoplan.quality.colour import BandModel, ChromaticModel
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics import Gain, Lateral, Quantisation, Spread
from photoplan.quality.formation.scenes import PatternScene

LATERAL = (Lateral(1, (0.6, -0.4), 0.004, 0.0), Lateral(3, (-0.5, 0.2), -0.003, 0.0))
SCENE = PatternScene("discs", (300, 220), (24.0, 11.0), 4, bands=3)
CAMERA = ImageModel(
    Spread(gaussian=(0.8, 0.8)), lateral=LATERAL, gain=Gain(200.0, 10.0, 2.0), quantisation=Quantisation(8)
)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("chromatic") / "chart.tif"
    write_whole_image(path, form_image(CAMERA, SCENE).values)
    return path


@pytest.fixture(scope="module")
def model(image: Path) -> ChromaticModel:
    return measure_chromatic(ChromaticRequest(image))


def test_bands_lie_on_each_other_after_correction(image: Path, model: ChromaticModel) -> None:
    assert model.reference == 2 and model.description == "discs of chart.tif"
    source = RasterReader(image)
    before, _ = source.read(Window(0, 0, 300, 220))
    after, valid = SteppedReader(source, (AlignStep(model),)).read(Window(0, 0, 300, 220))
    assert valid is None
    assert np.array_equal(after[1], before[1])
    inside = (slice(20, -20), slice(20, -20))
    for band in (0, 2):
        rough = np.sqrt(np.mean((before[band][inside].astype(float) - before[1][inside]) ** 2))
        fine = np.sqrt(np.mean((after[band][inside].astype(float) - after[1][inside]) ** 2))
        print(f"\nband {band + 1}: differs from the reference by {rough:.2f}, corrected by {fine:.2f} grey values")
        assert rough > 10.0 and fine < 3.0  # noise 2 in both
    left = measure_aligned(after, image)
    print(f"left after correction: {left:.4f} px")
    assert left < 0.02


def measure_aligned(bands: np.ndarray, image: Path) -> float:
    path = image.with_name("aligned.tif")
    write_whole_image(path, bands)
    again = measure_chromatic(ChromaticRequest(path, kind="scale"))
    return max(again.largest(1), again.largest(3))


def test_result_does_not_depend_on_windows(image: Path, model: ChromaticModel) -> None:
    reader = SteppedReader(RasterReader(image), (AlignStep(model),))
    whole, _ = reader.read(Window(0, 0, 300, 220))
    for window in Window(0, 0, 300, 220).tiles(97):
        rows, columns = slice(window.row, window.stop[1]), slice(window.col, window.stop[0])
        assert np.array_equal(reader.read(window)[0], whole[:, rows, columns])


@pytest.mark.parametrize("dtype", some(["uint8", "uint16", "int16", "float32"], 1))
def test_whole_pixels_are_moved_without_change(dtype: str, tmp_path: Path) -> None:
    values = np.random.default_rng(1).normal(100, 20, (3, 90, 110)).astype(dtype)
    write_whole_image(tmp_path / "t.tif", values)
    moved = ChromaticModel((110, 90), 2, (BandModel(1, ((0, 0, 1.0, 0.0),)), BandModel(3, ((0, 0, -2.0, 3.0),))))
    out, valid = SteppedReader(RasterReader(tmp_path / "t.tif"), (AlignStep(moved),)).read(Window(0, 0, 110, 90))
    assert valid is None and out.dtype == dtype
    # Where the band lies 1 px to the right, its value there is that of the reference's pixel; the border's is repeated.
    assert np.array_equal(out[0], values[0][:, np.minimum(np.arange(110) + 1, 109)])
    assert np.array_equal(out[2][:-3, 2:], values[2][3:, :-2])


def test_pixels_without_value_stay_so(tmp_path: Path, model: ChromaticModel) -> None:
    values = np.full((3, 220, 300), 50.0, np.float32)
    values[:, 100, 150] = np.nan
    write_whole_image(tmp_path / "gap.tif", values)
    out, valid = SteppedReader(RasterReader(tmp_path / "gap.tif"), (AlignStep(model),)).read(Window(0, 0, 300, 220))
    assert valid is not None and not valid[100, 150] and 1 <= (~valid).sum() <= 144
    assert np.allclose(out[:, valid], 50.0, atol=1e-4)


def test_a_file_holds_the_model(model: ChromaticModel, tmp_path: Path) -> None:
    save_chromatic(tmp_path / "c.toml", model)
    again = load_chromatic(tmp_path / "c.toml")
    x, y = np.meshgrid(np.arange(0, 300, 50), np.arange(0, 220, 50))
    for band in (1, 3):
        assert np.allclose(again.displacement(band, x, y), model.displacement(band, x, y), atol=1e-6)
    assert again.size == model.size and again.bands[0].count == model.bands[0].count
    figures = model_figures(model)
    assert figures["bands"][0]["corner"] == pytest.approx(0.004 * np.hypot(300, 220) / 2, abs=0.03)
    assert {t["kind"] for t in figures["bands"][0]["tried"]} >= {"shift", "scale", "radial"}


HEAD = 'format = "photoplan chromatic 1"\nimage_size = [3, 3]\nreference = 1\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("image_size = [3, 3]\nreference = 1\n", "format: is missing"),
        (HEAD + "bnds = 1\n", ":4: bnds: unknown entry"),
        (HEAD + "[[bands]]\nband = 1\n", "reference"),
        (HEAD + "[[bands]]\nband = 2\nterms = [[9, 0, 1.0, 1.0]]\n", "less than or equal to 5"),
        (HEAD + "[[bands]]\nband = 2\nterms = [[0, 0, 1e9, 1.0]]\n", "below 1000"),
        ("x = [", "not valid TOML"),
    ],
)
def test_faults_of_a_file(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        load_chromatic(tmp_path / "c.toml")
    assert "c.toml" in str(raised.value)


@pytest.mark.slow
def test_bands_of_a_real_camera_agree_between_frames(block: Path) -> None:
    """The drone's camera corrects its images: bands within 0.03 px everywhere, the same in all frames."""
    corners = []
    for name in ("DJI_0018.jpg", "DJI_0021.jpg"):
        model = measure_chromatic(ChromaticRequest(block / "images" / name, method="windows"))
        corners.append([model.corner(1), model.corner(3)])
        print("\n" + "\n".join(model_lines(model)))
        assert max(model.largest(1), model.largest(3)) < 0.1
        assert all(band.count > 100 and band.residual < 0.02 for band in model.bands)
    assert np.abs(corners).max() < 0.03
    assert np.ptp(corners, axis=0).max() < 0.03


def test_images_that_do_not_fit(image: Path, tmp_path: Path, model: ChromaticModel) -> None:
    write_whole_image(tmp_path / "small.tif", np.zeros((3, 40, 40), np.uint8))
    with pytest.raises(InputError, match="300 × 220"):
        SteppedReader(RasterReader(tmp_path / "small.tif"), (AlignStep(model),))
    far = ChromaticModel((40, 40), 2, (BandModel(1, ((0, 0, 30.0, 0.0),)),))
    with pytest.raises(InputError, match="displaces a band by 30"):
        SteppedReader(RasterReader(tmp_path / "small.tif"), (AlignStep(far),))
    with pytest.raises(InputError, match="describes band 4"):
        SteppedReader(
            RasterReader(tmp_path / "small.tif"), (AlignStep(ChromaticModel((40, 40), 2, (BandModel(4, ()),))),)
        )


def test_images_that_cannot_be_measured(image: Path, tmp_path: Path) -> None:
    write_whole_image(tmp_path / "grey.tif", np.zeros((60, 60), np.uint8))
    with pytest.raises(InputError, match="single band"):
        measure_chromatic(ChromaticRequest(tmp_path / "grey.tif"))
    noise = np.random.default_rng(1).normal(100, 4, (3, 150, 150)).astype(np.uint8)
    write_whole_image(tmp_path / "noise.tif", noise)
    with pytest.raises(InputError, match=r"noise.tif: by discs: band 2.*by windows: band 1.*by edges: band 1"):
        measure_chromatic(ChromaticRequest(tmp_path / "noise.tif"))
    with pytest.raises(UsageError, match="reference band 7"):
        measure_chromatic(ChromaticRequest(image, reference=7))
