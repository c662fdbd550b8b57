"""The run of a bundle adjustment."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.errors import DatumDefect, GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Image, Project, interior_of, lens_of
from photoplan.io.store import recording, stated_json, write_atomically
from photoplan.io.vector_layer import write_point_layers, write_residuals
from photoplan.orientation.bundle.adjust import Cause, adjust_block, misfit_hypotheses
from photoplan.orientation.bundle.model import Adjusted, AdjustSettings
from photoplan.orientation.conventions import Evidence, fitting_convention, misfit, rejection_reason
from photoplan.orientation.resection import ResectSettings
from photoplan.plain import counted, pick
from photoplan.products.adjust.findings import AdjustReport, block_json, point_layers, summarise
from photoplan.products.adjust.inputs import (
    AdjustInputs,
    MapResult,
    Prepared,
    adjust_prepared,
    decimals_of,
    known_poses,
    map_result,
    prepare,
    read_inputs,
    started,
    stated_accuracy,
)
from photoplan.products.adjust.sensors import Free, camera_entries, geometry_of, nadir_heights, parse_calibrate
from photoplan.products.film import control_rows, measured_control, resected
from photoplan.project.scene import input_files
from photoplan.requests.orient import AdjustRequest

#: Change of a camera constant, and part of the squared residuals that it explains, from which the block is refused.
_FAR, _ALL = 0.1, 0.9
#: Correction over what it is known to beforehand, from which on it is not believed.
_BEYOND = 8.0
#: Found over stated accuracy of positions that is worth a word.
_WORSE = 2.0


def refuse_impossible(result: MapResult) -> None:
    """Refuse a block of which images lie under the ground, or most measurements do not fit."""
    adjusted, inputs = result.adjusted, result.prepared.inputs
    _refuse_corrections(result)
    points, row = inputs.points, {name: k for k, name in enumerate(adjusted.points)}
    at = np.array([row.get(name, -1) for name in points.points], np.int64)[points.point]
    centers = np.array([pose.center for pose in result.poses]).reshape(-1, 3)
    terrain = nadir_heights(inputs.project, centers[:, :2], np.nan)
    residuals = adjusted.residuals[np.isfinite(adjusted.residuals[:, 0]) & ~adjusted.rejected]
    factors = [group.factor for group in adjusted.groups if group.unit == "px" and np.isfinite(group.factor)]
    wrong = []
    for k, name in enumerate(adjusted.images):
        mine = at[(points.image == points.images.index(name)) & (at >= 0)] if name in points.images else at[:0]
        fault = rejection_reason(
            Evidence(
                center=centers[k],
                R_ground_camera=result.poses[k].R_ground_camera,
                ground=result.XYZ[mine],
                rejected=int(adjusted.rejected.sum()),
                points=len(adjusted.rejected),
                sigma0=max(factors, default=np.nan),
                rms=float(np.sqrt((residuals**2).mean())) if len(residuals) else np.nan,
                terrain=float(terrain[k]),
            )
        )
        if fault is not None:
            wrong.append((name, fault))
    if not wrong:
        return
    name, fault = wrong[0]
    more = f" (so in {len(wrong)} images)" if len(wrong) > 1 else ""
    raise GeometryError(f"image {name!r}: {fault}{more}; the orientations are not written: {_hint(result)}")


def _refuse_corrections(result: MapResult) -> None:
    """Refuse corrections that are far from what is known of them, or that control does not fit."""
    adjusted, ground = result.adjusted, result.prepared.inputs.ground
    lost = None
    for each in adjusted.corrections:
        off = np.abs(each.values) / each.known
        if off.max(initial=0.0) > _BEYOND:
            lost = f"the {each.key} is {off.max():.0f} times what is known of it beforehand"
    control = np.isfinite(ground.XYZ) & ~ground.check[:, None]
    out = int((control & (adjusted.ground_rejected | ~np.isfinite(adjusted.ground_residuals))).sum())
    if not adjusted.images and 2 * out > control.sum():
        lost = f"{out} of {control.sum()} coordinates of control do not fit the images"
    rejected = adjusted.rejected
    if not adjusted.images and lost is None:
        lost = misfit(int(rejected.sum()), len(rejected), np.nan, np.nan)
    if lost is not None:
        raise GeometryError(
            f"{lost}; the corrections are not written: are names, axes, CRS and height system of the points as they "
            "are stated, and do the images come with the right polynomials or trajectories? What is known beforehand "
            "stands in [adjustment]"
        )


def refuse_cause(causes: Sequence[Cause]) -> None:
    """Refuse a block that only another camera constant makes one."""
    if causes and abs(causes[0].change) > _FAR and causes[0].explains > _ALL:
        cause = causes[0]
        raise GeometryError(
            f"the observations contradict {cause.name}: {1 + cause.change:.3f} times what is stated takes away "
            f"{cause.explains:.1%} of the squared residuals; the orientations are not written: {cause.remedy}"
        )


def cause_notes(causes: Sequence[Cause], result: MapResult) -> tuple[str, ...]:
    """Return likely causes of observations that do not fit, the likeliest first."""
    if causes:
        words = ("likeliest cause of what does not fit", "next")
        return tuple(
            f"{word}: {cause.name}, which explains {cause.explains:.0%} of the {cause.measure}; {cause.remedy}"
            for word, cause in zip(words, causes)
        )
    positions = [
        g.factor for g in result.adjusted.groups if g.name.startswith("observed positions") and np.isfinite(g.factor)
    ]
    if max(positions, default=1.0) > _WORSE and not result.adjusted.correlations:
        return (
            "observed positions fit worse than stated: they are, or errors of neighbouring image points are alike "
            "(too few points to tell); no shift, drift or camera explains it",
        )
    return ()


def _hint(result: MapResult) -> str:
    """Return what would fit, tried at the image with most control."""
    inputs = result.prepared.inputs
    rows = {image.name: control_rows(inputs, image.name) for image in inputs.images}
    image = max(inputs.images, key=lambda image: len(rows[image.name]))
    if len(rows[image.name]) < 4:
        return "are X and Y, the direction of y in the images, units and height systems as they are stated?"
    given, described = measured_control(inputs, rows[image.name]), inputs.project.cameras[image.camera]
    interior, lens = interior_of(described, image), lens_of(described)
    return fitting_convention(
        given,
        interior.size[1],
        lambda other: resected(inputs.project, image, other, interior, lens, ResectSettings()),
        math.nan,
    )


#: Part of the measurements that take no part, from which on the start is doubted.
_POOR = 0.1
#: Files of the output folder.
OUTPUTS = ("report.json", "points.gpkg", "image_points.csv")


def adjust_project(request: AdjustRequest, events: Events = SILENT) -> AdjustReport:
    """Adjust the block of a project and write the result into it.

    Raises
    ------
    UsageError
        An output exists or is an input, or an option makes no sense.
    InputError
        The project or its measurements cannot be used.
    GeometryError
        The observations do not determine what is asked (the parameters are named), or the result cannot be right.
    ResourceError
        The disk is full.
    """
    project = load_project(request.project)
    if request.datum is not None:
        own = project.adjustment.model_copy(update={"datum": request.datum})
        project = project.model_copy(update={"adjustment": own})
    free = _free(project, request.calibrate)
    names = project.select(request.images or None)
    if not request.dry_run:
        _check_outputs(request, project)
    inputs = read_inputs(project, names)
    if not request.dry_run:
        _refuse_inputs(request, inputs.files)
    begun = time.perf_counter()
    method = ("robust", "critical", "variance_components", "correlation", "iterations")
    settings = AdjustSettings(**pick(request, *method))
    try:
        prepared, adjusted = _adjusted(inputs, free, settings, events)
    except DatumDefect as error:
        if project.adjustment.datum == "orientations" or not known_poses(inputs):
            raise
        raise DatumDefect(
            f"{error}; or set `datum` to orientations: the block then lies where the orientations in the project "
            "place it, to the accuracy of these"
        ) from None
    result = map_result(prepared, adjusted)
    refuse_impossible(result)
    title = f"Bundle adjustment of {request.project.resolve().parent.name}"
    causes = misfit_hypotheses(prepared.block, adjusted)
    refuse_cause(causes)
    report = summarise(title, result, settings, time.perf_counter() - begun)
    report = replace(report, notes=(*cause_notes(causes, result), *report.notes))
    reasons = dict((*result.prepared.inputs.lost, *adjusted.left_out))
    images = [image.name for image in inputs.images if image.name not in adjusted.images]
    lost = tuple((name, reasons.get(name, "no reason is known")) for name in images)
    report = replace(report, not_oriented=lost)
    report = replace(report, data=block_json(report, result))
    return report if request.dry_run else _write(request, project, result, report)


def _adjusted(inputs: AdjustInputs, free: Free, settings: AdjustSettings, events: Events) -> tuple[Prepared, Adjusted]:
    """Adjust the block from any start that works, with the images that only its calibration orients."""

    def iterated(number: int, rms: float) -> None:
        events.begin(f"iteration {number} · weighted residuals {rms:.4g}")

    def tried(known: bool = True, earlier: MapResult | None = None) -> tuple[Prepared, Adjusted]:
        prepared = prepare(*started(inputs, known=known, earlier=earlier), free)
        events.talk(_used(prepared))
        return adjust_prepared(prepared, settings, partial(adjust_block, progress=iterated))

    prepared, adjusted = _begun(inputs, tried, settings, events)
    lost = len(inputs.images) - len(adjusted.images)
    if not (lost and any(camera.free for camera in adjusted.cameras)):
        return prepared, adjusted
    # A lens that was not known yet may have kept them out.
    earlier = map_result(prepared, adjusted)
    if len(started(inputs, earlier=earlier)[1]) == len(earlier.poses):
        return prepared, adjusted
    events.talk(f"note: starting again with the calibrated cameras, as {lost} images could not be oriented without")
    return tried(earlier=earlier)


def _begun(
    inputs: AdjustInputs, tried: Callable[[bool], tuple[Prepared, Adjusted]], settings: AdjustSettings, events: Events
) -> tuple[Prepared, Adjusted]:
    """Adjust the block from its approximate orientations; if that fails, from control and tie points alone."""
    first: tuple[Prepared, Adjusted] | None = None
    why = "many measurements do not fit them"
    try:
        first = tried(True)
        few = _used_of(first[1]) < (1.0 - _POOR) * len(inputs.points) or len(first[1].images) < len(inputs.images)
        if not (settings.robust and few and known_poses(inputs)):
            return first
    except GeometryError as error:
        if isinstance(error, DatumDefect) or not known_poses(inputs):
            raise
        failure, why = error, "from them the adjustment does not converge"
    events.talk(f"note: {why}: starting again without approximate orientations")
    try:
        prepared, adjusted = tried(False)
    except (GeometryError, InputError):
        if first is not None:
            return first
        raise failure from None
    if first is not None and _used_of(first[1]) >= _used_of(adjusted):
        return first
    note = f"the stated orientations were no start ({why}); the block began with control and tie points alone"
    return replace(prepared, inputs=replace(prepared.inputs, notes=(*prepared.inputs.notes, note))), adjusted


def _used_of(adjusted: Adjusted) -> int:
    """Count the measurements that take part."""
    return int((np.isfinite(adjusted.residuals[:, 0]) & ~adjusted.rejected).sum())


def _free(project: Project, options: Sequence[str]) -> Free:
    if options:
        return parse_calibrate(options, list(project.cameras))
    known = project.adjustment.prior_sigma
    stated = project.adjustment.calibrate.items()
    return {name: {p: known.get(name, {}).get(p) for p in parameters} for name, parameters in stated if parameters}


def _check_outputs(request: AdjustRequest, project: Project) -> None:
    """Refuse outputs that exist or cannot be written before any work."""
    if request.folder.exists() and not request.folder.is_dir():
        raise UsageError(f"{request.folder}: is no folder; reports go into a folder")
    there = next(
        folder for folder in (request.folder.absolute(), *request.folder.absolute().parents) if folder.exists()
    )
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        raise UsageError(f"{request.folder}: cannot be made, as {there} cannot be written into; give another `output`")
    # What an earlier run has written of corrections is written again.
    corrected = [image for image in project.images if not isinstance(image, Image)]
    files = [geometry_of(image).output(project.stems[image.name]) for image in corrected]
    written = [request.folder.resolve() / file for file in files if file is not None]
    inputs = [file for file in input_files(project) if file.resolve() not in written]
    _refuse_inputs(request, [request.project, *inputs])
    for file in written:
        check_output(file, inputs, overwrite=request.overwrite)


def _refuse_inputs(request: AdjustRequest, inputs: Sequence[Path]) -> None:
    for name in OUTPUTS:
        check_output(request.folder / name, inputs, overwrite=request.overwrite)


def _used(prepared: Prepared) -> str:
    inputs: AdjustInputs = prepared.inputs
    control = int((~inputs.ground.check).sum())
    positions = 0 if inputs.positions is None else len(inputs.positions.images)
    attitudes = 0 if inputs.attitudes is None else len(inputs.attitudes.images)
    free = [f"{name}: {', '.join(camera.free)}" for name, camera in prepared.block.cameras.items() if camera.free]
    return (
        f"{counted(len(inputs.images) + len(inputs.projected), 'image')} · {len(inputs.points)} measurements of "
        f"{counted(len(inputs.points.points), 'point')} · "
        f"{control} control, {len(inputs.ground) - control} check points · {positions} positions, {attitudes} attitudes"
        + (f" · calibrated {'; '.join(free)}" if free else "")
    )


def _write(request: AdjustRequest, project: Project, result: MapResult, report: AdjustReport) -> AdjustReport:
    folder, adjusted = request.folder, result.adjusted
    with recording("adjust", request, [request.project, *result.prepared.inputs.files]) as record:
        changes = _changes(result, report.not_oriented)
        try:
            make_parents(folder)
        except OSError as error:
            raise disk_error(folder, error) from error
        write_point_layers(folder / "points.gpkg", point_layers(result, report), result.prepared.frame.crs)
        write_residuals(
            folder / "image_points.csv",
            result.prepared.inputs.points,
            adjusted.residuals,
            adjusted.normalised,
            adjusted.redundancies,
            adjusted.rejected,
        )
        write_atomically(folder / "report.json", stated_json(report.data, folder))
        files = []
        for name, kind, found in result.corrections:
            file = kind.output(project.stems[name])
            if file is not None and found.file is not None:
                files.append(folder / file)
                write_atomically(files[-1], found.file.encode())
                where = Path(os.path.relpath(files[-1].resolve(), request.project.resolve().parent)).as_posix()
                changes.images[name]["correction"] = where
        edit_project(request.project, changes)
        written = (*(folder / name for name in OUTPUTS), *files)
        own = ("sigma0", "redundancy", "unknowns", "iterations", "seconds", "measurements", "points", "rejected")
        record((*written, request.project), pick(report, *own))
    return replace(report, files=written, orientations=len(adjusted.images) + len(adjusted.projections))


def _changes(result: MapResult, lost: Sequence[tuple[str, str]]) -> ProjectChanges:
    """Return entries of the project file: orientations with accuracy, calibrated cameras, what stays approximate."""
    project, block = result.prepared.inputs.project, result.prepared.block
    images: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(result.adjusted.images):
        images[name] = {
            "center": _rounded(result.poses[k].center, decimals_of(result.sigma_center[k])),
            "angles": _rounded(result.angles[k], 10),
            **stated_accuracy(result.covariances[k]),
            "approximate": None,
        }
    stated = [project.image(name) for name, _ in lost]
    images |= {image.name: {"approximate": True} for image in stated if image.center is not None}
    images |= {name: dict(found.entries) for name, _, found in result.corrections}
    sigmas = {found.name: found.sigmas for found in result.cameras}
    cameras = {
        found.name: {
            **camera_entries(project.cameras[found.name], block.cameras[found.name], found),
            "sigma": sigmas[found.name],
        }
        for found in result.adjusted.cameras
        if found.free
    }
    return ProjectChanges(images=images, cameras=cameras)


def _rounded(values: np.ndarray, digits: int) -> list[float]:
    return [round(float(v), digits) + 0.0 for v in values]
