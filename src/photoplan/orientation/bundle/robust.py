"""Observations that do not fit: their weights while iterating, and which are taken out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import MEDIAN_1D, MEDIAN_2D, geman_mcclure, huber, spread
from photoplan.orientation.bundle.block import Active
from photoplan.orientation.bundle.control import agreeing, misclosures
from photoplan.orientation.bundle.model import Model
from photoplan.orientation.bundle.rows import residuals_of, residuals_of_all, whitened
from photoplan.orientation.bundle.unknowns import State

_Floats = NDArray[np.float64]

#: Kinds of rows: what a group of observations is called, and the unit of its residuals.
Kinds = tuple[tuple[str, str], ...]

#: Approximate orientations that place the block, as messages call them.
DATUM = "datum from orientations"
#: Standard deviation of softened control in units of an image point's on the ground.
_SOFT = 3.0
#: Iterations with Huber's weights before gross errors may lose all influence.
_HUBER = 5
#: Where the weights begin to fall, in standard deviations.
_HUBER_LIMIT, _FALL = 2.0, 3.0
#: Standard deviation of control in the same units while it is asked which of it agrees.
_LOOSE = 100.0
#: Image points are not judged by less than this part of their stated standard deviation, however small residuals are.
_BEST = 0.05
#: An observation that was taken out comes back when its residual is below this part of the critical value.
_BACK = 0.75


@dataclass(frozen=True, eq=False)
class Judged:
    """What data snooping looks at, of all rows."""

    e: _Floats
    """Residuals divided by the standard deviations that were stated."""
    normalised: _Floats
    """Residuals divided by their own standard deviations."""
    weight: _Floats
    scales: _Floats
    """Of each group (`kinds_of`): standard deviation of its residuals in units of the stated ones."""


def kinds_of(model: Model) -> tuple[Kinds, NDArray[np.int64]]:
    """Groups of observations, and the group of each row; rows of what is known beforehand are not listed.

    Control and check points are measured otherwise than tie points (by hand, say), so they are groups of their own.
    """
    kinds: list[tuple[str, str]] = [(f"image points, {name}", "px") for name in model.groups]
    kinds += [(f"control and check points in images, {name}", "px") for name in model.groups]
    of = [np.repeat(kinds_of_measurements(model)[model.observation], 2)]
    at = len(kinds)
    kinds += [("control, horizontal", "m"), ("control, height", "m")]
    of.append(at + (model.ground_axis == 2))
    block = model.block
    if block.positions is not None:
        at = len(kinds)
        what = DATUM if block.datum else "observed positions"
        kinds += [(f"{what}, horizontal", "m"), (f"{what}, height", "m")]
        of.append(np.tile([at, at, at + 1], len(model.position)))
    if block.attitudes is not None:
        kinds.append((f"{DATUM}, angles" if block.datum else "observed attitudes", "rad"))
        of.append(np.full(3 * len(model.attitude), len(kinds) - 1))
    return tuple(kinds), np.concatenate(of).astype(np.int64)


def kinds_of_measurements(model: Model) -> NDArray[np.int64]:
    """Group of every measurement of the block, also of those that take no part; −1: its image takes none."""
    seen = model.block.observations
    groups = {name: k for k, name in enumerate(model.groups)}
    of_image = {b.name: groups.get(f"camera {b.camera}", -1) for b in model.block.images}
    of_image |= {p.name: groups.get(p.group, -1) for p in model.block.projections}
    camera = np.array([of_image.get(n, -1) for n in seen.images], np.int64)[seen.image]
    names = set(model.block.ground.names)
    surveyed = np.array([n in names for n in seen.points], bool)[seen.point]
    return np.where(camera < 0, -1, camera + len(groups) * surveyed)


def weights_of(model: Model, active: Active, factors: _Floats | None = None) -> _Floats:
    """Weights of all rows: 0 for what is taken out, 1 / factor² for its group's variance factor."""
    weight = np.ones(model.rows)
    if factors is not None:
        weight[: model.observed] = 1.0 / factors[kinds_of(model)[1]] ** 2
    weight[model.parts.ground] *= active.ground[model.ground, model.ground_axis]
    weight[model.parts.position] *= np.repeat(active.position[model.position_row], 3)
    return weight


def softened(model: Model, state: State) -> _Floats:
    """Weights that make control no better than what image points say of the ground, while gross errors are sought.

    A wrong control point of high weight would otherwise draw its image points along, and these would look wrong.
    """
    out = np.ones(model.rows)
    blur = _SOFT * image_on_ground(model, state)
    sigma = 1.0 / np.linalg.norm(model.ground_white, axis=1)
    out[model.parts.ground] = sigma**2 / (sigma**2 + blur**2)
    return out


def image_on_ground(model: Model, state: State) -> float:
    """Standard deviation of an image point on the ground, metres; the median."""
    size = [model.sigma[mine].mean(axis=1) * p.metres for p, _, mine in model.of_projections]
    model = model.posed
    distance = np.linalg.norm(state.XYZ[model.point] - state.images.centers[model.image], axis=1)
    pixel = np.sqrt(np.abs(model.plane[:, 0] * model.plane[:, 5] - model.plane[:, 1] * model.plane[:, 4]))
    c = np.array([state.camera(name).c for name in model.camera_names])[model.camera_of[: len(pixel)]] * pixel
    return float(np.median(np.concatenate([model.sigma.mean(axis=1) * distance / c[model.image], *size])))


def robust_scale(e: _Floats, kind: tuple[str, str]) -> float:
    """Standard deviation of a group's whitened residuals, that one in five gross errors hardly moves.

    Image points may be better than stated. Control, positions and attitudes may not: many of them are checked so little
    that their residuals are small for that reason alone. Fewer than 20 residuals count as stated: 1.
    """
    e = e[np.isfinite(e)]
    if len(e) < 20:
        return 1.0
    return max(spread(e), _BEST if kind[1] == "px" else 1.0)


def _joined(e: _Floats, kind: tuple[str, str]) -> _Floats:
    """Whitened residuals of a group, each coordinate of an image point replaced by what its length makes of it.

    Points of two rays have no residuals along the base, so that half of all coordinates would be small.
    """
    if kind[1] != "px":
        return e
    length: _Floats = np.linalg.norm(e.reshape(-1, 2), axis=1)
    return np.repeat(length * (MEDIAN_1D / MEDIAN_2D), 2)


def robust_weights(model: Model, e: _Floats, turn: int) -> _Floats:
    """Weights that fall with the residual: Huber's at first, then Geman and McClure's.

    Both coordinates of an image point, and all of an observed position, have one weight.
    """
    size = _sizes(model, e)
    weight = np.ones(len(e))
    kinds, of = kinds_of(model)
    stretch = _stretch(model)
    for k in range(len(kinds)):
        mine = np.flatnonzero(of == k)
        # Sizes of two or three coordinates are longer than single ones; the scale is that of the single ones.
        s = size[mine] / (robust_scale(_joined(e[mine], kinds[k]), kinds[k]) * stretch)
        weight[mine] = huber(s, _HUBER_LIMIT) if turn < _HUBER else geman_mcclure(s, _FALL)
    return np.nan_to_num(weight)


def scales_of(model: Model, e: _Floats) -> _Floats:
    """Standard deviation of the errors of each group (`kinds_of`), of whitened residuals, in a robust way."""
    kinds, of = kinds_of(model)
    own = e[: len(of)]
    return np.array([robust_scale(_joined(own[of == k], kind), kind) for k, kind in enumerate(kinds)]) * _stretch(model)


def _stretch(model: Model) -> float:
    """How much longer errors are than residuals, in the mean: unknowns take a part of the errors."""
    rows = model.observed
    unknowns = model.columns.count + 3 * len(model.point_names)
    return float(np.sqrt(rows / max(rows - unknowns, 0.05 * rows)))


def _sizes(model: Model, e: _Floats) -> _Floats:
    """Length of the whitened residual that each row is part of, in units of one coordinate's."""
    size = np.abs(e)
    for part, n in ((model.parts.image, 2), (model.parts.position, 3)):
        size[part] = np.repeat(np.sqrt((e[part].reshape(-1, n) ** 2).mean(axis=1)), n)
    return size


def first_taken_out(model: Model, state: State, active: Active, critical: float) -> Active:
    """Take out what does not fit the robust estimate at `state`."""
    e = whitened(model, residuals_of(model, state)) * np.sqrt(softened(model, state))
    size, of = np.abs(e), kinds_of(model)[1]
    size[: len(of)] /= scales_of(model, e)[of]
    size[~np.isfinite(size)] = np.inf
    # Where residuals are small beside the errors this is too strict, so it takes twice as much here; data snooping does
    # the rest.
    bad = size[: len(of)] > 2.0 * critical
    # Gross errors are few. Where most positions look wrong the robust estimate has lost them, and snooping will tell.
    wrong = bad[model.parts.position].reshape(-1, 3).any(axis=1)
    if 2 * np.count_nonzero(wrong) > wrong.size:
        bad[model.parts.position] = False
    # Control is judged afterwards, as a set (`judged_control`).
    return _without(model, active, bad)


def judged_control(
    model: Model, state: State, active: Active, factors: _Floats, critical: float
) -> tuple[Active, tuple[str, ...]]:
    """Control of which the largest set agrees, and the names of the largest other set.

    `factors` are the standard deviations of the groups' residuals (`kinds_of`) in units of the stated ones.
    """
    control = np.array([name.startswith("control, ") for name, _ in kinds_of(model)[0]], bool)
    weight = weights_of(model, active, np.where(control, 1.0, factors))
    used = active.image[model.observation]
    # A tie point of one ray says nothing, and its equations are singular.
    alone = np.bincount(model.point[used], minlength=len(model.point_names)) < 2
    alone[model.ground_point] = False
    weight[model.parts.image] *= np.repeat(used & ~alone[model.point], 2)
    found = misclosures(model, state, weight, _LOOSE * image_on_ground(model, state))
    if found is None:
        return active, ()
    result = agreeing(found, active.ground, critical)
    return replace(active, ground=result.kept), tuple(model.block.ground.names[k] for k in result.alternative)


def _without(model: Model, active: Active, bad: NDArray[np.bool_]) -> Active:
    """Take out the observations whose rows are bad."""
    image, position = active.image.copy(), active.position.copy()
    image[model.observation[bad[model.parts.image].reshape(-1, 2).any(axis=1)]] = False
    position[model.position_row[bad[model.parts.position].reshape(-1, 3).any(axis=1)]] = False
    return Active(image, active.ground, position)


def snooped(model: Model, state: State, judged: Judged, active: Active, critical: float) -> Active:
    """Data snooping: the worst measurement of each point is taken out, and what fits again comes back.

    Only the largest normalised residual of a point is judged at a time, since a gross error spreads over the
    residuals of its point's other measurements.
    """
    _, of = kinds_of(model)
    size = np.nan_to_num(np.abs(judged.normalised[: len(of)]))
    size[judged.weight[: len(of)] == 0] = 0.0
    on = slice(0, model.parts.ground.stop)
    bad = size > critical
    bad[model.parts.ground] = False
    point = np.concatenate([np.repeat(model.point, 2), model.ground_point])
    worst = np.zeros(len(model.point_names))
    np.maximum.at(worst, point, size[on])
    bad[on] &= size[on] >= worst[point]
    out = _without(model, active, bad)
    return _brought_back(model, state, judged, active, out, critical * _BACK)


def _brought_back(model: Model, state: State, judged: Judged, before: Active, after: Active, limit: float) -> Active:
    """Observations that were out before and fit now."""
    block, scales = model.block, judged.scales
    _, of = kinds_of(model)
    residuals = residuals_of_all(model, state)
    image = after.image.copy()
    kind = kinds_of_measurements(model)
    with np.errstate(invalid="ignore"):
        size = np.abs(residuals / block.observations.sigma).max(axis=1) / scales[kind]
    image |= ~before.image & (kind >= 0) & (np.nan_to_num(size, nan=np.inf) < limit)
    position = after.position.copy()
    off = np.abs(judged.e[: len(of)]) / scales[of]
    fits = off[model.parts.position].reshape(-1, 3).max(axis=1) < limit
    position[model.position_row[fits & ~before.position[model.position_row]]] = True
    return Active(image, after.ground, position)
