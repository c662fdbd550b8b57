"""Linear prediction (collocation, kriging): covariance functions, systems of patches, gross errors, breaklines."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.jit import inner, kernel

# Sides of breaklines, as coordinates of points.
#
# A line of constant sign cannot tell the two sides of a line that ends: around its end one gets from one side to the
# other. The angle that a line subtends, seen from a point and counted with its sign, does: it jumps by 2π across the
# line and passes smoothly through all values around the end. The sine of half of it lies in [−1, 1] and changes by 2
# across the middle of a line. Used as further coordinates in the distance of a covariance function, one for each line,
# it separates the sides and leaves every covariance matrix positive definite (design/007).


@kernel
def sides_of(xy: NDArray[Any], vertices: NDArray[Any], start: NDArray[Any], pieces: int, result: NDArray[Any]) -> None:
    """result[i, l] = sin(θ/2) of point i and piece l; vertices of piece l are vertices[start[l]:start[l + 1]].

    e^{iα/2} of every segment's angle α in (−π, π) is multiplied up: θ is then followed over several turns without an
    inverse function.
    """
    for line in range(pieces):
        first, last = start[line], start[line + 1]
        for i in range(xy.shape[0]):
            re, im = 1.0, 0.0
            ax, ay = vertices[first, 0] - xy[i, 0], vertices[first, 1] - xy[i, 1]
            ra = np.sqrt(ax * ax + ay * ay)
            for k in range(first + 1, last):
                bx, by = vertices[k, 0] - xy[i, 0], vertices[k, 1] - xy[i, 1]
                rb = np.sqrt(bx * bx + by * by)
                # Half-angle: cos(α/2) ~ rr + a·b, sin(α/2) ~ a×b, both over the same length.
                c = ra * rb + ax * bx + ay * by
                s = ax * by - ay * bx
                length = np.sqrt(c * c + s * s)
                if length > 0.0:
                    c, s = c / length, s / length
                    re, im = re * c - im * s, re * s + im * c
                ax, ay, ra = bx, by, rb
            result[i, line] = im


@kernel
def clip_lines(
    lines: NDArray[Any], start: NDArray[Any], box: NDArray[Any], out: NDArray[Any], out_start: NDArray[Any]
) -> int:
    """The parts of lines that pass a box, prolonged far outwards where they leave it; returns the number of pieces.

    Parameters
    ----------
    lines : ndarray, shape (v, 2)
        Vertices of all lines; line l has lines[start[l]:start[l + 1]].
    box : ndarray, shape (4,)
        xmin, ymin, xmax, ymax.
    out, out_start : ndarrays
        Receive the vertices and beginnings of the pieces; what finds no room is left out.
    """
    far = 20.0 * max(box[2] - box[0], box[3] - box[1])
    pieces, count = 0, 0
    out_start[0] = 0
    for line in range(len(start) - 1):
        inside = False
        for k in range(start[line], start[line + 1] - 1):
            ax, ay, bx, by = lines[k, 0], lines[k, 1], lines[k + 1, 0], lines[k + 1, 1]
            meets = max(ax, bx) >= box[0] and min(ax, bx) <= box[2] and max(ay, by) >= box[1] and min(ay, by) <= box[3]
            if meets and not inside:
                if pieces + 2 > len(out_start) or count + 4 > len(out):
                    return pieces
                inside = True
                if k > start[line]:
                    scale = far / max(np.hypot(bx - ax, by - ay), 1e-9)
                    out[count, 0], out[count, 1] = ax - scale * (bx - ax), ay - scale * (by - ay)
                    count += 1
                out[count, 0], out[count, 1] = ax, ay
                count += 1
            if inside and meets:
                if count + 2 > len(out):
                    out_start[pieces + 1] = count
                    return pieces + 1
                out[count, 0], out[count, 1] = bx, by
                count += 1
            last = k == start[line + 1] - 2
            if inside and (last or not meets):
                if not meets:  # the segment before this one was the last that met the box
                    px, py = lines[k - 1, 0], lines[k - 1, 1]
                    scale = far / max(np.hypot(ax - px, ay - py), 1e-9)
                    out[count, 0], out[count, 1] = ax + scale * (ax - px), ay + scale * (ay - py)
                    count += 1
                pieces += 1
                out_start[pieces] = count
                inside = False
    return pieces


# Linear algebra and covariance functions of linear prediction, on small dense systems.
#
# Own routines instead of a library's: the systems are small, thousands of them are solved at once by threads, and
# libraries start threads of their own there.


GAUSSIAN, MATERN, EXPONENTIAL = 0, 1, 2
"""Families of covariance functions, from the smoothest surface to the roughest."""

_LN2 = 0.6931471805599453
_MATERN_HALF = 1.6783469900166605
"""Argument at which (1 + t) exp(−t) is one half."""


@inner
def correlation(d2: float, family: int) -> float:
    """Correlation at squared distance `d2`, in units of the half-value distance: ½ at 1 for every family.

    Gaussian exp(−t²), Matérn 3/2 (1 + t) exp(−t), exponential exp(−t).
    """
    if family == GAUSSIAN:
        return np.exp(-_LN2 * d2)
    d = np.sqrt(d2)
    if family == MATERN:
        return (1.0 + _MATERN_HALF * d) * np.exp(-_MATERN_HALF * d)
    return np.exp(-_LN2 * d)


@kernel
def factorise(a: NDArray[Any]) -> bool:
    """Replace the upper triangle of a symmetric matrix by U with UᵀU = a; False if it is not positive definite.

    Rows are eliminated four at a time, so that each number of the rest is loaded once for four of them.
    """
    n = a.shape[0]
    k = 0
    while k < n:
        stop = min(k + 4, n)
        for p in range(k, stop):
            for q in range(k, p):
                f = a[q, p]
                for j in range(p, n):
                    a[p, j] -= f * a[q, j]
            pivot = a[p, p]
            if not pivot > 0.0:
                return False
            scale = 1.0 / np.sqrt(pivot)
            for j in range(p, n):
                a[p, j] *= scale
        if stop - k == 4:
            for i in range(stop, n):
                f0, f1, f2, f3 = a[k, i], a[k + 1, i], a[k + 2, i], a[k + 3, i]
                for j in range(i, n):
                    a[i, j] -= f0 * a[k, j] + f1 * a[k + 1, j] + f2 * a[k + 2, j] + f3 * a[k + 3, j]
        k = stop
    return True


@kernel
def solve_transposed(u: NDArray[Any], b: NDArray[Any]) -> None:
    """Replace b, shape (n, m), by U⁻ᵀ b; all right-hand sides at once, so that the inner loop is long."""
    n, m = b.shape
    k = 0
    while k < n:
        stop = min(k + 4, n)
        for p in range(k, stop):
            for q in range(k, p):
                f = u[q, p]
                for j in range(m):
                    b[p, j] -= f * b[q, j]
            scale = 1.0 / u[p, p]
            for j in range(m):
                b[p, j] *= scale
        if stop - k == 4:
            for i in range(stop, n):
                f0, f1, f2, f3 = u[k, i], u[k + 1, i], u[k + 2, i], u[k + 3, i]
                for j in range(m):
                    b[i, j] -= f0 * b[k, j] + f1 * b[k + 1, j] + f2 * b[k + 2, j] + f3 * b[k + 3, j]
        k = stop


# The system of a patch: covariance matrix of its data, trend, and predictions of single data from the others.


# Squared normalised differences count with their logarithm beyond this: no covariance function is to bend towards a
# blunder.
_KNEE = 16.0
# So many data of a patch at most take no part in what is said of the others.
_MOST_ASIDE = 8
JITTER = 1e-8
# A prior for the slope of the trend so weak that it only matters where all data lie on one line.
_SLOPE_WEIGHT = 1e-4
_MOST_PIECES = 40
_MOST_VERTICES = 4000


@kernel
def system(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaf: NDArray[Any],
    points: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    model: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Factorised covariance matrix U of the data `ids`; coordinates (x, y, sides …) of data and of `points`; trend.

    Coordinates are in half-value distances from the leaf's middle, so that their squared differences go straight into
    the covariance function. The last result holds heights and trend columns, U⁻ᵀ applied. An empty U: not solvable.
    """
    n, m = len(ids), len(points)
    family, variance, length, gap = int(model[0]), model[1], model[2], model[3]
    xy = np.empty((n + m, 2))
    # Which parts of lines count depends on the patch alone, not on what is asked of it: units that share a post then
    # get the same height for it.
    reach = 1.5 * leaf[2]
    box = np.array([leaf[0] - reach, leaf[1] - reach, leaf[0] + reach, leaf[1] + reach])
    for i in range(n):
        for c in range(2):
            value = xyz[ids[i], c]
            xy[i, c] = value
            box[c], box[2 + c] = min(box[c], value), max(box[2 + c], value)
    for i in range(m):
        xy[n + i, 0], xy[n + i, 1] = points[i, 0], points[i, 1]
    pieces = 0
    vertices, piece_start = np.empty((0, 2)), np.zeros(1, np.int64)
    if len(start) > 1:
        vertices, piece_start = np.empty((_MOST_VERTICES, 2)), np.empty(_MOST_PIECES + 1, np.int64)
        pieces = clip_lines(lines, start, box, vertices, piece_start)
    at = np.empty((n + m, 2 + pieces))
    if pieces:
        sides_of(xy, vertices, piece_start, pieces, at[:, 2:])
    for i in range(n + m):
        at[i, 0], at[i, 1] = (xy[i, 0] - leaf[0]) / length, (xy[i, 1] - leaf[1]) / length
        for k in range(2, 2 + pieces):
            at[i, k] *= gap / 2.0
    u = np.empty((n, n))
    for i in range(n):
        u[i, i] = variance * (1.0 + JITTER) + noise[ids[i]]
        for j in range(i + 1, n):
            u[i, j] = variance * correlation(_squared_distance(at, i, j), family)
    b = np.empty((n, 4))
    for i in range(n):
        b[i, 0], b[i, 1], b[i, 2], b[i, 3] = xyz[ids[i], 2], 1.0, at[i, 0], at[i, 1]
    if not factorise(u):
        return np.empty((0, 0)), at[:n], at[n:], b
    solve_transposed(u, b)
    return u, at[:n], at[n:], b


@inner
def _squared_distance(at: NDArray[Any], i: int, j: int) -> float:
    """Squared distance of two rows of coordinates."""
    total = 0.0
    for k in range(at.shape[1]):
        d = at[i, k] - at[j, k]
        total += d * d
    return total


@kernel
def trend(b: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Coefficients of the trend and the inverse of their normal matrix, from heights and trend columns (n, 4)."""
    g, r = np.zeros((3, 3)), np.zeros(3)
    for i in range(b.shape[0]):
        for p in range(3):
            r[p] += b[i, p + 1] * b[i, 0]
            for q in range(3):
                g[p, q] += b[i, p + 1] * b[i, q + 1]
    g[1, 1] += _SLOPE_WEIGHT
    g[2, 2] += _SLOPE_WEIGHT
    inverse = np.linalg.inv(g)
    return inverse @ r, inverse


@kernel
def usable_data(ids: NDArray[Any], noise: NDArray[Any]) -> NDArray[Any]:
    """Entries of `ids` that name data to be used, each once, in ascending order."""
    kept = np.empty(len(ids), np.int64)
    count = 0
    for i in ids:
        if i >= 0 and noise[i] >= 0.0:
            kept[count] = i
            count += 1
    kept = np.sort(kept[:count])
    unique = 0
    for k in range(count):
        if k == 0 or kept[k] != kept[k - 1]:
            kept[unique] = kept[k]
            unique += 1
    return kept[:unique]


@kernel
def leave_one_out(b: NDArray[Any], w: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """For right-hand sides w = U⁻ᵀe of single data: weight P and P·(height − trend) of each."""
    beta, inverse = trend(b)
    n, m = w.shape
    weight, alpha, cross = np.zeros(m), np.zeros(m), np.zeros((3, m))
    for i in range(n):
        rest = b[i, 0] - (b[i, 1] * beta[0] + b[i, 2] * beta[1] + b[i, 3] * beta[2])
        b1, b2, b3 = b[i, 1], b[i, 2], b[i, 3]
        for j in range(m):
            value = w[i, j]
            weight[j] += value * value
            alpha[j] += value * rest
            cross[0, j] += value * b1
            cross[1, j] += value * b2
            cross[2, j] += value * b3
    for j in range(m):
        for p in range(3):
            for q in range(3):
                weight[j] -= cross[p, j] * inverse[p, q] * cross[q, j]
    return weight, alpha


@kernel
def leave_one_out_robust(b: NDArray[Any], w: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """As `leave_one_out`, but data far off their prediction take no part in those of the others, the worst first.

    A gross error spoils what is said of its neighbours: each of them contradicts it, and together they ask for a
    surface that is rough enough to meet it. `b` and `w` are changed.

    Notes
    -----
    A datum takes no part if its error is a further unknown of the trend: all columns are made orthogonal to its own.
    """
    weight, alpha = leave_one_out(b, w)
    aside = np.zeros(len(weight), np.bool_)
    for _ in range(_MOST_ASIDE):
        worst, most = -1, _KNEE
        for j in range(len(weight)):
            if not aside[j] and weight[j] > 0.0 and alpha[j] * alpha[j] > most * weight[j]:
                worst, most = j, alpha[j] * alpha[j] / weight[j]
        if worst < 0:
            break
        aside[worst] = True
        unknown = w[:, worst].copy()
        _orthogonal(b, unknown)
        _orthogonal(w, unknown)
        now_weight, now_alpha = leave_one_out(b, w)
        for j in range(len(weight)):
            if not aside[j]:
                weight[j], alpha[j] = now_weight[j], now_alpha[j]
    return weight, alpha


@kernel
def _orthogonal(columns: NDArray[Any], to: NDArray[Any]) -> None:
    """Take the part along a vector away from columns (n, m)."""
    n, m = columns.shape
    part, size = np.zeros(m), 0.0
    for i in range(n):
        size += to[i] * to[i]
        for j in range(m):
            part[j] += to[i] * columns[i, j]
    for i in range(n):
        for j in range(m):
            columns[i, j] -= to[i] * (part[j] / size)


@inner
def misfit(alpha: float, weight: float) -> float:
    """Twice the negative logarithm of the density of a datum, predicted from the others; see `leave_one_out`.

    The difference from the prediction is alpha / weight, its variance 1 / weight. The density is normal up to four
    standard deviations; beyond, its logarithm falls slowly only.
    """
    square = alpha * alpha / weight
    if square > _KNEE:
        square = _KNEE * (1.0 + np.log(square / _KNEE))
    return square - np.log(weight)


# Prediction in patches: one dense system for each neighbourhood, many right-hand sides.


# Models of a patch with less weight than this are left out.
_LEAST = 0.02
MOST_MISFIT = 16.0
"""Squared normalised residuals count up to this: one blunder does not make its surroundings rough."""
# Sides of a line are this many reaches apart where roughness is averaged.
_APART = 4.0


@inner
def _patch_weight(d: float) -> float:
    """Weight of a patch at distance d from its middle in halves of its leaf: 1 up to ½, 0 from 1½, smooth between."""
    t = min(max(1.5 - abs(d), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@kernel
def predict(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    targets: NDArray[Any],
    wanted: NDArray[Any],
    wanted_start: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    shares: NDArray[Any],
    squares: NDArray[Any],
    lost: NDArray[Any],
    usual: NDArray[Any],
    sums: NDArray[Any],
) -> int:
    """Add each patch's prediction of its targets to `sums`; returns the number of patches without a solution.

    Parameters
    ----------
    xyz : ndarray, shape (n, 3)
        Data.
    noise : ndarray, shape (n,)
        Their variances (filter values squared); negative: not to be used.
    ids : ndarray, shape (p, k), int
        Data of each patch; negative entries are no data.
    leaves : ndarray, shape (p, 3)
        Middle and half side of each patch's leaf.
    targets : ndarray, shape (t, 2)
        Where heights are wanted.
    wanted, wanted_start : ndarrays, int
        Targets of patch i are wanted[wanted_start[i]:wanted_start[i + 1]].
    lines, start : ndarrays
        Vertices of all breaklines near, and where each begins.
    models : ndarray, shape (p, m, 4)
        Family, variance, half-value distance, gap between the sides of a line in half-value distances.
    shares : ndarray, shape (p, m)
        Weights of a patch's models, which add up to 1.
    squares : ndarray, shape (n,)
        Squared normalised residuals of the data; NaN: not known.
    lost : ndarray, shape (n,)
        Variance at each datum of ground that the filter took for noise, m².
    usual : ndarray, shape (3,)
        Mean of these squares everywhere, how many data it counts as, and the distance at which data count a quarter
        for the roughness, metres.
    sums : ndarray, shape (t, 6)
        Sums of w·height, w, w·standard deviation; the shortest distance to a datum; sum of w·roughness, which is the
        mean square of the normalised residuals around, on the same side of lines; sum of w·`lost` around.

    Notes
    -----
    The weight of a patch falls smoothly to zero at three quarters of a leaf's side from its middle, so that the sum
    over patches is continuous; and with the predicted variance, so that the patch that knows more decides.
    """
    failed = 0
    for patch in range(len(leaves)):
        some = wanted[wanted_start[patch] : wanted_start[patch + 1]]
        if len(some) == 0:
            continue
        data = usable_data(ids[patch], noise)
        solved = False
        for k in range(models.shape[1]):
            if len(data) > 0 and shares[patch, k] > _LEAST:
                u, at, at_points, b = system(
                    xyz, noise, data, leaves[patch], targets[some], lines, start, models[patch, k]
                )
                if u.shape[0] > 0:
                    solved = True
                    rough, taken = _roughness(at, at_points, squares[data], lost[data], models[patch, k], usual)
                    w, near = _target_covariances(at, at_points, models[patch, k])
                    solve_transposed(u, w)
                    about = np.stack((near, rough, taken))
                    _add_targets(
                        w, b, at_points, about, models[patch, k], leaves[patch], shares[patch, k], targets, some, sums
                    )
        failed += 0 if solved else 1
    return failed


@kernel
def _target_covariances(
    at: NDArray[Any], at_points: NDArray[Any], model: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Covariances between data and targets (n, t), and the distance of each target to the nearest datum, metres."""
    family, variance, length = int(model[0]), model[1], model[2]
    n, m = len(at), len(at_points)
    w = np.empty((n, m))
    near = np.full(m, np.inf)
    for i in range(n):
        for j in range(m):
            apart = 0.0
            for k in range(2, at.shape[1]):
                d = at[i, k] - at_points[j, k]
                apart += d * d
            dx, dy = at[i, 0] - at_points[j, 0], at[i, 1] - at_points[j, 1]
            plain = dx * dx + dy * dy
            near[j] = min(near[j], plain)
            w[i, j] = variance * correlation(plain + apart, family)
    return w, np.sqrt(near) * length


@kernel
def _roughness(
    at: NDArray[Any],
    at_points: NDArray[Any],
    squares: NDArray[Any],
    lost: NDArray[Any],
    model: NDArray[Any],
    usual: NDArray[Any],
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Means around each target (t,): of squared normalised residuals, drawn to the usual one, and of `lost`."""
    n, m = len(at), len(at_points)
    total, count = np.full(m, usual[0] * usual[1]), np.full(m, usual[1])
    taken, weights = np.zeros(m), np.full(m, 1e-30)
    plain, across = (model[2] / usual[2]) ** 2, (_APART / model[3]) ** 2
    for i in range(n):
        if not squares[i] >= 0.0:
            continue
        square = min(squares[i], MOST_MISFIT)
        for j in range(m):
            apart = 0.0
            for k in range(2, at.shape[1]):
                d = at[i, k] - at_points[j, k]
                apart += d * d
            dx, dy = at[i, 0] - at_points[j, 0], at[i, 1] - at_points[j, 1]
            near = 1.0 / (1.0 + (dx * dx + dy * dy) * plain + apart * across) ** 2
            total[j] += near * square
            count[j] += near
            taken[j] += near * near * lost[i]
            weights[j] += near * near
    return total / count, taken / weights


@kernel
def _add_targets(
    w: NDArray[Any],
    b: NDArray[Any],
    at_points: NDArray[Any],
    about: NDArray[Any],
    model: NDArray[Any],
    leaf: NDArray[Any],
    part: float,
    targets: NDArray[Any],
    some: NDArray[Any],
    sums: NDArray[Any],
) -> None:
    """Add heights, variances and `about` (nearest datum, roughness, lost; shape (3, t)) of one patch's targets."""
    n, m = w.shape
    beta, inverse = trend(b)
    height, explained = np.zeros(m), np.zeros(m)
    cross = np.zeros((3, m))
    for i in range(n):
        b1, b2, b3 = b[i, 1], b[i, 2], b[i, 3]
        rest = b[i, 0] - (b1 * beta[0] + b2 * beta[1] + b3 * beta[2])
        for j in range(m):
            value = w[i, j]
            height[j] += value * rest
            explained[j] += value * value
            cross[0, j] += value * b1
            cross[1, j] += value * b2
            cross[2, j] += value * b3
    for j in range(m):
        x, y = at_points[j, 0], at_points[j, 1]
        v0, v1, v2 = 1.0 - cross[0, j], x - cross[1, j], y - cross[2, j]
        i0 = inverse[0, 0] * v0 + inverse[0, 1] * v1 + inverse[0, 2] * v2
        i1 = inverse[1, 0] * v0 + inverse[1, 1] * v1 + inverse[1, 2] * v2
        i2 = inverse[2, 0] * v0 + inverse[2, 1] * v1 + inverse[2, 2] * v2
        spread = max(model[1] - explained[j] + v0 * i0 + v1 * i1 + v2 * i2, JITTER * model[1])
        t = some[j]
        share = _patch_weight((targets[t, 0] - leaf[0]) / leaf[2]) * _patch_weight((targets[t, 1] - leaf[1]) / leaf[2])
        weight = share * part / spread
        sums[t, 0] += weight * (height[j] + beta[0] + beta[1] * x + beta[2] * y)
        sums[t, 1] += weight
        sums[t, 2] += weight * np.sqrt(spread)
        sums[t, 3] = min(sums[t, 3], about[0, j])
        sums[t, 4] += weight * about[1, j]
        sums[t, 5] += weight * about[2, j]


# Tests: scores of covariance functions by the data of a patch, and gross errors.


# Points count with a normal weight of this many half sides of the leaf: far ones are other patches' matter.
_FOCUS = 1.5


@kernel
def score_models(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    points: int,
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    result: NDArray[Any],
) -> None:
    """How badly each model predicts every point of a patch from all others that it does not contradict,
    result[patch, model].

    The score is the sum of misfits over the points (numbers below `points`), e being the difference from the
    prediction and v its variance: twice the negative logarithm of the predictive density.
    """
    for patch in range(len(leaves)):
        data = usable_data(ids[patch], noise)
        n = len(data)
        m = np.searchsorted(data, points)
        for k in range(models.shape[1]):
            result[patch, k] = 0.0
            if m == 0:
                continue
            u, _, _, b = system(xyz, noise, data, leaves[patch], np.empty((0, 2)), lines, start, models[patch, k])
            if u.shape[0] == 0:
                result[patch, k] = np.inf
                continue
            w = np.zeros((n, m))
            for j in range(m):
                w[j, j] = 1.0
            solve_transposed(u, w)
            weight, alpha = leave_one_out_robust(b, w)
            total = 0.0
            for j in range(m):
                if weight[j] > 0.0:
                    dx, dy = xyz[data[j], 0] - leaves[patch, 0], xyz[data[j], 1] - leaves[patch, 1]
                    share = np.exp(-0.5 * (dx * dx + dy * dy) / (_FOCUS * leaves[patch, 2]) ** 2)
                    total += share * misfit(alpha[j], weight[j])
            result[patch, k] = total


@kernel
def test_points(
    xyz: NDArray[Any],
    noise: NDArray[Any],
    ids: NDArray[Any],
    leaves: NDArray[Any],
    own: NDArray[Any],
    own_start: NDArray[Any],
    lines: NDArray[Any],
    start: NDArray[Any],
    models: NDArray[Any],
    result: NDArray[Any],
) -> int:
    """Compare data with what their neighbours predict; returns the number of patches without a solution.

    Parameters are those of `predict`; `own` holds point numbers of each leaf. `result`, shape (points, 3), receives for
    each of them the difference from the prediction from all other data of the patch but those that are far off
    themselves (metres), the redundancy (share of it that is left as a residual against the filtered surface) and the
    difference in its standard deviations.
    """
    failed = 0
    for patch in range(len(leaves)):
        some = own[own_start[patch] : own_start[patch + 1]]
        if len(some) == 0:
            continue
        data = usable_data(ids[patch], noise)
        u, _, _, b = system(xyz, noise, data, leaves[patch], np.empty((0, 2)), lines, start, models[patch])
        if u.shape[0] == 0:
            failed += 1
            continue
        n, m = len(data), np.searchsorted(data, len(result))
        w = np.zeros((n, m))
        for j in range(m):
            w[j, j] = 1.0
        solve_transposed(u, w)
        weight, alpha = leave_one_out_robust(b, w)
        for t in some:
            j = np.searchsorted(data[:m], t)
            if j < m and data[j] == t and weight[j] > 0.0:
                result[t, 0] = alpha[j] / weight[j]
                result[t, 1] = noise[t] * weight[j]
                result[t, 2] = alpha[j] / np.sqrt(weight[j])
    return failed


# Scores of covariance functions: how well they predict each point of some blocks from the others.


@kernel
def block_score(
    d2: NDArray[Any], sides: NDArray[Any], b: NDArray[Any], noise: NDArray[Any], parameters: NDArray[Any], family: int
) -> float:
    """Twice the negative logarithm of the predictive density of one block's points, each from all others.

    A likelihood would ask how probable all data are together, and dense points along lines would decide it; this asks
    what a terrain model is for.

    Parameters
    ----------
    d2 : ndarray, shape (n, n)
        Squared distances on the map.
    sides : ndarray, shape (n, n)
        Squared distances of the side coordinates, in units of the half-value distance squared.
    b : ndarray, shape (n, 4)
        Heights, and the columns of the trend 1, x, y.
    noise : ndarray, shape (n, 3)
        Variance of each height = noise[:, 0] + noise[:, 1] · (third parameter). The first rows, as long as the third
        column is not 0, are the ones predicted: whether their variance is known does not matter.
    parameters : ndarray, shape (3,)
        Variance of the signal, half-value distance, variance of mass points.
    family : int
        See `photoplan.kernels.prediction`.

    Returns
    -------
    float
        Infinity where the matrix is not positive definite.
    """
    n = d2.shape[0]
    variance, scale = parameters[0], 1.0 / parameters[1] ** 2
    u = np.empty((n, n))
    for i in range(n):
        u[i, i] = variance * (1.0 + JITTER) + noise[i, 0] + noise[i, 1] * parameters[2]
        for j in range(i + 1, n):
            u[i, j] = variance * correlation(d2[i, j] * scale + sides[i, j], family)
    if not factorise(u):
        return np.inf
    scored = 0
    while scored < n and noise[scored, 2] != 0.0:
        scored += 1
    w = np.zeros((n, 4 + scored))
    for i in range(n):
        for k in range(4):
            w[i, k] = b[i, k]
    for i in range(scored):
        w[i, 4 + i] = 1.0
    solve_transposed(u, w)
    weight, alpha = leave_one_out(w[:, :4], w[:, 4:])
    total = 0.0
    for j in range(scored):
        if not weight[j] > 0.0:
            return np.inf
        total += misfit(alpha[j], weight[j])
    return total


@kernel
def total_score(
    d2: NDArray[Any],
    sides: NDArray[Any],
    b: NDArray[Any],
    noise: NDArray[Any],
    prior: NDArray[Any],
    logs: NDArray[Any],
    family: int,
) -> float:
    """Sum `block_score` over blocks, and add the prior.

    The prior of each logarithm is (log − prior[0])² · prior[1]; beyond the bounds prior[2:4] the score is infinite.
    """
    total = 0.0
    for p in range(3):
        if logs[p] < prior[2, p] or logs[p] > prior[3, p]:
            return np.inf
        total += (logs[p] - prior[0, p]) ** 2 * prior[1, p]
    parameters = np.exp(logs)
    for k in range(d2.shape[0]):
        total += block_score(d2[k], sides[k], b[k], noise[k], parameters, family)
        if not total < np.inf:
            return np.inf
    return total
