"""Image formation: charge, noise and grey values against closed forms."""

import numpy as np
import pytest
from tools.formed import form_image, form_series

from photoplan.errors import InputError
from photoplan.quality.formation.model import ImageModel, overflow
from photoplan.quality.formation.optics import (
    AutomaticGain,
    DarkCurrentPart,
    DefectPart,
    EnhancementPart,
    Exposure,
    FixedPattern,
    Gain,
    Quantisation,
    Readout,
    Spread,
    ToneCurve,
    Well,
)
from photoplan.quality.formation.scenes import PatternScene

FLAT = np.ones((400, 500))


def test_variance_of_shot_noise_is_gain_times_mean():
    """Photon transfer: σ² = K μ + K² σ_d² (EMVA 1288, eq. 15), K = 0.25."""
    for light in (100.0, 4000.0):
        model = ImageModel(
            exposure=Exposure(light=light / 0.5, quantum_efficiency=0.5),
            readout=Readout(shot_noise=True, noise=12.0),
            gain=Gain(factor=0.25, offset=40.0),
        )
        values = form_image(model, FLAT).values
        assert values.mean() == pytest.approx(40.0 + 0.25 * light, abs=0.1)
        assert values.var() == pytest.approx(0.25 * (0.25 * light) + (0.25 * 12.0) ** 2, rel=0.01)


def test_frames_differ_in_noise_only():
    model = ImageModel(
        exposure=Exposure(light=1000.0),
        fixed_pattern=FixedPattern(response=0.02, offset=5.0, column=2.0, row=1.0),
        readout=Readout(noise=3.0),
        seed=4,
    )
    first, again, second = (form_image(model, FLAT, frame).values for frame in (0, 0, 1))
    assert np.array_equal(first, again)
    assert (first - second).std() == pytest.approx(3.0 * np.sqrt(2), rel=0.01)
    # What the frames share: response 20, offset 5, columns 2, rows 1 electrons.
    shared = np.cov(first.ravel(), second.ravel())[0, 1]
    assert shared == pytest.approx(20.0**2 + 5.0**2 + 2.0**2 + 1.0**2, rel=0.02)
    other = form_image(ImageModel(**{**model.__dict__, "seed": 5}), FLAT).values
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.05


def test_dark_current_doubles():
    """Behr 1989, section 3.6.4: about every 10 °C."""
    means = []
    for degrees in (20.0, 30.0, 45.0):
        dark = DarkCurrentPart(rate=8.0, at_deg=20.0, doubling_deg=10.0, temperature_deg=degrees)
        image = form_image(ImageModel(exposure=Exposure(seconds=2.0), dark=dark), 0.0 * FLAT, exposure=3.0)
        means.append(image.values.mean())
        assert image.facts["dark_electrons"] == pytest.approx(means[-1])
    assert np.allclose(np.array(means) / (8.0 * 6.0), [1.0, 2.0, 2.0**2.5])


def test_defects():
    defects = (
        DefectPart(3, 5, "dead"),
        DefectPart(7, 5, "weak", 0.5),
        DefectPart(8, 5, "hot", 100.0),
        DefectPart(9, 5, "stuck", 77.0),
    )
    image = form_image(ImageModel(defects=defects, exposure=Exposure(light=10.0)), np.ones((10, 12)), exposure=2.0)
    assert image.values[5, [3, 7, 8, 9]].tolist() == [0.0, 10.0, 220.0, 77.0]
    assert np.delete(image.values.ravel(), [5 * 12 + c for c in (3, 7, 8, 9)]).tolist() == [20.0] * 116


@pytest.mark.parametrize(
    "well",
    [
        Well(100.0),
        Well(100.0, circular=0.4),
        Well(100.0, tailing=0.3),
        Well(100.0, drain=0.25, circular=0.2, tailing=0.1),
    ],
)
def test_overflow_keeps_the_charge(well):
    charge = np.full((61, 51), 20.0)
    charge[28:33, 24:27] = 700.0
    flown = overflow(charge, well)
    assert flown.electrons.max() <= 100.0 + 1e-9
    assert flown.electrons.sum() + flown.drained + flown.lost == pytest.approx(charge.sum(), rel=1e-12)
    assert flown.drained == pytest.approx(well.drain * 15 * 600.0)
    assert flown.lost == pytest.approx(0.0, abs=1e-6)
    assert (flown.electrons >= np.minimum(charge, 100.0) - 1e-12).all()


def test_overflow_runs_along_columns_first():
    charge = np.full((61, 51), 20.0)
    charge[30, 25] = 100.0 + 2 * 3 * 80.0
    flown = overflow(charge, Well(100.0))
    assert np.flatnonzero(flown.touched.any(0)).tolist() == [25]
    assert flown.electrons[27:34, 25].tolist() == [100.0] * 7
    assert flown.electrons[[26, 34], 25].tolist() == [20.0, 20.0]


def test_circular_overflow_is_round_and_tailing_one_sided():
    charge = np.zeros((61, 61))
    charge[30, 30] = 1100.0
    around = overflow(charge, Well(100.0, circular=1.0, circular_width=4.0)).electrons
    assert np.allclose(around, around.T, atol=2e-3) and np.allclose(around, around[::-1, ::-1])
    along = overflow(charge, Well(100.0, tailing=1.0)).electrons
    assert along[30, 30:41].tolist() == [100.0] * 11 and along.sum() == 1100.0


def test_charge_over_the_border_is_lost():
    charge = np.zeros((5, 3))
    charge[2, 1] = 1000.0
    flown = overflow(charge, Well(100.0))
    assert flown.electrons[:, 1].tolist() == [100.0] * 5
    assert flown.lost == pytest.approx(500.0)


def test_transfer_losses_lower_the_modulation():
    """Behr 1989, eq. 3.15: M = exp(−nε (1 − cos 2π f_s / f_c))."""
    for frequency in (0.125, 0.5):
        x = np.arange(512)
        scene = np.tile(100.0 + 50.0 * np.cos(2 * np.pi * frequency * x), (4, 1))
        image = form_image(ImageModel(readout=Readout(transfer_product=0.2)), scene).values
        found = np.ptp(image[2, 100:400:1]) / np.ptp(scene[2])
        wave = np.exp(-2j * np.pi * frequency * x[104:360])
        found = abs((image[2, 104:360] - 100.0) @ wave) / abs((scene[2, 104:360] - 100.0) @ wave)
        assert found == pytest.approx(np.exp(-0.2 * (1 - np.cos(2 * np.pi * frequency))), rel=1e-6)
        assert image[:, 50:].mean() == pytest.approx(100.0, rel=1e-2)


@pytest.mark.parametrize("product", [0.01, 0.1, 0.3, 2.0])
def test_charge_arrives_late_by_the_transfer_product(product):
    """The mean of the shares e^(−nε) (nε)^k / k! is nε; what is not late stays where it is, border included."""
    scene = np.full((3, 60), 10.0)
    scene[1, 20] = scene[1, 59] = 1010.0
    image = form_image(ImageModel(readout=Readout(transfer_product=product)), scene).values - 10.0
    assert image[1, 20] == pytest.approx(1000 * np.exp(-product), rel=1e-5)
    assert (image[1, :55] @ np.arange(55)) / image[1, :55].sum() == pytest.approx(20 + product, abs=1e-5)
    assert image[1, 59] == pytest.approx(1000 * np.exp(-product), rel=1e-5)
    assert np.allclose(image[[0, 2]], 0.0, atol=1e-4)


def test_smear_is_the_mean_of_the_column():
    scene = np.zeros((10, 6))
    scene[4, 2] = 50.0
    image = form_image(ImageModel(readout=Readout(smear=0.1)), scene).values
    assert np.allclose(image[0], [0, 0, 0.5, 0, 0, 0])


def test_quantisation_noise():
    """Behr 1989, eq. 3.14: 1 / √12; saturation clips."""
    ramp = np.linspace(10.0, 200.0, 500 * 400).reshape(400, 500)
    image = form_image(ImageModel(quantisation=Quantisation(8)), ramp)
    assert image.values.dtype == np.uint8
    assert (image.values - ramp).mean() == pytest.approx(0.0, abs=5e-3)
    assert (image.values - ramp).std() == pytest.approx(1 / np.sqrt(12), rel=2e-3)
    clipped = form_image(ImageModel(quantisation=Quantisation(12)), np.array([[-5.0, 4095.4, 9000.0]]))
    assert clipped.values.tolist() == [[0, 4095, 4095]] and clipped.values.dtype == np.uint16
    assert clipped.facts["saturated_pixels"] == 2


def test_edge_enhancement_over_and_undershoots():
    scene = PatternScene("edge", (60, 20), (0.0,), 8, levels=(50.0, 150.0))
    model = ImageModel(Spread(gaussian=(0.8, 0.8)), enhancement=EnhancementPart(1.0, 1.5))
    row = form_image(model, scene).values[10]
    assert row.max() > 155.0 and row.min() < 45.0
    assert row[[0, -1]] == pytest.approx([50.0, 150.0])
    assert row.max() - 150.0 == pytest.approx(50.0 - row.min())


def test_tone_curves():
    grey = np.array([[0.0, 10.0, 127.5, 255.0, -3.0]])
    gamma = form_image(ImageModel(tone=ToneCurve("gamma", 255.0, 2.0)), grey).values
    assert np.allclose(gamma, 255.0 * np.sqrt(np.maximum(grey, 0) / 255.0))
    srgb = form_image(ImageModel(tone=ToneCurve("srgb")), grey).values
    assert srgb[0, 2] == pytest.approx(187.5, abs=0.1)
    table = form_image(ImageModel(tone=ToneCurve("table", table=((0.0, 5.0), (255.0, 250.0)))), grey).values
    assert np.allclose(table, [[5.0, 5 + 10 * 245 / 255, 127.5, 250.0, 5.0]])


def test_automatic_gain_follows_a_step():
    """After a bright scene the dark one is raised over some frames; 1 − 1/e of the way after `frames`."""
    bright, dark = (PatternScene("flat", (40, 30), levels=(0.0, level)) for level in (200.0, 50.0))
    model = ImageModel(automatic_gain=AutomaticGain(200.0, frames=5.0, most=3.0))
    series = list(form_series(model, [bright] * 3 + [dark] * 30))
    assert [image.gain for image in series[:4]] == [1.0] * 4
    assert series[3].values.mean() == pytest.approx(50.0)
    assert series[8].gain == pytest.approx(1.0 + 2.0 * (1 - np.exp(-1.0)))
    assert series[-1].values.mean() == pytest.approx(150.0, rel=0.01)


def test_series_is_its_single_frames():
    model = ImageModel(exposure=Exposure(light=500.0), readout=Readout(shot_noise=True), seed=3)
    scene = PatternScene("star", (40, 30), (12.0,), 4)
    series = list(form_series(model, [scene] * 3, (1.0, 2.0, 4.0)))
    for frame, (image, exposure) in enumerate(zip(series, (1.0, 2.0, 4.0))):
        assert np.array_equal(image.values, form_image(model, scene, frame, exposure).values)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Well(100.0, drain=0.7, circular=0.6), "at most 1"),
        (lambda: DefectPart(1, 1, "odd"), "dead, weak, hot"),
        (lambda: Quantisation(17), "bits"),
        (lambda: ToneCurve("table", table=((1.0, 2.0),)), "2 to 65536"),
        (lambda: ImageModel(seed=-1), "seed"),
        (lambda: form_image(ImageModel(defects=(DefectPart(9, 0, "dead"),)), np.ones((4, 4))), "column 9"),
        (lambda: form_image(ImageModel(), np.ones((4, 4)), exposure=-1.0), "exposure"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()
