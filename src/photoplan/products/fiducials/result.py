"""What became of the fiducial marks of scans, as values, lines and JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.orientation.marks.fiducials import FiducialResult


@dataclass(frozen=True, eq=False)
class ImageFiducials:
    """Marks of one image."""

    name: str
    file: Path
    camera: str
    size: tuple[int, int]
    grey: str
    """Which grey values were used."""
    found: FiducialResult
    picture: Path | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        found, fit = self.found, self.found.fit
        residuals = {name: [_number(v, 2) for v in row] for name, row in zip(fit.names, found.residuals_um)}
        t = fit.transformation
        return {
            "image": self.name,
            "file": str(self.file),
            "camera": self.camera,
            "size": list(self.size),
            "grey": self.grey,
            "pixel_um": _number(1000 * found.pixel_mm, 4),
            "rotation": found.turn.rotation,
            "mirrored": found.turn.mirrored,
            "negative": found.negative,
            "blur_px": _number(found.blur_px, 2),
            "marks": [
                {
                    "name": m.name,
                    "x": _number(m.x, 4),
                    "y": _number(m.y, 4),
                    "sigma": [_number(m.sigma_x, 4), _number(m.sigma_y, 4)],
                    "correlation": _number(m.correlation, 4),
                    "method": m.method,
                    "paraboloid": m.paraboloid and [_number(v, 4) for v in m.paraboloid],
                    "matching": m.matching and [_number(v, 4) for v in m.matching],
                    "residual_um": residuals[m.name],
                }
                for m in found.marks
            ],
            "missing": [
                {
                    "name": m.name,
                    "x": _number(m.x, 1),
                    "y": _number(m.y, 1),
                    "best_correlation": _number(m.correlation, 4),
                    "reason": m.reason,
                }
                for m in found.missing
            ],
            "affine": {
                "parameters": [getattr(t, f"a{k}") for k in range(1, 7)],
                "residuals_um": residuals,
                "sigma0_px": _number(fit.sigma0, 4),
                "sigma0_um": _number(found.sigma0_um, 2),
                "redundancy": fit.redundancy,
            },
            "notes": list(found.notes),
            "picture": self.picture and str(self.picture),
        }

    def __str__(self) -> str:
        found = self.found
        s = "no check: three marks" if math.isnan(found.sigma0_um) else f"sigma0 {found.sigma0_um:.1f} µm"
        worst = float(np.hypot(*found.residuals_um.T).max())
        tone = "negative" if found.negative else "positive"
        lines = [
            f"{self.name}: {len(found.marks)} of {len(found.marks) + len(found.missing)} marks, pixel "
            f"{1000 * found.pixel_mm:.3f} µm, {s}, largest residual {worst:.1f} µm, turned {found.turn}, {tone}"
        ]
        for m, (vx, vy) in zip(found.marks, found.residuals_um):
            lines.append(
                f"  {m.name:>6}  x {m.x:10.3f} ± {m.sigma_x:.3f}  y {m.y:10.3f} ± {m.sigma_y:.3f} px  "
                f"correlation {m.correlation:.3f}  residual {vx:+7.1f} {vy:+7.1f} µm  {m.method}"
            )
        for lost in found.missing:
            best = "" if math.isnan(lost.correlation) else f", best correlation {lost.correlation:.2f}"
            lines.append(f"  {lost.name:>6}  not found near {lost.x:.0f} {lost.y:.0f}: {lost.reason}{best}")
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class FiducialsReport:
    """Marks of all images."""

    images: tuple[ImageFiducials, ...]
    failed: dict[str, str]
    """Reasons, by image."""
    written: Path | None
    """Project file that received the marks."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`."""
        return {
            "images": [image.to_dict() for image in self.images],
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
            "project": self.written and str(self.written),
        }


def _number(value: float, digits: int) -> float | None:
    """Rounded; None for NaN, which JSON does not know."""
    return round(float(value), digits) if math.isfinite(value) else None
