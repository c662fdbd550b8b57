"""Lateral chromatic aberration: what the image formation model puts in is found again."""

import numpy as np
import pytest
from scipy import ndimage
from tools.formed import ArrayScene, form_image

from photoplan.errors import GeometryError, InputError
from photoplan.quality.colour import (
    BandModel,
    ChromaticModel,
    Displacements,
    disc_displacements,
    edge_displacements,
    find_discs,
    fit_band,
    patch_displacements,
)
from photoplan.quality.edges.find import EdgePicture, find_edges
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics import Falloff, Gain, Lateral, Quantisation, Spread
from photoplan.quality.formation.scenes import PatternScene

LATERAL = (Lateral(1, (0.3, -0.2), 0.002, 0.001), Lateral(3, (-0.15, 0.05), -0.001, 0.0))
#: Contrast 200 with noise 4: a signal-to-noise ratio of 50.
SNR50 = Gain(200.0, 10.0, 4.0)


def camera(lateral=LATERAL, gain=SNR50, **parts):
    return ImageModel(Spread(gaussian=(0.7, 0.7)), lateral=lateral, gain=gain, quantisation=Quantisation(8), **parts)


def truth(lateral, size, x, y):
    u, v = x - (size[0] - 1) / 2, y - (size[1] - 1) / 2
    factor = lateral.scale + lateral.cubic * (u * u + v * v) / (size[0] ** 2 + size[1] ** 2) * 4
    return u * factor + lateral.shift[0], v * factor + lateral.shift[1]


def worst(model, lateral):
    """Largest difference of a model from what was put in, all over the image."""
    x, y = np.meshgrid(np.linspace(0, model.size[0] - 1, 25), np.linspace(0, model.size[1] - 1, 25))
    dx, dy = model.displacement(lateral.band, x, y)
    ex, ey = truth(lateral, model.size, x, y)
    return float(np.hypot(dx - ex, dy - ey).max())


def near(discs, centres):
    """Differences of discs from the nearest true centres."""
    here = np.array([[d.x, d.y] for d in discs])
    return here - centres[np.argmin(np.hypot(*(here[:, None] - centres[None]).transpose(2, 0, 1)), axis=1)]


@pytest.fixture(scope="module")
def chart():
    size = (320, 240)
    scene = PatternScene("discs", size, (24.0, 11.0), 4, phase=(0.3, 0.4), bands=3)
    return scene, form_image(camera(falloff=Falloff(artificial=0.2)), scene).values


@pytest.fixture(scope="module")
def found(chart):
    return [find_discs(band) for band in chart[1]]


def test_centres_of_discs_and_their_standard_deviations(chart, found):
    scene, _ = chart
    discs = found[1]
    errors = near(discs, scene.centres())
    claimed = np.sqrt(np.mean([[d.sigma_x**2, d.sigma_y**2] for d in discs]))
    print(f"\n{len(discs)} discs, centre ± {errors.std():.4f} px, claimed {claimed:.4f} px")
    assert len(discs) == 13 * 9
    assert abs(errors.mean()) < 0.002
    assert errors.std() == pytest.approx(claimed, rel=0.2)
    assert errors.std() < 0.012
    assert np.median([d.radius for d in discs]) == pytest.approx(5.5, abs=0.05)


@pytest.mark.parametrize("phase", [(0.0, 0.0), (0.25, 0.5), (0.5, 0.13)])
def test_centres_have_no_bias_by_phase(phase):
    scene = PatternScene("discs", (120, 90), (30.0, 9.0), 8, phase=phase)
    image = form_image(ImageModel(Spread(gaussian=(0.5, 0.8)), gain=Gain(200.0)), scene).values
    assert np.abs(near(find_discs(image), scene.centres())).max() < 2e-3


def test_bright_discs_and_mosaics(chart):
    scene, bands = chart
    part = bands[1][:120, :160]
    assert len(find_discs(240.0 - part)) == len(find_discs(part)) > 20
    # A mosaic whose planes have levels of their own: no interpolation, no bias.
    planes = np.add.outer(2 * (np.arange(240) % 2), np.arange(320) % 2)
    mosaic = bands[1] * np.array([0.3, 1.0, 0.6, 0.3])[planes]
    errors = near(find_discs(mosaic, 300.0, planes), scene.centres())
    assert abs(errors.mean()) < 0.002 and errors.std() < 0.012
    green = np.where((planes == 0) | (planes == 3), planes, -1)[:120]
    assert near(find_discs(mosaic[:120], None, green), scene.centres()).std() < 0.02


def test_displacements_of_discs_within_two_hundredths_of_a_pixel(chart, found):
    """Issue: simulated displacements are recovered within 0.02 px at SNR 50."""
    scene, discs = chart[0], found
    for lateral, kind in zip(LATERAL, ("radial", "scale")):
        measured = disc_displacements(discs[1], discs[lateral.band - 1])
        fitted = fit_band(lateral.band, scene.size, measured)
        model = ChromaticModel(scene.size, 2, (fitted,))
        error = worst(model, lateral)
        print(f"\nband {lateral.band}: {fitted.kind}, largest error {error:.4f} px, residuals {fitted.residual:.4f} px")
        assert fitted.kind == kind
        assert error < 0.02
        # The standard deviation of the shift is that of the mean of the discs.
        assert abs(fitted.terms[0][2] - lateral.shift[0]) < 4 * fitted.sigmas[0][0]
        corner = lateral.scale + lateral.cubic
        assert model.corner(lateral.band) == pytest.approx(corner * np.hypot(320, 240) / 2, abs=0.02)


def roofs(size, k, seed=0):
    """Turned rectangles of several brightnesses, in three bands."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[1] * k, : size[0] * k] / k
    scene = np.full(x.shape, 0.3)
    for _ in range(34):
        cx, cy = rng.uniform(20, size[0] - 20), rng.uniform(20, size[1] - 20)
        a, w, h = rng.uniform(0, np.pi), *rng.uniform(18, 45, 2)
        u = (x - cx) * np.cos(a) + (y - cy) * np.sin(a)
        v = (y - cy) * np.cos(a) - (x - cx) * np.sin(a)
        scene[(np.abs(u) < w) & (np.abs(v) < h)] = rng.uniform(0.05, 0.95)
    return ArrayScene(np.stack([0.8 * scene, scene, 0.9 * scene + 0.05]), k)


@pytest.mark.slow
def test_displacements_from_edges_of_a_scene():
    """Issue: the same from edges, at a median signal-to-noise ratio of 50."""
    size = (480, 360)
    lateral = (Lateral(1, (0.6, -0.4), 0.003, 0.0), Lateral(3, (-0.3, 0.2), -0.002, 0.0))
    bands = form_image(camera(lateral, Gain(200.0, 10.0, 1.6)), roofs(size, 3)).values.astype(np.float64)
    edges, _ = find_edges(EdgePicture(bands[1].astype(np.float32)))
    print(f"\nmedian signal-to-noise ratio {np.median([e.snr for e in edges]):.0f}")
    assert np.median([e.snr for e in edges]) < 55
    for each in lateral:
        measured = edge_displacements(bands[1], bands[each.band - 1], edges, 255.0)
        fitted = fit_band(each.band, size, measured)
        error = worst(ChromaticModel(size, 2, (fitted,)), each)
        print(f"\nband {each.band}: {fitted.count} edges, {fitted.kind}, largest error {error:.4f} px")
        assert fitted.kind == "scale"
        assert error < 0.02


def test_displacements_from_the_structure_of_a_scene():
    rng = np.random.default_rng(0)
    size, k = (420, 320), 3
    noises = [ndimage.gaussian_filter(rng.normal(size=(size[1] * k, size[0] * k)), s * k) * s * k for s in (1, 3, 8)]
    scene = sum(noises) / np.std(sum(noises)) * 0.13 + 0.5
    lateral = (Lateral(1, (0.6, -0.4), 0.003, 0.0), Lateral(3, (-0.3, 0.2), -0.002, 0.0))
    # A band is brighter and flatter than the other. Contrast 4 σ of the scene = 104, noise 2.
    bands = form_image(
        camera(lateral, Gain(200.0, 10.0, 2.0)), ArrayScene(np.stack([0.7 * scene + 0.2, scene, scene]), k)
    ).values.astype(float)
    for each in lateral:
        fitted = fit_band(each.band, size, patch_displacements(bands[1], bands[each.band - 1], 255.0))
        error = worst(ChromaticModel(size, 2, (fitted,)), each)
        print(f"\nband {each.band}: {fitted.count} windows, {fitted.kind}, largest error {error:.4f} px")
        assert error < 0.02
    with pytest.raises(InputError, match=r"0 of .* windows"):
        patch_displacements(bands[1], rng.normal(100, 10, bands[1].shape))


def displacements(n, make, sigma, seed=1):
    rng = np.random.default_rng(seed)
    place = rng.uniform(0, 1000, (n, 2))
    value = np.stack(make(place[:, 0] - 499.5, place[:, 1] - 499.5), 1) + rng.normal(0, sigma, (n, 2))
    return Displacements(
        np.repeat(place, 2, 0),
        np.tile(np.eye(2), (n, 1)),
        value.ravel(),
        np.full(2 * n, sigma),
        np.repeat(np.arange(n), 2),
    )


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (lambda u, v: (0 * u, 0 * v), "none"),
        (lambda u, v: (0 * u + 0.3, 0 * v - 0.1), "shift"),
        (lambda u, v: (1e-3 * u + 0.3, 1e-3 * v), "scale"),
        (lambda u, v: (1e-3 * u + 1e-9 * u * (u * u + v * v), 1e-3 * v + 1e-9 * v * (u * u + v * v)), "radial"),
        (lambda u, v: (1e-3 * u + 5e-4 * v, 2e-3 * v), "affine"),
        (lambda u, v: (1e-6 * u * v, 2e-6 * v * v), "polynomial 2"),
    ],
)
def test_the_simplest_kind_that_predicts_is_chosen(make, kind):
    fitted = fit_band(1, (1000, 1000), displacements(80, make, 0.02))
    assert fitted.kind == kind
    assert fitted.residual < 0.025


def test_gross_errors_are_left_out():
    measured = displacements(60, lambda u, v: (1e-3 * u, 1e-3 * v), 0.01)
    value = measured.value.copy()
    value[[4, 40]] += 3.0
    fitted = fit_band(
        1, (1000, 1000), Displacements(measured.place, measured.direction, value, measured.sigma, measured.group)
    )
    assert fitted.rejected == 2 and fitted.kind == "scale" and fitted.residual < 0.012


def test_residuals_scale_the_standard_deviations():
    """Standard deviations that were stated too small grow by what the residuals show."""
    measured = displacements(60, lambda u, v: (0 * u + 0.2, 0 * v), 0.04)
    told = Displacements(measured.place, measured.direction, measured.value, measured.sigma / 4, measured.group)
    assert fit_band(1, (1000, 1000), told, "shift").sigmas[0][0] == pytest.approx(0.04 / np.sqrt(60), rel=0.2)


def test_no_discs():
    rng = np.random.default_rng(1)
    with pytest.raises(InputError, match="no disc was found"):
        find_discs(rng.normal(100, 5, (200, 200)))
    with pytest.raises(InputError, match="no disc was found"):
        find_discs(form_image(ImageModel(gain=Gain(200.0)), PatternScene("edge", (200, 150))).values)


def test_saturated_discs_are_refused(chart):
    scene, _ = chart
    bright = form_image(ImageModel(gain=Gain(400.0), quantisation=Quantisation(8)), scene).values[0]
    with pytest.raises(InputError, match="saturated"):
        find_discs(bright)


def test_discs_that_do_not_match(found):
    discs = found[1]
    with pytest.raises(InputError, match="0 discs are the same"):
        disc_displacements(discs, [type(d)(**{**d.__dict__, "x": d.x + 12.0, "y": d.y + 12.0}) for d in discs])
    with pytest.raises(GeometryError, match="at least 4"):
        fit_band(1, (1000, 1000), displacements(3, lambda u, v: (u, v), 0.1))


def test_edges_that_cannot_be_measured():
    noise = np.random.default_rng(3).normal(100, 3, (90, 90))
    scene = form_image(camera(()), PatternScene("edge", (90, 90), (8.0,))).values.astype(float)
    edges, _ = find_edges(EdgePicture(scene.astype(np.float32)))
    with pytest.raises(InputError, match="edges can be measured in both bands"):
        edge_displacements(scene, noise, edges)


@pytest.mark.parametrize(
    "make",
    [
        lambda: BandModel(1, ((6, 0, 1.0, 0.0),)),
        lambda: BandModel(1, ((0, 0, float("nan"), 0.0),)),
        lambda: ChromaticModel((10, 10), 1, (BandModel(1, ()),)),
        lambda: ChromaticModel((10, 10), 1, (BandModel(2, ()), BandModel(2, ()))),
        lambda: fit_band(1, (1000, 1000), displacements(30, lambda u, v: (u, v), 0.1), "spline"),
    ],
)
def test_models_that_cannot_be(make):
    with pytest.raises(InputError):
        make()
