"""Whether the result of a block adjustment can be right."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from photoplan.errors import GeometryError
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.orientation.bundle.causes import Cause
from photoplan.orientation.judgement import Evidence, fitting, impossible, misfit
from photoplan.orientation.resection.model import ResectSettings
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.frame import nadir_heights
from photoplan.products.resect import control_rows, measured_control, resected

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
        fault = impossible(
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
    """What may be behind observations that do not fit, the likeliest first."""
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
    """What would fit, tried at the image with most control."""
    inputs = result.prepared.inputs
    rows = {image.name: control_rows(inputs, image.name) for image in inputs.images}
    image = max(inputs.images, key=lambda image: len(rows[image.name]))
    if len(rows[image.name]) < 4:
        return "are X and Y, the direction of y in the images, units and height systems as they are stated?"
    given, described = measured_control(inputs, rows[image.name]), inputs.project.cameras[image.camera]
    interior, lens = interior_of(described, image), lens_of(described)
    return fitting(
        given,
        interior.size[1],
        lambda other: resected(inputs.project, image, other, interior, lens, ResectSettings()),
        math.nan,
    )
