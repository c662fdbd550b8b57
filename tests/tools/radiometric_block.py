"""Simulated blocks for colour balance: scene, fall-off, exposures and haze are known; no code of the product."""

from __future__ import annotations

import tomllib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from scipy.ndimage import map_coordinates

_Floats = NDArray[np.float64]

WIDTH, HEIGHT = 240, 200
FOCAL = 260.0
"""Camera constant, pixels; the corner lies 31 degrees off axis, where cos⁴ is 0.54."""
X0, Y0, FLYING_HEIGHT = 500_000.0, 5_300_000.0, 260.0
"""A pixel covers one metre of level ground."""


def _equalised(light: _Floats) -> _Floats:
    return np.asarray(np.searchsorted(np.sort(light.ravel()), light) / light.size * 255)


#: Characteristic curves: from light on the sensor, after the fall-off, to grey values.
CURVES: dict[str, Callable[[_Floats], _Floats]] = {
    "straight": lambda light: light,
    "gamma 0.7": lambda light: 255 * (np.clip(light, 0, None) / 255) ** 0.7,
    "gamma 1.3": lambda light: 255 * (np.clip(light, 0, None) / 255) ** 1.3,
    "veil": lambda light: 40 + 0.62 * light,
    "film": lambda light: 255 / (1 + np.exp(-(light - 115) / 42)),
    "dark": lambda light: 0.8 * light + 3,
    "equalised": _equalised,
}


@dataclass(frozen=True, eq=False)
class RadiometricBlock:
    """Images of a flat scene with their disturbances."""

    folder: Path
    scene: _Floats
    """Reflected light, grey values; row 0 is north, one metre a pixel."""
    centres: _Floats
    """(images, 2): column and row of the scene at the principal points."""
    headings: _Floats
    """(images,): 1 or -1; strips in opposite directions are turned by 180 degrees."""
    images: tuple[_Floats, ...]

    @property
    def project(self) -> Path:
        """The project file."""
        return self.folder / "block.toml"

    def sample(self, image: int, col: _Floats, row: _Floats) -> tuple[_Floats, _Floats]:
        """Return columns and rows of the image at places of the scene."""
        turn = self.headings[image]
        return (
            (col - self.centres[image, 0]) * turn + (WIDTH - 1) / 2,
            (row - self.centres[image, 1]) * turn + (HEIGHT - 1) / 2,
        )

    def balanced(self, folder: Path) -> list[_Floats]:
        """Return the images after the balance files of a folder."""
        return [_applied(folder / f"i{k:02d}.toml", image) for k, image in enumerate(self.images)]

    def mosaic(self, images: list[_Floats]) -> tuple[_Floats, _Floats]:
        """Return a mosaic from the nearest image of each place, and the scene there."""
        value, truth, _, _ = self._nearest(images)
        # Means of squares of 12 metres: noise and interpolation count little.
        rows, cols = (n // 6 * 6 for n in value.shape)
        parts = [each[:rows, :cols].reshape(rows // 6, 6, -1, 6).mean(axis=(1, 3)) for each in (value, truth)]
        seen = np.isfinite(parts[0])
        return parts[0][seen], parts[1][seen]

    def _nearest(self, images: list[_Floats]) -> tuple[_Floats, _Floats, _Floats, _Floats]:
        """Mosaic, scene, and places from -1 to 1 east and north, at every second metre."""
        low = self.centres.min(axis=0) - (WIDTH / 2 - 4, HEIGHT / 2 - 4)
        high = self.centres.max(axis=0) + np.array([WIDTH / 2 - 4, HEIGHT / 2 - 4])
        col, row = np.meshgrid(np.arange(low[0], high[0], 2.0), np.arange(low[1], high[1], 2.0))
        best, value = np.full(col.shape, np.inf), np.full(col.shape, np.nan)
        for k, image in enumerate(images):
            x, y = self.sample(k, col, row)
            inside = (x >= 1) & (y >= 1) & (x <= WIDTH - 2) & (y <= HEIGHT - 2)
            apart = np.hypot((x - WIDTH / 2) / WIDTH, (y - HEIGHT / 2) / HEIGHT)
            nearer = inside & (apart < best)
            best[nearer] = apart[nearer]
            value[nearer] = map_coordinates(image, [y[nearer], x[nearer]], order=1)
        east, south = ((each - (a + b) / 2) / ((b - a) / 2) for each, a, b in zip((col, row), low, high))
        return value, map_coordinates(self.scene, [row, col], order=1), east, -south

    def error(self, images: list[_Floats]) -> float:
        """Return the rms error of the mosaic after the best straight line: a block's gain is unknowable."""
        value, truth = self.mosaic(images)
        line = np.polyfit(value, truth, 1)
        return float(np.std(np.polyval(line, value) - truth))

    def plain_error(self, images: list[_Floats]) -> float:
        """Return the rms error of the mosaic after one factor."""
        value, truth = self.mosaic(images)
        return float(np.sqrt(np.mean((value * (value @ truth) / (value @ value) - truth) ** 2)))

    def modes(self, images: list[_Floats]) -> _Floats:
        """Return slopes and bends of the mosaic, parts of its brightness from its middle to its edge, (5,).

        Slope east, slope north, bend east, twist, bend north, beside the best curve from the scene to the mosaic.
        """
        value, scene, X, Y = self._nearest(images)
        seen = np.isfinite(value)
        value, truth, X, Y = value[seen], (scene[seen] - 110) / 60, X[seen], Y[seen]
        curve, shapes = np.stack([truth**k for k in range(6)], axis=1), np.stack([X, Y, X**2, X * Y, Y**2], axis=1)
        base = value
        for _ in range(3):
            A = np.concatenate([curve, shapes * base[:, None]], axis=1)
            found = np.linalg.lstsq(A, value, rcond=None)[0]
            base = curve @ found[:6]
        return np.asarray(found[6:])

    def overlaps(self, images: list[_Floats]) -> float:
        """Return the rms difference of images that show the same ground, of single pixels four metres apart."""
        low, high = self.centres.min(axis=0) - WIDTH / 2, self.centres.max(axis=0) + WIDTH / 2
        col, row = np.meshgrid(np.arange(low[0], high[0], 4.0), np.arange(low[1], high[1], 4.0))
        every = np.full((len(images), *col.shape), np.nan)
        for k, image in enumerate(images):
            x, y = self.sample(k, col, row)
            inside = (x >= 0) & (y >= 0) & (x <= WIDTH - 1) & (y <= HEIGHT - 1)
            every[k, inside] = map_coordinates(image, [y[inside], x[inside]], order=1)
        some = np.isfinite(every).sum(axis=0) > 1
        values = every[:, some]
        count = np.isfinite(values).sum(axis=0)
        # The mean squared difference of two of n values is twice their variance.
        return float(np.sqrt(np.mean(2 * np.nanvar(values, axis=0) * count / (count - 1))))


def _applied(path: Path, image: _Floats) -> _Floats:
    """Apply a balance file as documented: look up the light, divide by the trend, look up in the table."""
    (band,) = tomllib.loads(path.read_text())["bands"]
    half = np.hypot(WIDTH, HEIGHT) / 2
    u, v = np.meshgrid((np.arange(WIDTH) - (WIDTH - 1) / 2) / half, (np.arange(HEIGHT) - (HEIGHT - 1) / 2) / half)
    trend = np.ones_like(u)
    for i, j, c in band.get("trend", ()):
        term = u**i * v**j
        trend += c * (term - term.mean())
    light = _line(image, band["curve_grey"], band["curve_light"]) if "curve_grey" in band else image
    return _line(light / np.maximum(trend, 0.2), band["grey"], band["becomes"])


def _line(x: _Floats, of: list[float], to: list[float]) -> _Floats:
    grey, becomes = np.array(of), np.array(to)
    k = np.clip(np.searchsorted(grey, x) - 1, 0, len(grey) - 2)
    slope = (becomes[k + 1] - becomes[k]) / (grey[k + 1] - grey[k])
    return np.asarray(becomes[k] + (x - grey[k]) * slope)


def _texture(rng: np.random.Generator, shape: tuple[int, int], power: float) -> _Floats:
    n = 1 << (max(shape) - 1).bit_length()
    k = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)[None])
    k[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * k**-power
    spectrum[0, 0] = 0.0
    z = np.fft.ifft2(spectrum).real[: shape[0], : shape[1]]
    return np.asarray((z - z.mean()) / z.std())


def simulate(
    folder: Path,
    *,
    strips: int,
    along: int,
    seed: int,
    steps: float = 0.2,
    fall_off: float = 4.0,
    haze: float = 0.06,
    shared_haze: float = 0.0,
    wander: float = 0.0,
    gammas: float = 0.0,
    curves: Sequence[str] = (),
    printed: bool = False,
    turned: bool = False,
    forward: float = 0.6,
    side: float = 0.4,
    large_scale: float = 20.0,
    noise: float = 1.5,
) -> RadiometricBlock:
    """Write images and a project of a block over level ground.

    `steps`: exposures differ by up to this part, evenly distributed; `wander`: standard deviation of a random walk of
    exposures from image to image; `fall_off`: power of the cosine; `haze`: brightness gradient of each image across its
    width, direction and size drawn by lot up to this; `shared_haze`: a gradient towards the east that all images have;
    `gammas`: exponents of the images' characteristic curves differ by up to this; `curves`: names of characteristic
    curves, see `CURVES`, which the images take in turn; `printed`: these act before fall-off and haze;
    `turned`: strips in opposite directions; `large_scale`: standard deviation of the scene's large forms.
    """
    rng = np.random.default_rng(seed)
    step = WIDTH * (1 - forward), HEIGHT * (1 - side)
    shape = int(HEIGHT + step[1] * (strips - 1)) + 40, int(WIDTH + step[0] * (along - 1)) + 40
    scene = 110 + 18 * _texture(rng, shape, 1.0) + large_scale * _texture(rng, shape, 2.0)
    scene += (np.floor(np.arange(shape[0]) / 37)[:, None] * 7 + np.floor(np.arange(shape[1]) / 29) * 13) % 5 * 8 - 16
    scene = np.clip(scene, 25, 205)
    y, x = np.meshgrid(np.arange(HEIGHT) - (HEIGHT - 1) / 2, np.arange(WIDTH) - (WIDTH - 1) / 2, indexing="ij")
    cosine = 1 / np.sqrt(1 + (x**2 + y**2) / FOCAL**2)
    places = [(s, a) for s in range(strips) for a in range(along)]
    centres = np.array([(20 + WIDTH / 2 + a * step[0], 20 + HEIGHT / 2 + s * step[1]) for s, a in places])
    headings = np.array([-1.0 if turned and s % 2 else 1.0 for s, _ in places])
    walk = np.exp(np.cumsum(rng.normal(0, wander, len(places)))) if wander else np.ones(len(places))
    images = []
    for k, ((col, row), turn) in enumerate(zip(centres, headings)):
        light = map_coordinates(scene, [row + y * turn, col + x * turn], order=1, mode="nearest")
        if curves and printed:
            light = CURVES[curves[k % len(curves)]](light)
        angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(0, haze)
        gradient = 1 + size * (x / WIDTH * np.cos(angle) + y / HEIGHT * np.sin(angle)) + shared_haze * x * turn / WIDTH
        value = light * cosine**fall_off * gradient * (1 + rng.uniform(-steps, steps)) * walk[k]
        if gammas:
            value = 255 * (np.clip(value, 0, None) / 255) ** (1 + rng.uniform(-gammas, gammas))
        if curves and not printed:
            value = CURVES[curves[k % len(curves)]](value)
        image = np.clip(np.rint(value + rng.normal(0, noise, value.shape)), 0, 255)
        images.append(image)
        profile = {"driver": "GTiff", "width": WIDTH, "height": HEIGHT, "count": 1, "dtype": "uint8"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(folder / f"i{k:02d}.tif", "w", **profile) as file:
                file.write(image.astype(np.uint8), 1)
    lines = ["format = 1", 'crs = "EPSG:32633"', "[terrain]", "height = 0.0", 'height_system = "same"']
    lines += ["[orientation]", 'height_system = "same"', "[cameras.c]", 'type = "frame"']
    lines += [f"size = [{WIDTH}, {HEIGHT}]", f"focal_px = {FOCAL}"]
    for k, ((col, row), turn) in enumerate(zip(centres, headings)):
        lines += ["[[images]]", f'name = "i{k:02d}"', f'file = "i{k:02d}.tif"', 'camera = "c"']
        lines += [
            f"center = [{X0 + col}, {Y0 - row}, {FLYING_HEIGHT}]",
            f"angles = [0.0, 0.0, {0 if turn > 0 else 180}.0]",
        ]
    block = RadiometricBlock(folder, scene, centres, headings, tuple(images))
    block.project.write_text("\n".join(lines) + "\n")
    return block
