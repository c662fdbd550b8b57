"""Bundle adjustment of a `Block`, on arrays without files: frame, the whole run, and causes of misfits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from photoplan.adjustment.statistics import chance_gain
from photoplan.arrays import Floats, Ints
from photoplan.cameras.curvature import Refraction, local_pose
from photoplan.cameras.framed import CurvatureCorrection
from photoplan.cameras.observed import GroundPoints, ObservedAttitudes, ObservedPositions
from photoplan.errors import GeometryError, PhotoplanError
from photoplan.geometry.heights import HeightStep
from photoplan.geometry.local import MEAN_RADIUS, LocalFrame, earth_radius
from photoplan.geometry.pose import Pose, angles_from_rotation, small_rotations
from photoplan.orientation.bundle.equations import check_rank, linearise, reduce_normals, residuals_of, whitened
from photoplan.orientation.bundle.model import (
    Active,
    Adjusted,
    AdjustSettings,
    Bend,
    Block,
    BlockCamera,
    BlockImage,
    Correlation,
    Model,
    State,
    build_model,
    start_state,
)
from photoplan.orientation.bundle.result import (
    Solution,
    Weighted,
    correlation_evidence,
    correlation_of,
    effects_of_rows,
    evened_sigmas,
    refitted_sigmas,
    result_of,
    solution_of,
    with_common_errors,
)
from photoplan.orientation.bundle.robust import (
    Loop,
    Progress,
    Selection,
    data_snooping,
    first_taken_out,
    judged_control,
    kinds_of_measurements,
    scales_of,
    select,
    start_points,
    weights_of,
)

#: Step for the derivatives of angles, radians.
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class BlockFrame:
    """From map X, Y and height (in the orientation's height system) to the block's system and back.

    Without a local system the map is taken for Cartesian, and the two are one.
    """

    crs: str
    local: LocalFrame | None
    """East, north, up near the block's middle, for strict earth curvature."""
    inward: HeightStep
    """From the orientation's height system to the one that is computed in."""
    outward: HeightStep

    def points(self, XYZ: ArrayLike) -> Floats:
        """Map points (..., 3) to block points; NaN where a coordinate is NaN and a local system mixes it in."""
        XYZ = np.array(XYZ, float)
        if self.local is None:
            return XYZ
        XYZ[..., 2] = self.inward(XYZ)
        return self.local.to_local(XYZ)

    def map_points(self, points: ArrayLike) -> Floats:
        """Block points (..., 3) to map points."""
        if self.local is None:
            return np.array(points, float)
        XYZ = self.local.to_map(points)
        XYZ[..., 2] = self.outward(XYZ)
        return XYZ

    def jacobian(self, XYZ: ArrayLike) -> Floats:
        """∂ block / ∂ map at map points (..., 3), shape (..., 3, 3); the height systems' own slope is left out."""
        XYZ = np.array(XYZ, float)
        if self.local is None:
            return np.broadcast_to(np.eye(3), (*XYZ.shape, 3)).copy()
        XYZ[..., 2] = self.inward(XYZ)
        return self.local.jacobian(XYZ)

    def map_covariance(self, covariance: Floats, XYZ: ArrayLike) -> Floats:
        """Covariances (..., 3, 3) of block coordinates as those of map coordinates, at map points."""
        if self.local is None:
            return np.array(covariance)
        back = np.linalg.inv(self.jacobian(XYZ))
        return back @ covariance @ np.swapaxes(back, -1, -2)

    def map_vectors(self, vectors: Floats, XYZ: ArrayLike) -> Floats:
        """Small vectors (..., 3) of block coordinates as those of map coordinates, at map points."""
        if self.local is None:
            return np.array(vectors)
        return np.asarray((np.linalg.inv(self.jacobian(XYZ)) @ vectors[..., None])[..., 0])

    def pose(self, pose: Pose) -> Pose:
        """Map pose, whose angles refer to the map's axes at the station, to a block pose."""
        if self.local is None:
            return pose
        center = np.array(pose.center)
        center[2] = self.inward(center)
        return local_pose(Pose(center, pose.R_ground_camera), self.local)

    def map_pose(self, pose: Pose) -> Pose:
        """Inverse of `pose`."""
        if self.local is None:
            return pose
        center = self.local.to_map(pose.center)
        R = self.local.axes(center).T @ pose.R_ground_camera
        center[2] = self.outward(center)
        return Pose(center, R)

    def ground(self, ground: GroundPoints, near: Floats) -> GroundPoints:
        """Ground points in the block's system."""
        if self.local is None:
            return ground
        known = np.isfinite(ground.XYZ)
        place = np.where(known, ground.XYZ, near)
        XYZ = np.where(known, self.points(place), np.nan)
        J = self.jacobian(place)
        variance = np.where(known, ground.sigma, 0.0) ** 2
        covariance = J @ (variance[..., None] * np.swapaxes(J, -1, -2))
        if ground.covariance is not None:
            covariance = J @ ground.covariance @ np.swapaxes(J, -1, -2)
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        covariance[~known.all(axis=1)] = np.nan
        return GroundPoints(
            names=ground.names, XYZ=XYZ, sigma=np.where(known, sigma, np.nan), check=ground.check, covariance=covariance
        )

    def positions(self, positions: ObservedPositions) -> ObservedPositions:
        """Observed positions in the block's system; covariances between coordinates are left out."""
        if self.local is None:
            return positions
        J = self.jacobian(positions.XYZ)
        sigma = np.sqrt((J**2 @ positions.sigma[..., None] ** 2)[..., 0])
        return ObservedPositions(
            images=positions.images,
            XYZ=self.points(positions.XYZ),
            sigma=sigma,
            strip=positions.strip,
            time=positions.time,
        )

    def attitudes(self, attitudes: ObservedAttitudes, centers: Floats) -> ObservedAttitudes:
        """Observed attitudes in the block's system; `centers` (n, 3) are the stations in the map."""
        if self.local is None:
            return attitudes
        at = np.array(centers)
        at[:, 2] = self.inward(at)
        R = self.local.axes(at) @ attitudes.R_ground_camera
        return ObservedAttitudes(attitudes.images, R, attitudes.sigma)


def angle_derivatives(R: Floats, order: str) -> Floats:
    """∂ angles / ∂ small rotations about the camera's x, y, z (R ← R · exp[δ]×), shape (3, 3), for an order of angles.

    By central differences; large where the angles are not determined (the second one near a right angle).
    """
    J = np.empty((3, 3))
    for axis, turn in enumerate(small_rotations(_STEP * np.eye(3))):
        difference = angles_from_rotation(R @ turn, order) - angles_from_rotation(R @ turn.T, order)
        J[:, axis] = (difference + np.pi) % (2 * np.pi) - np.pi
    return J / (2 * _STEP)


def make_bend(
    frame: BlockFrame,
    images: Sequence[BlockImage],
    cameras: Mapping[str, BlockCamera],
    nadir: Floats,
    curved: bool,
    refracted: bool,
) -> Bend | None:
    """What earth curvature (as a correction) and refraction add to the central projection; None if nothing.

    images: all of the block, in its order; nadir: height of the ground below each, metres; curved, refracted: which
    of them are to be regarded.
    """
    if not (curved or refracted):
        return None
    radii = [earth_radius(frame.crs, image.pose.center[:2]) if curved else MEAN_RADIUS for image in images]

    def warp_of(k: int, center: Floats) -> Callable[[Floats], Floats]:
        X, Y, Z = (float(v) for v in center)
        refract = Refraction((X, Y, Z)) if refracted else None
        curve = CurvatureCorrection((X, Y, Z), float(nadir[k]), radii[k] + float(nadir[k])) if curved else None

        def warp(points: Floats) -> Floats:
            points = points if refract is None else refract(points)
            return points if curve is None else curve(points)

        return warp

    def bend(image: Ints, poses: tuple[Pose, ...], points: Floats) -> Floats:
        on_map = points if frame.local is None else frame.local.to_map(points)
        shift = np.empty((len(points), 2))
        order = np.argsort(image, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(image[order])) + 1):
            if not len(part):
                continue
            k = int(image[part[0]])
            center = poses[k].center if frame.local is None else frame.local.to_map(poses[k].center)
            moved = warp_of(k, center)(on_map[part])
            moved = moved if frame.local is None else frame.local.to_local(moved)
            camera = cameras[images[k].camera]
            shift[part] = _pixels(images[k], camera, poses[k], moved) - _pixels(
                images[k], camera, poses[k], points[part]
            )
        return shift

    return bend


def _pixels(image: BlockImage, camera: BlockCamera, pose: Pose, points: Floats) -> Floats:
    p = pose.to_camera(points)
    t = p[:, :2] / np.where(p[:, 2] < 0, -p[:, 2], np.nan)[:, None]
    return image.plane_to_pixel(camera.c * camera.lens.distort(t) + np.array(camera.principal_point))


#: Points farther from the block than this, in units of its largest extent, begin anew.
_FAR = 10.0
#: Times that the robust start is made, each without the control that the one before has found wrong.
_AGAIN = 3
#: Rounds of data snooping, and of variance components.
_ROUNDS, _COMPONENTS = 8, 6
#: Rounds after which standard deviations of image points are fitted to residuals.
_REFITTED = 2


def adjust_block(block: Block, settings: AdjustSettings | None = None, progress: Progress | None = None) -> Adjusted:
    """Adjust a block of images, given as values and arrays.

    Parameters
    ----------
    block : Block
        In a Cartesian system.
    settings : AdjustSettings, optional
    progress : callable, optional
        Called after each iteration.

    Raises
    ------
    GeometryError
        The observations do not determine the unknowns; the message names them. Or no image has enough points, or the
        iterations do not converge.
    InputError, UsageError
        A standard deviation is missing, or a parameter cannot be free.
    """
    settings = settings or AdjustSettings()
    loop = Loop(settings.iterations, progress or (lambda number, rms: None))
    active = Active.all_of(block)
    alternative: tuple[str, ...] = ()
    selection, XYZ, lost = _selected(block, active, frozenset(), wait=settings.robust)
    model = build_model(block, selection.images, selection.measured, selection.points)
    stated, refit = block.observations.sigma, settings.variance_components and settings.covariance
    if refit:
        block = replace(block, observations=evened_sigmas(model))
        model = build_model(block, selection.images, selection.measured, selection.points)
    state = _started(model, XYZ)
    _check(model, state, active)
    passes: list[tuple[State, Active, tuple[str, ...]]] = []
    for _ in range(_AGAIN if settings.robust else 0):
        state = loop.run(model, state, weights_of(model, active), robust=True)
        found = first_taken_out(model, state, replace(Active.all_of(block), ground=active.ground), settings.critical)
        factors = scales_of(model, whitened(model, residuals_of(model, state)))
        found, alternative = judged_control(model, state, found, factors, settings.critical)
        again, active = bool((active.ground & ~found.ground).any()), found
        if not again:
            active = _returned(model, state, active, factors, settings.critical)
            break
        passes.append((state, active, alternative))
    else:
        # Judgements that do not settle: the one that most measurements fit, of equal ones the first.
        if passes:
            state, active, alternative = max(passes, key=lambda item: int(item[1].image.sum()))
    for turn in range(_ROUNDS):
        loose = frozenset() if turn == 0 else lost
        while True:
            model, state, selection, lost = _rebuilt(block, model, state, active, loose)
            state, loose = loop.watched(model, state, weights_of(model, active))
            if not loose:
                break
            loose |= lost
        solution = solution_of(model, state, weights_of(model, active), settings.covariance)
        if refit and turn < _REFITTED:
            block = replace(block, observations=refitted_sigmas(solution, stated))
        if not settings.robust or turn == _ROUNDS - 1:
            break
        judged = solution.judged()
        next_active = data_snooping(model, state, judged, active, settings.critical)
        next_active, alternative = judged_control(model, state, next_active, judged.scales, settings.critical)
        as_weighted = block.observations is model.block.observations
        if next_active.equals(active) and (as_weighted or turn >= _REFITTED):
            break
        active = next_active
    if block.observations is not model.block.observations:
        model, state, selection, lost = _rebuilt(block, model, state, active, lost)
        state = loop.run(model, state, weights_of(model, active))
        solution = solution_of(model, state, weights_of(model, active), settings.covariance)
    weighted = _weighted(loop, solution, selection, active, settings)
    check_rank(model, weighted.solution.state, weighted.solution.reduced)
    return replace(result_of(selection, weighted, active, loop.count), other_control=alternative)


def _weighted(
    loop: Loop, solution: Solution, selection: Selection, active: Active, settings: AdjustSettings
) -> Weighted:
    """The solution with the accuracies that residuals show: variance components, and correlated image points.

    Positions and attitudes that agree among each other far better than stated may all be off by the rest.
    """
    model, state = solution.model, solution.state
    correlations: tuple[Correlation, ...] = ()
    if settings.correlation and settings.covariance:
        image = model.parts.image
        used = solution.weight[image][::2] > 0
        correlations = correlation_of(model, solution.normalised()[image].reshape(-1, 2), used)
    effects = effects_of_rows(model, correlations, len(solution.e)) if correlations else None
    factors: Floats | None = None
    common = False
    for _ in range(2 * _COMPONENTS):
        if settings.variance_components and settings.covariance:
            factors = solution.trusted(solution.factors(factors))
        elif effects is None:
            break
        weight = weights_of(model, active, factors)
        state = loop.run(model, state, weight if effects is None else weight / effects)
        solution = solution_of(model, state, weight, settings.covariance, effects)
        if factors is not None and not np.allclose(solution.trusted(solution.factors(factors)), factors, rtol=0.02):
            continue
        block = model.block if factors is None or common else with_common_errors(solution, factors)
        if block is model.block:
            break
        common = True
        model = build_model(block, selection.images, selection.measured, selection.points)
        if effects is not None:
            effects = effects_of_rows(model, correlations, model.rows)
        solution = solution_of(model, state, weights_of(model, active, factors), settings.covariance, effects)
    return Weighted(solution, solution.factors(factors), correlations)


def _selected(
    block: Block, active: Active, lost: frozenset[str], wait: bool = False
) -> tuple[Selection, Floats, frozenset[str]]:
    """What takes part, start values of its points, and the points whose rays are parallel."""
    while True:
        selection = select(block, active, lost)
        if not selection.images or not selection.points:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in selection.left_out[:5])
            raise GeometryError(
                f"no image has enough measured points to be adjusted ({reasons or 'no measurements'}); are image "
                "points and images of the same block?"
            )
        XYZ, parallel = start_points(block, selection, wait)
        if not parallel:
            return selection, XYZ, lost
        lost |= parallel


def _check(model: Model, state: State, active: Active) -> None:
    """Refuse at once what nothing determines; start values with points behind cameras say nothing of that yet."""
    weight = weights_of(model, active)
    if not np.isfinite(whitened(model, residuals_of(model, state))[weight > 0]).all():
        return
    rows, _ = linearise(model, state, np.sqrt(weight))
    check_rank(model, state, reduce_normals(rows, len(model.point_names)))


def _rebuilt(
    block: Block, model: Model, state: State, active: Active, lost: frozenset[str], anew: bool = False
) -> tuple[Model, State, Selection, frozenset[str]]:
    """The model without what was taken out; unknowns keep their values, points that come back are intersected.

    Rays that are left may be parallel, so that points can be lost here too. With `anew` all points are intersected.
    """
    poses = dict(zip(model.image_names, state.poses()))
    block = replace(block, images=tuple(replace(b, pose=poses.get(b.name, b.pose)) for b in block.images))
    selection, XYZ, lost = _selected(block, active, lost)
    made = build_model(block, selection.images, selection.measured, selection.points)
    before = {name: k for k, name in enumerate(model.point_names)}
    old = np.array([before.get(n, -1) for n in made.point_names], np.int64)
    # What wrong rays have driven far away is intersected anew, without them.
    from_where = state.images.centers if len(state.images.centers) else XYZ
    middle = from_where.mean(axis=0)
    reach = _FAR * np.linalg.norm(np.concatenate([XYZ, from_where]) - middle, axis=1).max()
    old[anew | (np.linalg.norm(state.XYZ[old] - middle, axis=1) > reach)] = -1
    XYZ[old >= 0] = state.XYZ[old[old >= 0]]
    return made, state.carried(_started(made, XYZ)), selection, lost


def _returned(model: Model, state: State, active: Active, factors: Floats, critical: float) -> Active:
    """Points that have lost most of their rays while orientations were poor, and that fit now that they are good."""
    seen = model.block.observations
    left = np.bincount(seen.point[active.image], minlength=len(seen.points))
    few = left < np.maximum(2.0, 0.6 * np.bincount(seen.point, minlength=len(seen.points)))
    tried = replace(active, image=active.image | few[seen.point])
    made, started, _, parallel = _rebuilt(model.block, model, state, tried, frozenset(), anew=True)
    scale = factors[kinds_of_measurements(made)[made.observation]]
    e = np.abs(residuals_of(made, started).image / made.sigma).max(axis=1) / scale
    worst = np.zeros(len(made.point_names))
    np.maximum.at(worst, made.point, np.nan_to_num(e, nan=np.inf))
    image = active.image.copy()
    image[made.observation[worst[made.point] < critical]] = True
    image |= (few & np.array([name in parallel for name in seen.points], bool))[seen.point]
    return replace(active, image=image)


def _started(model: Model, XYZ: Floats) -> State:
    poses = [model.block.images[k].pose for k in model.image_rows]
    return start_state(model.block, model.camera_names, model.strip_names, poses, XYZ, model.sets)


#: Plain least squares of all that is not a gross error of an image point: nothing is thrown out, nothing reweighted.
_PLAIN = AdjustSettings(robust=False, variance_components=False, correlation=False, covariance=False)
#: Chance and part of the sum of squares from which a cause is named.
_CHANCE, _EXPLAINS = 1e-6, 0.3
#: Part of the sum of squares that a cause with more unknowns must explain beyond one with less.
_MORE = 0.1
#: Ratio of found to stated accuracy from which one asks for causes, and redundancy that the ratio needs.
_RATIO, _SOUND = 1.4, 15.0


@dataclass(frozen=True)
class Cause:
    """A model in which the observations fit better."""

    name: str
    """As users call it."""
    explains: float
    """Part of what does not fit that it takes away, 0 to 1."""
    change: float
    """By how much a camera constant changes, as a part of it; 0 for other causes."""
    remedy: str
    """What would regard it."""
    measure: str = "squared residuals"
    """What it takes away a part of; accuracies are weighed by the deviance, −2 times the logarithm of likelihood."""


def doubtful(result: Adjusted) -> bool:
    """Whether control or positions were thrown out, or accuracies are far from what was stated."""
    rejected = result.ground_rejected.any() or result.position_rejected.any()
    ratios = [g.factor for g in result.groups if g.redundancy > _SOUND and np.isfinite(g.factor)]
    return bool(rejected or any(ratio > _RATIO for ratio in ratios))


def misfit_hypotheses(block: Block, result: Adjusted) -> tuple[Cause, ...]:
    """Causes that explain a good part of what does not fit, the likeliest first; empty where all is as stated.

    Each is an adjustment of the block with other unknowns, all control and positions included. It is named where
    unknowns without meaning would hardly lower the sum of squares as much (F-test). What the best of them leaves is
    weighed as errors of image points that are alike, and as other accuracies than stated, by their likelihood.
    """
    if not doubtful(result):
        return ()
    poses = dict(zip(result.images, result.poses))
    used = np.isfinite(result.residuals[:, 0]) & ~result.rejected
    start = replace(
        block,
        images=tuple(replace(image, pose=poses[image.name]) for image in block.images if image.name in poses),
        observations=block.observations.where(used),
    )
    try:
        base = adjust_block(start, _PLAIN)
    except PhotoplanError:
        return ()
    whole = base.sigma0**2 * base.redundancy
    found: list[tuple[Cause, int, Block, Adjusted]] = []
    for name, remedy, other in _models(start):
        try:
            tried = adjust_block(other, _PLAIN)
        except PhotoplanError:
            continue
        rest, more = tried.sigma0**2 * tried.redundancy, tried.unknowns - base.unknowns
        if more <= 0 or tried.redundancy <= 0 or not rest < whole:
            continue
        if chance_gain(whole, rest, more, tried.redundancy) < _CHANCE and (whole - rest) / whole > _EXPLAINS:
            changes = [a.c / block.cameras[a.name].c - 1 for a in tried.cameras if "c" in a.free]
            change = max(changes, key=abs, default=0.0) if "constant" in name else 0.0
            found.append((Cause(name, (whole - rest) / whole, change, remedy), more, other, tried))
    # A simpler cause that explains nearly as much is the likelier one.
    best = max((cause.explains for cause, *_ in found), default=0.0)
    found.sort(key=lambda item: (item[0].explains < best - _MORE * (1 - best) - 0.02, item[1], -item[0].explains))
    other, tried = found[0][2:] if found else (start, base)
    return (*(cause for cause, *_ in found), *_of_errors(other, tried, result))


def _of_errors(block: Block, base: Adjusted, result: Adjusted) -> tuple[Cause, ...]:
    """Other errors than stated: of image points that are alike, or larger ones of what else was observed.

    Control that does not agree with the rest is wrong by itself, and has no part in this.
    """
    XYZ = np.where(result.ground_rejected, np.nan, block.ground.XYZ)
    likeness = correlation_evidence(replace(block, ground=replace(block.ground, XYZ=XYZ)), base)
    if likeness is None:
        return ()
    found = []
    if likeness.alike:
        name = (
            f"errors of image points that are alike over about {float(f'{likeness.reach:.2g}'):.0f} px "
            f"({likeness.share:.0%} of their variance)"
        )
        remedy = (
            "look at the lens, the film and how points were measured; with many more points in each image the "
            "adjustment regards it"
        )
        found.append(Cause(name=name, explains=likeness.by_likeness, change=0.0, remedy=remedy, measure="deviance"))
    if likeness.worse:
        groups = ", ".join(f"{name} ({times:.1f} times)" for name, times in likeness.worse)
        name = f"errors that are larger than stated: {groups}"
        found.append(
            Cause(
                name=name,
                explains=likeness.by_accuracy,
                change=0.0,
                remedy="state their accuracy as it is",
                measure="deviance",
            )
        )
    return tuple(sorted(found, key=lambda cause: -cause.explains))


def _models(block: Block) -> Iterator[tuple[str, str, Block]]:
    """Other models of a block: name, remedy, block."""
    for name, camera in block.cameras.items():
        for what, parameters in (("camera constant", ("c",)), ("principal point", ("x0", "y0"))):
            if not set(parameters) <= set(camera.free):
                free = tuple(dict.fromkeys((*camera.free, *parameters)))
                cameras = {**block.cameras, name: replace(camera, free=free)}
                remedy = f"calibrate {', '.join(parameters)} of camera {name!r}, or state what is right"
                yield f"the {what} of camera {name!r}", remedy, replace(block, cameras=cameras)
    positions = block.positions
    if positions is None or block.drift == "linear":
        return
    if block.drift == "none":
        together = replace(positions, strip=("all",) * len(positions.images))
        remedy = "check datum, heights and antenna of the observed positions"
        yield (
            "a common shift of the observed positions (datum)",
            remedy,
            replace(block, positions=together, drift="shift"),
        )
        yield (
            "a shift of the observed positions in each strip",
            'drift = "shift" in [adjustment]',
            replace(block, drift="shift"),
        )
    yield (
        "a drift of the observed positions in each strip",
        'drift = "linear" in [adjustment]',
        replace(block, drift="linear"),
    )
