"""Images with rational polynomials in an adjustment: a shift, a drift, or an affine correction of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from photoplan.cameras.rpc_correctable import FORMS, CorrectableRpc
from photoplan.io.project.model import Project
from photoplan.io.project.rpc import RpcImage
from photoplan.orientation.bundle.block import AdjustedCorrections
from photoplan.products.adjust.geometry import FoundCorrection, FoundParameter, Geometry
from photoplan.project.by_rpc import rpc_camera
from photoplan.project.ground import Ground

#: A satellite is about so far away, metres.
_AWAY = 6e5
_CALLED = ("column shift", "row shift", "column by row", "row by row", "column by column", "row by column")


def _correctable(project: Project, image: RpcImage, ground: Ground, size: tuple[int, int]) -> CorrectableRpc:
    camera = rpc_camera(project, image, ground, size)
    stated = project.adjustment.rpc
    plain = replace(camera, correction=None)
    return CorrectableRpc(
        plain=plain, name=image.name, form=stated.correction, sigma=stated.sigma, start=camera.correction
    )


def _found(image: CorrectableRpc, sets: Mapping[str, AdjustedCorrections]) -> FoundCorrection:
    found = sets[image.key]
    values, Q = found.values[0], found.covariance[0]
    count = 2 * FORMS[image.form]
    shift_drift = image.affine(values)
    T = image.to_affine[:, :count]
    whole = T @ Q @ T.T if count > 2 else Q
    entries = {
        "shift": [round(v, 6) + 0.0 for v in shift_drift[:2]],
        "drift": [float(f"{v:.9g}") for v in shift_drift[2:]] if count > 2 else None,
        "covariance": _triangle(whole),
    }
    sigma = np.sqrt(np.diag(Q))
    return FoundCorrection(
        entries, tuple(FoundParameter(*row, "px") for row in zip(_CALLED, values.tolist(), sigma.tolist()))
    )


def _triangle(Q: np.ndarray) -> list[float] | None:
    return [float(f"{v:.6g}") for v in Q[np.tril_indices(len(Q))]] if np.isfinite(Q).all() else None


POLYNOMIALS = Geometry("rational polynomials", lambda image: _AWAY, _correctable, _found)
