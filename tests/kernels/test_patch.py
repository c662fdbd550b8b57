"""One patch is textbook collocation; several patches join smoothly; what is said of single data is leave-one-out."""

from __future__ import annotations

import numpy as np
import pytest
from collocation_twin import collocation, stacked
from numpy.typing import NDArray

from photoplan.kernels import prediction
from photoplan.kernels.prediction import EXPONENTIAL, GAUSSIAN, MATERN, predict, usable_data

# The variance is small, so that the weak prior of the trend's slope (in 1/m²) does not matter.
VARIANCE, LENGTH, GAP = 1e-4, 3.0, 2.0
ROAD = np.array([[-200.0, 1.0], [2.0, 1.5], [6.0, 3.0], [200.0, 4.0]])
DITCH = np.array([[3.0, 7.0], [6.0, 6.0], [8.0, 8.0]])


def data(n: int = 40, seed: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(0, 10, (n, 2)), rng.normal(0, 0.01, n)])
    return xyz, rng.uniform(0.2, 2.0, n) * 1e-5


def predicted(
    xyz: NDArray[np.float64],
    noise: NDArray[np.float64],
    leaves: NDArray[np.float64],
    ids: NDArray[np.int64],
    targets: NDArray[np.float64],
    family: int = MATERN,
    lines: tuple[NDArray[np.float64], ...] = (),
    models: NDArray[np.float64] | None = None,
    shares: NDArray[np.float64] | None = None,
    squares: NDArray[np.float64] | None = None,
    lost: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Height, sigma, distance, roughness, lost variance (t, 5); a patch is asked for what lies within its reach."""
    p, t = len(leaves), len(targets)
    if models is None:
        models = np.tile(np.array([family, VARIANCE, LENGTH, GAP]), (p, 1, 1))
    if shares is None:
        shares = np.ones(models.shape[:2]) / models.shape[1]
    sums = np.zeros((t, 6))
    sums[:, 3] = np.inf
    reached = [np.flatnonzero(np.abs(targets - leaf[:2]).max(axis=1) < 1.5 * leaf[2]) for leaf in leaves]
    wanted, start = np.concatenate(reached), np.concatenate([[0], np.cumsum([len(r) for r in reached])])
    about = (
        np.full(len(xyz), np.nan) if squares is None else squares,
        np.zeros(len(xyz)) if lost is None else lost,
        USUAL,
    )
    ids = np.ascontiguousarray(ids)
    failed = predict(
        xyz, noise, ids, leaves, targets, wanted, start, *stacked(list(lines)), models, shares, *about, sums
    )
    assert failed == 0
    mean = sums / sums[:, 1:2]
    return np.column_stack([mean[:, 0], mean[:, 2], sums[:, 3], mean[:, 4:]])


USUAL = np.array([1.1, 3.0, 2.5])
"""Mean of squares, how many data it counts as, reach."""


ONE = np.array([[5.0, 5.0, 6.0]])
TARGETS = np.random.default_rng(9).uniform(0, 10, (25, 2))


@pytest.mark.parametrize("family", [GAUSSIAN, MATERN, EXPONENTIAL])
@pytest.mark.parametrize("lines", [(), (ROAD,), (ROAD, DITCH)])
def test_a_patch_is_textbook_collocation(family: int, lines: tuple[NDArray[np.float64], ...]) -> None:
    xyz, noise = data()
    got = predicted(xyz, noise, ONE, np.arange(40)[None], TARGETS, family, lines)
    local = xyz - [5.0, 5.0, 0.0]
    moved = [line - 5.0 for line in lines]
    heights, variances = collocation(local, noise, TARGETS - 5.0, (family, VARIANCE, LENGTH, GAP), moved)
    tolerance = 3e-4 if lines else 1e-7  # lines are cut at the box, and prolonged
    np.testing.assert_allclose(got[:, 0], heights, atol=tolerance)
    np.testing.assert_allclose(got[:, 1], np.sqrt(variances), rtol=1e-6 if not lines else 0.05)
    nearest = np.linalg.norm(TARGETS[:, None] - xyz[None, :, :2], axis=2).min(axis=1)
    np.testing.assert_allclose(got[:, 2], nearest, rtol=1e-9)


def test_roughness_is_the_weighted_mean_of_squares() -> None:
    xyz, noise = data()
    squares = np.random.default_rng(2).chisquare(1, 40) * 3
    squares[3], squares[5] = np.nan, 400.0
    got = predicted(xyz, noise, ONE, np.arange(40)[None], TARGETS, squares=squares)[:, 3]
    away = np.linalg.norm(TARGETS[:, None] - xyz[None, :, :2], axis=2)
    weight = np.where(np.isnan(squares), 0.0, (1 + (away / 2.5) ** 2) ** -2.0)
    expected = (weight @ np.minimum(np.nan_to_num(squares), 16.0) + 3.0 * 1.1) / (weight.sum(axis=1) + 3.0)
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_roughness_is_that_of_the_own_side_of_a_line() -> None:
    """A hundredth of the squares south of the road; so near to it both sides have as many data around."""
    xyz, noise = data(200)
    north = xyz[:, 1] > np.interp(xyz[:, 0], *ROAD.T)
    places = np.column_stack([np.linspace(2, 8, 7), np.interp(np.linspace(2, 8, 7), *ROAD.T)])
    args = (xyz, noise, ONE, np.arange(200)[None])
    above, below = (
        predicted(*args, places + np.array([0, by]), lines=(ROAD,), squares=np.where(north, 4.0, 0.04))[:, 3]
        for by in (0.1, -0.1)
    )
    assert (above > 2.5).all() and (below < 1.1).all()


def test_data_without_noise_are_met() -> None:
    xyz, _ = data()
    got = predicted(xyz, np.zeros(40), ONE, np.arange(40)[None], xyz[:, :2].copy())
    np.testing.assert_allclose(got[:, 0], xyz[:, 2], atol=1e-7)
    assert (got[:, 1] < 2e-3 * np.sqrt(VARIANCE)).all()


def test_a_plane_is_predicted_as_a_plane() -> None:
    xyz, noise = data()
    xyz[:, 2] = 3.0 + 0.4 * xyz[:, 0] - 0.7 * xyz[:, 1]
    got = predicted(xyz, noise, ONE, np.arange(40)[None], TARGETS, lines=(ROAD,))
    np.testing.assert_allclose(got[:, 0], 3.0 + TARGETS @ [0.4, -0.7], atol=1e-6)


def test_bad_data_and_repeated_data_do_not_count() -> None:
    xyz, noise = data()
    spoiled, marked = xyz.copy(), noise.copy()
    spoiled[7, 2], marked[7] = 99.0, -1.0
    ids = np.concatenate([np.arange(40), [3, 3, -1, 12]])[None]
    without = np.delete(np.arange(40), 7)
    np.testing.assert_array_equal(usable_data(ids[0], marked), without)
    got = predicted(spoiled, marked, ONE, ids, TARGETS)
    np.testing.assert_array_equal(got, predicted(xyz, noise, ONE, without[None], TARGETS))


def test_models_are_mixed_by_share_over_variance() -> None:
    xyz, noise = data()
    ids = np.arange(40)[None]
    models = np.array([[[MATERN, VARIANCE, LENGTH, GAP], [MATERN, 2 * VARIANCE, LENGTH / 3, GAP]]])
    each = [predicted(xyz, noise, ONE, ids, TARGETS, models=models[:, [k]].copy()) for k in (0, 1)]
    both = predicted(xyz, noise, ONE, ids, TARGETS, models=models, shares=np.array([[0.3, 0.7]]))
    weights = [share / one[:, 1] ** 2 for share, one in zip((0.3, 0.7), each)]
    mean = sum(w * one[:, 0] for w, one in zip(weights, each)) / sum(weights)
    np.testing.assert_allclose(both[:, 0], mean, rtol=1e-9)
    only = predicted(xyz, noise, ONE, ids, TARGETS, models=models, shares=np.array([[1.0, 0.0]]))
    np.testing.assert_array_equal(only, each[0])


LEAVES = np.array([[2.5, 2.5, 2.5], [7.5, 2.5, 2.5], [2.5, 7.5, 2.5], [6.25, 6.25, 1.25], [8.75, 6.25, 1.25],
                   [6.25, 8.75, 1.25], [8.75, 8.75, 1.25]])  # fmt: skip
"""Four leaves of a quadtree, one of them quartered."""


class TestManyPatches:
    """Each leaf with data of its own."""

    def surface(self, targets: NDArray[np.float64]) -> NDArray[np.float64]:
        xyz, noise = data(60, seed=4)
        apart = np.abs(LEAVES[:, None, :2] - xyz[None, :, :2]).max(axis=2)
        return predicted(xyz, noise, LEAVES, np.argsort(apart, axis=1)[:, :15], np.ascontiguousarray(targets))

    def edges(self) -> NDArray[np.float64]:
        """Places on the borders of leaves, and where their patches begin, end and lose weight."""
        parts = (-1.5, -1, -0.5, 0.5, 1, 1.5)
        x = np.unique(np.concatenate([LEAVES[:, 0] + part * LEAVES[:, 2] for part in parts]))
        return np.stack(np.meshgrid(x[(x > 0) & (x < 10)], np.linspace(0.4, 9.6, 5)), axis=-1).reshape(-1, 2)

    @pytest.mark.parametrize("axis", [0, 1])
    def test_patches_join_without_a_jump(self, axis: int) -> None:
        places, step = np.roll(self.edges(), axis, axis=1), np.eye(2)[axis] * 1e-9
        np.testing.assert_allclose(self.surface(places - step), self.surface(places + step), atol=3e-9)

    @pytest.mark.parametrize("axis", [0, 1])
    def test_patches_join_without_a_crease(self, axis: int) -> None:
        """The change of slope across a border vanishes with the step."""
        places = np.roll(self.edges(), axis, axis=1)
        bend = []
        for h in (1e-2, 1e-4):
            step = np.eye(2)[axis] * h
            before, here, after = (self.surface(places + k * step)[:, 0] for k in (-1, 0, 1))
            bend.append(np.abs(after - 2 * here + before).max() / h)
        assert bend[1] < 0.05 * bend[0]


MODEL = (MATERN, VARIANCE, LENGTH, GAP)


class TestLeaveOneOut:
    ROAD = np.array([[-600.0, 1.0], [2.0, 1.5], [6.0, 3.0], [600.0, 4.0]])

    @pytest.fixture
    def truth(self) -> tuple[NDArray[np.float64], ...]:
        """Data, and their differences from what the others predict, with the variances of these."""
        xyz, noise = data(24, seed=6)
        centre = np.array([5.0, 5.0, 0.0])
        differences, variances = np.empty(24), np.empty(24)
        for k in range(24):
            rest = np.delete(np.arange(24), k)
            z, v = collocation(xyz[rest] - centre, noise[rest], xyz[[k], :2] - 5.0, MODEL, [self.ROAD - 5.0])
            differences[k], variances[k] = xyz[k, 2] - z[0], v[0] + noise[k]
        return xyz, noise, differences, variances

    def test_points(self, truth: tuple[NDArray[np.float64], ...]) -> None:
        xyz, noise, differences, variances = truth
        result = np.full((24, 3), np.nan)
        own, own_start = np.arange(5, 24), np.array([0, 19])
        failed = prediction.test_points(
            xyz, noise, np.arange(24)[None], ONE, own, own_start, *stacked([self.ROAD]), np.array([MODEL]), result
        )
        assert failed == 0 and np.isnan(result[:5]).all()
        np.testing.assert_allclose(result[5:, 2], (differences / np.sqrt(variances))[5:], atol=0.03)
        np.testing.assert_allclose(result[5:, 1], (noise / variances)[5:], rtol=0.03)
        np.testing.assert_allclose(result[5:, 0], differences[5:], atol=2e-4)
        assert (result[5:, 1] > 0).all() and (result[5:, 1] < 1).all()

    def test_what_is_far_off_takes_no_part_in_what_is_said_of_others(self) -> None:
        xyz, noise = data(30)
        none, model = stacked([]), np.array([MODEL])
        without, spoiled = np.full((28, 3), np.nan), np.full((30, 3), np.nan)
        kept = np.arange(28)
        args = (kept, np.array([0, 28]), *none, model)
        prediction.test_points(xyz[kept], noise[kept], kept[None], ONE, *args, without)
        xyz[28:, 2] += 50.0
        prediction.test_points(xyz, noise, np.arange(30)[None], ONE, *args, spoiled)
        np.testing.assert_allclose(spoiled[:28], without, rtol=1e-4, atol=1e-6)

    def test_residuals_are_those_of_the_filtered_surface(self) -> None:
        """Where nothing is so far off that it takes no part."""
        xyz, noise = data()
        noise = 25 * noise
        result = np.full((40, 3), np.nan)
        none = stacked([])
        args = (np.arange(40), np.array([0, 40]), *none, np.array([MODEL]), result)
        assert prediction.test_points(xyz, noise, np.arange(40)[None], ONE, *args) == 0
        surface = predicted(xyz, noise, ONE, np.arange(40)[None], xyz[:, :2].copy())
        assert np.abs(result[:, 2]).max() < 4
        # Residual against the filtered surface = redundancy · difference from the prediction.
        np.testing.assert_allclose(result[:, 0] * result[:, 1], xyz[:, 2] - surface[:, 0], atol=1e-6)

    def test_score(self, truth: tuple[NDArray[np.float64], ...]) -> None:
        """The negative logarithm of the predictive density, near points counting most."""
        xyz, noise, differences, variances = truth
        result = np.empty((1, 2))
        worse = (MATERN, 25 * VARIANCE, LENGTH / 6, GAP)
        models = np.array([[MODEL, worse]])
        prediction.score_models(xyz, noise, np.arange(24)[None], ONE, 20, *stacked([self.ROAD]), models, result)
        away = ((xyz[:20, :2] - 5.0) ** 2).sum(axis=1) / (1.5 * ONE[0, 2]) ** 2
        expected = (np.exp(-away / 2) * (differences**2 / variances + np.log(variances))[:20]).sum()
        assert result[0, 0] == pytest.approx(expected, rel=5e-3)
        assert result[0, 1] > result[0, 0]

    def test_a_patch_of_equal_places_without_noise_has_no_solution(self) -> None:
        xyz = np.zeros((4, 3))
        result = np.full((4, 3), np.nan)
        model = np.array([[GAUSSIAN, np.nan, LENGTH, GAP]])
        none = stacked([])
        args = (np.arange(4), np.array([0, 4]), *none, model, result)
        assert prediction.test_points(xyz, np.zeros(4), np.arange(4)[None], ONE, *args) == 1
        assert np.isnan(result).all()
