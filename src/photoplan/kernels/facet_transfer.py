"""Transfer of image pixels to a surface of height facets: rays, radiometry, and agreement of the images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photoplan.kernels.facets import axpy
from photoplan.kernels.jit import inner, kernel

# Direct transfer: pixels of an image carried along their rays to a surface of height facets.
#
# Rays are followed to bilinear facets, then over to the curved ones: along each axis a facet bends by what the second
# differences around it have in common. So slopes and hills are curved, while an edge is none the rounder.


#: A ray goes on by no more than this part of a facet where the surface may be near.
_STRIDE = 0.25
#: Halvings of the piece of a ray in which it meets the surface.
_HALVINGS = 20
#: Least that a surface's height counts on a ray that grazes it.
_GRAZING = 0.1
#: Facets along a side of a cell whose steepness is known.
CELL = 8
#: What a surface may rise around a ray, part of what the ray comes down, that it is met but once without a look; steps
#: to where it is, and the part of a facet to which they find it.
_GENTLE, _STEPS, _EXACT = 0.5, 12, 1e-5


class Ray(NamedTuple):
    """A pixel's way down: column and row of the posts at the height 0, and their coefficients of z, z² and z³."""

    u: float
    v: float
    ku: float
    kv: float
    qu: float
    qv: float
    cu: float
    cv: float


@inner
def _place(ray, z):
    """Column and row of the posts at a height."""
    return ray.u + z * (ray.ku + z * (ray.qu + z * ray.cu)), ray.v + z * (ray.kv + z * (ray.qv + z * ray.cv))


@inner
def _place_slope(ray, z):
    """What these change per metre of height there."""
    return ray.ku + z * (2.0 * ray.qu + 3.0 * z * ray.cu), ray.kv + z * (2.0 * ray.qv + 3.0 * z * ray.cv)


@inner
def height_at(posts, u, v):
    """Height of the facets at a place, in columns and rows of the posts; beyond the border that of the border."""
    rows, columns = posts.shape
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    i, j = min(int(u), columns - 2), min(int(v), rows - 2)
    a, b = u - i, v - j
    upper = posts[j, i] * (1.0 - a) + posts[j, i + 1] * a
    lower = posts[j + 1, i] * (1.0 - a) + posts[j + 1, i + 1] * a
    return upper * (1.0 - b) + lower * b


@inner
def _above(posts, ray, z):
    """How far a ray is above the surface at a height."""
    u, v = _place(ray, z)
    return z - height_at(posts, u, v)


@inner
def _first_hit(posts, ray, top, bottom, slope, reach):
    """Height at which a ray first comes down to the surface; NaN: it does not. `reach`: facets that it goes per metre
    at most."""
    stride = _STRIDE / max(reach, 1e-12)
    z = top
    while z > bottom:
        above = _above(posts, ray, z)
        if above <= 0.0:
            return z
        # The surface cannot rise faster than its steepest facet.
        after = z - max(above / (1.0 + slope * reach), stride)
        if _above(posts, ray, after) > 0.0:
            z = after
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (z + after)
            if _above(posts, ray, middle) > 0.0:
                z = middle
            else:
                after = middle
        return 0.5 * (z + after)
    return np.nan


@inner
def _rise_along(posts, u, v, ku, kv):
    """What the facet at a place rises per metre that a ray comes down."""
    i, j = min(int(u), posts.shape[1] - 2), min(int(v), posts.shape[0] - 2)
    a, b = u - i, v - j
    along = (posts[j, i + 1] - posts[j, i]) * (1.0 - b) + (posts[j + 1, i + 1] - posts[j + 1, i]) * b
    down = (posts[j + 1, i] - posts[j, i]) * (1.0 - a) + (posts[j + 1, i + 1] - posts[j, i + 1]) * a
    return along * ku + down * kv


@inner
def _newton_hit(posts, ray, z):
    """Height at which a ray meets a surface that it meets once, by Newton's way from z; NaN: not found."""
    rows, columns = posts.shape
    enough = _EXACT / (abs(ray.ku) + abs(ray.kv) + 1e-12)
    for _ in range(_STEPS):
        x, y = _place(ray, z)
        x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
        i, j = min(int(x), columns - 2), min(int(y), rows - 2)
        a, b = x - i, y - j
        p00, p01, p10, p11 = posts[j, i], posts[j, i + 1], posts[j + 1, i], posts[j + 1, i + 1]
        upper, lower = p00 + a * (p01 - p00), p10 + a * (p11 - p10)
        along, down = _place_slope(ray, z)
        rise = ((1.0 - b) * (p01 - p00) + b * (p11 - p10)) * along + (lower - upper) * down
        step = (upper + b * (lower - upper) - z) / (1.0 - rise)
        z += step
        if abs(step) <= enough:
            return z
    return np.nan


@kernel
def steepness(posts, out):
    """Largest difference of neighbouring posts in cells of `CELL` × `CELL` facets and in those around each.

    `out` has shape (⌈(rows − 1)/CELL⌉, ⌈(columns − 1)/CELL⌉).
    """
    rows, columns = posts.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(columns):
            most = 0.0
            if i + 1 < columns:
                most = abs(posts[j, i + 1] - posts[j, i])
            if j + 1 < rows:
                most = max(most, abs(posts[j + 1, i] - posts[j, i]))
            # A post on the border of cells belongs to both, and cells around have it, too.
            for n in range(max(0, (j - 1) // CELL - 1), min(out.shape[0], j // CELL + 2)):
                for m in range(max(0, (i - 1) // CELL - 1), min(out.shape[1], i // CELL + 2)):
                    out[n, m] = max(out[n, m], most)


@inner
def _common_curvature(a, b, c, d, e, f):
    """What the second differences of six posts have in common: the least of them; 0 if they bend both ways."""
    least, most = np.inf, -np.inf
    for second in (a - 2.0 * b + c, b - 2.0 * c + d, c - 2.0 * d + e, d - 2.0 * e + f):
        least, most = min(least, second), max(most, second)
    return max(least, 0.0) + min(most, 0.0)


@kernel
def facet_curvatures(posts, out):
    """By how much facets bend: what second differences at the ends of a side, and at the next posts, have in common.

    `out` has shape (2, rows, columns): of the side from a post to the next along columns, and along rows; 0 near the
    border.
    """
    rows, columns = posts.shape
    out[:] = 0.0
    for j in range(rows):
        for i in range(2, columns - 3):
            out[0, j, i] = _common_curvature(
                posts[j, i - 2], posts[j, i - 1], posts[j, i], posts[j, i + 1], posts[j, i + 2], posts[j, i + 3]
            )
    for j in range(2, rows - 3):
        for i in range(columns):
            out[1, j, i] = _common_curvature(
                posts[j - 2, i], posts[j - 1, i], posts[j, i], posts[j + 1, i], posts[j + 2, i], posts[j + 3, i]
            )


@inner
def _curved_excess(bent, u, v):
    """How much higher a curved facet is than a bilinear one."""
    i, j = min(int(u), bent.shape[2] - 2), min(int(v), bent.shape[1] - 2)
    a, b = u - i, v - j
    along = (1.0 - b) * bent[0, j, i] + b * bent[0, j + 1, i]
    down = (1.0 - a) * bent[1, j, i] + a * bent[1, j, i + 1]
    return -0.5 * (a * (1.0 - a) * along + b * (1.0 - b) * down)


@inner
def _hit(posts, steep, ray, top, bottom, slope, z):
    """Where a ray first meets the surface: at once where all below the ray from above is gentle, else by a search from
    above; z: about there."""
    far = max(abs(top), abs(bottom))
    bent = 2.0 * (abs(ray.qu) + abs(ray.qv)) + 3.0 * far * (abs(ray.cu) + abs(ray.cv))
    reach = abs(ray.ku) + abs(ray.kv) + far * bent
    found = _newton_hit(posts, ray, z)
    at, clear = found, not np.isnan(found)
    if clear and slope * reach < _GENTLE:
        return found
    while clear:
        u, v = _place(ray, at)
        i, j = min(max(int(u) // CELL, 0), steep.shape[1] - 1), min(max(int(v) // CELL, 0), steep.shape[0] - 1)
        clear = steep[j, i] * reach < _GENTLE
        # What is around a cell goes as far as that.
        at += CELL / max(reach, 1e-12)
        if at > top:
            break
    return found if clear else _first_hit(posts, ray, top, bottom, slope, reach)


@kernel
def transfer(ways, right, down, posts, bent, steep, wall, out):
    """Where the rays of all pixels of a window first meet the surface: what hides behind it is met by none.

    Parameters
    ----------
    ways : ndarray, shape (rows, columns, 8)
        Rays of a lattice of pixels: column and row of the posts at the height 0, and the coefficients of the height z,
        of z² and of z³; NaN: there is no ray.
    right, down : int
        Pixels between neighbours of the lattice, whose first one is the window's first pixel.
    posts : ndarray, shape (m, n)
        Heights, metres, none of them NaN.
    bent, steep : ndarray
        See `facet_curvatures` and `steepness`.
    wall : float
        Times by which pixels lie closer on a facet than on level ground beyond which they are left out; infinite: none.
    out : ndarray, shape (height, width, 4), float32
        Column and row of the posts where the ray of a pixel ends, and by how much these change if the surface there
        rises, 1/m: (X − X0)/(Z − Z0) of Schlüter 2001, eq. 1, over 1 less the surface's own rise along the ray.
        NaN where a ray meets nothing inside the posts, or a wall.
    """
    rows, columns = posts.shape
    top, bottom, slope = posts[0, 0], posts[0, 0], 0.0
    for j in range(rows):
        for i in range(columns):
            top, bottom = max(top, posts[j, i]), min(bottom, posts[j, i])
    for j in range(steep.shape[0]):
        for i in range(steep.shape[1]):
            slope = max(slope, steep[j, i])
    top, bottom = top + 1e-3, bottom - 1e-3
    first, way = np.zeros(8), np.zeros(8)
    z = 0.5 * (top + bottom)
    for r in range(out.shape[0]):
        j = min(r // down, ways.shape[0] - 2)
        b = r / down - j
        for i in range(ways.shape[1] - 1):
            # Along a row rays change linearly from node to node.
            for k in range(8):
                first[k] = (1.0 - b) * ways[j, i, k] + b * ways[j + 1, i, k]
                way[k] = ((1.0 - b) * ways[j, i + 1, k] + b * ways[j + 1, i + 1, k] - first[k]) / right
            last = out.shape[1] if i == ways.shape[1] - 2 else min(out.shape[1], (i + 1) * right)
            for c in range(i * right, last):
                a = c - i * right
                u, v = first[0] + a * way[0], first[1] + a * way[1]
                ku, kv = first[2] + a * way[2], first[3] + a * way[3]
                qu, qv = first[4] + a * way[4], first[5] + a * way[5]
                cu, cv = first[6] + a * way[6], first[7] + a * way[7]
                for k in range(4):
                    out[r, c, k] = np.nan
                if np.isnan(u + v + ku + kv + qu + qv + cu + cv):
                    continue
                ray = Ray(u=u, v=v, ku=ku, kv=kv, qu=qu, qv=qv, cu=cu, cv=cv)
                z = _hit(posts, steep, ray, top, bottom, slope, z)
                u, v = _place(ray, z)
                if u >= 0.0 and v >= 0.0 and u <= columns - 1.0 and v <= rows - 1.0:
                    ku, kv = _place_slope(ray, z)
                    towards = max(1.0 - _rise_along(posts, u, v, ku, kv), _GRAZING)
                    if towards > wall:
                        continue
                    higher = _curved_excess(bent, u, v) / towards
                    out[r, c, 0] = min(max(u + higher * ku, 0.0), columns - 1.0)
                    out[r, c, 1] = min(max(v + higher * kv, 0.0), rows - 1.0)
                    out[r, c, 2], out[r, c, 3] = ku / towards, kv / towards
                if np.isnan(z):
                    z = 0.5 * (top + bottom)


# Radiometric transfer between a grey surface and images: an offset and a gain that change slowly over the surface.


#: Shares of two nodes, 1 − a and a, by powers of a; and products of two of them, by how many are of the second.
_ONE = np.array([[1.0, -1.0], [0.0, 1.0]])
_TWO = np.array([[1.0, -2.0, 1.0], [0.0, 1.0, -1.0], [0.0, 0.0, 1.0]])


@inner
def _lattice_cell(places, r, c, lattice, rows, columns, share, index):
    """Shares and numbers of the four nodes of the lattice around a pixel's place."""
    x = min(max((places[r, c, 0] - lattice[0]) * (1.0 / lattice[2]), 0.0), columns - 1.0)
    y = min(max((places[r, c, 1] - lattice[1]) * (1.0 / lattice[2]), 0.0), rows - 1.0)
    i, j = min(int(x), columns - 2), min(int(y), rows - 2)
    a, b = x - i, y - j
    for k in range(4):
        index[k] = (j + k // 2) * columns + i + k % 2
        share[k] = (a if k % 2 else 1.0 - a) * (b if k // 2 else 1.0 - b)


@kernel
def to_surface_grey(places, raw, offsets, gains, lattice, out):
    """Grey values of an image in the system of the surface: (g − offset) / gain at each pixel's place; NaN stays.

    Parameters
    ----------
    places : ndarray, shape (h, w, 4)
        See `transfer`.
    raw, out : ndarray, shape (h, w), float32
    offsets, gains : ndarray, shape (rows, columns)
        At the nodes of a lattice.
    lattice : (float, float, float)
        Column and row of the posts at its first node, and its pitch.
    """
    rows, columns = offsets.shape
    share, index = np.empty(4), np.empty(4, np.int64)
    first, second = offsets.reshape(-1), gains.reshape(-1)
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            out[r, c] = np.nan
            if np.isnan(places[r, c, 0]) or np.isnan(raw[r, c]):
                continue
            _lattice_cell(places, r, c, lattice, rows, columns, share, index)
            offset, gain = 0.0, 0.0
            for k in range(4):
                offset += share[k] * first[index[k]]
                gain += share[k] * second[index[k]]
            out[r, c] = (raw[r, c] - offset) / gain


@kernel
def add_radiometry(places, raw, weights, surface, shape, lattice, system, right):
    """Add equations g = offset + gain · G of an image's pixels.

    Parameters
    ----------
    places, raw, lattice
        See `to_surface_grey`.
    weights, surface : ndarray, shape (h, w), float32
        Weights, and grey values of the surface at the pixels' places.
    shape : (int, int)
        Rows and columns of the lattice.
    system, right : ndarray, shape (2n, 2n) and (2n,)
        Unknowns: offsets of all n nodes, then gains.
    """
    rows, columns = shape
    share, index = np.empty(4), np.empty(4, np.int64)
    # Σ p · a^i · b^j · (1, G, G²), Σ p · g · a^i · b^j · (1, G) of pixels in a cell: all follows from them.
    both, single, before = np.zeros((3, 3, 3)), np.zeros((2, 2, 2)), -1
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            p = weights[r, c]
            if not p > 0.0:
                continue
            _lattice_cell(places, r, c, lattice, rows, columns, share, index)
            if index[0] != before:
                if before >= 0:
                    _add_cell(before, rows, columns, both, single, system, right)
                before = index[0]
            a, b = share[1] + share[3], share[2] + share[3]
            G, g = surface[r, c], raw[r, c]
            for j in range(3):
                q = p
                for i in range(3):
                    both[j, i, 0] += q
                    both[j, i, 1] += q * G
                    both[j, i, 2] += q * G * G
                    q *= a
                if j < 2:
                    single[j, 0, 0] += p * g
                    single[j, 0, 1] += p * g * G
                    single[j, 1, 0] += p * a * g
                    single[j, 1, 1] += p * a * g * G
                p *= b
    if before >= 0:
        _add_cell(before, rows, columns, both, single, system, right)


@inner
def _add_cell(first, rows, columns, both, single, system, right):
    """Add the sums of a cell, whose upper left node is number `first`, to the equations, and empty them."""
    n = rows * columns
    for k in range(4):
        to = first + k // 2 * columns + k % 2
        for j in range(2):
            for i in range(2):
                part = _ONE[k // 2, j] * _ONE[k % 2, i]
                right[to] += part * single[j, i, 0]
                right[n + to] += part * single[j, i, 1]
        for q in range(4):
            other = first + q // 2 * columns + q % 2
            for j in range(3):
                for i in range(3):
                    part = _TWO[k // 2 + q // 2, j] * _TWO[k % 2 + q % 2, i]
                    system[to, other] += part * both[j, i, 0]
                    system[to, n + other] += part * both[j, i, 1]
                    system[n + to, other] += part * both[j, i, 1]
                    system[n + to, n + other] += part * both[j, i, 2]
    both[:] = 0.0
    single[:] = 0.0


@kernel
def solve_radiometry(system, right):
    """Solve with a full positive matrix, in place: its upper triangle becomes its Cholesky factor, `right`
    the solution.

    Libraries use threads of their own for this, which stand in each other's way in the workers of a run.
    """
    n = len(right)
    for k in range(n):
        system[k, k] = np.sqrt(system[k, k])
        scale = 1.0 / system[k, k]
        for j in range(k + 1, n):
            system[k, j] *= scale
        for j in range(k + 1, n):
            if system[k, j] != 0.0:
                axpy(-system[k, j], system[k, j:], system[j, j:])
    for k in range(n):
        right[k] /= system[k, k]
        axpy(-right[k], system[k, k + 1 :], right[k + 1 :])
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= system[k, j] * right[j]
        right[k] /= system[k, k]


# Agreement of images around posts at trial heights, and the images that a surface lets see a post.


#: Images of a post that are compared at most.
MOST_VIEWS = 8


@kernel
def image_agreement(raws, lattice, spacing, tried, slopes, ratio, half, gains, noise, seen, wanted, squares, expected):
    """Mean squared differences of grey values between images in patches around posts, in units of their noise.

    Of the pairs of images those that agree best count: as many as pairs of half of the images that see the post.

    Parameters
    ----------
    raws : ndarray, shape (views, h, w), float32
        NaN where there is no pixel.
    lattice : ndarray, shape (views, nz, ny, nx, 2)
        Columns and rows in `raws` of places on a lattice over the block; NaN: not seen.
    spacing : float
        Posts between its nodes.
    tried : ndarray, shape (rows, columns)
        Heights, in parts of the lattice.
    slopes : ndarray, shape (2, rows, columns)
        Change of the heights of a patch along columns and rows, the same units per post.
    ratio, half : int
        Cells per post; cells of a patch to each side.
    gains : ndarray, shape (views, rows, columns)
        By which grey values of a view are larger than those of the surface.
    noise : ndarray, shape (views,)
        Variances in the system of the surface.
    seen : ndarray of bool, shape (views, rows, columns)
        Whether the surface hides nothing between the post and the view.
    wanted : ndarray of bool, shape (rows, columns)
        Posts that are compared.
    squares, expected : ndarray, shape (rows, columns), float32
        Filled at these: the differences, and what they would be of unrelated grey values; NaN where no two views are
        compared.
    """
    views, nz, ny, nx, _ = lattice.shape
    height, width = raws.shape[1], raws.shape[2]
    side = 2 * half + 1
    cells = side * side
    patch, own, variance = np.empty((MOST_VIEWS, cells)), np.empty(MOST_VIEWS), np.empty(MOST_VIEWS)
    most = MOST_VIEWS * (MOST_VIEWS - 1) // 2
    best, chance = np.empty(most), np.empty(most)
    ends = np.empty((3, 2))
    for j in range(tried.shape[0]):
        for i in range(tried.shape[1]):
            if not wanted[j, i]:
                continue
            squares[j, i] = expected[j, i] = np.nan
            z = min(max(tried[j, i], 0.0), nz - 1.0)
            n = min(int(z), nz - 2)
            y, x = min(j / spacing, ny - 1.0), min(i / spacing, nx - 1.0)
            r, c = min(int(y), ny - 2), min(int(x), nx - 2)
            f, g, h = x - c, y - r, z - n
            number, visible = 0, 0
            for v in range(views):
                visible += seen[v, j, i]
                if number == MOST_VIEWS:
                    continue
                at = lattice[v, n : n + 2, r : r + 2, c : c + 2]
                px = py = 0.0
                for e in range(2):
                    low = at[0, 0, 0, e] * (1 - f) + at[0, 0, 1, e] * f
                    high = at[0, 1, 0, e] * (1 - f) + at[0, 1, 1, e] * f
                    below = low * (1 - g) + high * g
                    across = (at[0, 0, 1, e] - at[0, 0, 0, e]) * (1 - g) + (at[0, 1, 1, e] - at[0, 1, 0, e]) * g
                    down = high - low
                    low = at[1, 0, 0, e] * (1 - f) + at[1, 0, 1, e] * f
                    high = at[1, 1, 0, e] * (1 - f) + at[1, 1, 1, e] * f
                    above = low * (1 - g) + high * g
                    rise = above - below
                    ends[0, e] = across / spacing + rise * slopes[0, j, i]
                    ends[1, e] = down / spacing + rise * slopes[1, j, i]
                    ends[2, e] = below + h * rise
                px, py = ends[2, 0], ends[2, 1]
                if not (px >= 0.0 and py >= 0.0 and px <= width - 1.0 and py <= height - 1.0):
                    continue
                total, whole = 0.0, True
                for q in range(side):
                    for p in range(side):
                        a, b = (p - half) / ratio, (q - half) / ratio
                        sx, sy = px + ends[0, 0] * a + ends[1, 0] * b, py + ends[0, 1] * a + ends[1, 1] * b
                        if not (sx >= 0.0 and sy >= 0.0 and sx <= width - 1.0 and sy <= height - 1.0):
                            whole = False
                            break
                        s, t = min(int(sx), width - 2), min(int(sy), height - 2)
                        d, e2 = sx - s, sy - t
                        upper = raws[v, t, s] + d * (raws[v, t, s + 1] - raws[v, t, s])
                        lower = raws[v, t + 1, s] + d * (raws[v, t + 1, s + 1] - raws[v, t + 1, s])
                        value = upper + e2 * (lower - upper)
                        patch[number, q * side + p] = value
                        total += value
                    if not whole:
                        break
                if not whole or np.isnan(total):
                    continue
                mean, spread = total / cells, 0.0
                for k in range(cells):
                    patch[number, k] = (patch[number, k] - mean) / gains[v, j, i]
                    spread += patch[number, k] ** 2
                own[number], variance[number] = noise[v], spread / (cells - 1)
                number += 1
            if number < 2:
                continue
            count = 0
            for a2 in range(number):
                for b2 in range(a2):
                    total = 0.0
                    for k in range(cells):
                        total += (patch[a2, k] - patch[b2, k]) ** 2
                    scale = own[a2] + own[b2]
                    value, usual = total / ((cells - 1) * scale), (variance[a2] + variance[b2]) / scale
                    k = count
                    while k > 0 and best[k - 1] > value:
                        best[k], chance[k] = best[k - 1], chance[k - 1]
                        k -= 1
                    best[k], chance[k] = value, usual
                    count += 1
            some = max(2, (min(max(visible, 2), number) + 1) // 2)
            taken = min(count, some * (some - 1) // 2)
            one = two = 0.0
            for k in range(taken):
                one += best[k] / taken
                two += chance[k] / taken
            squares[j, i], expected[j, i] = one, two


@kernel
def visible_posts(heights, ways, ceiling, slack, seen):
    """Whether a surface of heights (rows, columns) lets a view see its posts.

    `ways` are the changes of place of the view's rays with height, posts per metre, shape (rows, columns, 2);
    `ceiling` is the highest of the heights, `slack` how far a ray may dive below a post, metres. `seen` is filled.
    """
    rows, columns = heights.shape
    for j in range(rows):
        for i in range(columns):
            seen[j, i] = True
            du, dv = ways[j, i, 0], ways[j, i, 1]
            length = max(abs(du), abs(dv))
            if not length > 0.0:
                continue
            k = 1
            while True:
                z = heights[j, i] + k / length
                if z > ceiling:
                    break
                u, v = i + du * k / length, j + dv * k / length
                c, r = int(u + 0.5), int(v + 0.5)
                if u < 0.0 or v < 0.0 or c >= columns or r >= rows:
                    break
                if heights[r, c] > z + slack:
                    seen[j, i] = False
                    break
                k += 1
