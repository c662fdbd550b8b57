"""Image formation: light on the pixels against closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage, signal, special
from tools.formed import ArrayScene, form_image

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.products.simulate import check_fit
from photoplan.quality.curves import GAUSSIAN_WIDTH
from photoplan.quality.formation import optics
from photoplan.quality.formation.model import ImageModel, model_modulation, model_mtf50, model_transfer
from photoplan.quality.formation.optics import Aperture, Falloff, Lateral, LineJitterPart, Spread, pixel_kernel
from photoplan.quality.formation.scenes import PatternScene, parse_pattern


def wave(frequency, size=(256, 8), k=8, phase=0.0):
    """Exact cell means of a sine of amplitude 0.5 around 1, cycles per pixel along x."""
    x = (np.arange(size[0] * k) + 0.5) / k - 0.5
    means = 1.0 + 0.5 * np.sin(2 * np.pi * frequency * x + phase) * np.sinc(frequency / k)
    return ArrayScene(np.tile(means, (size[1] * k, 1)), k)


def amplitude(row, frequency):
    n = np.arange(row.size)
    return 2.0 * abs(np.mean((row - row.mean()) * np.exp(-2j * np.pi * frequency * n)))


def edge_of_gauss(x, sigma):
    """Values of pixels of full width at distances x from a Gaussian edge."""

    def integral(u):
        return u * special.ndtr(u / sigma) + sigma * np.exp(-0.5 * (u / sigma) ** 2) / np.sqrt(2 * np.pi)

    return integral(x + 0.5) - integral(x - 0.5)


def test_a_model_without_parts_returns_the_scene():
    scene = np.random.default_rng(1).random((3, 20, 31))
    assert np.array_equal(form_image(ImageModel(), scene).values, scene)


@pytest.mark.parametrize("phase", [0.0, 0.137, 0.5])
@pytest.mark.parametrize("sigma", [0.4, 0.8, 2.0])
def test_gaussian_edge(sigma, phase):
    scene = PatternScene("edge", (64, 8), (0.0,), 16, phase=(phase, 0.0))
    image = form_image(ImageModel(Spread(gaussian=(sigma, sigma))), scene)
    expected = edge_of_gauss(np.arange(64) - 31.5 - phase, sigma)
    assert np.abs(image.values - expected).max() < 4e-4


def test_edge_at_an_angle_is_that_of_the_transfer_function():
    model = ImageModel(Spread(gaussian=(0.7, 0.7)))
    angle = np.radians(17.0)
    image = form_image(model, PatternScene("edge", (60, 60), (17.0,), 8)).values
    y, x = np.mgrid[:60, :60] - 29.5
    distance = x * np.cos(angle) + y * np.sin(angle)
    step = 1e-3
    f = np.arange(step / 2, 4.0, step)
    modulation = model_modulation(model, f, 17.0)
    u = np.linspace(-6, 6, 1201)
    edge = 0.5 + np.sin(2 * np.pi * np.outer(u, f)) @ (modulation / f) * step / np.pi
    near = np.abs(distance) < 5.9
    assert np.abs(image - np.interp(distance, u, edge))[near].max() < 3e-4


SPREADS = {
    "gaussian": Spread(gaussian=(0.6, 0.3)),
    "defocus": Spread(defocus=3.3),
    "motion": Spread(motion=4.0, motion_deg=30.0),
    "diffraction": Spread(diffraction=1.5),
    "tail": Spread(gaussian=(0.5, 0.5), tail_share=0.2, tail_length=3.0),
    "discrete": Spread(along_x=(0.02, 0.15, 0.66, 0.15, 0.02)),
    "kernel": Spread(kernel=((0.0, 0.1, 0.0), (0.1, 0.6, 0.1), (0.0, 0.1, 0.0))),
}
APERTURES = (Aperture(), Aperture("round", (0.75, 0.75)), Aperture("square", (0.4, 1.0)))


def spreads_and_apertures():
    """Every spread function with one of the apertures; with all of them in `make test-slow`."""
    for k, (name, spread) in enumerate(SPREADS.items()):
        for i, aperture in enumerate(APERTURES):
            slow = () if k % 3 == i else pytest.mark.slow
            yield pytest.param(spread, aperture, id=f"{name}-{aperture.shape} {aperture.width[0]:g}", marks=slow)


@pytest.mark.parametrize(("spread", "aperture"), spreads_and_apertures())
def test_modulation_of_a_wave_is_the_transfer_function(spread, aperture):
    model = ImageModel(spread, aperture)
    # Cells that the aperture cuts are taken as even where nothing smooths them; Airy's rings are cut off.
    bound = 3e-4 if max(spread.gaussian) else 6e-3
    for frequency in (0.125, 0.3125):
        image = form_image(model, wave(frequency)).values
        # Far from the border, over whole periods.
        found = amplitude(image[4, 64:192], frequency) / 0.5
        assert found == pytest.approx(model_modulation(model, np.array([frequency]))[0], abs=bound)


def test_koelbl_discrete_spread_on_square_object_pixels():
    """Kölbl 2006, table 1: normalised sums Z, Z + 2A, Z + 2A + 2B beside an edge."""
    scene = np.where(np.arange(40) < 20, 1.0, -1.0) * np.ones((9, 1))
    image = form_image(ImageModel(Spread(along_x=(0.02, 0.15, 0.66, 0.15, 0.02))), scene)
    assert np.allclose(image.values[4, 17:23], [1.0, 0.96, 0.66, -0.66, -0.96, -1.0], atol=1e-12)


def test_light_is_kept():
    scene = np.zeros((121, 121))
    scene[60, 60] = 1.0
    spread = Spread(gaussian=(0.9, 0.5), defocus=3.0, motion=4.0, motion_deg=20.0, tail_share=0.3, tail_length=3.0)
    light = form_image(ImageModel(spread), scene).light
    assert light.sum() == pytest.approx(1.0, abs=1e-9)
    assert light[60, :60].sum() == pytest.approx(light[60, 61:].sum(), rel=1e-9)


def test_spread_grows_over_the_field():
    model = ImageModel(Spread(gaussian=(0.7, 0.7), field_square=0.8))
    size = (420, 60)
    image = form_image(model, wave(0.2, size, 4)).values[30]
    half = np.hypot(*size) / 2
    for column in (210, 300, 380):
        part = image[column - 15 : column + 15] - 1.0
        weights = np.hanning(30)
        n = np.arange(column - 15, column + 15)
        found = 4.0 * abs(np.sum(part * weights * np.exp(-2j * np.pi * 0.2 * n))) / weights.sum()
        expected = model_modulation(model, np.array([0.2]), 0.0, abs(column - 209.5) / half)[0]
        assert found == pytest.approx(expected, abs=0.01)
    assert model_mtf50(model, radius=1.0) < 0.75 * model_mtf50(model)


def in_one_piece(scene, spread, aperture, moved=None):
    """Light on the pixels by one convolution of the whole scene for each scale, without any folding or tiles."""
    (width, height), k, margin = scene.size, scene.oversampling, 60
    whole = Window(0, 0, width, height)
    cells = scene.cells(Window(-margin, -margin, width + 2 * margin, height + 2 * margin))[0]
    levels = optics._levels(spread, scene.size, whole)
    light = np.zeros((height, width))
    for index, scale in enumerate(levels):
        kernel = pixel_kernel(spread, aperture, scale, k, scene.continuous)
        means = signal.fftconvolve(cells, kernel.spread, mode="same")
        means = signal.fftconvolve(means, kernel.weights[::-1, ::-1], mode="valid")
        rows = (margin + np.arange(height)[:, None] + np.zeros((1, width))) * k + kernel.row
        columns = (margin + np.arange(width) - (0.0 if moved is None else moved[:, None])) * k + kernel.column
        places = [rows, np.broadcast_to(columns, rows.shape)]
        order = 1 if moved is None else 3
        light += optics._level_share(spread, levels, index, scene.size, whole) * ndimage.map_coordinates(
            means, places, order=order
        )
    return light


@pytest.mark.parametrize(
    ("spread", "aperture", "k", "jitter"),
    [
        (Spread((0.6, 0.5), tail_share=0.1, tail_length=1.0, field_square=0.3), Aperture(), 4, 0.0),
        (Spread(defocus=1.5, motion=1.0), Aperture("round", (0.7, 1.4)), 5, 0.0),
        (Spread(along_x=(0.1, 0.6, 0.3)), Aperture("square", (2.7, 0.4)), 4, 0.0),
        (Spread(kernel=((0.0, 0.1, 0.0), (0.3, 0.2, 0.1), (0.2, 0.0, 0.1))), Aperture(), 1, 0.0),
        (Spread(), Aperture("point"), 4, 0.0),
        (Spread(), Aperture("round"), 3, 0.0),
        (Spread((0.6, 0.5), field_square=0.3), Aperture(), 3, 0.7),
    ],
)
@pytest.mark.parametrize("kept", [0, 1 << 24])
def test_tiles_and_transforms_change_nothing(spread, aperture, k, jitter, kept, monkeypatch):
    monkeypatch.setattr(optics, "_TILE_CELLS", 1)  # tiles of 16 pixels
    monkeypatch.setattr(optics, "_SMALL_TILE_CELLS", 1)
    monkeypatch.setattr(optics, "_KEPT_BYTES", kept)
    rng = np.random.default_rng(7)
    scene = ArrayScene(rng.random((27 * k, 38 * k)), k)
    moved = rng.normal(0.0, jitter, 27) if jitter else None
    light = optics.Light(scene, optics.Optics(spread, aperture), moved=moved).whole()[0]
    assert np.abs(light - in_one_piece(scene, spread, aperture, moved)).max() < (1e-9 if jitter else 1e-12)


def test_figures_of_a_gaussian_with_its_pixel():
    model = ImageModel(Spread(gaussian=(0.8, 0.8)), Aperture("point"))
    top, half = line_spread(model, np.array([0.0, GAUSSIAN_WIDTH * 0.4]))
    assert half / top == pytest.approx(0.5, rel=1e-4)
    assert model_mtf50(model) == pytest.approx(np.sqrt(np.log(2) / 2) / (np.pi * 0.8), rel=1e-6)
    assert model_mtf50(ImageModel()) == pytest.approx(0.60335, abs=1e-4)  # sinc f = 1/2


def test_fall_off():
    flat = np.full((60, 80), 100.0)
    centre = (np.array([80, 60]) - 1) / 2
    y, x = np.mgrid[:60, :80]
    r = np.hypot(x - centre[0], y - centre[1])
    image = form_image(ImageModel(falloff=Falloff(focal=90.0)), flat).values
    assert np.allclose(image, 100.0 * np.cos(np.arctan(r / 90.0)) ** 4)
    image = form_image(ImageModel(falloff=Falloff(artificial=0.3, power=6.0)), flat).values
    assert np.allclose(image, 100.0 * (1 - 0.3 * (r / 50.0) ** 6))
    image = form_image(ImageModel(falloff=Falloff(polynomial=((0, 0, 1.0), (1, 0, -0.2)), centre=(10.0, 0.0))), flat)
    assert np.allclose(image.values, 100.0 * np.maximum(1 - 0.2 * (x - 10.0) / 50.0, 0))


def test_jitter_moves_lines_by_what_the_truth_says():
    jitter = LineJitterPart(sigma=0.3, field=0.4, amplitude=0.5, period=40.0, phase_deg=30.0)
    model = ImageModel(Spread(gaussian=(0.7, 0.7)), jitter=jitter, seed=5)
    image = form_image(model, PatternScene("edge", (32, 2000), (0.0,), 8), frame=2)
    edge = 32 - image.values.sum(1) - 0.5
    assert np.abs(edge - 15.5 - image.line_shift).max() < 1e-9
    line = np.arange(2000)
    rest = image.line_shift - 0.5 * np.sin(2 * np.pi * line / 40 + np.radians(30)) - np.where(line % 2, 0.2, -0.2)
    assert rest.std() == pytest.approx(0.3, rel=0.05)
    assert abs(rest.mean()) < 0.02
    other = form_image(model, PatternScene("edge", (32, 2000), (0.0,), 8), frame=3).line_shift
    assert abs(np.corrcoef(rest, other - image.line_shift + rest)[0, 1]) < 0.08


def test_lateral_colour_moves_discs():
    lateral = (Lateral(2, (0.3, -0.2), 0.002, 0.001),)
    scene = PatternScene("discs", (300, 200), (30.0, 14.0), 8, bands=2)
    image = form_image(ImageModel(Spread(gaussian=(0.7, 0.7)), lateral=lateral), scene)
    middle = np.array([149.5, 99.5])
    for place in scene.centres():
        if (np.abs(place - middle) > (130, 80)).any():
            continue
        at = place - middle
        factor = 0.002 + 0.001 * (at @ at) / (300**2 + 200**2) * 4
        for band, moved in ((0, np.zeros(2)), (1, at * factor + (0.3, -0.2))):
            c, r = np.round(place).astype(int)
            dark = 1.0 - image.values[band, r - 13 : r + 14, c - 13 : c + 14]
            y, x = np.mgrid[-13:14, -13:14]
            centre = np.array([c + (dark * x).sum() / dark.sum(), r + (dark * y).sum() / dark.sum()])
            assert np.abs(centre - place - moved).max() < 1.5e-3


@pytest.mark.parametrize(
    ("kind", "numbers", "bound"),
    [("edge", (7.3,), 1e-9), ("bars", (6.3, 30.0), 1e-9), ("star", (24.0,), 0.02), ("wedge", (9.0,), 1e-9),
     ("discs", (20.0, 9.0), 1e-9)],
)  # fmt: skip
def test_cells_of_patterns_hold_exact_means(kind, numbers, bound):
    """Means of large cells are the means of the small cells inside."""
    coarse, fine = (PatternScene(kind, (50, 40), numbers, k, phase=(0.3, -0.2)) for k in (2, 32))
    window = Window(-3, -2, 56, 44)
    inside = fine.cells(window).reshape(1, 88, 16, 112, 16).mean((2, 4))
    assert np.abs(coarse.cells(window) - inside).max() < bound


def test_area_of_a_disc():
    scene = PatternScene("discs", (40, 40), (40.0, 17.0), 3)
    assert (1 - scene.cells(Window(0, 0, 40, 40))).sum() / 9 == pytest.approx(np.pi * 8.5**2, rel=1e-12)


def test_patterns_by_name():
    assert parse_pattern("edge:5") == ("edge", (5.0,))
    assert parse_pattern("bars:6,45") == ("bars", (6.0, 45.0))
    assert parse_pattern("flat") == ("flat", ())
    assert parse_pattern("photo.tif") is None


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Spread(gaussian=(-1.0, 0.0)), "gaussian"),
        (lambda: Spread(along_x=(0.5, 0.5)), "odd"),
        (lambda: Spread(field_square=-0.9, field_fourth=-0.5), "field_fourth"),
        (lambda: Spread(defocus=float("nan")), "finite"),
        (lambda: Aperture(width=(0.0, 1.0)), "width"),
        (lambda: PatternScene("edge", (0, 5)), "sides"),
        (lambda: PatternScene("discs", (50, 50), (10.0, 12.0)), "diameter"),
        (lambda: PatternScene("star", (50, 50), (7.5,)), "whole number"),
        (lambda: ArrayScene(np.full((4, 4), np.nan)), "finite"),
        (lambda: ArrayScene(np.ones((5, 4)), 2), "multiples"),
        (lambda: check_fit(PatternScene("flat", (90_000, 90_000)), "s", ImageModel(), None), "cut the scene"),
        (lambda: check_fit(PatternScene("flat", (9, 9)), "s", ImageModel(lateral=(Lateral(2),)), None), "band 2"),
        (
            lambda: form_image(ImageModel(Spread(tail_share=0.1, tail_length=50.0)), PatternScene("flat", (9, 9))),
            "lower oversampling",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


#: Cycles per pixel up to which a transfer function is summed; what is left there is refused.
_MOST_FREQUENCY = 40.0


def line_spread(
    model: ImageModel, offsets: NDArray[np.float64], angle_deg: float = 0.0, radius: float = 0.0
) -> NDArray[np.float64]:
    """Line spread function at offsets in pixels, its integral 1, by Fourier's integral.

    Direction and place are those of `model_transfer`.

    Raises
    ------
    InputError
        The line spread function has steps (an aperture or a motion without other spread): the integral does not
        converge.
    """
    f = np.linspace(0.0, _MOST_FREQUENCY, 16001)
    transfer = model_transfer(model, f, angle_deg, radius)
    if np.abs(transfer[-2000:]).max() > 2e-3:
        raise InputError(
            "the line spread function of this model has steps; give it some Gaussian spread, or ask for its MTF"
        )
    waves = np.exp(2j * np.pi * np.multiply.outer(np.asarray(offsets, float), f))
    weights = np.full(f.size, f[1])
    weights[[0, -1]] /= 2.0
    return np.asarray(2.0 * (waves * transfer).real @ weights)
