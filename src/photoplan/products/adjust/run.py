"""Bundle adjustment of a project: its measurements in, its orientations and cameras changed, its figures beside it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from photoplan.errors import DatumDefect, GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.geopackage import write_point_layers, write_residuals
from photoplan.io.naming import write_atomically
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.run_record import recording, stated_json
from photoplan.orientation.bundle.adjust import adjust_block
from photoplan.orientation.bundle.block import Adjusted, AdjustSettings
from photoplan.orientation.bundle.causes import weighed_causes
from photoplan.plain import pick
from photoplan.products.adjust.block import (
    MapResult,
    Prepared,
    adjust_prepared,
    decimals_of,
    map_result,
    prepare,
    stated_accuracy,
)
from photoplan.products.adjust.cameras import Free, camera_entries, parse_calibrate
from photoplan.products.adjust.figures import AdjustFigures
from photoplan.products.adjust.inputs import AdjustInputs, read_inputs
from photoplan.products.adjust.judged import cause_notes, refuse_cause, refuse_impossible
from photoplan.products.adjust.layers import point_layers
from photoplan.products.adjust.projections import geometry_of
from photoplan.products.adjust.record import block_json
from photoplan.products.adjust.start import EarlierResult, known_poses, started
from photoplan.products.adjust.summary import summarise
from photoplan.project.scene import input_files

#: Part of the measurements that take no part, from which on the start is doubted.
_POOR = 0.1
#: Files of the output folder.
OUTPUTS = ("report.json", "points.gpkg", "image_points.csv")


@dataclass(frozen=True)
class AdjustRequest:
    """What is asked."""

    project: Path
    calibrate: tuple[str, ...] = ()
    """``CAMERA=c,x0,y0,k1`` each; empty: as [adjustment] states."""
    datum: Literal["observations", "orientations"] | None = None
    """What places the block: observations (control, observed positions), or the orientations that the project states;
    None: as [adjustment] states."""
    images: tuple[str, ...] = ()
    """Names or patterns; empty: all."""
    robust: bool = True
    critical: float = 4.0
    variance_components: bool = True
    """Whether each group of observations gets the accuracy that its residuals show."""
    correlation: bool = True
    """Whether errors of neighbouring image points may be alike."""
    iterations: int = 40
    """Most iterations of each least-squares solution."""
    output: Path | None = None
    """Folder; None: ``adjustment`` beside the project file."""
    dry_run: bool = False
    """Adjust and tell, but write nothing."""
    overwrite: bool = False

    @property
    def folder(self) -> Path:
        """Where reports go."""
        return self.output if self.output is not None else self.project.resolve().parent / "adjustment"


@dataclass(frozen=True, eq=False)
class AdjustReport:
    """What came out."""

    written: tuple[Path, ...]
    """Empty after a dry run."""
    figures: AdjustFigures
    orientations: int
    """Images whose orientation was written into the project."""
    data: dict[str, Any]
    not_oriented: tuple[tuple[str, str], ...] = ()
    """Images that were asked for and could not be oriented: name and reason."""

    def json_fields(self) -> dict[str, Any]:
        """Those of ``report.json``, with the files."""
        return {"files": self.written, **self.data}


def adjust_project(request: AdjustRequest, events: Events = SILENT) -> AdjustReport:
    """Adjust the block of a project and write the result into it.

    Parameters
    ----------
    request : AdjustRequest
    events : Events
        Told what is used, and of each iteration.

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
    if not (math.isfinite(request.critical) and request.critical > 0):
        raise UsageError(f"`critical` {request.critical:g}; a positive number of standard deviations is needed")
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
    settings = AdjustSettings(
        request.robust,
        request.critical,
        request.variance_components,
        correlation=request.correlation,
        iterations=request.iterations,
    )
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
    causes = weighed_causes(prepared.block, adjusted)
    refuse_cause(causes)
    figures = summarise(title, result, settings, time.perf_counter() - begun)
    figures = replace(figures, notes=(*cause_notes(causes, result), *figures.notes))
    data = block_json(figures, result)
    reasons = dict((*result.prepared.inputs.lost, *adjusted.left_out))
    images = [image.name for image in inputs.images if image.name not in adjusted.images]
    lost = tuple((name, reasons.get(name, "no reason is known")) for name in images)
    data["not_oriented"] = [{"name": name, "reason": reason} for name, reason in lost]
    if request.dry_run:
        return AdjustReport(written=(), figures=figures, orientations=0, data=data, not_oriented=lost)
    return _write(request, project, result, figures, data, lost)


def _adjusted(inputs: AdjustInputs, free: Free, settings: AdjustSettings, events: Events) -> tuple[Prepared, Adjusted]:
    """The block adjusted from wherever it can begin, with the images that only its calibration orients."""

    def iterated(number: int, rms: float) -> None:
        events.begin(f"iteration {number} · weighted residuals {rms:.4g}")

    def tried(known: bool = True, earlier: EarlierResult | None = None) -> tuple[Prepared, Adjusted]:
        prepared = prepare(*started(inputs, known=known, earlier=earlier), free)
        events.talk(_used(prepared))
        return adjust_prepared(prepared, settings, partial(adjust_block, progress=iterated))

    prepared, adjusted = _begun(inputs, tried, settings, events)
    lost = len(inputs.images) - len(adjusted.images)
    if not (lost and any(camera.free for camera in adjusted.cameras)):
        return prepared, adjusted
    # A lens that was not known yet may have kept them out.
    poses = dict(zip(adjusted.images, map_result(prepared, adjusted).poses))
    cameras = {
        c.name: replace(prepared.block.cameras[c.name], c=c.c, principal_point=c.principal_point, lens=c.lens)
        for c in adjusted.cameras
    }
    earlier = EarlierResult(poses, cameras)
    if len(started(inputs, earlier=earlier)[1]) == len(poses):
        return prepared, adjusted
    events.talk(f"note: starting again with the calibrated cameras, as {lost} images could not be oriented without")
    return tried(earlier=earlier)


def _begun(
    inputs: AdjustInputs, tried: Callable[[bool], tuple[Prepared, Adjusted]], settings: AdjustSettings, events: Events
) -> tuple[Prepared, Adjusted]:
    """The block adjusted from its approximate orientations; if that fails, from control and tie points alone."""
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
    """Measurements that take part."""
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
    written = [request.folder.resolve() / n for i in project.images if (n := _correction_file(project, i)) is not None]
    inputs = [file for file in input_files(project) if file.resolve() not in written]
    _refuse_inputs(request, [request.project, *inputs])
    for file in written:
        check_output(file, inputs, overwrite=request.overwrite)


def _correction_file(project: Project, image: ImageEntry) -> str | None:
    return None if isinstance(image, Image) else geometry_of(image).output(project.stems[image.name])


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
        f"{len(inputs.images) + len(inputs.projected)} images · {len(inputs.points)} measurements of "
        f"{len(inputs.points.points)} points · "
        f"{control} control, {len(inputs.ground) - control} check points · {positions} positions, {attitudes} attitudes"
        + (f" · calibrated {'; '.join(free)}" if free else "")
    )


def _write(
    request: AdjustRequest,
    project: Project,
    result: MapResult,
    figures: AdjustFigures,
    data: dict[str, Any],
    lost: tuple[tuple[str, str], ...],
) -> AdjustReport:
    folder, adjusted = request.folder, result.adjusted
    with recording("adjust", request, [request.project, *result.prepared.inputs.files]) as record:
        changes = _changes(result, lost)
        try:
            make_parents(folder)
        except OSError as error:
            raise disk_error(folder, error) from error
        write_point_layers(folder / "points.gpkg", point_layers(result, figures), result.prepared.frame.crs)
        write_residuals(
            folder / "image_points.csv",
            result.prepared.inputs.points,
            adjusted.residuals,
            adjusted.normalised,
            adjusted.redundancies,
            adjusted.rejected,
        )
        write_atomically(folder / "report.json", stated_json(data, folder))
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
        figures_of_block = (
            "sigma0",
            "redundancy",
            "unknowns",
            "iterations",
            "seconds",
            "measurements",
            "points",
            "rejected",
        )
        record((*written, request.project), pick(figures, *figures_of_block))
    return AdjustReport(
        written=written,
        figures=figures,
        orientations=len(adjusted.images) + len(adjusted.projections),
        data=data,
        not_oriented=lost,
    )


def _changes(result: MapResult, lost: Sequence[tuple[str, str]]) -> ProjectChanges:
    """Entries of the project file: orientations with their accuracy, calibrated cameras, what stays approximate."""
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
