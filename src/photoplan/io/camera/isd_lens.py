"""Distortions of support data (CSM ISD) that are lenses, for cameras of frames and of lines.

With u without and d with distortion in the focal plane, both in millimetres, r² = x² + y² (USGS, usgscsm,
`Distortion.cpp`, public domain; names are its own):

    radial      u = d (1 − k0 − k1 r² − k2 r⁴), r of d
    transverse  dx, dy = cubic polynomials of u with ten coefficients each, in the order of `Cubic`
    dawnfc      d = u (1 + k r²), r of u
    radtan      d / f = OpenCV's lens of u / f: k1, k2, p1, p2, k3
"""

from __future__ import annotations

from collections.abc import Callable

from photoplan.cameras.lenses import Brown, Cubic, Lens, NoLens, OpenCV, Reversed
from photoplan.errors import InputError
from photoplan.io.camera.isd import Isd


def lens_of(isd: Isd, kind: str | None) -> tuple[float, Lens]:
    """The camera constant, millimetres, and the lens by its tangents, of one of `LENSES`; None: there is none."""
    f = isd.focal_plane().focal
    return (f, NoLens()) if kind is None else LENSES[kind](isd, f)


def not_known(kind: str, known: list[str]) -> InputError:
    """What is said of another distortion."""
    return InputError(
        f"the distortion {kind!r} is not known; {', '.join(known)} are. Where all its coefficients are 0, or are "
        "not needed, take optical_distortion out of the file"
    )


def _radial(isd: Isd, f: float) -> tuple[float, Lens]:
    # As usgscsm reads them: the first is the constant part, and those that are not there are 0.
    found = [float(v) for v in isd.numbers("optical_distortion.radial.coefficients", (-1,))]
    if not found or any(found[3:]):
        raise InputError(
            f"optical_distortion.radial.coefficients has {len(found)} numbers; 1 to 3 are known (k0, k1, k2), and more "
            "must be 0"
        )
    k0, k1, k2 = (*found, 0.0, 0.0)[:3]
    if not k0 < 1.0:
        raise InputError(f"radial distortion with a constant part of {k0:g}")
    # The constant part changes the scale of the image, and nothing else.
    c = f / (1.0 - k0)
    lens = Brown.from_image_units(c, k=(-k1 / (1.0 - k0), -k2 / (1.0 - k0)))
    return c, Reversed(lens) if k1 or k2 else NoLens()


def _transverse(isd: Isd, f: float) -> tuple[float, Lens]:
    x, y = (tuple(isd.coefficients(f"transverse.{axis}", 10)) for axis in "xy")
    return f, Cubic.from_y_down(f, x, y)


def _dawn(isd: Isd, f: float) -> tuple[float, Lens]:
    return f, Brown.from_image_units(f, k=tuple(isd.coefficients("dawnfc.coefficients", 1)))


def _radtan(isd: Isd, f: float) -> tuple[float, Lens]:
    k1, k2, p1, p2, k3 = isd.coefficients("radtan.coefficients", 5)
    return f, OpenCV(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)


#: Camera constant and lens of every distortion that is a lens.
LENSES: dict[str, Callable[[Isd, float], tuple[float, Lens]]] = {
    "radial": _radial,
    "transverse": _transverse,
    "dawnfc": _dawn,
    "radtan": _radtan,
}
