"""Findings of the bundle adjustment: figures, layers, record and summary."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import ImagesLeftOut
from photoplan.findings import Result, noted, with_sigma
from photoplan.geometry.crs import crs_label
from photoplan.geometry.frames import Triple, triple
from photoplan.geometry.heights import height_label
from photoplan.geometry.pose import angle_in_unit
from photoplan.io.files import fingerprint
from photoplan.io.project.model import image_size
from photoplan.io.store import versions
from photoplan.io.vector_layer import PointLayer
from photoplan.orientation.bundle.model import AdjustSettings, BlockImage, Group
from photoplan.orientation.intersection import CheckAccuracy, check_accuracy
from photoplan.plain import counted, pick, shown_metres
from photoplan.products.adjust.inputs import MapResult
from photoplan.products.adjust.sensors import Calibrated, FoundParameter
from photoplan.products.init import some

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ImageFigures:
    """One image."""

    name: str
    strip: str
    """Empty where no strips are known."""
    measurements: int
    """That take part."""
    rejected: int
    mean: tuple[float, float]
    """Mean residual, column and row, pixels."""
    rms: tuple[float, float]
    worst: float
    """Largest normalised residual; NaN: not computed."""
    center: tuple[float, float, float]
    sigma_center: tuple[float, float, float]
    """Metres."""
    sigma_angles: tuple[float, float, float]
    """In the unit of the project."""


@dataclass(frozen=True, eq=False)
class CorrectionFigures:
    """An image without a pose: its residuals and its correction."""

    name: str
    group: str
    measurements: int
    rejected: int
    mean: tuple[float, float]
    rms: tuple[float, float]
    worst: float
    parameters: tuple[FoundParameter, ...]
    seconds: _Floats
    """Time of each measurement that takes part, (k,); empty where time means nothing."""
    residuals: _Floats
    """Residuals of these, (k, 2), pixels."""
    over_time: tuple[_Floats, _Floats] | None
    """Times and corrections that change with them: metres, radians."""
    angles: tuple[_Floats, _Floats] | None = None
    """Times, and ω, φ, κ of the adjusted trajectory, radians."""


@dataclass(frozen=True, eq=False)
class GroundFigures:
    """One control or check point."""

    name: str
    check: bool
    rays: int
    XYZ: tuple[float, float, float]
    """Coordinates as given; NaN if not known."""
    residual: tuple[float, float, float]
    """Adjusted minus given, metres."""
    stated: tuple[float, float, float]
    """Stated standard deviations, metres."""
    normalised: tuple[float, float, float]
    rejected: tuple[bool, bool, bool]
    covariance: _Floats
    """Covariances of the adjusted X, Y, Z, (3, 3), m²."""


@dataclass(frozen=True)
class NamedMeasurement:
    """One measurement of a point in an image, or a coordinate of control, that is to be named."""

    what: str
    residual: str
    normalised: float
    rejected: bool


@dataclass(frozen=True, eq=False)
class StripFigures:
    """Observed positions of one strip."""

    name: str
    count: int
    rejected: int
    mean: tuple[float, float, float]
    """Mean residual, computed minus observed, metres."""
    rms: tuple[float, float, float]
    shift: tuple[float, float, float]
    """NaN where it was no unknown."""
    rate: tuple[float, float, float]
    sigma_shift: tuple[float, float, float]
    sigma_rate: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class ResidualField:
    """Mean residuals of one camera's images in cells of the image plane."""

    camera: str
    unit: str
    """Unit of the image plane: mm or px."""
    at: _Floats
    """Middles of the cells, (n, 2), x right, y up."""
    mean: _Floats
    """Mean residual (computed minus measured), (n, 2), pixels, x right, y up."""
    count: NDArray[np.int64]
    frame: tuple[float, float, float, float]
    """xmin, ymin, xmax, ymax of the image plane."""
    noise: float
    """Standard deviation of one residual, pixels."""


@dataclass(frozen=True, eq=False)
class AdjustReport(Result):
    """Figures of an adjusted block, and what was written."""

    title: str
    crs: str
    """Name of the CRS and the height system."""
    sigma0: float
    redundancy: int
    unknowns: int
    iterations: int
    seconds: float
    rms_pixels: float
    """Root mean square of image residuals, pixels (one coordinate)."""
    measurements: int
    rejected: int
    points: int
    mean_rays: float
    angle_unit: str
    groups: tuple[Group, ...]
    images: tuple[ImageFigures, ...]
    corrections: tuple[CorrectionFigures, ...]
    ground: tuple[GroundFigures, ...]
    check: CheckAccuracy | None
    cameras: tuple[Calibrated, ...]
    strips: tuple[StripFigures, ...]
    lever_arm: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    """Value and standard deviation, metres; None: no positions."""
    boresight: tuple[tuple[float, float, float], tuple[float, float, float]] | None
    """In the unit of the project; None: no unknown."""
    gross: tuple[NamedMeasurement, ...]
    """Gross errors, largest first."""
    worst: tuple[NamedMeasurement, ...]
    """Largest normalised residuals of what was kept."""
    left_out: tuple[tuple[str, str], ...]
    normalised: _Floats
    """Normalised residuals of image points that take part, flat."""
    critical: float
    robust: bool
    tie_XY: _Floats
    """(m, 2), metres."""
    point_sigma: tuple[float, float, float]
    """Root mean square of the standard deviations of tie points in X, Y, Z, metres."""
    fields: tuple[ResidualField, ...]
    notes: tuple[str, ...]
    inputs: tuple[tuple[str, str], ...]
    settings: tuple[tuple[str, str], ...]
    not_oriented: tuple[tuple[str, str], ...] = ()
    """Images that were asked for and could not be oriented: name and reason."""
    data: dict[str, Any] = field(default_factory=dict)
    """Values of ``report.json``."""
    files: tuple[Path, ...] = ()
    """Empty after a dry run."""
    orientations: int = 0
    """Images whose orientation was written into the project."""

    def json_fields(self) -> dict[str, Any]:
        """Values of ``report.json``, with the files."""
        return {"files": self.files, **self.data}

    def written(self) -> Sequence[Path]:
        """Return the files of the report."""
        return self.files

    def summary(self) -> Sequence[str]:
        """Return the figures of the block, of its groups, cameras and corrections, and of check points."""
        lines = [
            f"sigma0 {self.sigma0:.3f} · image residuals {self.rms_pixels:.3f} px rms · redundancy {self.redundancy} · "
            f"{self.unknowns} unknowns · {self.iterations} iterations · {self.seconds:.1f} s",
            f"{counted(len(self.images) + len(self.corrections), 'image')}, {counted(self.points, 'point')} adjusted · "
            f"{self.rejected} gross errors taken out",
        ]
        width = max((len(g.name) for g in self.groups), default=0)
        for g in self.groups:
            ratio = f"as stated (redundancy {g.redundancy:.1f}: not estimated)"
            if np.isfinite(g.factor):
                ratio = f"found/stated {g.factor:.2f}"
            lines.append(f"  {g.name:<{width}}  {g.count:>7}  rms {g.rms:>9.4g} {g.unit:<3}  {ratio}")
        for camera in self.cameras:
            columns = zip(camera.parameters, camera.units, camera.before, camera.after, camera.sigma)
            for name, unit, before, after, sigma in columns:
                lines.append(
                    f"  camera {camera.name}: {name} {with_sigma(after, sigma, unit)} (change {after - before:+.3g})"
                )
        for image in self.corrections:
            found = ", ".join(f"{p.name} {with_sigma(p.value, p.sigma, p.unit, signed=True)}" for p in image.parameters)
            lines.append(f"  {image.name}: {found or 'nothing of it was unknown'}")
        if self.check is not None:
            c = self.check
            rmse = f"RMSE_H {shown_metres(c.rmse_h, c.rmse_h)}, RMSE_V {shown_metres(c.rmse_v, c.rmse_v)}"
            lines.append(f"check points: {rmse}, {max(c.horizontal, c.vertical)} points (ASPRS 2023)")
            lines += [f"  warning: {text}" for text in c.warnings]
        return lines

    def messages(self) -> Sequence[str]:
        """Return gross errors and notes, reasons for which measurements are left out, and what was written."""
        notes = [
            f"gross error: {m.what}: {m.residual}"
            + (f", {abs(m.normalised):.1f} sigma" if np.isfinite(m.normalised) else "")
            for m in self.gross[:_SHOWN]
        ]
        if len(self.gross) > _SHOWN:
            notes.append(f"and {len(self.gross) - _SHOWN} more gross errors; all are in report.json")
        reasons = Counter(reason for _, reason in self.left_out)
        lines = [f"left out: {count} × {reason}" for reason, count in reasons.items()]
        if self.orientations:
            lines.append(f"orientations of {counted(self.orientations, 'image')} written into the project")
        return [*noted([*notes, *self.notes]), *lines]

    def raise_failures(self) -> None:
        """Name the images that are not oriented, by reason, and what may help."""
        if not self.not_oriented:
            return
        names: dict[str, list[str]] = {}
        for name, reason in self.not_oriented:
            names.setdefault(reason, []).append(name)
        count = len(self.images) + len(self.not_oriented)
        others = "written, and products leave these out:" if self.files else "determined:"
        lines = [f"{len(self.not_oriented)} of {count} images could not be oriented; those of the others are {others}"]
        lines += [f"  {', '.join(images)}: {reason}" for reason, images in names.items()]
        lines.append(
            "more tie points may connect them: `photoplan tie `overwrite`` with other `pairs`, `scale` or `features`; "
            "or control points in them"
        )
        raise ImagesLeftOut("\n".join(lines))


#: Measurements in a cell on average, and cells along the longer side at least and at most.
_PER_CELL, _FEWEST, _MOST = 25, 4, 18
#: Cells with fewer measurements are not shown.
_LEAST = 4


def residual_fields(result: MapResult, used: NDArray[np.bool_]) -> tuple[ResidualField, ...]:
    """Compute the fields of all cameras that have enough measurements.

    Residuals are turned from pixels into the image plane (x right, y up), where the images of a film camera agree, and
    scaled back so that their length stays in pixels.
    """
    points, block = result.prepared.inputs.points, result.prepared.block
    of = {image.name: image for image in block.images}
    at, turned = np.full((len(points), 2), np.nan), np.full((len(points), 2), np.nan)
    camera = np.full(len(points), "", object)
    for k, name in enumerate(points.images):
        rows = np.flatnonzero((points.image == k) & used)
        if len(rows) and name in of:
            at[rows], turned[rows] = _in_plane(of[name], points.xy[rows], result.adjusted.residuals[rows])
            camera[rows] = of[name].camera
    out = []
    for name in block.cameras:
        mine = camera == name
        if mine.sum() >= _LEAST * _FEWEST**2:
            out.append(_field(result, name, at[mine], turned[mine]))
    return tuple(out)


def _in_plane(image: BlockImage, xy: _Floats, residuals: _Floats) -> tuple[_Floats, _Floats]:
    """Return places in the image plane, and residuals along its axes in pixels."""
    transformation = image.plane_to_pixel
    at = transformation.inverse(xy)
    ends = transformation.inverse(xy + residuals)
    middle = np.median(at, axis=0)
    pixel = float(np.sqrt(abs(np.linalg.det(transformation.derivative(middle)))))
    return at, (ends - at) * pixel


def _field(result: MapResult, name: str, at: _Floats, residuals: _Floats) -> ResidualField:
    frame = _frame(result, name)
    width, height = frame[2] - frame[0], frame[3] - frame[1]
    cells = max(1.0, len(at) / _PER_CELL)
    side = max(np.sqrt(width * height / cells), max(width, height) / _MOST)
    side = min(side, max(width, height) / _FEWEST)
    columns, rows = max(1, round(width / side)), max(1, round(height / side))
    column = np.clip(((at[:, 0] - frame[0]) / width * columns).astype(int), 0, columns - 1)
    row = np.clip(((at[:, 1] - frame[1]) / height * rows).astype(int), 0, rows - 1)
    cell = row * columns + column
    count = np.bincount(cell, minlength=rows * columns)
    mean = np.stack([np.bincount(cell, residuals[:, k], rows * columns) for k in (0, 1)], axis=1)
    shown = np.flatnonzero(count >= _LEAST)
    middles = np.stack(
        [frame[0] + (shown % columns + 0.5) * width / columns, frame[1] + (shown // columns + 0.5) * height / rows],
        axis=1,
    )
    camera = result.prepared.inputs.project.cameras[name]
    unit = "mm" if camera.type == "film" or (camera.camera_constant_mm and not camera.principal_point_px) else "px"
    return ResidualField(
        camera=name,
        unit=unit,
        at=middles,
        mean=mean[shown] / count[shown, None],
        count=count[shown],
        frame=frame,
        noise=float(np.sqrt((residuals**2).mean())),
    )


def _frame(result: MapResult, name: str) -> tuple[float, float, float, float]:
    """Return the corners of the camera's image format in the image plane, by its first image."""
    project = result.prepared.inputs.project
    image = next(i for i in result.prepared.block.images if i.camera == name)
    width, height = image_size(project.cameras[name], project.image(image.name))
    corners = np.array([(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)])
    plane = image.plane_to_pixel.inverse(corners)
    low, high = plane.min(axis=0), plane.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def point_layers(result: MapResult, facts: AdjustReport) -> list[PointLayer]:
    """Return layers of the GeoPackage: adjusted points, projection centres, residuals of control and check points."""
    adjusted = result.adjusted
    role = {g.name: "check" if g.check else "control" for g in facts.ground}
    sigma = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    points = PointLayer(
        "points",
        result.XYZ,
        {
            "name": np.array(adjusted.points, object),
            "role": np.array([role.get(name, "tie") for name in adjusted.points], object),
            "images": np.asarray(adjusted.rays, np.int32),
            **_xyz("sigma", sigma),
        },
    )
    images = facts.images
    centers = PointLayer(
        "projection_centres",
        np.array([image.center for image in images]).reshape(-1, 3),
        {
            "name": np.array([image.name for image in images], object),
            "strip": np.array([image.strip for image in images], object),
            "points": np.array([image.measurements for image in images], np.int32),
            "rms_px": np.array([np.hypot(*image.rms) for image in images]),
            **_xyz("sigma", np.array([image.sigma_center for image in images]).reshape(-1, 3)),
        },
    )
    shown = [g for g in facts.ground if np.isfinite(g.XYZ).all() and np.isfinite(g.residual).all()]
    control = PointLayer(
        "ground_residuals",
        np.array([g.XYZ for g in shown]).reshape(-1, 3),
        {
            "name": np.array([g.name for g in shown], object),
            "role": np.array([role[g.name] for g in shown], object),
            **_xyz("residual", np.array([g.residual for g in shown]).reshape(-1, 3)),
            **_xyz("normalised", np.array([g.normalised for g in shown]).reshape(-1, 3)),
            "rejected": np.array([any(g.rejected) for g in shown], bool),
        },
    )
    return [points, centers, control]


def _xyz(name: str, values: _Floats) -> dict[str, _Floats]:
    return {f"{name}_{axis}": np.ascontiguousarray(values[:, k], float) for k, axis in enumerate("xyz")}


def block_json(figures: AdjustReport, result: MapResult) -> dict[str, Any]:
    """Return all figures by their keys."""
    inputs = result.prepared.inputs
    own = ("sigma0", "redundancy", "unknowns", "iterations", "seconds", "measurements", "points", "notes")
    group = ("name", "count", "redundancy", "rms", "unit")
    image = ("name", "center", "sigma_center", "sigma_angles", "measurements", "rejected", "mean", "rms")
    return {
        **pick(figures, *own, image_residual_rms_px="rms_pixels", mean_images_of_a_point="mean_rays"),
        "groups": [pick(g, *group, found_to_stated="factor") for g in figures.groups],
        "image_correlations": [
            {
                "camera": c.group.removeprefix("camera "),
                **pick(c, "effect", "rho", reach_px="reach", distance_px="distance"),
            }
            for c in result.adjusted.correlations
        ],
        "cameras": {camera.name: _camera(camera) for camera in figures.cameras},
        "control": [_ground(g) for g in figures.ground if not g.check],
        "check_points": [_ground(g) for g in figures.ground if g.check],
        "check_accuracy": figures.check and _check(figures.check),
        "gross_errors": [_measurement(m) for m in figures.gross],
        "largest_normalised": [_measurement(m) for m in figures.worst],
        "positions": _positions(figures),
        "images": [
            {
                **pick(of, *image, largest_normalised="worst"),
                "angles": result.angles[k],
                "covariance_rotation": result.adjusted.pose_covariance[k, 3:, 3:],
            }
            for k, of in enumerate(figures.images)
        ],
        "corrections": [
            {
                **pick(c, "name", "group", "measurements", "rejected", "mean", "rms", largest_normalised="worst"),
                "parameters": {p.name: {"value": p.value, "sigma": p.sigma, "unit": p.unit} for p in c.parameters},
                "over_time": c.over_time and {"seconds": c.over_time[0], "corrections": c.over_time[1]},
            }
            for c in figures.corrections
        ],
        "determined_by_priors_alone": result.adjusted.by_prior,
        "left_out": [{"name": name, "reason": reason} for name, reason in figures.left_out],
        "tie_point_sigma": figures.point_sigma,
        "crs": inputs.project.crs,
        "heights": {
            "system": inputs.project.orientation.height_system,
            "computed_in": result.prepared.frame.inward.target,
            "operation": result.prepared.frame.inward.operation,
        },
        "inputs": {str(path): fingerprint(path).digest for path in inputs.files},
        "versions": versions(),
        "settings": dict(figures.settings),
        "not_oriented": [{"name": name, "reason": reason} for name, reason in figures.not_oriented],
    }


def _camera(found: Calibrated) -> dict[str, Any]:
    columns = zip(found.parameters, found.units, found.before, found.after, found.sigma)
    parameters = {p: {"unit": u, "before": b, "after": a, "sigma": s} for p, u, b, a, s in columns}
    return {"parameters": parameters, "correlation": found.correlation}


def _ground(g: GroundFigures) -> dict[str, Any]:
    known = pick(g, "name", "residual", "normalised", "rejected", images="rays", given="XYZ", sigma_given="stated")
    return {**known, "sigma_adjusted": np.sqrt(np.diag(g.covariance))}


def _check(check: CheckAccuracy) -> dict[str, Any]:
    return {
        "standard": "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023)",
        **pick(check, "rmse", "warnings", number_horizontal="horizontal", number_vertical="vertical"),
        **pick(check, mean_error="mean", RMSE_H1="fit_h", RMSE_V1="fit_v", RMSE_H2="survey_h", RMSE_V2="survey_v"),
        **pick(check, RMSE_H="rmse_h", RMSE_V="rmse_v", RMSE_3D="rmse_3d"),
    }


def _measurement(m: NamedMeasurement) -> dict[str, Any]:
    return pick(m, "residual", "normalised", observation="what")


def _positions(figures: AdjustReport) -> dict[str, Any] | None:
    if not figures.strips:
        return None
    own = ("name", "rejected", "mean", "rms", "shift", "rate", "sigma_shift", "sigma_rate")
    arm, turn = figures.lever_arm, figures.boresight
    return {
        "strips": [pick(strip, *own, images="count") for strip in figures.strips],
        "lever_arm": arm and {"value": arm[0], "sigma": arm[1]},
        "boresight": turn and {"value": turn[0], "sigma": turn[1]},
    }


#: Gross errors that are printed; the rest is in the report.
_SHOWN = 20
#: Kept measurements that are named.
_WORST = 15
#: Redundancy from which a group's variance factor says something, and from which ratio on it is told.
_SOUND, _CONTRADICTED = 30.0, 1.4


def summarise(title: str, result: MapResult, settings: AdjustSettings, seconds: float) -> AdjustReport:
    """Return the figures of a block."""
    prepared, adjusted = result.prepared, result.adjusted
    inputs, project = prepared.inputs, prepared.inputs.project
    used = np.isfinite(adjusted.residuals).all(axis=1) & ~adjusted.rejected
    ground = ground_facts(result)
    names = {g.name for g in ground}
    tie = np.array([name not in names for name in adjusted.points], bool)
    sigma = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    system = project.height_system
    residuals = adjusted.residuals[used]
    return AdjustReport(
        title=title,
        crs=f"{crs_label(project.crs)} · heights {height_label(system)} · earth curvature "
        f"{project.orientation.earth_curvature}",
        sigma0=adjusted.sigma0,
        redundancy=adjusted.redundancy,
        unknowns=adjusted.unknowns,
        iterations=adjusted.iterations,
        seconds=seconds,
        rms_pixels=float(np.sqrt((residuals**2).mean())) if len(residuals) else float("nan"),
        measurements=int(used.sum()),
        rejected=int(adjusted.rejected.sum() + adjusted.ground_rejected.sum() + adjusted.position_rejected.sum()),
        points=len(adjusted.points),
        mean_rays=float(adjusted.rays.mean()) if len(adjusted.rays) else float("nan"),
        angle_unit=project.orientation.angle_unit,
        groups=tuple(adjusted.groups),
        images=_images(result, used),
        corrections=_corrections(result, used),
        ground=ground,
        check=_check_summary(ground),
        cameras=tuple(result.cameras),
        strips=_strips(result),
        lever_arm=None if inputs.positions is None else (triple(adjusted.lever_arm), triple(adjusted.lever_arm_sigma)),
        boresight=_boresight(result),
        gross=_gross(result),
        worst=_worst(result, used),
        left_out=(*inputs.lost, *adjusted.left_out),
        normalised=adjusted.normalised[used].ravel(),
        critical=settings.critical,
        robust=settings.robust,
        tie_XY=result.XYZ[tie, :2],
        point_sigma=triple(np.sqrt(np.mean(sigma[tie] ** 2, axis=0)) if tie.any() else np.full(3, np.nan)),
        fields=residual_fields(result, used),
        notes=(*inputs.notes, *_advice(result, used)),
        inputs=tuple((path.name, str(path)) for path in inputs.files),
        settings=_settings(result, settings, seconds),
    )


def _advice(result: MapResult, used: NDArray[np.bool_]) -> list[str]:
    """Return advice: stated accuracies that observations contradict, images that only GNSS holds."""
    points, adjusted = result.prepared.inputs.points, result.adjusted
    out = []
    for group in adjusted.groups:
        if (
            group.redundancy < _SOUND
            or not np.isfinite(group.factor)
            or 1 / _CONTRADICTED < group.factor < _CONTRADICTED
        ):
            continue
        if adjusted.common is not None and group.name.startswith("observed positions") and group.factor < 1:
            better, rest = 1 / max(group.factor, 1e-9), adjusted.common[2 * group.name.endswith("height")]
            out.append(
                f"{group.name}: they agree among each other {better:.1f} times better than stated; the rest, "
                f"{rest:.2g} m, counts as an error that all of them share"
            )
            continue
        how = "small" if group.factor > 1 else "large"
        ratio = max(group.factor, 1 / group.factor) if group.factor > 0 else np.inf
        advice = ""
        if group.unit == "px" and group.factor > 0:
            advice = f"; {float(np.median(points.sigma)) * group.factor:.2g} px would fit"
        out.append(f"{group.name}: the stated standard deviation is {ratio:.1f} times too {how}{advice}")
    out += _control_out(result)
    out += [
        f"image errors of {c.group} are alike over up to {c.reach:.0f} px: for its orientations "
        f"{c.effect:.1f} measurements count as one"
        for c in adjusted.correlations
    ]
    if adjusted.by_prior:
        out.append(
            "no observation determines " + ", ".join(adjusted.by_prior) + ": only what is known of corrections "
            "beforehand does; give control, if the block is to lie better than that"
        )
    seen = {points.images[k] for k in np.unique(points.image[used])}
    alone = [name for name in adjusted.images if name not in seen]
    if alone:
        out.append(f"{len(alone)} images have no measured point; their orientation is the observed one: {some(alone)}")
    return out


def _control_out(result: MapResult) -> list[str]:
    """Return advice on control that contradicts itself: if half is taken out, the wrong half may be kept."""
    adjusted, ground = result.adjusted, result.prepared.inputs.ground
    known = np.isfinite(adjusted.ground_residuals) & ~ground.check[:, None]
    out = []
    for name, axes in (("horizontal control coordinates", slice(0, 2)), ("control heights", slice(2, 3))):
        total, lost = int(known[:, axes].sum()), int((adjusted.ground_rejected & known)[:, axes].sum())
        if lost and 2 * lost >= total:
            out.append(
                f"{lost} of {total} {name} are taken out as gross errors: nothing tells whether they are wrong or "
                "those that are left; measure more control"
            )
    names = [ground.names[k] for k in np.flatnonzero((adjusted.ground_rejected & known).any(axis=1))]
    others = some(list(adjusted.other_control))
    if others and not names:
        out.append(
            f"control points contradict each other, and nothing tells which is wrong: {others} agree, and so do as "
            "many others; all are kept: look at their coordinates, or measure one more"
        )
    elif names and others:
        out.append(f"control that does not agree with the rest is taken out: {some(names)}; next best agree {others}")
    place = dict(zip(adjusted.points, result.XYZ))
    for a, b in combinations([name for name in names if name in place], 2):
        given = [ground.XYZ[ground.names.index(name)] for name in (a, b)]
        apart = 0.2 * float(np.linalg.norm(given[0] - given[1]))
        if max(np.linalg.norm(place[a] - given[1]), np.linalg.norm(place[b] - given[0])) < apart:
            out.append(f"control points {a!r} and {b!r} look exchanged: each lies where the other is stated")
    return out


def _check_summary(ground: Sequence[GroundFigures]) -> CheckAccuracy | None:
    check = [g for g in ground if g.check and np.isfinite(g.residual).any()]
    if not check:
        return None
    return check_accuracy(np.array([g.residual for g in check]), np.array([g.stated for g in check]))


def _images(result: MapResult, used: NDArray[np.bool_]) -> tuple[ImageFigures, ...]:
    adjusted, points = result.adjusted, result.prepared.inputs.points
    positions = result.prepared.inputs.positions
    strip = {} if positions is None else dict(zip(positions.images, positions.strip))
    number = {name: k for k, name in enumerate(points.images)}
    order = np.argsort(points.image, kind="stable")
    starts = np.searchsorted(points.image[order], np.arange(len(points.images) + 1))
    out = []
    for k, name in enumerate(adjusted.images):
        at = number.get(name)
        rows = np.empty(0, np.int64) if at is None else order[starts[at] : starts[at + 1]]
        mine = rows[used[rows]]
        r, w = adjusted.residuals[mine], np.abs(adjusted.normalised[mine])
        none = not len(mine)
        out.append(
            ImageFigures(
                name=name,
                strip=strip.get(name, ""),
                measurements=len(mine),
                rejected=int(adjusted.rejected[rows].sum()),
                mean=(float("nan"),) * 2 if none else (float(r[:, 0].mean()), float(r[:, 1].mean())),
                rms=(float("nan"),) * 2 if none else (_rms(r[:, 0]), _rms(r[:, 1])),
                worst=float(np.nanmax(w)) if np.isfinite(w).any() else float("nan"),
                center=triple(result.poses[k].center),
                sigma_center=triple(result.sigma_center[k]),
                sigma_angles=triple(result.sigma_angles[k]),
            )
        )
    return tuple(out)


def _corrections(result: MapResult, used: NDArray[np.bool_]) -> tuple[CorrectionFigures, ...]:
    """Return figures of the images without poses that took part."""
    adjusted, points = result.adjusted, result.prepared.inputs.points
    out = []
    for name, kind, found in result.corrections:
        at = points.images.index(name) if name in points.images else -1
        rows = np.flatnonzero(points.image == at)
        mine = rows[used[rows]]
        r, w = adjusted.residuals[mine], np.abs(adjusted.normalised[mine])
        timed = found.seconds is not None
        out.append(
            CorrectionFigures(
                name=name,
                group=kind.group,
                measurements=len(mine),
                rejected=int(adjusted.rejected[rows].sum()),
                mean=(float(r[:, 0].mean()), float(r[:, 1].mean())) if len(mine) else (float("nan"),) * 2,
                rms=(_rms(r[:, 0]), _rms(r[:, 1])),
                worst=float(np.nanmax(w)) if np.isfinite(w).any() else float("nan"),
                parameters=found.parameters,
                seconds=np.empty(0) if found.seconds is None else found.seconds(points.xy[mine, 1]),
                residuals=r if timed else np.empty((0, 2)),
                over_time=found.over_time,
                angles=found.angles,
            )
        )
    return tuple(out)


def _rms(values: _Floats) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def ground_facts(result: MapResult) -> tuple[GroundFigures, ...]:
    """Return figures of control and check points, in the order of their files."""
    ground, adjusted = result.prepared.inputs.ground, result.adjusted
    row = {name: k for k, name in enumerate(adjusted.points)}
    unknown = ~np.isfinite(ground.XYZ)
    normalised = np.where(unknown, np.nan, adjusted.ground_normalised)
    out = []
    for k, name in enumerate(ground.names):
        at = row.get(name)
        a, b, c = (bool(v) for v in adjusted.ground_rejected[k])
        out.append(
            GroundFigures(
                name=name,
                check=bool(ground.check[k]),
                rays=0 if at is None else int(adjusted.rays[at]),
                XYZ=triple(ground.XYZ[k]),
                residual=triple(result.ground_residuals[k]),
                stated=triple(ground.sigma[k]),
                normalised=triple(normalised[k]),
                rejected=(a, b, c),
                covariance=np.full((3, 3), np.nan) if at is None else result.covariance[at],
            )
        )
    return tuple(out)


def _strips(result: MapResult) -> tuple[StripFigures, ...]:
    positions = result.prepared.inputs.positions
    if positions is None:
        return ()
    adjusted = result.adjusted
    frame = result.prepared.frame
    drift = {strip.name: strip for strip in adjusted.strips}
    out = []
    names = np.array(positions.strip, object)
    for name in dict.fromkeys(positions.strip):
        mine = names == name
        good = mine & ~adjusted.position_rejected & np.isfinite(result.position_residuals).all(axis=1)
        r = result.position_residuals[good]
        found = drift.get(name)
        middle = positions.XYZ[mine].mean(axis=0)
        nothing = np.full(3, np.nan)
        known = found is not None and bool(np.isfinite(found.sigma[:3]).any())
        out.append(
            StripFigures(
                name=str(name),
                count=int(mine.sum()),
                rejected=int(adjusted.position_rejected[mine].sum()),
                mean=triple(r.mean(axis=0) if len(r) else nothing),
                rms=triple(np.sqrt((r**2).mean(axis=0)) if len(r) else nothing),
                shift=triple(frame.map_vectors(found.shift, middle) if known and found is not None else nothing),
                rate=triple(frame.map_vectors(found.rate, middle) if known and found is not None else nothing),
                sigma_shift=triple(found.sigma[:3] if found is not None else nothing),
                sigma_rate=triple(found.sigma[3:] if found is not None else nothing),
            )
        )
    return tuple(out)


def _boresight(result: MapResult) -> tuple[Triple, Triple] | None:
    project, adjusted = result.prepared.inputs.project, result.adjusted
    if not project.adjustment.boresight or result.prepared.inputs.attitudes is None:
        return None
    unit = project.orientation.angle_unit
    return triple(angle_in_unit(adjusted.boresight, unit)), triple(angle_in_unit(adjusted.boresight_sigma, unit))


def _gross(result: MapResult) -> tuple[NamedMeasurement, ...]:
    """Return all gross errors, the largest first."""
    adjusted, inputs = result.adjusted, result.prepared.inputs
    out = [_measurement_summary(result, int(k), True) for k in np.flatnonzero(adjusted.rejected)]
    for k, axis in zip(*np.nonzero(adjusted.ground_rejected)):
        d = result.ground_residuals[k, axis]
        what = f"control point {inputs.ground.names[k]!r}, {'XYZ'[axis]}"
        text = ("+" if d > 0 else "") + shown_metres(d, d) if np.isfinite(d) else "too few of its image points are left"
        out.append(NamedMeasurement(what, text, float(adjusted.ground_normalised[k, axis]), True))
    if inputs.positions is not None:
        for k in np.flatnonzero(adjusted.position_rejected):
            d = result.position_residuals[k]
            size = np.abs(d) / inputs.positions.sigma[k]
            what = f"observed position of image {inputs.positions.images[k]!r}"
            out.append(NamedMeasurement(what, " ".join(f"{v:+.3f}" for v in d) + " m", float(size.max()), True))
    return tuple(sorted(out, key=lambda m: -abs(m.normalised) if np.isfinite(m.normalised) else 0.0))


def _worst(result: MapResult, used: NDArray[np.bool_]) -> tuple[NamedMeasurement, ...]:
    w = np.abs(result.adjusted.normalised).max(axis=1)
    w[~used | ~np.isfinite(w)] = -1.0
    order = np.argsort(-w)[:_WORST]
    return tuple(_measurement_summary(result, int(k), False) for k in order if w[k] > 0)


def _measurement_summary(result: MapResult, k: int, rejected: bool) -> NamedMeasurement:
    adjusted = result.adjusted
    dx, dy = adjusted.residuals[k]
    normalised = adjusted.normalised[k]
    axis = int(np.argmax(np.abs(np.nan_to_num(normalised))))
    text = f"{dx:+.2f} {dy:+.2f} px" if np.isfinite([dx, dy]).all() else "without it, one image sees the point"
    return NamedMeasurement(result.prepared.inputs.points.label(k), text, float(normalised[axis]), rejected)


def _settings(result: MapResult, settings: AdjustSettings, seconds: float) -> tuple[tuple[str, str], ...]:
    adjustment, observations = (getattr(result.prepared.inputs.project, n) for n in ("adjustment", "observations"))
    free = "; ".join(f"{c.name}: {', '.join(c.parameters)}" for c in result.cameras) or "none"
    stated = {
        "sigma_image": f"{observations.sigma_image:g} px, where the measurements state none",
        "sigma_control": observations.sigma_control,
        "sigma_position": observations.sigma_position,
        "sigma_attitude": observations.sigma_attitude,
    }
    return (
        ("gross errors", f"beyond {settings.critical:g} standard deviations" if settings.robust else "not sought"),
        ("calibrated parameters", free),
        *((key, str(value)) for key, value in stated.items() if value is not None),
        ("lever arm", f"{adjustment.lever_arm} m ± {adjustment.lever_arm_sigma:g} m"),
        ("drift", adjustment.drift),
        ("variance components", "estimated and used" if settings.variance_components else "not used"),
        ("correlation of image errors", "regarded" if settings.correlation else "not regarded"),
        ("time", f"{seconds:.1f} s"),
    )
