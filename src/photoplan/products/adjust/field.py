"""Mean residuals over the image format of each camera: what is left of systematic image errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.io.project.cameras import image_size
from photoplan.orientation.bundle.block import BlockImage
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.figures import ResidualField

_Floats = NDArray[np.float64]
#: Measurements in a cell on average, and cells along the longer side at least and at most.
_PER_CELL, _FEWEST, _MOST = 25, 4, 18
#: Cells with fewer measurements are not shown.
_LEAST = 4


def residual_fields(result: MapResult, used: NDArray[np.bool_]) -> tuple[ResidualField, ...]:
    """Fields of all cameras that have enough measurements.

    Residuals are turned from pixels into the image plane (x right, y up), where the images of a film camera agree, and
    scaled back so that their length stays in pixels.

    Parameters
    ----------
    result : MapResult
    used : ndarray, shape (k,)
        Measurements that take part.
    """
    points, block = result.prepared.inputs.points, result.prepared.block
    of = {image.name: image for image in block.images}
    at, turned = np.full((len(points), 2), np.nan), np.full((len(points), 2), np.nan)
    camera = np.full(len(points), "", object)
    for k, name in enumerate(points.images):
        rows = np.flatnonzero((points.image == k) & used)
        if len(rows):
            at[rows], turned[rows] = _in_plane(of[name], points.xy[rows], result.adjusted.residuals[rows])
            camera[rows] = of[name].camera
    out = []
    for name in block.cameras:
        mine = camera == name
        if mine.sum() >= _LEAST * _FEWEST**2:
            out.append(_field(result, name, at[mine], turned[mine]))
    return tuple(out)


def _in_plane(image: BlockImage, xy: _Floats, residuals: _Floats) -> tuple[_Floats, _Floats]:
    """Places in the image plane, and residuals along its axes in pixels."""
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
        [
            frame[0] + (shown % columns + 0.5) * width / columns,
            frame[1] + (shown // columns + 0.5) * height / rows,
        ],
        axis=1,
    )
    camera = result.prepared.inputs.project.cameras[name]
    unit = "mm" if camera.type == "film" or (camera.camera_constant_mm and not camera.principal_point_px) else "px"
    return ResidualField(
        name,
        unit,
        middles,
        mean[shown] / count[shown, None],
        count[shown],
        frame,
        float(np.sqrt((residuals**2).mean())),
    )


def _frame(result: MapResult, name: str) -> tuple[float, float, float, float]:
    """Corners of the camera's image format in the image plane: of its first image."""
    project = result.prepared.inputs.project
    image = next(i for i in result.prepared.block.images if i.camera == name)
    width, height = image_size(project.cameras[name], project.image(image.name))
    corners = np.array([(-0.5, -0.5), (width - 0.5, -0.5), (width - 0.5, height - 0.5), (-0.5, height - 0.5)])
    plane = image.plane_to_pixel.inverse(corners)
    low, high = plane.min(axis=0), plane.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
