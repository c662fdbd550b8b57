"""What the adjustment of a project has to know of images without poses, whatever their geometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.correctable import Correctable
from photoplan.io.project.model import Project
from photoplan.orientation.bundle.block import AdjustedCorrections
from photoplan.project.ground import Ground

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FoundParameter:
    """A parameter of a correction that was determined."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class FoundCorrection:
    """What came out for an image."""

    entries: Mapping[str, Any]
    """Of its table in the project; None takes one out."""
    parameters: tuple[FoundParameter, ...]
    file: str | None = None
    """Text of a file of corrections; the project's entry `correction` names it."""
    over_time: tuple[_Floats, _Floats] | None = None
    """Times (k,) in seconds and corrections (k, 6) that change with them: metres, radians."""
    seconds: Callable[[_Floats], _Floats] | None = None
    """Times of rows (n,), where residuals are worth a look over time."""
    angles: tuple[_Floats, _Floats] | None = None
    """Times (k,) in seconds, and ω, φ, κ of the adjusted trajectory (k, 3), radians."""


@dataclass(frozen=True)
class Geometry:
    """A kind of geometry."""

    group: str
    """Images of it as messages call them."""
    away: Callable[[Any], float]
    """About how far a correctable is from the ground, metres."""
    correctable: Callable[[Project, Any, Ground, tuple[int, int]], Correctable]
    """Of an image's entry; cameras are over the ground's height system."""
    found: Callable[[Any, Mapping[str, AdjustedCorrections]], FoundCorrection]
    """Of a correctable and its adjusted sets."""
    output: Callable[[str], str | None] = field(default=lambda name: None)
    """Name of the file of corrections of an image, in the output folder, by the stem of its products."""
