"""Accuracy at check points after the ASPRS Positional Accuracy Standards for Digital Geospatial Data.

American Society for Photogrammetry and Remote Sensing, Edition 2, Version 1.0, August 2023: accuracy is stated as RMSE
(no longer at 95 % confidence); horizontally RMSE_H² = RMSE_X² + RMSE_Y²; the survey's own error belongs to it,
RMSE_H² = RMSE_H1² + RMSE_H2² with H1 the fit to the check points and H2 the accuracy of their survey, and the same
for heights (V); RMSE_3D² = RMSE_H² + RMSE_V². At least 30 check points are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Check points that the standard asks for at least.
LEAST_CHECK_POINTS = 30
#: Mean error, as part of the RMSE, from which a systematic error should be looked for.
_MEAN = 0.25


@dataclass(frozen=True)
class CheckAccuracy:
    """Figures of all check points, metres; NaN where no point has the coordinate."""

    horizontal: int
    """Check points with X and Y."""
    vertical: int
    """Check points with a height."""
    mean: tuple[float, float, float]
    """Mean error in X, Y, Z: adjusted minus surveyed."""
    rmse: tuple[float, float, float]
    """RMSE in X, Y, Z: the fit to the check points."""
    fit_h: float
    """RMSE_H1."""
    fit_v: float
    """RMSE_V1."""
    survey_h: float
    """RMSE_H2, from the stated standard deviations of the survey; NaN: not stated for every point."""
    survey_v: float
    """RMSE_V2."""
    rmse_h: float
    """RMSE_H: with the survey's part, where it is known."""
    rmse_v: float
    """RMSE_V."""
    rmse_3d: float
    """RMSE_3D."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the standard would object to."""
        out = []
        fewest = min(self.horizontal, self.vertical) if self.vertical and self.horizontal else 0
        count = fewest or max(self.horizontal, self.vertical)
        if count < LEAST_CHECK_POINTS:
            out.append(
                f"{count} check points; the standard asks for at least {LEAST_CHECK_POINTS}, so these figures are no "
                "accuracy after the standard"
            )
        axes = [
            axis
            for axis, mean, rmse in zip("XYZ", self.mean, self.rmse)
            if np.isfinite(mean) and rmse > 0 and abs(mean) > _MEAN * rmse
        ]
        if axes and count > 2:
            out.append(f"the mean error in {', '.join(axes)} is more than a quarter of the RMSE: look for a bias")
        if not np.isfinite([self.survey_h, self.survey_v]).all():
            out.append("the accuracy of the survey is not stated for every check point, so its part is left out")
        return tuple(out)


def check_accuracy(residuals: NDArray[np.float64], sigma: NDArray[np.float64]) -> CheckAccuracy:
    """Accuracy at check points."""
    known = np.isfinite(residuals)
    plane = known[:, :2].all(axis=1)
    columns = [residuals[plane, 0], residuals[plane, 1], residuals[known[:, 2], 2]]
    mean = tuple(float(c.mean()) if len(c) else np.nan for c in columns)
    rmse = tuple(float(np.sqrt((c**2).mean())) if len(c) else np.nan for c in columns)
    fit_h, fit_v = float(np.hypot(rmse[0], rmse[1])), rmse[2]
    survey_h = _rms(sigma[plane, :2]) * np.sqrt(2.0)
    survey_v = _rms(sigma[known[:, 2], 2:])
    h = float(np.hypot(fit_h, np.nan_to_num(survey_h)))
    v = float(np.hypot(fit_v, np.nan_to_num(survey_v)))
    return CheckAccuracy(
        horizontal=int(plane.sum()),
        vertical=int(known[:, 2].sum()),
        mean=(mean[0], mean[1], mean[2]),
        rmse=(rmse[0], rmse[1], rmse[2]),
        fit_h=fit_h,
        fit_v=fit_v,
        survey_h=float(survey_h),
        survey_v=float(survey_v),
        rmse_h=h,
        rmse_v=v,
        rmse_3d=float(np.hypot(h, v)),
    )


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")
