"""Tables and worked examples of error budgets as Ecker 1991, §4.8 and §8.2.2, prints them, computed."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from math import pi
from typing import Any

import numpy as np

from photoplan.plan.budget import (
    FILM_CORNER,
    admissible_height_error,
    admissible_shift,
    displacement_by_height,
    displacement_by_kappa,
    displacement_by_tilt,
    orientation_effect,
)

_GON = pi / 200
#: Flying heights and height errors of table 4.3, metres.
_HEIGHTS, _ERRORS = (750.0, 1500.0, 3750.0, 7500.0), (1.0, 5.0, 10.0, 25.0, 100.0)
#: The worked example: 0.1 mm at 1 : 5000 from images 1 : 10 000 with c = 150 mm, at the tangent 0.733 along each axis.
_PRODUCT, _MAP, _SCALE, _C, _W = 1e-4, 5000.0, 10_000.0, 0.150, 0.733
#: Standard deviations of the two images of §8.2.2: X0, Y0, Z0 (metres), ω, φ, κ (gon); c, flying height, scale number.
_IMAGES = {
    "5162": ((0.14, 0.16, 0.05), (0.0095, 0.0082, 0.0032)),
    "5164": ((0.24, 0.32, 0.19), (0.0227, 0.0134, 0.0063)),
}
_FLIGHT = (0.15324, 900.0, 6000.0)


@dataclass(frozen=True)
class SourceTables:
    """What the source prints."""

    heights: tuple[tuple[float, ...], ...]
    """Table 4.3: radial displacement in the image corner, mm, by flying height and height error."""
    shift: float
    """Admissible error of X0, Y0 in the worked example of §4.8.2.1, metres."""
    height: float
    """Admissible error of Z0, metres."""
    tilt: float
    """Admissible error of ω and φ in the worked example of §4.8.2.2, gon."""
    kappa: float
    """Of κ, gon."""
    images: dict[str, tuple[float, ...]]
    """§8.2.2: displacement in the image corner by X0, Y0, Z0, ω, φ, κ of two images, µm."""

    def json_fields(self) -> dict[str, Any]:
        """All figures with their units."""
        names = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
        return {
            "table_4_3_mm": {
                f"{h:g} m": dict(zip(map("{:g} m".format, _ERRORS), row)) for h, row in zip(_HEIGHTS, self.heights)
            },
            "admissible": {
                "X0_Y0_m": self.shift,
                "Z0_m": self.height,
                "omega_phi_gon": self.tilt,
                "kappa_gon": self.kappa,
            },
            "orientation_8_2_2_um": {image: dict(zip(names, row)) for image, row in self.images.items()},
        }

    def __str__(self) -> str:
        lines = ["Ecker 1991, table 4.3: radial displacement in the corner (r = 140 mm) by a height error, mm"]
        lines.append("  flying height" + "".join(f"{e:>7g} m" for e in _ERRORS))
        lines += [f"  {h:>11g} m" + "".join(f"{v:>9.1f}" for v in row) for h, row in zip(_HEIGHTS, self.heights)]
        lines += [
            "Ecker 1991, §4.8.2: admissible for 0.1 mm at 1 : 5000 in the corner, image 1 : 10 000, c = 150 mm",
            f"  X0, Y0   {self.shift:.2f} m",
            f"  Z0       {self.height:.2f} m",
            f"  ω, φ     {self.tilt:.3f} gon",
            f"  κ        {self.kappa:.3f} gon",
            "Ecker 1991, §8.2.2: displacement in the corner by the orientation's standard deviations, µm",
            "  image        X0     Y0     Z0      ω      φ      κ",
        ]
        return "\n".join(
            [*lines, *(f"  {name:<7}" + "".join(f"{v:>7.0f}" for v in row) for name, row in self.images.items())]
        )


def source_tables() -> SourceTables:
    """Tables and examples, from the formulas of `photoplan.plan.budget`."""
    in_image = _PRODUCT * _MAP / _SCALE
    c, height, scale = _FLIGHT
    images = {}
    for name, (center, angles) in _IMAGES.items():
        omega, phi, kappa = (a * _GON for a in angles)
        effect = orientation_effect(center, (omega, phi, kappa), c, height, scale_number=scale, w=_W)
        images[name] = tuple(v * 1e6 for v in astuple(effect))
    return SourceTables(
        heights=tuple(
            tuple((displacement_by_height(FILM_CORNER, h, np.array(_ERRORS)) * 1000).tolist()) for h in _HEIGHTS
        ),
        shift=float(admissible_shift(in_image, _SCALE)),
        height=float(admissible_height_error(FILM_CORNER, _C * _SCALE, in_image)),
        tilt=float(in_image / displacement_by_tilt(_GON, _C, _W)),
        kappa=float(in_image / displacement_by_kappa(_GON, _C, _W)),
        images=images,
    )
