"""How well images agree around posts at heights that are tried, and which images a surface lets see a post."""

from __future__ import annotations

import numpy as np

from photoplan.kernels.jit import kernel

#: Images of a post that are compared at most.
MOST_VIEWS = 8


@kernel
def agreement(raws, lattice, spacing, tried, slopes, ratio, half, gains, noise, seen, wanted, squares, expected):
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
def unhidden(heights, ways, ceiling, slack, seen):
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
