"""Results of a bundle adjustment: accuracies, correlated errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import linalg, sparse
from scipy.optimize import nnls

from photoplan.adjustment.least_squares import ENOUGH, MEDIAN_1D, variance_factors
from photoplan.adjustment.statistics import Components, chance_chi_square, variance_components
from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.correctable import Corrections
from photoplan.cameras.observed import ImagePoints
from photoplan.errors import GeometryError
from photoplan.geometry.pose import rotation_vector
from photoplan.orientation.bundle.equations import (
    Inverse,
    Reduced,
    Residuals,
    by_prior,
    check_rank,
    linearise,
    reduce_normals,
    residuals_of_all,
    whitened,
)
from photoplan.orientation.bundle.model import (
    BORESIGHT,
    DRIFT,
    IMAGES,
    LEVER,
    Active,
    Adjusted,
    AdjustedCamera,
    AdjustedCorrections,
    AdjustedStrip,
    Block,
    Correlation,
    Group,
    Model,
    State,
    build_model,
    start_state,
)
from photoplan.orientation.bundle.robust import (
    DATUM,
    Judged,
    Selection,
    kinds_of,
    kinds_of_measurements,
    robust_scale,
    select,
)

#: Classes of distance: their number, and the largest distance as a part of the extent of an image's points.
_CLASSES, _REACH = 14, 0.5
#: The first class ends where the last does, divided by this.
_RANGE = 64.0
#: Measurements of an image that are compared with each other at most.
_SAMPLE = 500
#: Pairs that a class needs to say anything, and how many of its standard deviations a correlation must exceed zero by.
_PAIRS, _CLEAR = 50, 3.0
#: Fewer measurements that count as one than this are none: formal accuracies stay as they are.
_LEAST = 1.2


def correlation_of(model: Model, normalised: Floats, used: Mask) -> tuple[Correlation, ...]:
    """Correlation of the residuals within the images of each camera, as a function of their distance.

    Orientations are smooth functions of the image's points, so errors that are alike over some distance d do not
    average out: of n measurements, n / effect count, with effect = 1 + Σ ρ(d) over the neighbours of each.
    """
    v = np.nan_to_num(normalised)
    found = []
    for index, name in enumerate(model.groups):
        mine = np.flatnonzero(used & (model.camera_of[model.image] == index))
        made = _of_camera(name, model.image[mine], model.xy[mine], v[mine]) if len(mine) > _PAIRS else None
        if made is not None:
            found.append(made)
    return tuple(found)


def effects_of_rows(model: Model, correlations: tuple[Correlation, ...], rows: int) -> Floats:
    """How many measurements count as one, of each row; 1 for everything but correlated tie points, (rows,).

    Control and check points are few and far from each other, so what they say is hardly alike. And if the image points
    of control lost weight, it would lie where its ground coordinates are, and nothing would check these.
    """
    of_camera = np.ones(len(model.groups))
    for correlation in correlations:
        of_camera[model.groups.index(correlation.group)] = correlation.effect
    out = np.ones(rows)
    ground = set(model.block.ground.names)
    surveyed = np.array([name in ground for name in model.point_names], bool)
    effects = np.where(surveyed[model.point], 1.0, of_camera[model.camera_of[model.image]])
    out[model.parts.image] = np.repeat(effects, 2)
    return out


def _of_camera(name: str, image: Ints, xy: Floats, v: Floats) -> Correlation | None:
    extent = float(np.hypot(*np.ptp(xy, axis=0)))
    if extent == 0.0:
        return None
    edges = np.concatenate([[0.0], np.geomspace(extent * _REACH / _RANGE, extent * _REACH, _CLASSES)])
    sums, pairs, weights = (np.zeros(_CLASSES) for _ in range(3))
    rng = np.random.default_rng(0)
    order = np.argsort(image, kind="stable")
    images = [0, *(np.flatnonzero(np.diff(image[order])) + 1).tolist(), len(order)]
    for begin, end in pairwise(images):
        members = order[begin:end]
        chosen = members if len(members) <= _SAMPLE else members[rng.permutation(len(members))[:_SAMPLE]]
        i, j = np.triu_indices(len(chosen), 1)
        distance = np.linalg.norm(xy[chosen[i]] - xy[chosen[j]], axis=1)
        product = (v[chosen[i]] * v[chosen[j]]).mean(axis=1)
        # The last class takes what is too far away.
        of = np.searchsorted(edges, distance, side="right") - 1
        sums += np.bincount(of, product, _CLASSES + 1)[:_CLASSES]
        count = np.bincount(of, minlength=_CLASSES + 1)[:_CLASSES]
        pairs += count
        # Of a sample of the points, each pair stands for many.
        weights += count * (len(members) / len(chosen)) ** 2
    variance = float((v**2).mean())
    enough = pairs >= _PAIRS
    rho = np.where(enough, sums / np.maximum(pairs, 1.0) / max(variance, 1e-300), 0.0)
    clear = rho > _CLEAR / np.sqrt(np.maximum(pairs, 1.0))
    ends = np.flatnonzero(enough & ~clear)
    last = int(ends[0]) if len(ends) else _CLASSES
    effect = 1.0 + 2.0 * float((rho[:last] * weights[:last]).sum()) / len(image)
    if effect < _LEAST:
        return None
    return Correlation(
        group=name, effect=effect, reach=float(edges[last]), distance=edges[1:], rho=np.where(enough, rho, np.nan)
    )


#: Images and contrasts that are looked at at most: a neighbourhood tells as much as needed.
_IMAGES, _CONTRASTS = 30, 400
#: Contrasts below which nothing is said.
_FEW = 40
#: Correlation lengths that are tried, as parts of the extent of an image's points, and on either side of the best.
_LENGTHS = 1.0 / np.array([48.0, 24.0, 12.0, 6.0, 3.0])
_BESIDE = 2.0 ** np.array([-0.5, 0.5])
#: Chance from which on a difference in likelihood means something.
_CHANCE = 1e-4
#: Times that an accuracy is worse than stated from which on it is named.
_WORSE = 1.4
#: Singular values below this part of the largest are none.
_RANK = 1e-10


@dataclass(frozen=True)
class CorrelationEvidence:
    """What makes the misfits of a block likely, image errors of free size at any rate."""

    reach: float
    """Distance at which the correlation of image errors has fallen to 1/e, pixels."""
    share: float
    """Part of their variance that is alike, 0 to 1."""
    by_likeness: float
    """Part of what the best model makes more likely (in deviance) that image errors which are alike make, all other
    accuracies as stated, 0 to 1."""
    by_accuracy: float
    """The same of other accuracies than stated, image errors independent."""
    worse: tuple[tuple[str, float], ...]
    """Groups of observations that are less accurate than stated even so, and how many times; empty: none with any
    certainty."""
    alike: bool
    """Whether errors are alike, whatever the accuracies of the others are."""


def correlation_evidence(block: Block, base: Adjusted) -> CorrelationEvidence | None:
    """Weigh image errors that are alike, with covariance exp(−(d/L)²) over distances d, against other accuracies."""
    model, K, w = _contrasts(_part(block, base), base)
    if len(w) < _FEW:
        return None
    kinds, of = kinds_of(model)
    kind = np.full(model.rows, -1)
    kind[: len(of)] = of
    there = [k for k in range(len(kinds)) if (of == k).any()]
    parts = {k: K[kind == k].T @ K[kind == k] for k in there}
    image = [parts[k] for k in there if kinds[k][1] == "px"]
    others = [k for k in there if kinds[k][1] != "px"]
    free = [parts[k] for k in others]
    rest = K[kind < 0].T @ K[kind < 0]
    stated = sum(free, rest)
    size = float(w @ w) / len(w)
    plain = variance_components(w, stated, image, np.full(len(image), size))
    accuracy = variance_components(w, rest, [*image, *free], np.full(len(there), max(size, 1.0)))
    length, near, likeness = _likeliest(model, K, lambda near: (w, stated, image, near), size)
    start = [*likeness.variances[:-1], *np.ones(len(free)), likeness.variances[-1]]
    both = variance_components(w, rest, [*image, *free, near], start)
    whole = plain.deviance - both.deviance
    alike = _means(accuracy.deviance - both.deviance, 2)
    variances = dict(zip(others, both.variances[len(image) :]))
    worse = []
    for k, variance in variances.items():
        if variance > _WORSE**2:
            # As stated, with all others free.
            rest_free = [parts[j] for j in others if j != k]
            start = [*both.variances[: len(image)], *(variances[j] for j in others if j != k), both.variances[-1]]
            without = variance_components(w, rest + parts[k], [*image, *rest_free, near], start)
            if _means(without.deviance - both.deviance, 1):
                worse.append((kinds[k][0], float(np.sqrt(variance))))
    if not (alike or worse):
        return None
    own = float(np.average(likeness.variances[:-1], weights=[np.trace(part) for part in image]))
    return CorrelationEvidence(
        reach=length,
        share=float(likeness.variances[-1]) / (own + float(likeness.variances[-1])),
        by_likeness=min(1.0, (plain.deviance - likeness.deviance) / whole),
        by_accuracy=min(1.0, (plain.deviance - accuracy.deviance) / whole),
        worse=tuple(worse),
        alike=alike,
    )


def _means(gain: float, more: int) -> bool:
    return more > 0 and chance_chi_square(max(gain, 0.0), more) < _CHANCE


_Data = tuple[Floats, Floats, list[Floats], Floats]


def _likeliest(
    model: Model, K: Floats, data: Callable[[Floats], _Data], size: float
) -> tuple[float, Floats, Components]:
    """Correlation length, its part of the covariance matrix, and variances: the last of errors that are alike."""
    found: list[tuple[float, Floats, Components]] = []

    def tried(lengths: Floats) -> tuple[float, Floats, Components]:
        for length in lengths.tolist():
            w, fixed, image, near = data(_near(model, K, length))
            start = found[-1][2].variances if found else np.full(len(image) + 1, size / 2.0)
            start = np.maximum(start, 0.01 * size)
            found.append((length, near, variance_components(w, fixed, [*image, near], start)))
        return min(found, key=lambda each: each[2].deviance)

    best = tried(_LENGTHS * np.hypot(*np.ptp(model.xy, axis=0)))
    return tried(best[0] * _BESIDE)


def _near(model: Model, K: Floats, length: float) -> Floats:
    """Covariance of contrasts from errors that are alike within each image, in either coordinate."""
    out = np.zeros((K.shape[1], K.shape[1]))
    for image in range(len(model.image_names)):
        mine = np.flatnonzero(model.image == image)
        xy = model.xy[mine]
        distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
        covariance = np.exp(-((distance / length) ** 2))
        for axis in range(2):
            rows = K[2 * mine + axis]
            out += rows.T @ covariance @ rows
    return out


def _part(block: Block, base: Adjusted) -> Block:
    """A neighbourhood of images with so many of their points, at random, that all can be computed at once."""
    seen = block.observations
    centers = {name: pose.center for name, pose in zip(base.images, base.poses)}
    names = [image.name for image in block.images if image.name in centers]
    if len(names) > _IMAGES:
        XYZ = np.array([centers[name] for name in names])
        away = np.linalg.norm(XYZ - np.median(XYZ, axis=0), axis=1)
        names = [names[k] for k in np.argsort(away)[:_IMAGES]]
    names += [each.name for each in block.projections]
    inside = np.array([name in set(names) for name in seen.images], bool)[seen.image]
    inside &= np.array([name in set(base.points) for name in seen.points], bool)[seen.point]
    rays = np.bincount(seen.point[inside], minlength=len(seen.points))
    surveyed = np.array([name in set(block.ground.names) for name in seen.points], bool)
    usable = (rays >= 2) | surveyed
    order = np.random.default_rng(0).permutation(len(seen.points))
    order = order[np.argsort(~surveyed[order], kind="stable")]
    added = np.where(usable[order], np.maximum(2 * rays[order] - 3, 0), 0)
    chosen = np.zeros(len(seen.points), bool)
    chosen[order[usable[order] & (np.cumsum(added) <= _CONTRASTS + 6 * len(names))]] = True
    return replace(block, observations=seen.where(inside & chosen[seen.point]))


def _contrasts(block: Block, base: Adjusted) -> tuple[Model, Floats, Floats]:
    """The model, combinations of its rows that no unknown moves (rows, n), and what they are (n,)."""
    cameras = {
        each.name: replace(block.cameras[each.name], c=each.c, principal_point=each.principal_point, lens=each.lens)
        for each in base.cameras
    }
    block = replace(block, cameras={**block.cameras, **cameras})
    selection = select(block, Active.all_of(block))
    model = build_model(block, selection.images, selection.measured, selection.points)
    XYZ = dict(zip(base.points, base.XYZ))
    poses = dict(zip(base.images, base.poses))
    state = start_state(
        block,
        model.camera_names,
        model.strip_names,
        [poses[block.images[k].name] for k in model.image_rows],
        np.array([XYZ[name] for name in model.point_names]).reshape(-1, 3),
        model.sets,
    )
    rows, _ = linearise(model, state, np.ones(model.rows))
    A = np.hstack([rows.A_global.toarray(), rows.A_points.toarray()])
    lengths = np.linalg.norm(A, axis=0)
    Q, R, _ = linalg.qr(A / np.where(lengths > 0.0, lengths, 1.0), pivoting=True)
    diagonal = np.abs(np.diag(R))
    K = Q[:, int((diagonal > _RANK * diagonal.max(initial=0.0)).sum()) :]
    return model, K, K.T @ rows.e


@dataclass(frozen=True, eq=False)
class Solution:
    """The equations at the minimum and what follows from them."""

    model: Model
    state: State
    reduced: Reduced
    found: Residuals
    e: Floats
    """Residuals of all rows divided by the standard deviations that were stated."""
    weight: Floats
    """Weights of all rows, each by itself: 0 for those that are taken out."""
    inverse: Inverse | None
    """None: covariances were not asked for."""
    redundancies: Floats
    """Of each row; NaN without covariances."""
    point_cofactors: Floats
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

    def scales(self) -> Floats:
        """Standard deviation of each group's residuals in units of the stated ones, in a robust way."""
        kinds, of = kinds_of(self.model)
        out = np.ones(len(kinds))
        size = self.e / np.sqrt(np.clip(np.nan_to_num(self.redundancies, nan=1.0), 1e-3, 1.0))
        counted = (self.weight > 0) & (np.nan_to_num(self.redundancies, nan=1.0) > 0.05)
        for k in range(len(kinds)):
            out[k] = robust_scale(size[: len(of)][(of == k) & counted[: len(of)]], kinds[k])
        return out

    def normalised(self) -> Floats:
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

    def trusted(self, factors: Floats) -> Floats:
        """Factors that weights are made with: control is not taken for better than stated.

        Errors of control are often alike (one survey, one orthophoto); orientations then follow them, and residuals
        are small for that reason alone.
        """
        kinds, _ = kinds_of(self.model)
        control = np.array([name.startswith("control, ") for name, _ in kinds], bool)
        return np.asarray(np.where(control, np.maximum(factors, 1.0), factors))

    def factors(self, before: Floats | None = None) -> Floats:
        """Variance components of the groups; `before`: None is 1 for all. Orientations that are the datum keep 1."""
        kinds, of = kinds_of(self.model)
        used = self.weight[: len(of)] > 0
        start = np.ones(len(kinds)) if before is None else before
        found = variance_factors(self.e[: len(of)][used], self.redundancies[: len(of)][used], of[used], start)
        return np.where([name.startswith(DATUM) for name, _ in kinds], 1.0, found)


def solution_of(
    model: Model, state: State, weight: Floats, covariance: bool, effects: Floats | None = None
) -> Solution:
    """Equations, redundancy numbers and cofactors at a converged state."""
    rows, found = linearise(model, state, np.sqrt(weight))
    reduced = reduce_normals(rows, len(model.point_names))
    e = whitened(model, found)
    inverse = None
    redundancies, points = np.full(len(e), np.nan), np.full((len(model.point_names), 3, 3), np.nan)
    if covariance:
        try:
            inverse = Inverse(reduced)
        except GeometryError:
            check_rank(model, state, reduced)
            raise
        points, variance = inverse.variances()
        redundancies = np.clip(1.0 - variance, 0.0, 1.0)
    if covariance and effects is not None:
        common, _ = linearise(model, state, np.sqrt(weight / effects))
        own = reduced.V_inverse
        reduced = reduce_normals(common, len(model.point_names))
        inverse = Inverse(reduced)
        points, variance = inverse.variances()
        points = points - reduced.V_inverse + own
        others = slice(model.parts.image.stop, None)
        redundancies[others] = np.clip(1.0 - variance[others], 0.0, 1.0)
    return Solution(
        model=model,
        state=state,
        reduced=reduced,
        found=found,
        e=e,
        weight=weight,
        inverse=inverse,
        redundancies=redundancies,
        point_cofactors=points,
    )


#: Redundancy from which standard deviations of image points are fitted, classes of them, and the ratio of large to
#: small ones (deciles) below which they are all alike.
_FITTED, _CLASSES_RESULT, _ALIKE = 200.0, 8, 1.2


def evened_sigmas(model: Model) -> ImagePoints:
    """Image points of which each group has one standard deviation, to begin with, where stated ones differ.

    Nearer to what residuals show than those that matching states, see `refitted_sigmas`, which needs such a beginning.
    """
    seen, kinds = model.block.observations, kinds_of_measurements(model)
    sigma = seen.sigma.copy()
    for kind in np.unique(kinds[model.observation]):
        s = seen.sigma[kinds == kind]
        if s.size >= _FITTED and np.quantile(s, 0.9) >= _ALIKE * np.quantile(s, 0.1):
            sigma[kinds == kind] = np.median(s)
    return seen if np.array_equal(sigma, seen.sigma) else replace(seen, sigma=sigma)


def refitted_sigmas(solution: Solution, stated: Floats) -> ImagePoints:
    """Image points whose standard deviations have the form that residuals show, group by group: √(a s² + b).

    Matching states what noise makes of a patch's place; what it does not know of (relief inside of the patch, shutter,
    moving leaves) comes to all points alike. If it were scaled as well, a few points would get nearly all the weight,
    and formal accuracies would be too good. The median keeps its stated value: factors of the groups show the size.
    """
    model, seen = solution.model, solution.model.block.observations
    kinds = kinds_of_measurements(model)
    # What was taken out belongs to the form as well: points with the smallest s are the first to go.
    v = np.abs(residuals_of_all(model, solution.state))
    r = np.full_like(v, np.nan)
    r[model.observation] = np.nan_to_num(solution.redundancies[model.parts.image]).reshape(-1, 2)
    r[~np.isfinite(r)] = np.nanmean(r)
    sigma = stated.copy()
    for kind in np.unique(kinds[model.observation]):
        own = kinds == kind
        mine = own[:, None] & np.isfinite(v) & (r > 0.1)
        s, size, red = stated[mine], v[mine] / np.sqrt(r[mine]), r[mine]
        if red.sum() < _FITTED or np.quantile(s, 0.9) < _ALIKE * np.quantile(s, 0.1):
            continue
        classes = np.array_split(np.argsort(s, kind="stable"), _CLASSES_RESULT)
        square = np.array([(s[c] ** 2).mean() for c in classes])
        found = np.array([(np.median(size[c]) / MEDIAN_1D) ** 2 for c in classes])
        if not (found > 0).all():
            continue
        (a, b), _ = nnls(np.column_stack([square, np.ones(_CLASSES_RESULT)]) / found[:, None], np.ones(_CLASSES_RESULT))
        middle = float(np.median(s))
        sigma[own] = np.sqrt(a * stated[own] ** 2 + b) * (middle / np.sqrt(a * middle**2 + b))
    return seen if np.array_equal(sigma, seen.sigma) else replace(seen, sigma=sigma)


#: Found over stated accuracy below which the rest of what is stated is an error that all share; chance of as little
#: without one.
_BETTER, _CHANCE_RESULT = 0.7, 0.01


def with_common_errors(solution: Solution, factors: Floats) -> Block:
    """The block with an error that all observed positions share, and one of all attitudes, where residuals hide them.

    What all positions have in common leaves no residuals: it moves the block, or bends its camera. So of a stated
    variance what residuals show is each position's own, and the rest may be common.
    """
    block, (kinds, of) = solution.model.block, kinds_of(solution.model)
    hidden = {}
    for k, (name, _) in enumerate(kinds):
        r = float(solution.redundancies[: len(of)][of == k].sum())
        f2 = float(factors[k]) ** 2
        clear = f2 < _BETTER**2 and chance_chi_square(f2 * r, r) > 1.0 - _CHANCE_RESULT
        hidden[name] = float(np.sqrt(1.0 - f2)) if r > ENOUGH and clear else 0.0
    plane, height = (hidden.get(f"observed positions, {what}", 0.0) for what in ("horizontal", "height"))
    if block.positions is not None and block.drift == "none" and max(plane, height) > 0:
        s = np.median(block.positions.sigma, axis=0)
        x, y, z = np.maximum(s * [plane, plane, height], 1e-3 * s).tolist()
        block = replace(block, common=(x, y, z))
    turn = hidden.get("observed attitudes", 0.0)
    if block.attitudes is not None and not block.boresight and turn > 0:
        block = replace(block, boresight=True, boresight_sigma=turn * float(np.median(block.attitudes.sigma)))
    return block


@dataclass(frozen=True, eq=False)
class Weighted:
    """The last solution and how its observations were weighted."""

    solution: Solution
    factors: Floats
    """Standard deviation found over the one stated, of each group (`kinds_of`)."""
    correlations: tuple[Correlation, ...]


def result_of(selection: Selection, weighted: Weighted, active: Active, iterations: int) -> Adjusted:
    """The result as users see it."""
    solution = weighted.solution
    model, state = solution.model, solution.state
    residuals = residuals_of_all(model, state)
    redundancies, normalised = _of_measurements(solution, residuals)
    rejected = ~active.image
    ground_residuals, ground_normalised = _of_ground(solution)
    position_residuals, attitude_residuals = _of_direct(solution)
    sigma0 = solution.sigma0
    variance = sigma0**2 if np.isfinite(sigma0) else 1.0
    return Adjusted(
        images=model.image_names[: len(model.image_rows)],
        poses=state.poses(),
        pose_covariance=_covariances(solution, IMAGES, variance),
        pose_camera_covariance=_with_camera(solution, variance),
        cameras=_cameras(solution, variance),
        points=model.point_names,
        XYZ=state.XYZ,
        point_covariance=solution.point_cofactors * variance,
        rays=np.bincount(model.point, minlength=len(model.point_names)),
        left_out=selection.left_out,
        residuals=residuals,
        redundancies=redundancies,
        normalised=normalised,
        rejected=rejected,
        ground_residuals=ground_residuals,
        ground_normalised=ground_normalised,
        ground_rejected=~active.ground & np.isfinite(ground_residuals),
        position_residuals=position_residuals,
        position_rejected=~active.position,
        attitude_residuals=attitude_residuals,
        lever_arm=state.lever,
        lever_arm_sigma=_sigma(solution, LEVER, variance),
        boresight=rotation_vector(state.boresight),
        boresight_sigma=_sigma(solution, BORESIGHT, variance),
        strips=_strips(solution, variance),
        common=model.block.common,
        groups=_groups(solution, weighted.factors),
        sigma0=sigma0,
        redundancy=solution.redundancy,
        unknowns=model.columns.count + 3 * len(model.point_names),
        iterations=iterations,
        correlations=weighted.correlations,
        projections=tuple(p.name for p in model.projections),
        corrections=_corrections(solution, variance),
        by_prior=by_prior(model, state, solution.reduced.rows, solution.reduced.of_points),
    )


def _of_measurements(solution: Solution, residuals: Floats) -> tuple[Floats, Floats]:
    """Redundancy numbers and normalised residuals of all measurements."""
    model = solution.model
    redundancies = np.full_like(residuals, np.nan)
    normalised = np.full_like(residuals, np.nan)
    redundancies[model.observation] = solution.redundancies[model.parts.image].reshape(-1, 2)
    normalised[model.observation] = solution.normalised()[model.parts.image].reshape(-1, 2)
    # What was taken out is judged against the scale of its group; it had no part in the result.
    out = np.isfinite(residuals[:, 0])
    out[model.observation] = False
    if out.any():
        scale = solution.scales()[kinds_of_measurements(model)[out]]
        normalised[out] = residuals[out] / model.block.observations.sigma[out] / scale[:, None]
    return redundancies, normalised


def _of_ground(solution: Solution) -> tuple[Floats, Floats]:
    model = solution.model
    ground = model.block.ground
    points = {name: k for k, name in enumerate(model.point_names)}
    at = np.array([points.get(n, -1) for n in ground.names], np.int64)
    residuals = np.full((len(ground), 3), np.nan)
    residuals[at >= 0] = solution.state.XYZ[at[at >= 0]] - ground.XYZ[at >= 0]
    normalised = np.full((len(ground), 3), np.nan)
    normalised[model.ground, model.ground_axis] = solution.normalised()[model.parts.ground]
    # What was taken out is judged by how well its rays and its own coordinates are known, be these held fixed.
    out = solution.weight[model.parts.ground] == 0.0
    g, axis, p = model.ground[out], model.ground_axis[out], at[model.ground[out]]
    spread = np.hypot(np.nan_to_num(ground.sigma[g, axis]), np.sqrt(solution.point_cofactors[p, axis, axis]))
    normalised[g, axis] = residuals[g, axis] / (spread * (solution.sigma0 if solution.sigma0 > 0 else 1.0))
    return residuals, normalised


def _of_direct(solution: Solution) -> tuple[Floats, Floats]:
    model, block = solution.model, solution.model.block
    position = np.full((0 if block.positions is None else len(block.positions.images), 3), np.nan)
    position[model.position_row] = solution.found.position
    attitude = np.full((0 if block.attitudes is None else len(block.attitudes.images), 3), np.nan)
    attitude[model.attitude_row] = solution.found.attitude
    return position, attitude


def _covariances(solution: Solution, key: str, variance: float) -> Floats:
    """Covariances of all blocks of a kind, (n, w, w); (0, 0, 0) where it is no unknown."""
    kind = solution.model.columns.get(key)
    if kind is None:
        return np.empty((0, 0, 0))
    out = np.full((len(kind.owners), kind.width, kind.width), np.nan)
    for k in range(len(out) if solution.inverse is not None else 0):
        assert solution.inverse is not None
        out[k] = solution.inverse.block(kind.columns(k)) * variance
    return out


def _with_camera(solution: Solution, variance: float) -> tuple[Floats, ...]:
    """Covariances of each pose with the free parameters of its camera, (6, k)."""
    model = solution.model
    poses = model.columns.get(IMAGES)
    if poses is None:
        return ()
    out = []
    for k in range(len(model.image_rows)):
        camera = model.columns.get(f"camera {model.camera_names[model.camera_of[k]]}")
        if camera is None or solution.inverse is None:
            out.append(np.full((6, 0 if camera is None else camera.width), np.nan))
            continue
        both = solution.inverse.block(np.concatenate([poses.columns(k), camera.columns(0)]))
        out.append(both[:6, 6:] * variance)
    return tuple(out)


def _sigma(solution: Solution, key: str, variance: float) -> Floats:
    """Standard deviations of three unknowns; 0 where they are held fixed."""
    found = _covariances(solution, key, variance)
    return np.sqrt(np.diag(found[0])) if len(found) else np.zeros(3)


def _cameras(solution: Solution, variance: float) -> tuple[AdjustedCamera, ...]:
    found = []
    for name in solution.model.camera_names:
        camera = solution.state.camera(name)
        covariance = _covariances(solution, f"camera {name}", variance)
        found.append(
            AdjustedCamera(
                name=name,
                c=camera.c,
                principal_point=(camera.x0, camera.y0),
                lens=camera.lens,
                free=camera.free,
                covariance=covariance[0] if len(covariance) else np.empty((0, 0)),
            )
        )
    return tuple(found)


def _corrections(solution: Solution, variance: float) -> tuple[AdjustedCorrections, ...]:
    found = []
    for each in solution.model.sets:
        own = sparse.csr_matrix(each.known)
        # Rows of a single value are what is known of it alone.
        single = own[np.flatnonzero(np.diff(own.indptr) == 1)]
        weight = np.asarray(single.multiply(single).sum(axis=0)).ravel()
        with np.errstate(divide="ignore"):
            known = 1.0 / np.sqrt(weight)
        values = solution.state.corrections(each.key)
        covariance = _covariances(solution, each.key, variance)
        joint = _joint(solution, each, variance) if each.owner == "knot" else {}
        found.append(
            AdjustedCorrections(
                key=each.key, values=values, covariance=covariance, known=known.reshape(values.shape), joint=joint
            )
        )
    return tuple(found)


def _joint(solution: Solution, knots: Corrections, variance: float) -> dict[str, Floats]:
    """See `AdjustedCorrections.joint`."""
    model, out = solution.model, {}
    kind = model.columns.get(knots.key)
    if kind is None or solution.inverse is None:
        return {}
    for keys in model.keys:
        other = next((key for key in keys if key != knots.key), "")
        if knots.key not in keys or other in out:
            continue
        beside = model.columns.get(other)
        before = np.empty(0, np.int64) if beside is None else beside.columns(0)
        blocks = [
            solution.inverse.block(np.concatenate([before, *(kind.columns(k + j) for j in range(4))]))
            for k in range(len(kind.owners) - 3)
        ]
        out[other] = np.array(blocks) * variance
    return out


def _strips(solution: Solution, variance: float) -> tuple[AdjustedStrip, ...]:
    model = solution.model
    covariances = _covariances(solution, DRIFT, variance)
    sigma = np.full((len(model.strip_names), 6), np.nan)
    sigma[:, : covariances.shape[1]] = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)) if len(covariances) else 0.0
    return tuple(
        AdjustedStrip(name=name, shift=row[:3], rate=row[3:], epoch=float(epoch), sigma=s)
        for name, row, epoch, s in zip(model.strip_names, solution.state.drift, model.epochs, sigma)
    )


def _groups(solution: Solution, factors: Floats) -> tuple[Group, ...]:
    """Figures of each kind of observation."""
    model = solution.model
    kinds, of = kinds_of(model)
    if solution.inverse is None:
        factors = np.full(len(kinds), np.nan)
    raw = np.concatenate(
        [
            solution.found.image.ravel(),
            _of_ground(solution)[0][model.ground, model.ground_axis],
            solution.found.position.ravel(),
            solution.found.attitude.ravel(),
        ]
    )
    counted = solution.weight[: len(of)] > 0
    groups = []
    for k, (name, unit) in enumerate(kinds):
        mine = (of == k) & counted
        if mine.any():
            rms = float(np.sqrt((raw[mine] ** 2).mean()))
            r = float(solution.redundancies[: len(of)][mine].sum())
            factor = float(factors[k]) if r > ENOUGH else float("nan")
            groups.append(Group(name=name, count=int(mine.sum()), redundancy=r, rms=rms, unit=unit, factor=factor))
    return tuple(groups)
