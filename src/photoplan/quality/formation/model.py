"""The image formation model: the image that a camera makes of a scene, and the true image next to it.

Scene → spread → sampling by the pixels' apertures, lines and bands displaced → fall-off → electrons → overflow → smear
and transfer → noise → gain → edge enhancement → tone curve → whole grey values. Every part is optional; a model without
parts returns the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, exp, radians, sin
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.quality.curves import MtfCurve
from photoplan.quality.formation.optics import (
    Aperture,
    AutomaticGain,
    DarkCurrentPart,
    DefectPart,
    EnhancementPart,
    Exposure,
    Falloff,
    FixedPattern,
    FormationPart,
    Gain,
    Lateral,
    Light,
    LineJitterPart,
    Optics,
    Quantisation,
    Readout,
    Spread,
    ToneCurve,
    Well,
    Within,
    aperture_transfer,
    line_displacements,
    spread_transfer,
)
from photoplan.quality.formation.scenes import LightScene

#: Times that circular overflow spreads again where it meets full elements; what is left then goes along the columns.
_ROUNDS = 60


@dataclass(frozen=True, eq=False)
class Pattern:
    """What is the same in all frames; arrays of shape (height, width)."""

    response: Floats
    """Sensitivity relative to the mean; 0 where an element is dead."""
    offset: Floats
    """Electrons that are added, independent of time."""
    dark_rate: Floats
    """Electrons per second."""
    stuck: Floats
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

    def normal(sigma: float, of: tuple[int, int]) -> Floats:
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


def add_shot_noise(electrons: Floats, rng: np.random.Generator) -> Floats:
    """Numbers of electrons drawn from Poisson distributions; huge means by the normal distribution they tend to."""
    mean = np.maximum(electrons, 0.0)
    few = mean < 1e9
    drawn = rng.poisson(np.where(few, mean, 0.0)).astype(float)
    return drawn if few.all() else np.where(few, drawn, mean + np.sqrt(mean) * rng.standard_normal(mean.shape))


@dataclass(frozen=True, eq=False)
class Overflow:
    """Charge after overflowing, and where the excess went."""

    electrons: Floats
    """Shape (height, width), nowhere above the capacity."""
    excess: float
    """Electrons that found no room in their own element."""
    drained: float
    """Of these, taken away by the drain."""
    lost: float
    """Of these, flown over the border of the sensor."""
    touched: Mask
    """True where an element received charge of others."""


def overflow(electrons: Floats, well: Well) -> Overflow:
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


def _around(held: Floats, excess: Floats, well: Well) -> tuple[Floats, Floats]:
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


def _flow(held: Floats, excess: Floats, capacity: float) -> Floats:
    """Let excess run towards higher rows, filling what room it finds; what leaves the last row is gone."""
    out = np.empty_like(held)
    carried = np.zeros(held.shape[1])
    for row in range(held.shape[0]):
        total = held[row] + excess[row] + carried
        out[row] = np.minimum(total, capacity)
        carried = total - out[row]
    return out


def moved_charge(electrons: Floats, readout: Readout) -> Floats:
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


#: Pixels × bands of an image that is formed: it is held in memory several times as float64.
MOST_PIXELS = 40_000_000


def next_gain(automatic: AutomaticGain, gain: float, mean: float) -> float:
    """Gain of the next frame, relative to the fixed one."""
    wanted = automatic.target / mean if mean > 0.0 else automatic.most
    wanted = min(max(wanted, automatic.least), automatic.most)
    share = 1.0 - exp(-1.0 / automatic.frames) if automatic.frames > 0.0 else 1.0
    return gain + (wanted - gain) * share


def enhanced(grey: Floats, enhancement: EnhancementPart) -> Floats:
    """Grey values of one band with over- and undershoot beside edges."""
    width = (enhancement.width if enhancement.direction == "both" else 0.0, enhancement.width)
    smooth = ndimage.gaussian_filter(grey, width, mode="nearest")
    return np.asarray(grey + enhancement.amount * (grey - smooth))


def toned(grey: Floats, tone: ToneCurve) -> Floats:
    """Stored grey values of linear ones."""
    if tone.curve == "table":
        points = np.array(tone.table)
        return np.asarray(np.interp(grey, points[:, 0], points[:, 1]))
    part = np.maximum(grey / tone.white, 0.0)
    if tone.curve == "gamma":
        return np.asarray(tone.white * part ** (1.0 / tone.gamma))
    # IEC 61966-2-1
    curve = np.where(part <= 0.0031308, 12.92 * part, 1.055 * part ** (1.0 / 2.4) - 0.055)
    return np.asarray(tone.white * curve)


def quantised(grey: Floats, quantisation: Quantisation) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Whole grey values within the range, as the smallest unsigned type that holds them."""
    whole = np.clip(np.floor(grey + 0.5), 0, quantisation.most)
    return whole.astype(np.uint8) if quantisation.bits <= 8 else whole.astype(np.uint16)


@dataclass(frozen=True)
class ImageModel(FormationPart, name="model"):
    """How an image comes about. Each part's default changes nothing."""

    spread: Spread = field(default_factory=Spread)
    aperture: Aperture = field(default_factory=Aperture)
    lateral: tuple[Lateral, ...] = ()
    falloff: Falloff = field(default_factory=Falloff)
    jitter: LineJitterPart = field(default_factory=LineJitterPart)
    exposure: Exposure = field(default_factory=Exposure)
    dark: DarkCurrentPart = field(default_factory=DarkCurrentPart)
    fixed_pattern: FixedPattern = field(default_factory=FixedPattern)
    defects: tuple[DefectPart, ...] = ()
    well: Well | None = None
    readout: Readout = field(default_factory=Readout)
    gain: Gain = field(default_factory=Gain)
    automatic_gain: AutomaticGain | None = None
    enhancement: EnhancementPart | None = None
    tone: ToneCurve | None = None
    quantisation: Quantisation | None = None
    seed: Annotated[int, Within(0, 2**63)] = 0
    """Of all that is random: the same seed gives the same sensor, the same seed and frame the same image."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len({each.band for each in self.lateral}) < len(self.lateral):
            raise InputError("lateral: a band is described twice")
        if len(self.defects) > 1_000_000:
            raise InputError(f"{len(self.defects)} defects; at most 1000000 are allowed")

    @property
    def optics(self) -> Optics:
        """The parts that decide how a scene is sampled."""
        return Optics(self.spread, self.aperture, self.lateral)


@dataclass(frozen=True, eq=False)
class FormedImage:
    """An image and the truth about it."""

    values: NDArray[Any]
    """Grey values, shape (height, width), or (bands, height, width) where the scene has several bands; uint8 or uint16
    with a quantisation, else float64."""
    light: Floats
    """What fell on the pixels in the units of the scene, without noise, after spread, aperture and fall-off; same
    shape."""
    line_shift: Floats
    """By how many pixels each line was moved to the right, shape (height,)."""
    gain: float
    """Automatic gain of this frame, relative to the fixed one."""
    next_gain: float
    """Automatic gain of the frame after it."""
    facts: Mapping[str, object]
    """Figures: electrons (means), overflow, clipped pixels; plain values."""


@dataclass(frozen=True)
class FormedFrame:
    """One of a series."""

    number: int
    """Frames differ in what is random in time."""
    exposure: float = 1.0
    """Factor of the light and of the time."""
    gain: float = 1.0
    """Automatic gain that earlier frames led to, `FormedImage.next_gain`."""

    def __post_init__(self) -> None:
        if not self.exposure >= 0.0 or not np.isfinite(self.exposure) or self.number < 0:
            raise InputError(f"frame {self.number} with exposure {self.exposure}; neither may be negative")


def _random(model: ImageModel, *key: int) -> np.random.Generator:
    """A generator of its own for each purpose, so that no part changes the numbers of another."""
    return np.random.default_rng(np.random.SeedSequence([model.seed, *key]))


def _shift(model: ImageModel, lines: int, frame: int) -> Floats:
    """By how many pixels each line of a frame is moved to the right."""
    return line_displacements(model.jitter, lines, _random(model, 1, frame))


def frame_light(model: ImageModel, scene: LightScene, frame: int) -> Light:
    """The light on the pixels of a frame; the same for all frames without random jitter."""
    shift = _shift(model, scene.size[1], frame)
    return Light(scene, model.optics, model.falloff, shift if shift.any() else None)


def exposed(model: ImageModel, light: Floats, frame: FormedFrame) -> FormedImage:
    """Image of light on the pixels, shape (bands, height, width), see `frame_light`."""
    bands, height, width = light.shape
    grey = np.empty_like(light)
    facts: dict[str, float] = {"electrons": 0.0, "dark_electrons": 0.0, "overflow": 0.0, "drained": 0.0, "lost": 0.0}
    for band in range(bands):
        pattern = fixed_pattern(
            model.fixed_pattern, model.dark, model.defects, (width, height), _random(model, 2, band)
        )
        noise = _random(model, 3, band, frame.number)
        electrons = _electrons(model, light[band], pattern, frame.exposure, noise, facts)
        grey[band] = electrons * model.gain.factor
    gain = frame.gain if model.automatic_gain is not None else 1.0
    after = next_gain(model.automatic_gain, gain, float(grey.mean())) if model.automatic_gain is not None else 1.0
    values = _grey(model, grey * gain, frame)
    if model.quantisation is not None:
        facts["saturated_pixels"] = int((values == model.quantisation.most).sum())
        facts["black_pixels"] = int((values == 0).sum())
    facts |= {name: facts[name] / light.size for name in ("electrons", "dark_electrons")}
    single = bands == 1
    shift = _shift(model, height, frame.number)
    return FormedImage(
        values=values[0] if single else values,
        light=light[0] if single else light,
        line_shift=shift,
        gain=gain,
        next_gain=after,
        facts=facts,
    )


def _electrons(
    model: ImageModel,
    light: Floats,
    pattern: Pattern,
    exposure: float,
    noise: np.random.Generator,
    facts: dict[str, float],
) -> Floats:
    """Charge that is read, shape (height, width); sums are added to the facts."""
    source = model.exposure
    signal = light * (source.light * source.quantum_efficiency * exposure) * pattern.response
    dark = pattern.dark_rate * (source.seconds * exposure)
    charge = signal + dark
    facts["electrons"] += float(signal.sum())
    facts["dark_electrons"] += float(dark.sum())
    if model.readout.shot_noise:
        charge = add_shot_noise(charge, noise)
    if model.well is not None:
        flown = overflow(charge, model.well)
        charge = flown.electrons
        facts["overflow"] += flown.excess
        facts["drained"] += flown.drained
        facts["lost"] += flown.lost
    charge = moved_charge(charge, model.readout) + pattern.offset
    stuck = np.isfinite(pattern.stuck)
    charge[stuck] = pattern.stuck[stuck]
    if model.readout.noise:
        charge = charge + noise.normal(0.0, model.readout.noise, charge.shape)
    return np.asarray(charge)


def _grey(model: ImageModel, grey: Floats, frame: FormedFrame) -> NDArray[Any]:
    """Stored grey values of the amplified signal, shape (bands, height, width)."""
    if model.gain.noise:
        grey = grey + _random(model, 4, frame.number).normal(0.0, model.gain.noise, grey.shape)
    if model.enhancement is not None:
        grey = np.stack([enhanced(band, model.enhancement) for band in grey])
    grey = grey + model.gain.offset
    if model.tone is not None:
        grey = toned(grey, model.tone)
    return grey if model.quantisation is None else quantised(grey, model.quantisation)


def model_transfer(
    model: ImageModel, frequency: Floats, angle_deg: float = 0.0, radius: float = 0.0
) -> NDArray[np.complex128]:
    """Optical transfer function of spread and aperture together, of a continuous scene."""
    f = np.asarray(frequency, float)
    fx, fy = f * cos(radians(angle_deg)), f * sin(radians(angle_deg))
    scale = model.spread.scale_at(radius)
    return np.asarray(spread_transfer(model.spread, fx, fy, scale) * aperture_transfer(model.aperture, fx, fy))


def model_modulation(model: ImageModel, frequency: Floats, angle_deg: float = 0.0, radius: float = 0.0) -> Floats:
    """Modulus of `model_transfer`, which says what the arguments are: the MTF."""
    return np.abs(model_transfer(model, frequency, angle_deg, radius))


def model_mtf50(model: ImageModel, angle_deg: float = 0.0, radius: float = 0.0) -> float:
    """First frequency at which the MTF falls to one half, cycles per pixel; NaN if it does not below 20.

    Direction and place are those of `model_transfer`.
    """
    f = np.linspace(0.0, 20.0, 40001)
    return MtfCurve(f, model_modulation(model, f, angle_deg, radius)).falls_to(0.5)
