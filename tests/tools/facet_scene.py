"""A block of images over hills, rendered from known heights and grey values: the truth of reconstructed surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera
from photoplan.io.project.file import load_project
from photoplan.project.cameras import central_without_pixels
from tools.rendered_block import Flight, write_project
from tools.small_block import CRS, X0, Y0, write_image

Field = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]

SIZE, FOCAL, HEIGHT = (160, 140), 400.0, 200.0
"""Of an image, its camera constant, pixels, and the flying height over the mean ground, metres: pixels of 0.5 m."""
GSD = HEIGHT / FOCAL
GROUND = 100.0
CONTRAST = 20.0
"""Standard deviation of the grey values."""


def waves(
    seed: int, lengths: NDArray[np.float64], sizes: NDArray[np.float64], centre: tuple[float, float] = (X0, Y0)
) -> Field:
    """A sum of plane waves of these lengths, metres, and sizes in random directions."""
    rng = np.random.default_rng(seed)
    way, phase = rng.uniform(0, 2 * np.pi, (2, len(lengths)))
    kx, ky = 2 * np.pi / lengths * np.cos(way), 2 * np.pi / lengths * np.sin(way)

    def field(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
        out = np.zeros(np.shape(X))
        for a, b, p, s in zip(kx, ky, phase, sizes):
            out += s * np.cos(a * (X - centre[0]) + b * (Y - centre[1]) + p)
        return out

    return field


@dataclass(frozen=True, eq=False)
class Scene:
    """A project with rendered images, and what they show."""

    path: Path
    heights: Field
    grey: Field
    base: float
    """Distance of the outermost projection centres, metres."""

    @property
    def height_of_a_pixel(self) -> float:
        """Error of height that is one pixel of parallax between the outermost images, metres."""
        return GSD * HEIGHT / self.base


def write_scene(
    folder: Path,
    images: int,
    seed: int = 0,
    snr: float = 50.0,
    base: float = 40.0,
    finest: float = 3.0,
    size: tuple[int, int] = SIZE,
    gain: float = 0.0,
    bare: float = 0.0,
    relief: Field | None = None,
) -> Scene:
    """Images in a strip with `base` metres between the outermost; the shortest wave of the pattern has `finest` pixels.

    Noise of CONTRAST / snr, then whole grey values. From the first to the last image they become brighter by the part
    `gain`. Within `bare` metres north and south of the middle there is no pattern. `relief`: other hills.
    """
    flight = Flight((X0, Y0), GROUND + HEIGHT, (base / (images - 1), 0.0), (images, 1), size, FOCAL)
    path = write_project(folder, CRS, f"height = {GROUND}", "", flight)
    rng = np.random.default_rng(seed)
    lengths = np.repeat((40.0, 100.0), 6)
    hills = relief or waves(seed + 1, lengths, lengths / 100.0)
    pattern = waves(seed + 2, finest * GSD * 12.0 ** np.linspace(0, 1, 64), np.full(64, CONTRAST * np.sqrt(2 / 64)))
    grey: Field = lambda X, Y: 120 + pattern(X, Y) * np.clip(np.abs(Y - Y0) - bare, 0, 1)  # noqa: E731
    scene = Scene(path, lambda X, Y: GROUND + hills(X, Y), grey if bare else lambda X, Y: 120 + pattern(X, Y), base)
    (folder / "rendered").mkdir()
    project = load_project(path)
    for number, image in enumerate(project.images):
        pixels = rendered(central_without_pixels(project, image.name), scene)
        pixels *= 1 + gain * number / (images - 1)
        noisy = np.clip(np.rint(pixels + rng.normal(0, CONTRAST / snr, pixels.shape)), 1, 255)
        write_image(folder / "rendered" / f"{image.name}.tif", noisy[None].astype(np.uint8))
    return scene


def rendered(camera: CentralCamera, scene: Scene, finer: int = 2) -> NDArray[np.float64]:
    """Means of finer × finer rays for each pixel, shape (height, width); gentle hills hide nothing."""
    x, y = np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1]))
    total = np.zeros(x.shape)
    for i in range(finer):
        for j in range(finer):
            xy = np.stack([x + (i + 0.5) / finer - 0.5, y + (j + 0.5) / finer - 0.5], axis=-1).reshape(-1, 2)
            origin, way = camera.rays(xy)
            z = np.full(len(xy), GROUND)
            for _ in range(10):
                along = (z - origin[:, 2]) / way[:, 2]
                XY = origin[:, :2] + along[:, None] * way[:, :2]
                z = scene.heights(XY[:, 0], XY[:, 1])
            total += scene.grey(XY[:, 0], XY[:, 1]).reshape(x.shape)
    return total / finer**2
