"""A described model as the value that computes."""

from __future__ import annotations

from typing import Any

from photoplan.errors import InputError
from photoplan.io.simulation_file import SimulationFile
from photoplan.quality.formation.model import ImageModel
from photoplan.quality.formation.optics_parts import Aperture, Falloff, Lateral, LineJitterPart, Spread
from photoplan.quality.formation.sensor_parts import (
    AutomaticGain,
    DarkCurrentPart,
    DefectPart,
    EnhancementPart,
    Exposure,
    FixedPattern,
    Gain,
    Quantisation,
    Readout,
    Tone,
    Well,
)

_PARTS: dict[str, Any] = {
    "spread": Spread,
    "aperture": Aperture,
    "falloff": Falloff,
    "jitter": LineJitterPart,
    "exposure": Exposure,
    "dark": DarkCurrentPart,
    "fixed_pattern": FixedPattern,
    "well": Well,
    "readout": Readout,
    "gain": Gain,
    "automatic_gain": AutomaticGain,
    "enhancement": EnhancementPart,
    "tone": Tone,
    "quantisation": Quantisation,
}
_LISTS: dict[str, Any] = {"lateral": Lateral, "defects": DefectPart}


def model_of(described: SimulationFile, source: str) -> ImageModel:
    """Model of a description.

    Raises
    ------
    InputError
        A value is outside its range; the message begins with the source.
    """
    stated = described.stated()
    for part, entry in (("spread", "gaussian"), ("aperture", "width")):
        # One number stands for both directions.
        value = stated.get(part, {}).get(entry)
        if isinstance(value, float):
            stated[part][entry] = (value, value)
    try:
        parts: dict[str, Any] = {name: make(**stated[name]) for name, make in _PARTS.items() if name in stated}
        parts |= {n: tuple(make(**each) for each in stated[n]) for n, make in _LISTS.items() if n in stated}
        if "seed" in stated:
            parts["seed"] = stated["seed"]
        return ImageModel(**parts)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
