"""The plane wave of a bar pattern: its frequency and direction to a fraction of a period over the window."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot, log, pi

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.patterns.pixels import least_squares

Array = NDArray[np.float64]

#: Harmonic waves of bars that are fitted beside the fundamental one.
_HARMONICS = (2, 3, 4, 5, 6, 7, 9, 11)
#: Beyond it, in cycles per pixel, lenses and pixels leave nothing of a harmonic wave.
_HIGHEST = 1.6


@dataclass(frozen=True)
class BarWave:
    """Frequency vector of parallel bars."""

    fx: float
    """Cycles per pixel along the columns' direction."""
    fy: float
    """Cycles per pixel along the rows' direction."""

    @property
    def frequency(self) -> float:
        """Cycles per pixel across the bars."""
        return hypot(self.fx, self.fy)

    def phases(self, shape: tuple[int, ...]) -> Array:
        """Periods from the middle of a window, shape (rows, columns)."""
        x = np.arange(shape[1]) - (shape[1] - 1) / 2.0
        y = np.arange(shape[0]) - (shape[0] - 1) / 2.0
        return np.asarray(self.fx * x[None, :] + self.fy * y[:, None])

    def harmonics(self, shape: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Harmonic waves that the pixels tell apart from each other, and those hidden behind the fundamental one.

        On pixels a wave looks like all others whose frequencies differ by whole numbers; two are told apart if they
        differ by more than a period over the window.
        """
        least = np.array([1.0 / shape[1], 1.0 / shape[0]])
        taken = [np.array([0.0, 0.0]), *_both(np.array([self.fx, self.fy]))]
        kept: list[int] = []
        hidden: list[int] = []
        for k in _HARMONICS:
            if k * self.frequency > _HIGHEST:
                break
            wave = np.array([k * self.fx, k * self.fy])
            near = [bool((np.abs(_wrapped(wave - other)) < least).all()) for other in taken]
            if any(near[1:3]):
                hidden.append(k)
            if not any(near) and not (np.abs(_wrapped(2 * wave)) < least).all():
                kept.append(k)
                taken += _both(wave)
        return tuple(kept), tuple(hidden)


def _both(wave: Array) -> list[Array]:
    return [wave, -wave]


def _wrapped(wave: Array) -> Array:
    return np.asarray(wave - np.round(wave))


def wave_columns(shape: tuple[int, ...], phase: Array, harmonics: tuple[int, ...]) -> Array:
    """Columns of the linear model: level, its slopes in x and y, and cosine and sine of each harmonic wave.

    The phase is in periods, one for each pixel of a window of this shape; a row of the result is a pixel.
    """
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = x / max(shape[1] - 1, 1) - 0.5, y / max(shape[0] - 1, 1) - 0.5
    columns = [np.ones(phase.size), x.ravel(), y.ravel()]
    for k in harmonics:
        turn = 2.0 * pi * k * phase.ravel()
        columns += [np.cos(turn), np.sin(turn)]
    return np.stack(columns, axis=1)


def find_wave(values: Array, what: str) -> BarWave:
    """The strongest plane wave of a window.

    Raises
    ------
    InputError
        No wave stands out of the noise.
    """
    rows, columns = values.shape
    flat = values - values.mean()
    plane = wave_columns(values.shape, np.zeros(values.size), ())
    _, _, residuals = least_squares(plane, flat.ravel())
    taper = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1])
    size = (2 * rows, 2 * columns)
    power = np.abs(np.fft.rfft2(residuals.reshape(values.shape) * taper, size)) ** 2
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None, :]
    # Below, a wave has less than a period and a half across the window: slow changes of light look alike.
    slow = np.hypot(fx * columns, fy * rows) < 1.5
    power[slow] = 0.0
    top = int(power.argmax())
    level = float(np.median(power[~slow])) / log(2.0)
    if power.flat[top] < (log(power.size) + 12.0) * level or power.flat[top] == 0.0:
        raise InputError(f"{what}: no bars are found; nothing periodic stands out of the window")
    row, column = np.unravel_index(top, power.shape)
    return _refined(residuals.reshape(values.shape), BarWave(float(fx[0, column]), float(fy[row, 0])))


def _refined(values: Array, wave: BarWave) -> BarWave:
    """Frequencies by least squares, from a start that is right within half a period over the window."""
    y, x = np.mgrid[0 : values.shape[0], 0 : values.shape[1]]
    x = (x - (values.shape[1] - 1) / 2.0).ravel()
    y = (y - (values.shape[0] - 1) / 2.0).ravel()
    for k in range(16):
        waves = (1,) if k < 4 else (1, *wave.harmonics(values.shape)[0])
        columns = wave_columns(values.shape, wave.phases(values.shape), waves)
        solution, _, _ = least_squares(columns, values.ravel())
        slope = np.zeros(values.size)
        for place, harmonic in enumerate(waves):
            a, b = solution[3 + 2 * place : 5 + 2 * place]
            slope += 2.0 * pi * harmonic * (b * columns[:, 3 + 2 * place] - a * columns[:, 4 + 2 * place])
        solution, _, _ = least_squares(
            np.concatenate([columns, (slope * x)[:, None], (slope * y)[:, None]], axis=1), values.ravel()
        )
        dx, dy = (float(np.clip(d, -0.5 / n, 0.5 / n)) for d, n in zip(solution[-2:], values.shape[::-1]))
        wave = BarWave(wave.fx + dx, wave.fy + dy)
        if k > 4 and abs(dx) * values.shape[1] + abs(dy) * values.shape[0] < 1e-6:
            break
    return wave
