"""Kernels of facets stereo vision against slow, obvious ways."""

from __future__ import annotations

import numpy as np
import pytest

from photoplan.kernels import facet_transfer, facets
from photoplan.kernels.jit import COMPILED
from photoplan.matching.facets.block import shares
from photoplan.matching.facets.observe import means_around


def carried(low, high, posts, out, wall=np.inf) -> None:
    steep = np.empty((-(-(len(posts) - 1) // facet_transfer.CELL), -(-(posts.shape[1] - 1) // facet_transfer.CELL)))
    facet_transfer.steepness(posts, steep)
    ways = np.concatenate([low, (high - low) / 100.0, *np.zeros((2, *low.shape))], axis=-1)
    bent = np.empty((2, *posts.shape))
    facet_transfer.facet_curvatures(posts, bent)
    facet_transfer.transfer(ways, 1, 1, posts, bent, steep, wall, out)


def test_a_ray_ends_at_the_first_facet_that_it_meets() -> None:
    """A wall of 20 m hides what is behind it; oblique rays of both directions."""
    posts = np.zeros((4, 21))
    posts[:, 8:10] = 20.0
    u = np.linspace(0, 20, 41) + 0.35
    low = np.zeros((2, 41, 2))
    low[..., 0], low[1, :, 1] = u, 3.0
    for slope in (-0.1, 0.1, 0.3):
        high = low + np.array([100.0 * slope, 0.0])
        out = np.empty((2, 41, 4), np.float32)
        carried(low, high, posts, out)
        z = np.linspace(25.0, -1.0, 26_001)
        for k in range(41):
            at = u[k] + slope * z
            below = np.flatnonzero(z <= np.interp(at, np.arange(21), posts[0]))[0]
            if 0.01 <= at[below] <= 19.99:
                assert abs(out[0, k, 0] - at[below]) < 1e-3
            elif not -0.01 <= at[below] <= 20.01:
                assert np.isnan(out[0, k]).all()
        without = np.empty_like(out)
        carried(low, high, posts, without, wall=1.5)
        facing = 9 if slope > 0 else 7
        face = (out[0, :, 0] > facing) & (out[0, :, 0] < facing + 1)
        assert face.any() and (np.isnan(without[0, :, 0]) == (face | np.isnan(out[0, :, 0]))).all()


def test_a_place_moves_as_stated_when_the_surface_rises() -> None:
    v, u = np.mgrid[:8, :8].astype(float)
    posts = 3.0 * u - 2.0 * v
    low = np.array([[[1.0, 2.0], [5.0, 2.0]], [[1.0, 5.0], [5.0, 5.0]]])
    high = low + np.array([6.0, 3.0])
    places = [np.empty((2, 2, 4), np.float32) for _ in range(2)]
    for out, lift in zip(places, (0.0, 0.1)):
        carried(low, high, posts + lift, out)
    moved = (places[1] - places[0])[..., :2] / 0.1
    assert np.abs(moved - places[0][..., 2:]).max() < 1e-3
    assert np.abs(places[0][..., 2:] - np.array([0.06, 0.03])).max() > 1e-3


def test_slopes_are_curved_between_posts_and_edges_are_not() -> None:
    """Rays on a bowl and on a hip roof end where these are; with bilinear facets, 2 m away from the bowl."""
    v, u = np.mgrid[:12, :14].astype(float)
    at = np.random.default_rng(0).uniform(2.1, 8.9, (2, 60, 2))
    for shape, off in (
        (lambda u, v: 0.3 * (u - 6.2) ** 2 + 0.2 * (v - 5.1) ** 2 + 0.4 * u, 1e-3),
        (lambda u, v: 9.0 - 0.8 * np.abs(u - 6.0) - 0.7 * np.abs(v - 5.0), 1e-5),
    ):
        way = np.array([0.02, -0.01])
        low = at - shape(at[..., 0], at[..., 1])[..., None] * way
        out = np.empty((2, 60, 4), np.float32)
        carried(low, low + 100.0 * way, shape(u, v), out)
        assert np.abs(out[..., :2] - at).max() < off


def spline(f: float) -> np.ndarray:
    """The four cubic B-splines at a part of a facet (de Boor 1978)."""
    return np.array([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3]) / 6


def grey(values: np.ndarray, at: np.ndarray, ratio: int = 2) -> np.ndarray:
    out = np.empty(len(at))
    facets.sample_grey(values, ratio, np.asarray(at, float), out)
    return out


def test_grey_facets_reproduce_a_plane() -> None:
    v, u = np.mgrid[:9, :11].astype(np.float32) - facets.PAD
    at = np.random.default_rng(0).uniform(0, 2, (50, 2))
    assert np.abs(grey(3 * u - 2 * v + 5, at) - (6 * at[:, 0] - 4 * at[:, 1] + 5)).max() < 1e-5


def grey_equations(seed: int = 0):
    """Pixels of one image on 3 × 4 posts with two grey facets each, as equations for the coefficients."""
    rng = np.random.default_rng(seed)
    places = np.empty((14, 16, 4), np.float32)
    places[..., 0], places[..., 1] = rng.uniform(0, 3, (14, 16)), rng.uniform(0, 2, (14, 16))
    places[..., 2:] = rng.normal(0, 0.1, (14, 16, 2))
    weights = rng.uniform(0.5, 1.5, (14, 16)).astype(np.float32)
    weights[3, 4] = 0.0
    shape = (2 * 2 + 1 + 2 * facets.PAD, 3 * 2 + 1 + 2 * facets.PAD)
    A = np.zeros((14 * 16, *shape))
    for row, (u, v) in enumerate(places[..., :2].reshape(-1, 2).astype(float) * 2):
        A[row, int(v) + 1 : int(v) + 5, int(u) + 1 : int(u) + 5] = np.outer(spline(v - int(v)), spline(u - int(u)))
    return rng, places, weights, shape, A.reshape(14 * 16, -1)


def test_grey_values_are_those_of_least_squares() -> None:
    rng, places, weights, shape, A = grey_equations()
    seen = rng.normal(100, 20, (14, 16)).astype(np.float32)
    counts = np.zeros((shape[0] - 2 * facets.PAD, shape[1] - 2 * facets.PAD), np.int32)
    facets.count_pixels(places, weights, 2, counts)
    assert counts.sum() == 14 * 16 - 1
    ends = np.cumsum(counts, dtype=np.int32).reshape(counts.shape) - counts
    pixels = np.empty((int(counts.sum()), 4), np.float32)
    for rows in (slice(0, 9), slice(9, 14)):
        facets.sort_pixels(places[rows], seen[rows], weights[rows], 2, ends, pixels)
    system = np.zeros((shape[0], facets.GREY_ENTRIES, shape[1]), np.float32)
    right, density = np.zeros((2, *shape), np.float32)
    facets.add_grey(pixels, ends, system, right, density)
    nearest = np.rint(places[..., :2].astype(float) * 2).astype(int) + facets.PAD
    expected = np.zeros(shape)
    np.add.at(expected, (nearest[..., 1], nearest[..., 0]), weights)
    assert np.abs(density - expected).max() < 1e-4
    system[:, 0] += np.float32(0.01)
    values = np.zeros(shape, np.float32)
    facets.solve_grey(system, right, np.ones(shape, np.float32), values, 300, 1e-7)
    N = A.T @ (weights.reshape(-1, 1) * A) + 0.01 * np.eye(A.shape[1])
    expected = np.linalg.solve(N, A.T @ (weights * seen).reshape(-1))
    assert np.abs(values.reshape(-1) - expected).max() < 1e-2


def test_errors_have_the_covariance_of_the_equations() -> None:
    """One standard deviation each, of a pixel of an image always the same."""
    _, places, weights, shape, A = grey_equations()
    right, moved = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    facets.add_random_errors(places, (7, 3), weights, 2, right)
    facets.add_random_errors(places[4:, 5:], (12, 7), weights[4:, 5:], 2, moved)
    layers = np.empty((4, 14, 5))  # of column c the layer c % 4
    facets.rademacher(1, 3, layers)
    signs = layers.transpose(1, 2, 0).reshape(14, -1)[:, 3:19]
    drawn = np.sqrt(weights) * signs
    assert np.abs(right.reshape(-1) - A.T @ drawn.reshape(-1)).max() < 1e-4 and abs(signs.mean()) < 0.2
    drawn[:4], drawn[:, :5] = 0, 0
    assert np.abs(moved.reshape(-1) - A.T @ drawn.reshape(-1)).max() < 1e-4


def test_heights_get_the_equations_of_the_pixels() -> None:
    """Against the same equations written out; the mean change of a facet counts nothing."""
    rng, places, weights, shape, A = grey_equations(1)
    values = rng.normal(0, 10, shape).astype(np.float32)
    seen = rng.normal(0, 10, (14, 16)).astype(np.float32)
    means = rng.normal(0, 0.05, (2, 3, 2))
    residuals, factors, sums = np.empty((14, 16), np.float32), np.ones((14, 16), np.float32), np.zeros(3)
    moments, trusted = np.zeros((2, 3, facets.MOMENTS)), np.arange(4) < np.full((3, 1), 2)
    pixels = facets.Pixels(first=(0, 0), places=places, grey=seen, weights=weights)
    ground = facets.GreyFacets(values=values, ratio=2, means=means, trusted=trusted)
    facets.add_heights(pixels, ground, 8.0, 2.0, moments, residuals, factors, sums)
    system, (right, noise) = np.zeros((7, 3, 4)), np.zeros((2, 3, 4))
    facets.height_equations(moments, system, right, noise)
    misfit = (A @ values.reshape(-1)).reshape(14, 16) - seen
    used = weights > 0
    assert np.abs(residuals - misfit)[used].max() < 1e-3 and np.isnan(residuals[3, 4])
    assert np.abs(factors - np.minimum(1, 16.0 / np.abs(misfit)))[used].max() < 1e-3
    told = used & (places[..., 0] < 1.5)
    assert 0 < sums[2] == told.sum() < used.sum()
    assert sums[1] == pytest.approx((factors * (misfit / 8) ** 2)[told].sum(), rel=1e-4)
    whole, squares = np.zeros((2, 2, 3)), np.zeros((2, 3))
    facets.add_sensitivities(places, weights, ground, np.float32(2.0) * values, whole)
    N, b = np.zeros((12, 12)), np.zeros(12)
    step = np.array([(1e-4, 0), (-1e-4, 0), (0, 1e-4), (0, -1e-4)])
    for (u, v, ku, kv), p, m in zip(places.reshape(-1, 4).astype(float), weights.reshape(-1), misfit.reshape(-1)):
        i, j = min(int(u), 2), min(int(v), 1)
        g = grey(values, np.array([u, v]) + step)
        a = ((g[0] - g[1]) * (ku - means[j, i, 0]) + (g[2] - g[3]) * (kv - means[j, i, 1])) / 2e-4
        squares[j, i] += p * a * a
        phi = np.zeros((3, 4))
        f, g = u - i, v - j
        phi[j : j + 2, i : i + 2] = np.outer((1 - g, g), (1 - f, f))
        N += p * a * a * np.outer(phi, phi)
        b -= p * a * m * phi.reshape(-1)
    assert np.abs(right.reshape(-1) - b).max() < 1e-3 * np.abs(b).max()
    assert np.abs(whole - np.array([1, 4])[:, None, None] * squares).max() < 4e-3 * squares.max()
    # Errors of one standard deviation have the variances of the equations.
    assert 0.4 < np.mean(noise**2 / system[0]) < 2.0
    assert np.abs(dense(system, np.zeros((3, 3, 4))) - N).max() < 1e-4 * np.abs(N).max()


#: Row, column and factor of the posts of second differences: along columns, along rows, across.
SECOND = (
    ((0, -1, 1), (0, 0, -2), (0, 1, 1)),
    ((-1, 0, 1), (0, 0, -2), (1, 0, 1)),
    ((0, 0, 1), (0, 1, -1), (1, 0, -1), (1, 1, 1)),
)


def dense(system, curve):
    """Normal equations as a full matrix."""
    _, rows, columns = system.shape
    N = np.zeros((rows, columns, rows, columns))
    for k, (dj, di) in enumerate(facets.HEIGHT_OFFSETS):
        for j in range(rows - dj):
            for i in range(max(0, -di), columns - max(0, di)):
                N[j, i, j + dj, i + di] += system[k, j, i]
                if k:
                    N[j + dj, i + di, j, i] += system[k, j, i]
    for kind in range(3):
        for j, i in zip(*np.nonzero(curve[kind])):
            c = np.zeros((rows, columns))
            for dj, di, a in SECOND[kind]:
                c[j + dj, i + di] += a
            N += curve[kind, j, i] * c[..., None, None] * c
    return N.reshape(rows * columns, -1)


def height_system(rows: int, columns: int):
    rng = np.random.default_rng(3)
    system = np.zeros((7, rows, columns))
    system[0] = rng.uniform(2, 4, (rows, columns))
    system[1, :, :-1] = system[4, :-1] = 0.3
    system[3, :-1, 1:] = system[5, :-1, :-1] = 0.1
    curve = np.zeros((3, rows, columns))
    curve[0, :, 1:-1] = curve[1, 1:-1] = curve[2, :-1, :-1] = rng.uniform(0.1, 2)
    return rng, system, curve


def test_heights_and_variances_are_those_of_the_full_matrix() -> None:
    rng, system, curve = height_system(9, 12)
    right, out = rng.normal(size=(9, 12)), np.zeros((9, 12))
    inverse = np.linalg.inv(dense(system, curve))
    facets.add_curvatures(curve, system)
    assert facets.solve_heights(system, right, 200, 1e-12, out) < 200
    assert np.abs(out.reshape(-1) - inverse @ right.reshape(-1)).max() < 1e-10
    facets.variances(system, 12, 2, out)
    assert np.abs(out.reshape(-1) - np.diag(inverse)).max() < 1e-12


def test_variances_of_parts_are_those_of_the_whole_where_pixels_determine_the_heights() -> None:
    size = (30, 34) if COMPILED else (12, 14)
    _, system, curve = height_system(*size)
    facets.add_curvatures(curve, system)
    parts, whole = np.empty(size), np.empty(size)
    facets.variances(system, 10, 8, parts)
    facets.variances(system, 40, 0, whole)
    assert np.abs(parts / whole - 1).max() < 0.01


def test_a_ray_that_meets_gentle_ground_is_not_stopped_by_a_wall_far_away_but_by_one_before_it() -> None:
    posts = 0.1 * np.random.default_rng(2).normal(size=(60, 60))
    posts[:, 40:42] = 15.0
    u = np.linspace(1, 58, 58)
    low = np.stack([np.tile(u, (2, 1)), np.repeat([[5.0], [50.0]], 58, axis=1)], axis=-1)
    for slope in (0.1, 1.0):
        out = np.empty((2, 58, 4), np.float32)
        carried(low, low + np.array([100.0 * slope, 0.0]), posts, out)
        far, hidden = u + slope * 15.0 < 39.0, (u < 38.5) & (u + slope * 13.0 > 42.0)
        assert np.abs(out[0, far, 0] - u[far]).max() < 0.6
        assert slope < 0.5 or (hidden.any() and (out[0, hidden, 0] > 38.9).all())


def test_radiometry_gets_the_equations_of_the_pixels() -> None:
    """Against g = offset + gain · G written out, with nodes every post and a half."""
    rng, places, weights, *_ = grey_equations(1)
    raw, surface = rng.normal(100, 20, (2, 14, 16)).astype(np.float32)
    shape, lattice = (3, 4), (-0.5, -0.5, 1.5)
    x, y = ((places[..., k].astype(float) + 0.5) / 1.5 for k in (0, 1))
    share = (np.maximum(0, 1 - np.abs(at[..., None] - np.arange(n))) for at, n in ((y, 3), (x, 4)))
    nodes = np.einsum("rcj,rci->rcji", *share).reshape(-1, 12)
    A = np.hstack([nodes, nodes * surface.reshape(-1, 1)])[weights.reshape(-1) > 0]
    p, g = (values.reshape(-1)[weights.reshape(-1) > 0].astype(float) for values in (weights, raw))
    system, right = np.zeros((24, 24)), np.zeros(24)
    facet_transfer.add_radiometry(places, raw, weights, surface, shape, lattice, system, right)
    assert np.abs(system - A.T @ (p[:, None] * A)).max() < 1e-5 * np.abs(system).max()
    assert np.abs(right - A.T @ (p * g)).max() < 1e-5 * np.abs(right).max()


def test_radiometry_is_solved_as_a_full_matrix() -> None:
    rng = np.random.default_rng(6)
    A = rng.normal(size=(40, 20))
    N, right = A.T @ A, rng.normal(size=20)
    want = np.linalg.solve(N, right)
    facet_transfer.solve_radiometry(N, right)
    assert np.abs(right - want).max() < 1e-9 * np.abs(want).max()


def test_what_facets_miss_of_a_wave_is_the_one_beside_it() -> None:
    """Waves of three facets as cubic splines have them, 7 % of which is another wave."""
    length, phase = 3.0, 0.4
    at = np.arange(30.0) - facets.PAD
    values = (120 + 20 * np.cos(2 * np.pi * at / length + phase) + np.zeros((28, 1))).astype(np.float32)
    places = np.zeros((40, 50, 4), np.float32)
    places[..., :2] = np.random.default_rng(0).uniform(1.5, 10, (40, 50, 2))
    seen = np.empty(places.shape[:2], np.float32)
    facets.sample_pixels(values, 2, places, np.ones_like(seen), seen)
    size = 20 * np.sinc(1 / length) ** 4
    wave = 120 + size * np.cos(2 * np.pi * 2 * places[..., 0] / length + phase)
    missed = np.zeros_like(seen)
    facets.add_spline_residual(values, 2, places, np.ones_like(seen), shares(), missed)
    assert np.abs(seen - wave).max() > 0.06 * size and np.abs(seen - missed - wave).max() < 0.01 * size
    missed[:] = 0
    facets.add_spline_residual(np.full_like(values, 120), 2, places, np.ones_like(seen), shares(), missed)
    assert np.abs(missed).max() < 1e-3


def test_means_of_squares_are_not_negative_beside_large_ones() -> None:
    values = np.zeros((40, 50))
    values[5:9, 7:12] = np.random.default_rng(0).uniform(0, 1e9, (4, 5))
    found = means_around(values, 5)
    assert found.min() == 0 and found.max() > 1e7
