"""Registration on pictures whose displacements are known: its accuracy, and the accuracy that it states."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from tools.thinned import some
from tools.ties import ArrayPixels

from photoplan.kernels.jit import COMPILED
from photoplan.matching.features import GreyImage
from photoplan.matching.register import (
    APART,
    FOUND,
    MISSING,
    TEXTURELESS,
    UNLIKE,
    PatchDisplacements,
    PatchSettings,
    PixelTransfer,
    contradicting,
    match_grid,
)

pytestmark = pytest.mark.skipif(not COMPILED, reason="many patches")

SIDE, CONTRAST = 320, 50.0
LINES = np.arange(14, SIDE - 14, 21)
AT = np.stack([v.ravel() for v in np.meshgrid(LINES, LINES)], axis=1)
SHAPE = len(LINES), len(LINES)


def values(at: NDArray, finest: float, seed: int = 7) -> NDArray:
    """Waves from `finest` to 40 pixels at points (..., 2)."""
    rng = np.random.default_rng(seed)
    length, way = np.exp(rng.uniform(np.log(finest), np.log(40), 120)), rng.uniform(0, 2 * np.pi, 120)
    k = 2 * np.pi / length[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
    phase = rng.uniform(0, 2 * np.pi, 120)
    return sum(np.cos(at @ each + p) for each, p in zip(k, phase)) / np.sqrt(60)


def picture(at: NDArray, snr: float, seed: int, finest: float = 4.0, alike: float = 0.0) -> NDArray:
    """Grey values at points (rows, columns, 2) with noise, of which neighbours are alike."""
    noise = np.random.default_rng(seed).normal(size=at.shape[:2])
    if alike:
        noise = ndimage.gaussian_filter(noise, alike)
        noise /= noise.std()
    return 120 + CONTRAST * values(at, finest) + CONTRAST / snr * noise


def grid(side: int = SIDE) -> NDArray:
    return np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).astype(float)


def image(pixels: NDArray) -> GreyImage:
    return GreyImage(ArrayPixels(pixels[None].astype(np.float32)))


@pytest.mark.parametrize(
    ("shift", "snr", "finest", "alike"),
    some(
        [
            ((0.0, 0.0), 50, 4.0, 0.0),
            ((0.25, 0.25), 50, 4.0, 0.0),
            ((-1.3, 2.2), 50, 4.0, 0.0),
            ((0.25, 0.25), 10, 4.0, 0.0),
            ((0.3, -0.4), 50, 10.0, 0.0),
            ((0.3, -0.4), 10, 10.0, 0.0),
            ((0.3, -0.4), 50, 4.0, 0.7),
            ((0.5, 0.5), 50, 3.0, 0.0),
        ],
        *(2, 5, 6),
    ),
)
def test_errors_are_small_and_as_large_as_stated(
    shift: tuple[float, float], snr: float, finest: float, alike: float
) -> None:
    pair = (
        image(picture(grid(), snr, 1, finest, alike)),
        image(1.3 * picture(grid() - shift, snr, 2, finest, alike) - 10),
    )
    found = contradicting(match_grid(pair, PixelTransfer(), AT, PatchSettings()), SHAPE)
    assert (found.state == FOUND).all()
    error = found.moved - shift
    rms, normalised = np.sqrt((error**2).mean()), np.sqrt((error**2 / found.sigma**2).mean())
    assert 0.9 < normalised < 1.1
    assert rms < (0.02 if snr == 50 else 0.06)
    # Towards half pixels, where a spline has less noise, matching would be drawn by 0.05 px.
    assert np.abs(error.mean(axis=0)).max() < (0.003 if snr == 50 else 0.01)


def test_the_second_image_may_be_turned_and_of_another_resolution() -> None:
    angle, scale = 0.3, 1.25
    L = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    t = np.array([140.0, 30.0])
    moved = np.array([0.6, -1.1])
    # Content of pixel p of the first image lies at L (p + moved) + t.
    back = (grid(520) - t) @ np.linalg.inv(L).T - moved
    pair = image(picture(grid(), 50, 1, 5.0)), image(picture(back, 50, 2, 5.0))
    found = match_grid(pair, PixelTransfer(tuple(L.ravel()), tuple(t)), AT, PatchSettings())
    good = found.state == FOUND
    error = found.moved[good] - moved
    assert good.mean() > 0.95 and np.sqrt((error**2).mean()) < 0.01
    # Of another resolution is another sharpness: residuals hold it, so accuracies are stated on the safe side.
    assert 0.5 < np.sqrt((error**2 / found.sigma[good] ** 2).mean()) < 1.1


def test_what_cannot_be_matched_is_named() -> None:
    first, second = picture(grid(), 50, 1), picture(grid() - (0.4, 0.2), 50, 2)
    noise = np.random.default_rng(3).normal(size=(2, SIDE, SIDE))
    flat, new, gone = np.s_[30:120, 30:120], np.s_[180:280, 30:120], np.s_[30:120, 200:300]
    first[flat], second[flat] = 100 + noise[0][flat], 100 + noise[1][flat]
    second[new] = 120 + CONTRAST * values(grid(), 4.0, seed=99)[new]
    second[gone] = np.nan
    found = contradicting(match_grid((image(first), image(second)), PixelTransfer(), AT, PatchSettings()), SHAPE)

    def states(part: tuple[slice, slice], edge: int = 14) -> set[int]:
        row, col = part
        inside = (AT[:, 0] >= col.start + edge) & (AT[:, 0] < col.stop - edge)
        inside &= (AT[:, 1] >= row.start + edge) & (AT[:, 1] < row.stop - edge)
        return set(found.state[inside].tolist())

    assert states(flat) == {TEXTURELESS} and states(gone, 0) == {MISSING}
    assert UNLIKE in states(new) and FOUND not in states(new)
    good = found.state == FOUND
    assert good.sum() > 80 and np.abs(found.moved[good] - (0.4, 0.2)).max() < 0.35


def test_a_vector_that_contradicts_its_neighbours_is_apart() -> None:
    n = len(AT)
    moved = 0.002 * AT + np.random.default_rng(1).normal(0, 0.01, (n, 2))
    wrong = 7 * SHAPE[1] + 7
    moved[wrong] += (0.4, 0.0)
    found = PatchDisplacements(
        at=AT,
        moved=moved,
        covariance=np.broadcast_to(1e-4 * np.eye(2), (n, 2, 2)),
        correlation=np.ones(n),
        state=np.zeros(n, np.uint8),
        factor=np.ones((n, 2)),
    )
    assert np.flatnonzero(contradicting(found, SHAPE).state == APART).tolist() == [wrong]
