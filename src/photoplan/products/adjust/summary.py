"""From an adjusted block to its figures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.crs import crs_label
from photoplan.geometry.frames import Triple, triple
from photoplan.geometry.heights import height_label
from photoplan.geometry.rotation import ANGLE_UNITS
from photoplan.orientation.bundle.block import AdjustSettings
from photoplan.orientation.check_points import CheckAccuracy, check_accuracy
from photoplan.plain import shown_metres
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.figures import (
    AdjustFigures,
    CorrectionFigures,
    GroundFigures,
    ImageFigures,
    NamedMeasurement,
    StripFigures,
    residual_fields,
)
from photoplan.products.init.match import some

_Floats = NDArray[np.float64]
#: Kept measurements that are named.
_WORST = 15
#: Redundancy from which a group's variance factor says something, and from which ratio on it is told.
_SOUND, _CONTRADICTED = 30.0, 1.4


def summarise(title: str, result: MapResult, settings: AdjustSettings, seconds: float) -> AdjustFigures:
    """The figures of a block."""
    prepared, adjusted = result.prepared, result.adjusted
    inputs, project = prepared.inputs, prepared.inputs.project
    used = np.isfinite(adjusted.residuals).all(axis=1) & ~adjusted.rejected
    ground = ground_facts(result)
    names = {g.name for g in ground}
    tie = np.array([name not in names for name in adjusted.points], bool)
    sigma = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
    system = project.height_system
    residuals = adjusted.residuals[used]
    return AdjustFigures(
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
        check=_check(ground),
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
    """What to look at: stated accuracies that the observations contradict, images that hang on nothing but GNSS."""
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
    """Control of which as much is taken out as is left: then the wrong half may have been kept."""
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


def _check(ground: Sequence[GroundFigures]) -> CheckAccuracy | None:
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
    """Images without poses that took part."""
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
    """Control and check points, in the order of their files."""
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
    factor = ANGLE_UNITS[project.orientation.angle_unit] / (2 * np.pi)
    return triple(adjusted.boresight * factor), triple(adjusted.boresight_sigma * factor)


def _gross(result: MapResult) -> tuple[NamedMeasurement, ...]:
    """All gross errors, the largest first."""
    adjusted, inputs = result.adjusted, result.prepared.inputs
    out = [_measurement(result, int(k), True) for k in np.flatnonzero(adjusted.rejected)]
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
    return tuple(_measurement(result, int(k), False) for k in order if w[k] > 0)


def _measurement(result: MapResult, k: int, rejected: bool) -> NamedMeasurement:
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
