"""Distortions in support data (CSM ISD) of line cameras.

With u without and d with distortion in the focal plane, both in millimetres: those of `isd_lens`, and (USGS, usgscsm,
`Distortion.cpp`, and for THEMIS ISIS, `ThemisIrDistortionMap.cpp`; public domain; names are their own)

    kaguyalism      ux = dx + boresight_x + x0 + x1 r + x2 r² + x3 r³, uy likewise, r of d, positive on either side
    kplo_shadowcam  ux = dx, uy = dy (1 + k dy²)
    lrolrocnac      ux = dx, uy = dy / (1 + k dy²)
    themisir        dx = p_k ux, dy = (1 + p_alpha1) uy + p_alpha2 uy²
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.pushbroom_rays import LineBend, LineLook
from photoplan.errors import InputError
from photoplan.io.camera.isd import Isd
from photoplan.io.camera.isd_lens import LENSES, lens_of, not_known

_Floats = NDArray[np.float64]
#: From y down to y up, and back.
_UP = np.array([1.0, -1.0])


def look(isd: Isd) -> LineLook:
    """Directions of the detectors: places in the focal plane without distortion, over the focal length."""
    plane, summing = isd.focal_plane(), isd.summing("sample")
    to_plane = np.linalg.inv(plane.to_detector)
    place = np.asarray(to_plane @ (np.array([plane.first[0], 0.5 * summing + plane.first[1]]) - plane.axis), float)
    step = np.asarray(to_plane[:, 1] * summing, float)
    kind = isd.distortion

    def places(column: _Floats) -> _Floats:
        return np.asarray(place + column[:, None] * step)

    if kind is None or kind in LENSES:
        c, lens = lens_of(isd, kind)
        return LineLook.of(lambda column: lens.undistort(places(column) * (_UP / c)) * _UP, isd.samples)
    if kind not in _PLANE:
        raise not_known(kind, [*LENSES, *_PLANE])
    undistorted = _PLANE[kind](isd)
    bend = None
    if kind == "kaguyalism":
        odd = _kaguya(isd)[[1, 3]] / plane.focal
        bend = LineBend(place, step, *odd) if odd.any() else None
    return LineLook.of(lambda column: undistorted(places(column)) / plane.focal, isd.samples, bend=bend)


_Plane = Callable[[_Floats], _Floats]


def _even(isd: Isd) -> _Plane:
    """What depends on even powers of the distance; for the odd ones see `LineBend`."""
    shift = [isd.numbers(f"optical_distortion.kaguyalism.boresight_{axis}", ()) for axis in "xy"]
    k = _kaguya(isd)
    return lambda d: np.asarray(d + shift + k[0] + (d**2).sum(axis=1, keepdims=True) * k[2])


def _kaguya(isd: Isd) -> _Floats:
    """Coefficients (4, 2) of rising powers of the distance, for x and y."""
    return np.array([isd.coefficients(f"kaguyalism.{axis}", 4) for axis in "xy"]).T


def _shadowcam(isd: Isd) -> _Plane:
    (k,) = isd.coefficients("kplo_shadowcam.coefficients", 1)
    return lambda d: d * np.stack([np.ones(len(d)), 1.0 + k * d[:, 1] ** 2], axis=1)


def _lroc(isd: Isd) -> _Plane:
    (k,) = isd.coefficients("lrolrocnac.coefficients", 1)
    return lambda d: d / np.stack([np.ones(len(d)), 1.0 + k * d[:, 1] ** 2], axis=1)


def _themis(isd: Isd) -> _Plane:
    k, one, two = (isd.numbers(f"optical_distortion.themisir.{name}", ()) for name in ("p_k", "p_alpha1", "p_alpha2"))
    if not k > 0:
        raise InputError(f"optical_distortion.themisir.p_k is {k:g}: a scale, above 0")

    def undistorted(d: _Floats) -> _Floats:
        with np.errstate(invalid="ignore"):
            root = np.sqrt((1.0 + one) ** 2 + 4.0 * two * d[:, 1])
        return np.stack([d[:, 0] / k, 2.0 * d[:, 1] / (1.0 + one + root)], axis=1)

    return undistorted


_PLANE: dict[str, Callable[[Isd], _Plane]] = {
    "kaguyalism": _even,
    "kplo_shadowcam": _shadowcam,
    "lrolrocnac": _lroc,
    "themisir": _themis,
}
