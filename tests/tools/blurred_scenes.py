"""Simulated scenes and their images: Gaussian blur, the aperture of a pixel, noise."""

import numpy as np
from scipy.special import ndtr

from photoplan.quality.curves import MtfCurve, SpreadFunction
from photoplan.quality.restoration.design import Sharpness

FINE = 8
SIZE = 256
NOISE = 0.5
FREQUENCY = np.linspace(0.0, 2.0, 401)


def discrete_spread(sigma):
    """Of a Gaussian and the sensor's aperture, as an edge on the border of two pixels shows it."""

    def ramp(z):
        return z * ndtr(z / sigma) + sigma * np.exp(-((z / sigma) ** 2) / 2.0) / np.sqrt(2.0 * np.pi)

    borders = np.arange(-20.5, 21.0)
    response = ramp(borders + 0.5) - ramp(borders - 0.5)
    return SpreadFunction.normalised(np.diff(response))


def sharpness(sigma):
    curve = MtfCurve(FREQUENCY, np.exp(-2 * (np.pi * sigma * FREQUENCY) ** 2) * np.sinc(FREQUENCY))
    return Sharpness(discrete_spread(sigma), curve)


def whole_pixels(rng, size=SIZE):
    """Objects whose borders are borders of pixels (Kölbl's model)."""
    scene = np.full((size, size), 90.0)
    for _ in range(150):
        (col, row), (width, height) = rng.integers(0, size, 2), rng.integers(1, 30, 2)
        scene[row : row + height, col : col + width] = rng.uniform(20, 230)
    return np.kron(scene, np.ones((FINE, FINE)))


def any_edges(rng, size=SIZE):
    """Rectangles in any place and direction."""
    scene = np.full((size * FINE, size * FINE), 90.0)
    for _ in range(round(60 * (size / SIZE) ** 2)):
        (x, y), angle, (width, height) = rng.uniform(0, size, 2), rng.uniform(0, np.pi), rng.uniform(3, 40, 2)
        reach = np.hypot(width, height)
        rows, cols = (slice(max(0, int((at - reach) * FINE)), int((at + reach) * FINE) + 1) for at in (y, x))
        row, col = np.ogrid[: scene.shape[0], : scene.shape[1]]
        row, col = row[rows] / FINE - y, col[:, cols] / FINE - x
        along = col * np.cos(angle) + row * np.sin(angle)
        across = row * np.cos(angle) - col * np.sin(angle)
        scene[rows, cols][(abs(along) < width) & (abs(across) < height)] = rng.uniform(20, 230)
    return scene


def gaussian(sigma):
    """Transfer function of a Gaussian blur."""
    return lambda frequency: np.exp(-2 * (np.pi * sigma * frequency) ** 2)


def diffraction(wavelength_by_aperture):
    """Transfer function of a perfect round lens, by the product of wavelength and f-number, pixels."""

    def transfer(frequency):
        x = np.clip(frequency * wavelength_by_aperture, 0.0, 1.0)
        return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x**2))

    return transfer


def fractal(rng, slope, size=SIZE):
    """Amplitudes that fall with a power of the frequency, any phases; 20 to 230."""
    side = size * FINE
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    scene = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(side, side))) * frequency**-slope, s=(side, side))
    return np.clip(125.0 + 35.0 * scene / scene.std(), 20.0, 230.0)


def white_texture(rng, size=SIZE, highest=1.0):
    """The same amplitude at all frequencies up to the highest, cycles per pixel; 20 to 230."""
    side = size * FINE
    frequency = np.hypot(np.fft.fftfreq(side, 1 / FINE)[:, None], np.fft.rfftfreq(side, 1 / FINE))
    scene = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(side, side))) * (frequency < highest), s=(side, side))
    return np.clip(125.0 + 35.0 * scene / scene.std(), 20.0, 230.0)


def leaves(rng, size=SIZE):
    """Ellipses of all sizes from 0.6 to 12 pixels (by the inverse cube) that cover each other, as foliage does."""
    side = size * FINE
    scene = np.full((side, side), 120.0)
    count = round(0.5 * size**2)
    radius = (0.6**-2 + rng.uniform(size=count) * (12.0**-2 - 0.6**-2)) ** -0.5
    for reach in radius:
        (y, x), narrow, angle = rng.uniform(0, size, 2), rng.uniform(0.4, 1.0), rng.uniform(0, np.pi)
        rows, cols = (slice(max(0, int((at - reach) * FINE)), int((at + reach) * FINE) + 1) for at in (y, x))
        row, col = np.ogrid[:side, :side]
        row, col = row[rows] / FINE - y, col[:, cols] / FINE - x
        along = (col * np.cos(angle) + row * np.sin(angle)) / reach
        across = (row * np.cos(angle) - col * np.sin(angle)) / (reach * narrow)
        scene[rows, cols][along**2 + across**2 < 1.0] = np.clip(rng.normal(120.0, 45.0), 10.0, 245.0)
    return scene


def sharpened(image, optics, amount, sigma):
    """The image plus so much of its difference to a Gaussian blur, and the transfer function that it has then."""

    def enhanced(frequency):
        return 1.0 + amount * (1.0 - np.exp(-2 * (np.pi * sigma * frequency) ** 2))

    v, u = np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1])
    result = np.fft.irfft2(np.fft.rfft2(image) * enhanced(np.hypot(u, v)), s=image.shape)
    return result, lambda frequency: optics(frequency) * enhanced(abs((frequency + 0.5) % 1.0 - 0.5))


def taken(scene, optics, rng, noise=NOISE):
    """The image: blur, a pixel's aperture, sampled in the middle of the pixels, noise; and the object.

    The optics are a transfer function of the radial frequency, or the sigma of a Gaussian.
    """
    blur = optics if callable(optics) else gaussian(optics)
    v, u = np.fft.fftfreq(scene.shape[0], 1 / FINE)[:, None], np.fft.rfftfreq(scene.shape[1], 1 / FINE)
    seen = np.fft.rfft2(scene) * blur(np.hypot(u, v))
    for frequency in (u, v):
        aperture = np.sinc(frequency) / np.sinc(frequency / FINE)
        seen *= aperture * np.exp(2j * np.pi * frequency * (0.5 - 0.5 / FINE))
    image = np.fft.irfft2(seen, s=scene.shape)[::FINE, ::FINE]
    objects = scene.reshape(image.shape[0], FINE, image.shape[1], FINE).mean(axis=(1, 3))
    return image + rng.normal(0, noise, image.shape), objects
