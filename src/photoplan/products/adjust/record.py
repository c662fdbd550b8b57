"""The figures of an adjusted block by their keys, as `report.json` has them."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.io.fingerprint import fingerprint
from photoplan.io.run_record import versions
from photoplan.orientation.check_points import CheckAccuracy
from photoplan.plain import pick
from photoplan.products.adjust.block import MapResult
from photoplan.products.adjust.cameras import Calibrated
from photoplan.products.adjust.figures import AdjustFigures, GroundFigures, NamedMeasurement


def block_json(figures: AdjustFigures, result: MapResult) -> dict[str, Any]:
    """All figures by their keys."""
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


def _positions(figures: AdjustFigures) -> dict[str, Any] | None:
    if not figures.strips:
        return None
    own = ("name", "rejected", "mean", "rms", "shift", "rate", "sigma_shift", "sigma_rate")
    arm, turn = figures.lever_arm, figures.boresight
    return {
        "strips": [pick(strip, *own, images="count") for strip in figures.strips],
        "lever_arm": arm and {"value": arm[0], "sigma": arm[1]},
        "boresight": turn and {"value": turn[0], "sigma": turn[1]},
    }
