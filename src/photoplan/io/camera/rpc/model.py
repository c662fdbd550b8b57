"""Rational polynomials as files state them: by name, as texts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.cameras.rpc import RationalFunctions
from photoplan.errors import InputError

#: Nothing that holds 90 numbers and what belongs to an image is larger.
MAX_BYTES = 20_000_000
GROUPS = ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")
IMAGE, GROUND = ("SAMP", "LINE"), ("LONG", "LAT", "HEIGHT")
SINGLE = tuple(f"{axis}_{what}" for what in ("OFF", "SCALE") for axis in (*IMAGE, *GROUND))


@dataclass(frozen=True, eq=False)
class StatedRpc:
    """Rational polynomials of a file."""

    file: Path
    form: str
    """The file's format, in words."""
    functions: RationalFunctions

    def describe(self) -> dict[str, str]:
        """In words, by name."""
        f = self.functions
        lon, lat, height = f.ground_offset
        low, high = f.ground_offset[2] - f.ground_scale[2], f.ground_offset[2] + f.ground_scale[2]
        return {
            "rational polynomials": f"RPC00B, {self.form}",
            "middle": f"longitude {lon:.5f}°, latitude {lat:.5f}°, height {height:g} m (WGS 84)",
            "ground": f"± {f.ground_scale[0]:.5f}°, ± {f.ground_scale[1]:.5f}°, heights {low:g} to {high:g} m",
            "image": f"column {f.image_offset[0]:g} ± {f.image_scale[0]:g}, row {f.image_offset[1]:g} ± "
            f"{f.image_scale[1]:g} (0, 0 is the centre of the first pixel)",
        }


def stated(
    values: Mapping[str, str | Sequence[str]], where: str, first: tuple[float, float] = (0.0, 0.0)
) -> RationalFunctions:
    """Rational polynomials of numbers as GDAL calls them."""
    missing = [name for name in (*SINGLE, *GROUPS) if name not in values]
    if missing:
        raise InputError(
            f"{where}: {', '.join(missing)} missing; RPC00B has ten offsets and scales and 80 coefficients"
        )
    single = {name: _numbers(values[name], f"{where}: {name}", 1)[0] for name in SINGLE}
    coefficients = [_numbers(values[name], f"{where}: {name}", 20) for name in GROUPS]
    offsets, scales = ({axis: single[f"{axis}_{what}"] for axis in (*IMAGE, *GROUND)} for what in ("OFF", "SCALE"))
    try:
        return RationalFunctions(
            image_offset=(offsets["SAMP"] - first[0], offsets["LINE"] - first[1]),
            image_scale=(scales["SAMP"], scales["LINE"]),
            ground_offset=(offsets["LONG"], offsets["LAT"], offsets["HEIGHT"]),
            ground_scale=(scales["LONG"], scales["LAT"], scales["HEIGHT"]),
            coefficients=np.array(coefficients),
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _numbers(given: str | Sequence[str], where: str, count: int) -> list[float]:
    words = given.split() if isinstance(given, str) else list(given)
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{where}: {' '.join(words)[:80]!r} given; {count} numbers are needed") from None
    if len(values) != count or not np.isfinite(values).all():
        told = "a number that is not finite" if len(values) == count else f"{len(values)} values"
        raise InputError(f"{where}: {told} given; {count} finite numbers are needed")
    return values
