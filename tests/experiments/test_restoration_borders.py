"""What lies beyond the edge of an image: why restoration mirrors it in the outermost pixel, grey value included."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from photoplan.geometry.grid import Window
from photoplan.quality.restoration.restorer import FilterKernel, RestorationFilter, Restorer

SPREAD = np.array([0.02, 0.15, 0.66, 0.15, 0.02])
#: Rules of `numpy.pad`: the edge repeated, mirrored with and without the outermost pixel.
OTHERS = {"repeated": "edge", "mirrored": "symmetric", "mirrored, edge once": "reflect"}
LOW, HIGH = 20.0, 230.0


def restoring() -> np.ndarray:
    """Eleven elements of the inverse of Kölbl's band matrix, in both directions."""
    matrix = sum(value * np.eye(41, k=k - 2) for k, value in enumerate(SPREAD))
    row = np.linalg.inv(matrix)[20, 15:26]
    return np.outer(row, row) / row.sum() ** 2


def scenes():
    """Patches with sharp edges that the frame cuts through: object, and its image with noise of 0.5."""
    rng = np.random.default_rng(1)
    for _ in range(12):
        scene = np.full((140, 140), 90.0)
        for _ in range(220):
            y, x = rng.integers(0, 135, 2)
            height, width = rng.integers(3, 25, 2)
            scene[y : y + height, x : x + width] = rng.uniform(LOW, HIGH)
        blurred = ndimage.convolve(scene, np.outer(SPREAD, SPREAD), mode="nearest") + rng.normal(0, 0.5, scene.shape)
        yield scene[20:120, 20:120], blurred[20:120, 20:120].astype(np.float32)


def ours(image):
    used = RestorationFilter((FilterKernel(restoring()),))
    whole = Window(0, 0, image.shape[1], image.shape[0])
    return (
        Restorer(used, image.shape[::-1], 1, image.dtype, image.dtype)
        .restore(whole, image[None], whole, None)
        .values[0]
    )


def other(image, mode):
    return ndimage.convolve(np.pad(image.astype(float), 5, mode=mode), restoring())[5:-5, 5:-5]


@pytest.fixture(scope="module")
def figures():
    """For each rule: root mean square error of the outermost row of pixels and of the next, largest overshoot."""
    frame = np.ones((100, 100), bool)
    frame[1:-1, 1:-1] = False
    second = np.zeros((100, 100), bool)
    second[1:-1, 1:-1] = True
    second[2:-2, 2:-2] = False
    found = {}
    for name in ("ours", *OTHERS):
        rows = []
        for scene, image in scenes():
            made = ours(image) if name == "ours" else other(image, OTHERS[name])
            error = made - scene
            beyond = float(np.maximum(made - HIGH, LOW - made)[frame].max())
            rows.append([np.sqrt((error[part] ** 2).mean()) for part in (frame, second)] + [beyond])
        found[name] = np.mean(rows, axis=0)
        print(
            f"{name:20} rms at the edge {found[name][0]:5.2f}, next {found[name][1]:5.2f}, beyond {found[name][2]:6.2f}"
        )
    return found


def test_it_overshoots_least_at_the_edge(figures):
    assert figures["ours"][2] == min(each[2] for each in figures.values())
    assert figures["ours"][2] < 0 < 10 < figures["mirrored, edge once"][2]


def test_one_pixel_inside_it_is_as_good_as_any(figures):
    assert figures["ours"][1] < 1.05 * min(each[1] for each in figures.values())


def test_only_it_keeps_ramps():
    y, x = np.mgrid[:40, :40]
    ramp = (3.0 * x + 2.0 * y).astype(np.float32)
    off = {name: np.abs(other(ramp, mode) - ramp).max() for name, mode in OTHERS.items()}
    print(
        "ramp of 3 and 2 grey values per pixel, off by at most:", {name: round(float(o), 2) for name, o in off.items()}
    )
    assert np.abs(ours(ramp) - ramp).max() < 1e-3
    assert min(off.values()) > 0.5
