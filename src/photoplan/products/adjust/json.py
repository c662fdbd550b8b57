"""The result of a bundle adjustment as plain values, for report.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.io.fingerprint import fingerprint
from photoplan.io.run_record import versions
from photoplan.products.adjust.block import MapResult
from photoplan.products.plain_values import plain
from photoplan.report.adjust.facts import AdjustFacts, GroundFacts, MeasurementFacts


def facts_json(facts: AdjustFacts, result: MapResult) -> dict[str, Any]:
    """All figures of the report; NaN becomes null."""
    inputs = result.prepared.inputs
    data = {
        "sigma0": facts.sigma0,
        "redundancy": facts.redundancy,
        "unknowns": facts.unknowns,
        "iterations": facts.iterations,
        "seconds": round(facts.seconds, 3),
        "image_residual_rms_px": facts.rms_pixels,
        "measurements": facts.measurements,
        "points": facts.points,
        "mean_images_of_a_point": facts.mean_rays,
        "groups": [
            {
                "name": g.name,
                "count": g.count,
                "redundancy": g.redundancy,
                "rms": g.rms,
                "unit": g.unit,
                "found_to_stated": g.factor,
            }
            for g in facts.groups
        ],
        "image_correlations": [
            {"camera": c.camera, "effect": c.effect, "reach_px": c.reach, "distance_px": c.distance, "rho": c.rho}
            for c in result.adjusted.correlations
        ],
        "cameras": _cameras(facts),
        "control": [_ground(g) for g in facts.ground if not g.check],
        "check_points": [_ground(g) for g in facts.ground if g.check],
        "check_accuracy": _check(facts),
        "gross_errors": [_measurement(m) for m in facts.gross],
        "largest_normalised": [_measurement(m) for m in facts.worst],
        "positions": _positions(facts),
        "images": _images(facts, result),
        "left_out": [{"name": name, "reason": reason} for name, reason in facts.left_out],
        "tie_point_sigma": facts.point_sigma,
        "notes": facts.notes,
        "crs": inputs.project.crs,
        "heights": {
            "system": inputs.project.orientation.height_system,
            "computed_in": result.prepared.frame.inward.target,
            "operation": result.prepared.frame.inward.operation,
        },
        "inputs": {str(path): fingerprint(path).digest for path in inputs.files},
        "versions": versions(),
        "settings": dict(facts.settings),
    }
    clean: dict[str, Any] = plain(data)
    return clean


def _cameras(facts: AdjustFacts) -> dict[str, Any]:
    return {
        c.name: {
            "parameters": {
                p: {"unit": u, "before": b, "after": a, "sigma": s}
                for p, u, b, a, s in zip(c.parameters, c.units, c.before, c.after, c.sigma)
            },
            "correlation": c.correlation,
        }
        for c in facts.cameras
    }


def _ground(g: GroundFacts) -> dict[str, Any]:
    return {
        "name": g.name,
        "images": g.rays,
        "given": g.XYZ,
        "residual": g.residual,
        "sigma_given": g.stated,
        "sigma_adjusted": np.sqrt(np.diag(g.covariance)),
        "normalised": g.normalised,
        "rejected": g.rejected,
    }


def _check(facts: AdjustFacts) -> dict[str, Any] | None:
    c = facts.check
    if c is None:
        return None
    return {
        "standard": "ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023)",
        "number_horizontal": c.horizontal,
        "number_vertical": c.vertical,
        "mean_error": c.mean,
        "rmse": c.rmse,
        "RMSE_H1": c.fit_h,
        "RMSE_V1": c.fit_v,
        "RMSE_H2": c.survey_h,
        "RMSE_V2": c.survey_v,
        "RMSE_H": c.rmse_h,
        "RMSE_V": c.rmse_v,
        "RMSE_3D": c.rmse_3d,
        "warnings": c.warnings,
    }


def _measurement(m: MeasurementFacts) -> dict[str, Any]:
    return {"observation": m.what, "residual": m.residual, "normalised": m.normalised}


def _positions(facts: AdjustFacts) -> dict[str, Any] | None:
    if not facts.strips:
        return None
    return {
        "strips": [
            {
                "name": s.name,
                "images": s.count,
                "rejected": s.rejected,
                "mean": s.mean,
                "rms": s.rms,
                "shift": s.shift,
                "rate": s.rate,
                "sigma_shift": s.sigma_shift,
            }
            for s in facts.strips
        ],
        "lever_arm": facts.lever_arm and {"value": facts.lever_arm[0], "sigma": facts.lever_arm[1]},
        "boresight": facts.boresight and {"value": facts.boresight[0], "sigma": facts.boresight[1]},
    }


def _images(facts: AdjustFacts, result: MapResult) -> list[dict[str, Any]]:
    return [
        {
            "name": image.name,
            "center": image.center,
            "angles": result.angles[k],
            "sigma_center": image.sigma_center,
            "sigma_angles": image.sigma_angles,
            "measurements": image.measurements,
            "rejected": image.rejected,
            "mean": image.mean,
            "rms": image.rms,
            "largest_normalised": image.worst,
        }
        for k, image in enumerate(facts.images)
    ]
