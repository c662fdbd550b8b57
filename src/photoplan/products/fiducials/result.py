"""What became of the fiducial marks of scans, as values, lines and JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.orientation.marks.fiducials import FiducialResult
from photoplan.orientation.marks.layout import MarkLayout
from photoplan.plain import pick


@dataclass(frozen=True, eq=False)
class ImageFiducials:
    """Marks of one image."""

    name: str
    file: Path
    camera: str
    size: tuple[int, int]
    grey: str
    """Which grey values were used."""
    band: int | None
    """Band that was used; None: luminance."""
    layout: MarkLayout
    """What was sought."""
    found: FiducialResult

    def json_fields(self) -> dict[str, Any]:
        """Every mark, and the affine transformation."""
        found, fit = self.found, self.found.fit
        residuals = dict(zip(fit.names, found.residuals_um))
        return {
            **pick(self, "file", "camera", "size", "grey", image="name"),
            "pixel_um": 1000 * found.pixel_mm,
            **pick(found.turn, "rotation", "mirrored"),
            **pick(found, "negative", "blur_px", "notes"),
            "marks": [
                {
                    **pick(m, "name", "x", "y", "correlation", "method", "paraboloid", "matching"),
                    "sigma": [m.sigma_x, m.sigma_y],
                    "residual_um": residuals[m.name],
                }
                for m in found.marks
            ],
            "missing": [pick(m, "name", "x", "y", "reason", best_correlation="correlation") for m in found.missing],
            "affine": {
                "parameters": [getattr(fit.transformation, f"a{k}") for k in range(1, 7)],
                "residuals_um": residuals,
                "sigma0_px": fit.sigma0,
                **pick(found, "sigma0_um"),
                "redundancy": fit.redundancy,
            },
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

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        failed = [{"image": name, "reason": reason} for name, reason in self.failed.items()]
        return {**pick(self, "images", project="written"), "failed": failed}
