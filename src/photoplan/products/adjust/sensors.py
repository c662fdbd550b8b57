"""Cameras of all kinds in the bundle adjustment, and its frame."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera
from photoplan.cameras.correctable import (
    FORMS,
    TURNED,
    Correctable,
    CorrectableLine,
    CorrectableRpc,
    LineCorrection,
    TrackPriors,
    map_axes,
)
from photoplan.cameras.lenses import Brown, Interior, NoLens, OpenCV, Reversed
from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.geometry.heights import OPTIONS, check_height_system, declared_pair, height_step
from photoplan.geometry.local import LocalFrame
from photoplan.geometry.pose import angles_from_rotation
from photoplan.io.camera.line import line_correction_text, read_line_correction
from photoplan.io.camera.model import BrownLens, CameraEntry, RadialTableLens
from photoplan.io.project.model import ImageEntry, LineImage, Project, RpcImage, StripAdjustment, lens_of
from photoplan.orientation.bundle.adjust import BlockFrame
from photoplan.orientation.bundle.model import (
    PARAMETERS,
    Adjusted,
    AdjustedCamera,
    AdjustedCorrections,
    Block,
    BlockCamera,
    BlockProjection,
    OnMap,
)
from photoplan.project.cameras import line_camera, rpc_camera, size_of
from photoplan.project.ground import Ground, ground_of
from photoplan.surfaces.base import LevelSurface

_Floats = NDArray[np.float64]


def block_frame(project: Project, XYZ: _Floats) -> BlockFrame:
    """Return the Cartesian system of a project's block."""
    if project.orientation.earth_curvature != "strict":
        same = height_step("same", "same", project.crs)
        return BlockFrame(project.crs, None, same, same)
    system = orientation_system(project)
    working = "same" if system == "same" else "ellipsoidal"
    XY = XYZ[np.isfinite(XYZ[:, :2]).all(axis=1), :2]
    low, high = XY.min(axis=0), XY.max(axis=0)
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    inward = height_step(system, working, project.crs, bounds)
    middle = (low + high) / 2
    return BlockFrame(
        project.crs,
        LocalFrame(project.crs, (float(middle[0]), float(middle[1]))),
        inward,
        height_step(working, system, project.crs, bounds),
    )


def orientation_system(project: Project) -> str:
    """Return the height system of orientations and control."""
    stated = project.height_system
    if stated is None:
        raise HeightSystemError(
            "strict earth curvature, satellites and strips are computed with ellipsoidal heights, and the height "
            "system of orientation and control is not stated; give height_system in [orientation]; allowed are "
            f"{OPTIONS}"
        )
    system = check_height_system(stated, "orientation")
    if system != "same" or project.terrain is None:
        return system
    if project.terrain.height_system is not None:
        return declared_pair(project.terrain.height_system, system)[1]
    return ground_of(project).height_systems[1]


def nadir_heights(project: Project, XY: _Floats, otherwise: float) -> _Floats:
    """Return the height of the ground below stations (n, 2), metres: the terrain's, or `otherwise` without one."""
    if project.terrain is None:
        return np.full(len(XY), otherwise)
    heights = np.asarray(ground_of(project).bare.heights(XY), float)
    return np.where(np.isfinite(heights), heights, otherwise)


@dataclass(frozen=True)
class FoundParameter:
    """A parameter of a correction that was determined."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, eq=False)
class FoundCorrection:
    """Correction that was found for an image."""

    entries: Mapping[str, Any]
    """Entries of its table in the project; None takes one out."""
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
    """Function that returns the correctable geometry of an image's entry; cameras are over the ground's height
    system."""
    found: Callable[[Any, Mapping[str, AdjustedCorrections]], FoundCorrection]
    """Function that returns the corrections of a correctable from its adjusted sets."""
    output: Callable[[str], str | None] = field(default=lambda name: None)
    """Name of the file of corrections of an image, in the output folder, by the stem of its products."""


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
    """Read free parameters from options ``CAMERA=c:5,x0,y0,k1``; a single camera need not be named.

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
    """Return a camera of the block."""
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
    """Return the result of a camera that had free parameters."""
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
    """Return entries of the camera in the project file that give the adjusted camera exactly."""
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
    """Return the unit of c, x0, y0 in the project, and the factor that turns y0 into rows."""
    if not camera.states_pixels or camera.pixels is None:
        return dict.fromkeys(INTERIOR, "mm"), 1.0
    fx, fy = camera.pixels.focal
    c = "mm" if _constant_in_pixels_of_mm(camera) else "px"
    return {"c": c, "x0": "px", "y0": "px"}, -fy / fx


def _interior(
    camera: CameraEntry, start: BlockCamera, found: AdjustedCamera
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return c, x0, y0 before and after as the project states them: principal point in pixels or millimetres."""
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
    """Return the lens as the project file states it; None if its entry stays right."""
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
    """Return a lens by its coefficients, without those that are 0."""
    values = dataclasses.asdict(lens).items()
    return {"type": "brown" if isinstance(lens, Brown) else "opencv", **{k: v for k, v in values if v}}


#: Lines at which angles are drawn, at most.
_DRAWN = 3000
_UNITS = np.repeat([180.0 / np.pi, 1.0, 1.0], [3, 3, 1])
_CALLED = [*(f"{what} {axis}" for what in ("boresight", "lever arm") for axis in "xyz"), "time offset"]


def _correctable(project: Project, image: LineImage, ground: Ground, size: tuple[int, int]) -> CorrectableLine:
    plain: Any = line_camera(project, image.model_copy(update={"correction": None}), ground, size)
    start = LineCorrection.none()
    if image.correction is not None and project.resolve(image.correction).exists():
        start = read_line_correction(project.resolve(image.correction))
    return CorrectableLine(
        plain=plain,
        mount=image.mount or image.line,
        flight=image.line,
        priors=_priors(project.adjustment.strips),
        start=start,
    )


def _priors(stated: StripAdjustment) -> TrackPriors:
    smooth = stated.smooth_position, stated.smooth_attitude
    return TrackPriors(
        boresight=float(np.radians(stated.boresight)),
        lever_arm=stated.lever_arm,
        time_offset=stated.time_offset,
        knots=stated.knots,
        position=stated.position,
        attitude=float(np.radians(stated.attitude)),
        smooth_position=np.inf if smooth[0] is None else smooth[0],
        smooth_attitude=np.inf if smooth[1] is None else float(np.radians(smooth[1])),
    )


def _found(image: CorrectableLine, sets: Mapping[str, AdjustedCorrections]) -> FoundCorrection:
    correction = image.correction({key: each.values for key, each in sets.items()})
    covariance, sigma, joint, over_time, free = None, None, None, None, image.free
    Q = sets[image.keys[0]].covariance[0] if len(free) else None
    mount = np.concatenate([correction.boresight, correction.lever_arm, [correction.time_offset]]) * _UNITS
    parameters: tuple[FoundParameter, ...] = ()
    if Q is not None:
        roots = np.sqrt(np.diag(Q)) * _UNITS[free]
        parameters = tuple(
            FoundParameter(_CALLED[k], float(mount[k]), float(s), "°" if k < 3 else "m" if k < 6 else "s")
            for k, s in zip(free, roots)
        )
        if np.isfinite(Q).all():
            covariance = np.zeros((7, 7))
            covariance[np.ix_(free, free)] = Q
    if image.spline is not None and correction.spline is not None:
        found = sets[image.keys[1]]
        joint = found.joint["" if Q is None else image.keys[0]]
        sigma = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
        over_time = correction.spline.times, correction.spline.coefficients
    text = line_correction_text(correction, covariance, sigma, image.pose_errors(correction, Q, joint))
    return FoundCorrection(
        entries={},
        parameters=parameters,
        file=text,
        over_time=over_time,
        seconds=image.plain.track.time,
        angles=_angles(image, correction),
    )


def _angles(image: CorrectableLine, correction: LineCorrection) -> tuple[_Floats, _Floats]:
    """Return times and ω, φ, κ of the camera at lines over the image, against east, north and up in its middle."""
    track = correction.track(image.plain.track)
    first, last = track.oriented
    rows = np.unique(np.linspace(np.ceil(first), np.floor(last), _DRAWN).round())
    rows = rows[track.is_oriented(rows)]
    R = track(rows)[1] @ TURNED
    return track.time(rows), np.stack([angles_from_rotation(each) for each in map_axes(track).T @ R])


LINES = Geometry(group="lines", away=lambda image: image.away, correctable=_correctable, found=_found,
                 output="{}.correction.toml".format)  # fmt: skip


#: A satellite is about so far away, metres.
_AWAY = 6e5
_CALLED_BY_RPC = ("column shift", "row shift", "column by row", "row by row", "column by column", "row by column")


def _correctable_by_rpc(project: Project, image: RpcImage, ground: Ground, size: tuple[int, int]) -> CorrectableRpc:
    camera = rpc_camera(project, image, ground, size)
    stated = project.adjustment.rpc
    plain = replace(camera, correction=None)
    return CorrectableRpc(
        plain=plain, name=image.name, form=stated.correction, sigma=stated.sigma, start=camera.correction
    )


def _found_by_rpc(image: CorrectableRpc, sets: Mapping[str, AdjustedCorrections]) -> FoundCorrection:
    found = sets[image.key]
    values, Q = found.values[0], found.covariance[0]
    count = 2 * FORMS[image.form]
    shift_drift = image.affine(values)
    T = image.to_affine[:, :count]
    whole = T @ Q @ T.T if count > 2 else Q
    entries = {
        "shift": [round(v, 6) + 0.0 for v in shift_drift[:2]],
        "drift": [float(f"{v:.9g}") for v in shift_drift[2:]] if count > 2 else None,
        "covariance": [float(f"{v:.6g}") for v in whole[np.tril_indices(len(whole))]]
        if np.isfinite(whole).all()
        else None,
    }
    sigma = np.sqrt(np.diag(Q))
    return FoundCorrection(
        entries, tuple(FoundParameter(*row, "px") for row in zip(_CALLED_BY_RPC, values.tolist(), sigma.tolist()))
    )


POLYNOMIALS = Geometry("rational polynomials", lambda image: _AWAY, _correctable_by_rpc, _found_by_rpc)


GEOMETRIES: dict[type[ImageEntry], Geometry] = {RpcImage: POLYNOMIALS, LineImage: LINES}
#: Length of a ray by which its direction is carried into the block, metres.
_REACH = 1000.0


def geometry_of(image: ImageEntry) -> Geometry:
    """Return the geometry of an image's entry; InputError if it cannot be corrected."""
    if type(image) not in GEOMETRIES:
        raise InputError(
            f"image {image.name!r}: its orientation stands in {image.geometry_file}, and is not corrected by an "
            "adjustment; leave the image out"
        )
    return GEOMETRIES[type(image)]


def block_projections(
    project: Project, images: Sequence[ImageEntry], frame: BlockFrame, level: float | None
) -> tuple[BlockProjection, ...]:
    """Return the images without poses of a block."""
    return tuple(_projection(project, image, frame, level) for image in images)


def place_of(project: Project, image: ImageEntry) -> _Floats:
    """Return about where an image looks, (3,), metres."""
    geometry = geometry_of(image).correctable(project, image, _ground(project), size_of(project, image))
    return geometry.camera({each.key: each.values for each in geometry.corrections}).vantage.point


def _ground(project: Project) -> Ground:
    """Return level ground in the height system of control, over which cameras are made."""
    system = orientation_system(project)
    return Ground(
        surface=LevelSurface(0.0),
        bounds=None,
        file=None,
        operations=(),
        height_systems=(system, system),
        working_system=system,
    )


def _projection(project: Project, image: ImageEntry, frame: BlockFrame, level: float | None) -> BlockProjection:
    kind = geometry_of(image)
    geometry = kind.correctable(project, image, _ground(project), size_of(project, image))
    camera = geometry.camera({each.key: each.values for each in geometry.corrections})
    height = _level(project, camera) if level is None else level
    vantage = camera.vantage
    height = float(np.clip(height, vantage.floor + 1.0, vantage.point[2] - 1.0))
    away = kind.away(geometry)
    middle = (np.array(camera.size) - 1.0) / 2.0
    J = camera.derivatives(camera.rays(middle[None], height)[0])[0]
    if not np.isfinite(J).all():
        raise InputError(
            f"image {image.name!r}: its geometry does not hold at a height of {height:.0f} m in its middle"
        )

    def sight(xy: _Floats) -> tuple[_Floats, _Floats]:
        at, tangent = camera.rays(xy, height)
        foot, up = frame.points(at), frame.points(at - _REACH * tangent)
        directions = np.asarray((foot - up) / np.linalg.norm(foot - up, axis=1, keepdims=True), np.float64)
        return foot - away * directions, directions

    metres = float(1.0 / np.sqrt(abs(np.linalg.det(J[:, :2]))))
    return BlockProjection(name=image.name, group=kind.group, geometry=geometry, sight=sight, metres=metres, away=away)


def _level(project: Project, camera: Camera) -> float:
    """Return the height of the ground about where a camera looks."""
    if project.terrain is not None:
        height = float(ground_of(project).bare.heights(camera.vantage.point[:2]))
        if np.isfinite(height):
            return height
    floor, top = camera.vantage.floor, float(camera.vantage.point[2])
    # Polynomials hold about the ground that they were made for; whoever flies knows more than that.
    return (floor + top) / 2 if top - floor < 2_000.0 else max(floor, 0.0)


def on_map(frame: BlockFrame) -> OnMap | None:
    """Return where projections see points of a block."""
    if frame.local is None:
        return None

    def placed(points: _Floats) -> tuple[_Floats, _Floats]:
        at = frame.map_points(points)
        return at, np.asarray(np.linalg.inv(frame.jacobian(at)), np.float64)

    return placed


def found_corrections(
    project: Project, block: Block, adjusted: Adjusted
) -> Iterator[tuple[str, Geometry, FoundCorrection]]:
    """Return each image without a pose whose corrections were found: it, or one with all of them, took part."""
    sets = {each.key: each for each in adjusted.corrections}
    for projection in block.projections:
        keys = {each.key for each in projection.geometry.corrections}
        if projection.name in adjusted.projections or (keys and keys <= set(sets)):
            kind = geometry_of(project.any_image(projection.name))
            yield projection.name, kind, kind.found(projection.geometry, sets)
