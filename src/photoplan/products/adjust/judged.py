"""Whether the result of a block adjustment can be right."""

from __future__ import annotations

import numpy as np

from photoplan.errors import GeometryError
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.orientation.judgement import Evidence, fitting, impossible
from photoplan.orientation.resection.model import ResectSettings
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.frame import nadir_heights
from photoplan.products.resect.image import control_rows, measured_control, resected


def refuse_impossible(result: MapResult) -> None:
    """Refuse a block of which images lie under the ground, or most measurements do not fit.

    Raises
    ------
    GeometryError
        The message says what of the measurements read otherwise would fit.
    """
    adjusted, inputs = result.adjusted, result.prepared.inputs
    points, row = inputs.points, {name: k for k, name in enumerate(adjusted.points)}
    at = np.array([row.get(name, -1) for name in points.points], np.int64)[points.point]
    centers = np.array([pose.center for pose in result.poses])
    terrain = nadir_heights(inputs.project, centers[:, :2], np.nan)
    residuals = adjusted.residuals[np.isfinite(adjusted.residuals[:, 0]) & ~adjusted.rejected]
    factors = [group.factor for group in adjusted.groups if group.unit == "px"]
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


def _hint(result: MapResult) -> str:
    """What would fit, tried at the image with most control."""
    inputs = result.prepared.inputs
    rows = {image.name: control_rows(inputs, image.name) for image in inputs.images}
    image = max(inputs.images, key=lambda image: len(rows[image.name]))
    if len(rows[image.name]) < 4:
        return "are X and Y, the direction of y in the images, units and height systems as they are stated?"
    given, described = measured_control(inputs, rows[image.name]), inputs.project.cameras[image.camera]
    camera = interior_of(described, image), lens_of(described)
    return fitting(
        given, camera[0].size[1], lambda other: resected(inputs.project, image, other, camera, ResectSettings())
    )
