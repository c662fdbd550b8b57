"""What a converged bundle adjustment knows of its accuracy: redundancy numbers, variance factors, cofactors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.normal import Inverse, Reduced, reduce_normals
from photoplan.orientation.bundle.robust import Judged, kinds_of, robust_scale
from photoplan.orientation.bundle.rows import Residuals, linearise, whitened
from photoplan.orientation.bundle.unknowns import State

_Floats = NDArray[np.float64]

#: Smallest variance factor: data without noise would otherwise get weights that no arithmetic bears.
_LEAST = 0.02
#: Redundancy from which the variance factor of a group is worth estimating.
_ENOUGH = 10.0


@dataclass(frozen=True, eq=False)
class Solution:
    """The equations at the minimum and what follows from them."""

    model: Model
    state: State
    reduced: Reduced
    found: Residuals
    e: _Floats
    """Residuals of all rows divided by the standard deviations that were stated."""
    weight: _Floats
    """Weights of all rows, each by itself: 0 for those that are taken out."""
    inverse: Inverse | None
    """None: covariances were not asked for."""
    redundancies: _Floats
    """Of each row; NaN without covariances."""
    point_cofactors: _Floats
    """(m, 3, 3); NaN without covariances."""

    @property
    def redundancy(self) -> int:
        """Equations minus unknowns."""
        return int((self.weight > 0).sum()) - self.model.columns.count - 3 * len(self.model.point_names)

    @property
    def sigma0(self) -> float:
        """Standard deviation of unit weight; NaN without redundancy."""
        counted = self.weight > 0
        total = float((self.weight[counted] * self.e[counted] ** 2).sum())
        redundancy = float(self.redundancies[counted].sum()) if self.inverse is not None else float(self.redundancy)
        return float(np.sqrt(total / redundancy)) if self.redundancy > 0 else float("nan")

    def scales(self) -> _Floats:
        """Standard deviation of each group's residuals in units of the stated ones, in a robust way."""
        kinds, of = kinds_of(self.model)
        out = np.ones(len(kinds))
        size = self.e / np.sqrt(np.clip(np.nan_to_num(self.redundancies, nan=1.0), 1e-3, 1.0))
        counted = (self.weight > 0) & (np.nan_to_num(self.redundancies, nan=1.0) > 0.05)
        for k in range(len(kinds)):
            out[k] = robust_scale(size[: len(of)][(of == k) & counted[: len(of)]], kinds[k])
        return out

    def normalised(self) -> _Floats:
        """Residuals divided by their own standard deviations, all rows; NaN where nothing checks the observation."""
        _, of = kinds_of(self.model)
        scale = np.ones(len(self.e))
        scale[: len(of)] = self.scales()[of]
        checked = np.nan_to_num(self.redundancies, nan=1.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(checked > 1e-3, self.e / (scale * np.sqrt(np.clip(checked, 1e-3, 1.0))), np.nan)

    def judged(self) -> Judged:
        """What data snooping looks at."""
        return Judged(self.e, self.normalised(), self.weight, self.scales())

    def trusted(self, factors: _Floats) -> _Floats:
        """Factors that weights are made with: control is not taken for better than stated.

        Errors of control are often alike (one survey, one orthophoto); orientations then follow them, and residuals
        are small for that reason alone.
        """
        kinds, _ = kinds_of(self.model)
        control = np.array([name.startswith("control, ") for name, _ in kinds], bool)
        return np.asarray(np.where(control, np.maximum(factors, 1.0), factors))

    def factors(self, before: _Floats | None = None) -> _Floats:
        """Variance components: standard deviation found over the one stated, of each group (Förstner 1979).

        Groups with little redundancy keep the factor that they had `before` (1 if it is None): the more a group's
        weight grows, the less checks it, so its factor may not fall for ever, nor jump back.
        """
        kinds, of = kinds_of(self.model)
        out = np.ones(len(kinds)) if before is None else before.copy()
        r, e, w = (v[: len(of)] for v in (self.redundancies, self.e, self.weight))
        for k in range(len(kinds)):
            mine = (of == k) & (w > 0)
            if mine.any() and (total := float(r[mine].sum())) > _ENOUGH:
                out[k] = max(float(np.sqrt((e[mine] ** 2).sum() / total)), _LEAST)
        return out


def solution_of(
    model: Model, state: State, weight: _Floats, covariance: bool, effects: _Floats | None = None
) -> Solution:
    """Equations, redundancy numbers and cofactors at a converged state.

    Parameters
    ----------
    weight : ndarray, shape (rows,)
        Weights of the rows, each by itself.
    covariance : bool
        Whether cofactors and redundancy numbers are wanted.
    effects : ndarray, shape (rows,), optional
        How many rows of image points count as one for what they have in common: orientations and cameras. Points, and
        residuals of image points, go by the rows' own weights.
    """
    rows, found = linearise(model, state, np.sqrt(weight))
    reduced = reduce_normals(rows, len(model.point_names))
    e = whitened(model, found)
    if not covariance:
        none = np.full(len(e), np.nan)
        return Solution(
            model, state, reduced, found, e, weight, None, none, np.full((len(model.point_names), 3, 3), np.nan)
        )
    inverse = Inverse(reduced)
    points, variance = inverse.variances()
    redundancies = np.clip(1.0 - variance, 0.0, 1.0)
    if effects is not None:
        common, _ = linearise(model, state, np.sqrt(weight / effects))
        own = reduced.V_inverse
        reduced = reduce_normals(common, len(model.point_names))
        inverse = Inverse(reduced)
        points, variance = inverse.variances()
        points = points - reduced.V_inverse + own
        others = slice(model.parts.image.stop, None)
        redundancies[others] = np.clip(1.0 - variance[others], 0.0, 1.0)
    return Solution(model, state, reduced, found, e, weight, inverse, redundancies, points)
