"""Charge in a sensor: fixed pattern, dark current, overflowing wells, smear, transfer losses, noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from photoplan.errors import InputError
from photoplan.quality.formation.parts import DarkCurrentPart, DefectPart, FixedPattern, Readout, Well

_Array = NDArray[np.float64]
#: Times that circular overflow spreads again where it meets full elements; what is left then goes along the columns.
_ROUNDS = 60


@dataclass(frozen=True, eq=False)
class Pattern:
    """What is the same in all frames; arrays of shape (height, width)."""

    response: _Array
    """Sensitivity relative to the mean; 0 where an element is dead."""
    offset: _Array
    """Electrons that are added, independent of time."""
    dark_rate: _Array
    """Electrons per second."""
    stuck: _Array
    """Electrons of elements that do not react; NaN elsewhere."""


def fixed_pattern(
    fixed: FixedPattern,
    dark: DarkCurrentPart,
    defects: Sequence[DefectPart],
    size: tuple[int, int],
    rng: np.random.Generator,
) -> Pattern:
    """The pattern of one sensor; the same for the same state of the generator."""
    width, height = size
    shape = (height, width)

    def normal(sigma: float, of: tuple[int, int]) -> _Array:
        # Drawn also where sigma is 0, so that switching a part on does not change the others.
        return sigma * rng.standard_normal(of)

    response = np.maximum(1.0 + normal(fixed.response, shape), 0.0)
    offset = normal(fixed.offset, shape) + normal(fixed.column, (1, width)) + normal(fixed.row, (height, 1))
    rate = dark.electrons_per_second * np.maximum(1.0 + normal(dark.spread, shape), 0.0)
    stuck = np.full(shape, np.nan)
    for defect in defects:
        if defect.column >= width or defect.row >= height:
            raise InputError(
                f"defect in column {defect.column}, row {defect.row}; the image has {width} × {height} pixels, counted "
                "from 0"
            )
        at = (defect.row, defect.column)
        if defect.kind in ("dead", "weak"):
            response[at] *= 0.0 if defect.kind == "dead" else defect.value
        elif defect.kind == "hot":
            rate[at] += defect.value
        else:
            stuck[at] = defect.value
    return Pattern(response, offset, rate, stuck)


def add_shot_noise(electrons: _Array, rng: np.random.Generator) -> _Array:
    """Numbers of electrons drawn from Poisson distributions; huge means by the normal distribution they tend to."""
    mean = np.maximum(electrons, 0.0)
    few = mean < 1e9
    drawn = rng.poisson(np.where(few, mean, 0.0)).astype(float)
    return drawn if few.all() else np.where(few, drawn, mean + np.sqrt(mean) * rng.standard_normal(mean.shape))


@dataclass(frozen=True, eq=False)
class Overflow:
    """Charge after overflowing, and where the excess went."""

    electrons: _Array
    """Shape (height, width), nowhere above the capacity."""
    excess: float
    """Electrons that found no room in their own element."""
    drained: float
    """Of these, taken away by the drain."""
    lost: float
    """Of these, flown over the border of the sensor."""
    touched: NDArray[np.bool_]
    """True where an element received charge of others."""


def overflow(electrons: _Array, well: Well) -> Overflow:
    """Let wells overflow: into the drain, around, along the line, along the column (Behr 1989, section 3.6.5).

    Charge is kept: sum before = sum after + drained + lost.
    """
    excess = np.maximum(electrons - well.capacity, 0.0)
    held = np.minimum(electrons, well.capacity)
    if not excess.any():
        return Overflow(electrons=held, excess=0.0, drained=0.0, lost=0.0, touched=np.zeros(held.shape, bool))
    before = held.copy()
    rest = excess * max(1.0 - well.drain - well.tailing - well.circular, 0.0)
    if well.circular:
        held, over = _around(held, excess * well.circular, well)
        rest = rest + over
    if well.tailing:
        held = _flow(held.T, (excess * well.tailing).T, well.capacity).T
    held = _flow(held, rest / 2.0, well.capacity)
    held = _flow(held[::-1], (rest / 2.0)[::-1], well.capacity)[::-1]
    total, drained = float(excess.sum()), well.drain * float(excess.sum())
    lost = total - drained - float((held - before).sum())
    return Overflow(
        electrons=np.ascontiguousarray(held), excess=total, drained=drained, lost=max(lost, 0.0), touched=held > before
    )


def _around(held: _Array, excess: _Array, well: Well) -> tuple[_Array, _Array]:
    """Let excess spread to all sides, again where it meets full elements; charge, and what found no room."""
    most = 1e-6 * float(excess.sum())
    for _ in range(_ROUNDS):
        # "constant" lets the part beyond the border go: that charge is lost.
        held = held + ndimage.gaussian_filter(excess, well.circular_width, mode="constant", truncate=5.0)
        excess = np.maximum(held - well.capacity, 0.0)
        held = np.minimum(held, well.capacity)
        if float(excess.sum()) <= most:
            break
    return held, excess


def _flow(held: _Array, excess: _Array, capacity: float) -> _Array:
    """Let excess run towards higher rows, filling what room it finds; what leaves the last row is gone."""
    out = np.empty_like(held)
    carried = np.zeros(held.shape[1])
    for row in range(held.shape[0]):
        total = held[row] + excess[row] + carried
        out[row] = np.minimum(total, capacity)
        carried = total - out[row]
    return out


def moved_charge(electrons: _Array, readout: Readout) -> _Array:
    """What moving the charge to the output does: smear along columns, transfer losses along lines.

    A charge that is moved n times with the inefficiency ε arrives late by k elements with a share e^(−nε) (nε)^k / k!:
    its modulation is that of Behr 1989, eq. 3.15. Charge beyond the last column is read with the line's end and lost.
    """
    if readout.smear:
        electrons = electrons + readout.smear * electrons.mean(0, keepdims=True)
    if readout.transfer_product:
        late = np.arange(int(readout.transfer_product + 12.0 * np.sqrt(readout.transfer_product) + 6.0))
        shares = np.exp(
            late * np.log(readout.transfer_product) - readout.transfer_product - special.gammaln(late + 1.0)
        )
        padded = np.pad(electrons, ((0, 0), (late.size - 1, 0)), mode="edge")
        # Before the first column lie elements as the first one: a line has no dark border.
        electrons = ndimage.convolve1d(padded, shares, axis=1, origin=-(late.size // 2))[:, late.size - 1 :]
    return np.asarray(electrons)
