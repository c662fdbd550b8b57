"""Cameras of a project as the bundle adjustment takes them, and its result as entries of the project."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.none import NoLens
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.cameras.lenses.reversed import Reversed
from photoplan.errors import UsageError
from photoplan.io.camera.model import BrownLens, CameraEntry, RadialTableLens
from photoplan.io.project.cameras import lens_of
from photoplan.orientation.bundle.block import PARAMETERS, AdjustedCamera, BlockCamera

#: Parameters that every camera has; the others are its lens's.
INTERIOR = ("c", "x0", "y0")
#: OpenCV's y axis points down: its p2 is p1 of a lens with y up, and its p1 is −p2.
_OPENCV = {"p1": ("p2", -1.0), "p2": ("p1", 1.0)}


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Parameters of a camera that were unknowns, by the names and in the units of the project file."""

    name: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    """px, mm, or empty."""
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    covariance: NDArray[np.float64]
    """Shape (k, k); NaN without covariance."""
    of_block: NDArray[np.float64]
    """Takes the adjustment's parameters to these, shape (k, k)."""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """Standard deviations, shape (k,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def sigmas(self) -> dict[str, float] | None:
        """Standard deviations as the project states them; None where they are not known."""
        known = np.isfinite(self.sigma).all() and (self.sigma > 0).all()
        return dict(zip(self.parameters, (float(f"{v:.6g}") for v in self.sigma))) if known else None

    @property
    def correlation(self) -> NDArray[np.float64]:
        """Shape (k, k)."""
        s = self.sigma
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / np.outer(s, s)


#: Parameters of each camera that are unknowns, with the standard deviation with which each is known beforehand.
Free = dict[str, dict[str, float | None]]


def parse_calibrate(options: Sequence[str], cameras: Sequence[str]) -> Free:
    """Free parameters from options ``CAMERA=c:5,x0,y0,k1``; the name may be left out where there is one camera.

    A number after a colon is the standard deviation with which the parameter is known beforehand.
    """
    found: Free = {}
    for option in options:
        name, equals, listed = option.rpartition("=")
        if not equals and len(cameras) == 1:
            name = cameras[0]
        if name not in cameras:
            raise UsageError(
                f"`calibrate` {option!r}: cameras of the project are {', '.join(map(repr, cameras))}; write "
                "CAMERA=c,x0,y0,k1"
            )
        parts = [p.partition(":") for p in listed.split(",") if p.strip()]
        parameters = {p.strip(): _prior(option, colon, sigma) for p, colon, sigma in parts}
        unknown = [p for p in parameters if p not in PARAMETERS]
        if unknown or not parameters:
            raise UsageError(f"`calibrate` {option!r}: {unknown[:1] or 'nothing'}; allowed are {', '.join(PARAMETERS)}")
        found[name] = parameters
    return found


def _prior(option: str, colon: str, text: str) -> float | None:
    if not colon:
        return None
    try:
        sigma = float(text)
    except ValueError:
        sigma = math.nan
    if not (math.isfinite(sigma) and sigma > 0):
        raise UsageError(f"`calibrate` {option!r}: {text!r} is no standard deviation; write c:5 for ± 5")
    return sigma


def block_camera(
    name: str, camera: CameraEntry, interior: Interior, free: Mapping[str, float | None] | None = None
) -> BlockCamera:
    """A camera of the block."""
    free = free or {}
    lens = lens_of(camera)
    own = [p for p in free if p not in INTERIOR]
    if own and isinstance(lens, Reversed):
        raise UsageError(
            f"camera {name!r}: {', '.join(own)} cannot be unknowns, as its lens is stated as a correction (meaning = "
            '"correction"); free c, x0, y0 only, or begin without distortion: lens = { type = "none" }'
        )
    if own and not isinstance(lens, Brown | OpenCV | NoLens):
        raise UsageError(
            f"camera {name!r}: {', '.join(own)} cannot be unknowns, as its lens ({camera.lens.type}) is not described "
            'by them; free c, x0, y0 only, or begin without distortion: lens = { type = "none" }'
        )
    missing = [p for p in own if p in ("b1", "b2")]
    if missing and isinstance(lens, OpenCV):
        raise UsageError(f'camera {name!r}: an OpenCV lens has no {", ".join(missing)}; a lens of type "brown" has')
    names = {_OPENCV.get(p, (p, 1.0))[0] if isinstance(lens, OpenCV) else p: sigma for p, sigma in free.items()}
    ordered = tuple(p for p in PARAMETERS if p in names)
    prior = {p: sigma for p, sigma in names.items() if sigma is not None}
    if "c" in prior and _constant_in_pixels_of_mm(camera) and camera.camera_constant_mm is not None:
        prior["c"] *= interior.c / camera.camera_constant_mm
    return BlockCamera(
        c=interior.c, principal_point=interior.principal_point, lens=lens, free=ordered, prior_sigma=prior
    )


def calibrated(camera: CameraEntry, start: BlockCamera, found: AdjustedCamera) -> Calibrated:
    """The result of a camera that had free parameters."""
    lens = found.lens
    names, units, before, after, scales = [], [], [], [], []
    unit, to_row = _unit(camera)
    for p in found.free:
        own, scale = p, 1.0
        if isinstance(lens, OpenCV) and p in ("p1", "p2"):
            own, scale = next((name, sign) for name, (other, sign) in _OPENCV.items() if other == p)
        if p in INTERIOR:
            old, new = _interior(camera, start, found)
            scale = {"y0": to_row}.get(p, 1.0)
            value = (old[INTERIOR.index(p)], new[INTERIOR.index(p)])
            if p == "c" and _constant_in_pixels_of_mm(camera):
                scale = value[1] / found.c
        else:
            value = (float(getattr(start.lens, own, 0.0)), float(getattr(lens, own)))
        names.append(own)
        units.append(unit[p] if p in INTERIOR else "")
        before.append(value[0])
        after.append(value[1])
        scales.append(scale)
    order = np.argsort([PARAMETERS.index(n) for n in names])
    of_block = np.diag(scales)[order]
    return Calibrated(
        name=found.name,
        parameters=tuple(names[k] for k in order),
        units=tuple(units[k] for k in order),
        before=np.array(before)[order],
        after=np.array(after)[order],
        covariance=of_block @ found.covariance @ of_block.T,
        of_block=of_block,
    )


def camera_entries(camera: CameraEntry, start: BlockCamera, found: AdjustedCamera) -> dict[str, Any]:
    """Entries of the camera in the project file after the adjustment: they give the adjusted camera exactly."""
    if not found.free:
        return {}
    _, new = _interior(camera, start, found)
    entries: dict[str, Any] = {}
    constant, x0, y0 = new
    if camera.camera_constant_mm is None and camera.pixels is not None:
        fx, fy = camera.pixels.focal
        entries["focal_px"] = constant if fx == fy else [constant, constant * fy / fx]
    else:
        entries["camera_constant_mm"] = constant
    if {"x0", "y0"} & set(found.free):
        entries["principal_point_px" if camera.states_pixels else "principal_point_mm"] = [x0, y0]
    if "c" not in found.free:
        entries = {k: v for k, v in entries.items() if k.startswith("principal")}
    lens = _lens_entry(camera, start, found)
    if lens is not None:
        entries["lens"] = lens
    return entries


def _constant_in_pixels_of_mm(camera: CameraEntry) -> bool:
    return camera.states_pixels and camera.camera_constant_mm is not None


def _unit(camera: CameraEntry) -> tuple[dict[str, str], float]:
    """Unit of c, x0, y0 in the project, and what turns y0 into rows."""
    if not camera.states_pixels or camera.pixels is None:
        return dict.fromkeys(INTERIOR, "mm"), 1.0
    fx, fy = camera.pixels.focal
    c = "mm" if _constant_in_pixels_of_mm(camera) else "px"
    return {"c": c, "x0": "px", "y0": "px"}, -fy / fx


def _interior(
    camera: CameraEntry, start: BlockCamera, found: AdjustedCamera
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """c, x0, y0 before and after, as the project states them: principal point as column and row, or in millimetres."""
    if not camera.states_pixels or camera.pixels is None:
        return (start.c, *start.principal_point), (found.c, *found.principal_point)
    col, row = camera.pixels.point
    _, to_row = _unit(camera)
    factor = 1.0
    if _constant_in_pixels_of_mm(camera):
        assert camera.camera_constant_mm is not None
        factor = camera.camera_constant_mm / start.c
    x, y = found.principal_point
    x_start, y_start = start.principal_point
    old = (start.c * factor, col, row)
    return old, (found.c * factor, col + x - x_start, row + to_row * (y - y_start))


def _lens_entry(camera: CameraEntry, start: BlockCamera, found: AdjustedCamera) -> dict[str, Any] | None:
    """The lens as the project file states it; None where its entry stays right."""
    lens = camera.lens
    own = [p for p in found.free if p not in INTERIOR]
    if own and isinstance(found.lens, Brown | OpenCV):
        return _stated(found.lens)
    if found.c == start.c:
        return None
    # The lens stays; entries that depend on the camera constant are written for the new one.
    if isinstance(lens, BrownLens) and lens.unit != "tangent":
        inner = found.lens.lens if isinstance(found.lens, Reversed) else found.lens
        assert isinstance(inner, Brown)
        meaning = {"meaning": "correction"} if isinstance(found.lens, Reversed) else {}
        return {**_stated(inner), **meaning}
    if isinstance(lens, RadialTableLens):
        factor = found.c / start.c
        entry: dict[str, Any] = {"type": lens.type, "distortion_um": [v * factor for v in lens.distortion_um]}
        if lens.radii_mm is not None:
            return {**entry, "radii_mm": [v * factor for v in lens.radii_mm]}
        return {**entry, "angles_deg": list(lens.angles_deg or ())}
    return None


def _stated(lens: Brown | OpenCV) -> dict[str, Any]:
    """A lens by its coefficients; those that are 0 are left out."""
    values = dataclasses.asdict(lens).items()
    return {"type": "brown" if isinstance(lens, Brown) else "opencv", **{k: v for k, v in values if v}}
