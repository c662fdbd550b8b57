"""Filters measured in images: simulated scenes as files, whose spread function and truth are known."""

import numpy as np
import pytest
import rasterio
from scipy.ndimage import convolve
from tools.blurred_scenes import any_edges, discrete_spread, taken

from photoplan.errors import InputError, UsageError
from photoplan.products.measured_filter import design_restoration
from photoplan.requests.quality import RestoreRequest

pytestmark = pytest.mark.usefixtures("searched_once")

SIZE = 320
MOST = 24
FEW = 8
SIGMA = 0.5


def write(path, bands):
    values = np.clip(np.rint(bands), 0, 65535).astype(np.uint16)
    with rasterio.open(
        path, "w", driver="GTiff", width=values.shape[2], height=values.shape[1], count=values.shape[0], dtype="uint16"
    ) as file:
        file.write(values)
    return path


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Two images of one camera, their objects, and their files; grey values times 100."""
    rng = np.random.default_rng(21)
    folder = tmp_path_factory.mktemp("scenes")
    made = [taken(any_edges(rng, SIZE), SIGMA, rng) for _ in range(2)]
    files = [write(folder / f"image_{i}.tif", 100.0 * image[None]) for i, (image, _) in enumerate(made)]
    return made, tuple(files)


def test_a_filter_is_measured_and_restores_other_images(scenes, whole):
    """Measured in one image, used for the other."""
    made, _ = scenes
    (part,) = whole.parts
    truth = discrete_spread(SIGMA).side()[:3]
    print(part.facts())
    for one in part.sharpness:
        assert one.spread.side()[:3] == pytest.approx(truth, abs=0.02)
        frequency = np.array([0.1, 0.25, 0.4])
        curve = np.exp(-2 * (np.pi * SIGMA * frequency) ** 2) * np.sinc(frequency)
        assert [one.modulation().at(f) for f in frequency] == pytest.approx(curve, abs=0.03)
    # 50 of a full scale of 65535, and the contrast that the object has.
    assert part.scene.noise * 65535 == pytest.approx(50.0, rel=0.05)
    image, object_ = made[1]
    seen = np.sqrt((np.diff(object_, axis=1) ** 2).mean())
    assert part.scene.contrast * 655.35 == pytest.approx(seen, rel=0.2)
    restored = convolve(image, part.design.kernel, mode="nearest")
    before, after = ((a - object_)[20:-20, 20:-20].std() for a in (image, restored))
    print(f"rms {before:.2f} -> {after:.2f}")
    assert after < 0.5 * before
    expected = part.design.expected
    assert [655.35 * expected["none"], 655.35 * expected["regularised"]] == pytest.approx([before, after], rel=0.15)


@pytest.fixture(scope="module")
def whole(scenes):
    """What the first image alone shows."""
    return design_restoration(RestoreRequest(scenes[1][:1], most_edges=MOST, method="regularised"))


@pytest.mark.parametrize("level", [65535.0 + 110.0, pytest.param(-90.0, marks=pytest.mark.slow)])
def test_full_skies_and_black_shadows_do_not_hide_the_noise(scenes, tmp_path, level):
    """A part that is just full: its few pixels beside the end of the range are not the noise of the image."""
    made, _ = scenes
    flat = level + np.random.default_rng(3).normal(0.0, 50.0, (144, SIZE))
    path = write(tmp_path / "sky.tif", np.concatenate([100.0 * made[0][0], flat])[None])
    (part,) = design_restoration(RestoreRequest((path,), most_edges=FEW, method="regularised")).parts
    assert part.scene.noise * 65535 == pytest.approx(50.0, rel=0.05)


def test_the_exact_inverse_for_whoever_asks_for_it(scenes):
    _, files = scenes
    found = design_restoration(RestoreRequest(files[:1], most_edges=FEW, method="exact"))
    (part,) = found.parts
    assert part.design.method == "exact"
    assert found.filter.facts["rule"].startswith("exact: as asked for")
    assert set(part.facts()["expected_error"]) == {"none", "regularised", "exact"}
    assert f"{part.design.expected['exact']:.3g} exact" in found.filter.facts["expected"]
    assert found.filter.kernels[0].total == pytest.approx(1.0)
    assert found.filter.facts["noise_gain"] == pytest.approx(found.filter.noise_gain, abs=1e-3)
    assert not found.mtf.enhancement.enhanced


@pytest.mark.slow
def test_what_a_part_of_the_field_does_not_show_is_taken_from_the_whole(scenes, whole):
    _, files = scenes
    asked = RestoreRequest(files[:1], cells=3, most_edges=MOST, method="regularised")
    found = design_restoration(asked)
    (whole,) = whole.parts
    assert len(found.filter.kernels) == 9
    assert found.filter.image_size == (SIZE, SIZE)
    partly = [part for part in found.parts if part.edges and part.missing]
    assert partly
    for part in partly:
        lacking = "xy".index(part.missing[0])
        assert part.sharpness[lacking].spread.values == pytest.approx(whole.sharpness[lacking].spread.values)
        assert part.sharpness[1 - lacking].spread.values != pytest.approx(whole.sharpness[1 - lacking].spread.values)


@pytest.mark.slow
def test_parts_without_edges_get_the_filter_of_the_whole_field(scenes):
    _, files = scenes
    found = design_restoration(RestoreRequest(files[:1], cells=6, most_edges=FEW, method="regularised"))
    assert sum(part.edges == 0 for part in found.parts) > 10
    assert any("get the filter of the whole field" in note for note in found.notes)


def test_bands_of_different_sharpness_get_filters_of_their_own(tmp_path):
    rng = np.random.default_rng(22)
    scene = any_edges(rng, 256)
    bands = [taken(scene, sigma, rng)[0] for sigma in (0.35, 0.65)]
    file = write(tmp_path / "colour.tif", 100.0 * np.array(bands))
    found = design_restoration(RestoreRequest((file,), per_band=True, most_edges=5))
    assert [kernel.band for kernel in found.filter.kernels] == [1, 2]
    gains = [kernel.noise_gain for kernel in found.filter.kernels]
    print("noise gains", np.round(gains, 2))
    assert gains[0] < gains[1]


def test_images_of_different_size_are_refused(scenes, tmp_path):
    made, _ = scenes
    files = [write(tmp_path / f"{rows}.tif", 100.0 * made[0][0][None, :rows, :144]) for rows in (144, 140)]
    with pytest.raises(UsageError, match="different size"):
        design_restoration(RestoreRequest(tuple(files), most_edges=2))


def test_images_without_edges_give_no_filter(tmp_path):
    rng = np.random.default_rng(23)
    file = write(tmp_path / "flat.tif", rng.normal(1000.0, 20.0, (1, 300, 300)))
    with pytest.raises(InputError, match="no image can be measured"):
        design_restoration(RestoreRequest((file,)))


@pytest.mark.slow
def test_of_several_parts_the_noisiest_tells_of_the_condition(scenes):
    _, files = scenes
    found = design_restoration(RestoreRequest(files[:1], cells=3, most_edges=60))
    worst = max(found.parts, key=lambda part: part.design.noise_gain)
    assert found.filter.facts["rule"].startswith("of 9 parts 9 regularised; the noisiest, at col")
    assert str(worst.design.condition_x) in found.filter.facts["condition"]
    assert found.filter.facts["noise_gain"] == pytest.approx(worst.design.noise_gain, abs=1e-3)
