"""Analysis `stage`: the camera calibrated by a stage that moves a target over its field."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.groups import FrameGroup, frame_groups
from photoplan.products.characterise.targets import locate_targets
from photoplan.quality.camera.geometry import LEAST_POINTS, StageCalibration, b4_lines, stage_calibration

_GON = 200.0 / math.pi

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Points:
    label: str
    unit: str
    names: tuple[str, ...]
    stage: Array
    measured: Array
    notes: tuple[str, ...] = ()


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    if any(p.entry.kind == "stage" for p in data.series.positions) or len(data.series.of("stage")) >= LEAST_POINTS:
        return None
    return f"{LEAST_POINTS} or more stage frames with stage_x and stage_y, or a table of positions of kind stage"


def analyse(data: SeriesData) -> Findings:
    """Affine transformation between stage and image, for every target and table."""
    points = [p for group in frame_groups(data, "stage") for p in _of_frames(data, group)]
    points += [
        _Points(
            label=table.label,
            unit=table.entry.unit,
            names=tuple(line.name for line in table.lines),
            stage=np.array([line.stage for line in table.lines], float).reshape(-1, 2),
            measured=np.array([(line.x, line.y) for line in table.lines], float),
        )
        for table in data.series.positions
        if table.entry.kind == "stage"
    ]
    parts = []
    for k, each in enumerate(points, 1):
        try:
            found = stage_calibration(each.names, each.stage, each.measured)
        except InputError as error:
            raise type(error)(f"{each.label}: {error}") from None
        parts.append(_outcome(found, each, k))
    return joined(parts)


def _of_frames(data: SeriesData, group: FrameGroup) -> list[_Points]:
    stage = []
    for frame in group.frames:
        values = [frame.values.get(key) for key in ("stage_x", "stage_y")]
        if not all(isinstance(v, float | int) and math.isfinite(v) for v in values):
            raise InputError(
                f"{group.group.label}: {frame.file.name} lacks stage_x or stage_y; give a table with columns file, "
                "stage_x and stage_y, or fields of these names in the pattern"
            )
        stage.append([float(v) for v in values if v is not None])
    unit = str(group.group.entry.values.get("unit", "um"))[:20]
    out = []
    for name, places in locate_targets(data, group).items():
        seen = [k for k, p in enumerate(places) if not p.why]
        lost = [f"{p.frame.file.name}: {p.why}" for p in places if p.why]
        label = group.label if len(group.group.entry.targets) < 2 else f"{group.label}, {name}"
        out.append(
            _Points(
                label=label,
                unit=unit,
                names=tuple(group.frames[k].file.stem for k in seen),
                stage=np.array(stage)[seen],
                measured=np.array([(places[k].x, places[k].y) for k in seen]),
                notes=tuple(f"{label}: not found in {text}" for text in lost),
            )
        )
    return out


def _outcome(found: StageCalibration, given: _Points, number: int) -> Findings:
    at, unit, f, of = given.label, given.unit, found.facts, Subject(at=given.label)
    n = len(found.names) - len(found.gross)
    figures = []
    for axis, scale, size, sigma in zip("xy", f.scale, f.pixel_size, found.sigma_pixel_size):
        words = f"scale factor in {axis}"
        figures.append(of.figure(f"scale_{axis}", scale, scale * sigma / size, words, f"px/{unit}"))
        figures.append(of.figure(f"pixel_size_{axis}", size, sigma, f"pixel size in {axis}", unit))
    for axis, value, sigma in zip("xy", (f.direction_x, f.direction_y), found.sigma_direction):
        words = f"rotation of the {axis} axis"
        figures.append(of.figure(f"rotation_{axis}_gon", value * _GON, sigma * _GON, words, "gon"))
    figures.append(of.figure("shear_gon", f.shear * _GON, found.sigma_shear * _GON, "shear", "gon"))
    for axis, value in zip("xy", found.sigma):
        of_value = value / math.sqrt(2 * (n - 3))
        figures.append(of.figure(f"mean_error_{axis}_px", value, of_value, f"mean error {axis}", "px"))
    figures.append(of.figure("m0_px", found.sigma0, found.sigma0 / math.sqrt(2 * found.redundancy), "M0", "px"))
    both = [[float(getattr(t, f"a{k}")) for k in range(1, 7)] for t in (found.to_image, found.to_stage)]
    elements = dict(zip(("a1", "a2", "a3", "b1", "b2", "b3"), zip(*both)))
    points = Table.of(
        "Points, residuals measured minus transformed",
        series=at,
        point=found.names,
        **dict(zip(("stage_x", "stage_y"), found.stage.T)),
        **dict(zip(("x_px", "y_px"), found.measured.T)),
        **dict(zip(("residual_x_px", "residual_y_px"), found.residuals.T)),
        remark=["gross error" if name in found.gross else "" for name in found.names],
    )
    matrices = Table.of("Affine matrices", series=at, way=("stage to image", "image to stage"), **elements)
    return Findings(
        tuple(figures),
        tables={"matrices": matrices, "points": points},
        plots=(_chart(found, at),),
        notes=(*given.notes, *_notes(found, at)),
        files={f"stage_calibration_{number}.txt": ("\n".join(b4_lines(found, unit)) + "\n").encode()},
    )


def _notes(found: StageCalibration, at: str) -> list[str]:
    notes = [f"{at}: gross errors left out: {', '.join(found.gross)}"] if found.gross else []
    if found.facts.mirrored:
        notes.append(f"{at}: the image is mirrored against the stage")
    if found.systematic is not None and found.systematic < 0.001:
        notes.append(
            f"{at}: the residuals are systematic (second-order terms, chance of none {found.systematic:.1g}): "
            "distortion, or a stage that is not straight"
        )
    return notes


def _chart(found: StageCalibration, at: str) -> Chart:
    """Residual vectors (Behr 1989, figs. B.2 and B.3), enlarged."""
    x, y = found.measured.T
    return Chart(
        title=f"Residuals, {at}",
        caption=f"Measured minus transformed, enlarged as the legend says; mean errors {found.sigma[0]:.2f} and "
        f"{found.sigma[1]:.2f} px (Behr 1989, figs. B.2 and B.3).",
        x_label="column px",
        y_label="row px (upwards in the figure)",
        curves=(Trace(x, y, "points", "points"), Trace(x, y, "residuals", vectors=found.residuals)),
    )
