"""The layers of an adjusted block's points, as a GIS shows them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.io.geopackage import PointLayer
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.figures import AdjustFigures

_Floats = NDArray[np.float64]


def point_layers(result: MapResult, facts: AdjustFigures) -> list[PointLayer]:
    """Layers of the GeoPackage: adjusted points, projection centres, and residuals of control and check points."""
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
