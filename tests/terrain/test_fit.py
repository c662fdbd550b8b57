"""The stochastic model: known covariance functions are recovered, sigmas are honest, gross errors found by name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.build_terrain import built, directly, line, scattered, terrain
from tools.build_terrain import unit_of as unit_at
from tools.random_field import random_field
from tools.rough_terrain import dunes, sampled
from tools.thinned import some, thinned

from photoplan.surfaces.units import MeasuredLine
from photoplan.terrain.build import Built, plan_build
from photoplan.terrain.covariance import Covariance, Neighbours, estimate_all
from photoplan.terrain.fit import _members, unit_of
from photoplan.terrain.observations import FAMILIES, BuildSettings, quadtree

STEP = 0.2
#: Few posts: what is asked here is asked of the fit, and of places themselves.
WIDE = {"grid_width": 4.0, "unit_meshes": 16, "adapt": 0.0}


def sample(family: str, length: float, seed: int, noise: float, count: int = 6000) -> NDArray[np.float64]:
    """Points at random nodes of a random field of variance 1, one per m²."""
    nodes = int(np.sqrt(count) / STEP)
    rng = np.random.default_rng(seed + 1000)
    place = rng.choice(nodes * nodes, count, replace=False)
    row, column = np.divmod(place, nodes)
    z = random_field(family, length, nodes, STEP, seed)[row, column] + rng.normal(0, noise, count)
    return np.column_stack([column * STEP + 1000, row * STEP + 500, z])


def estimated(xyz: NDArray[np.float64], family: str) -> Covariance:
    """Covariance function of the whole area."""
    settings = BuildSettings(family=family, unit_meshes=32)  # type: ignore[arg-type]
    plan = plan_build(terrain(xyz), settings)
    seen, origin = plan.seen, plan.seen.origin
    layout = replace(plan.layout, left=plan.layout.left - origin[0], top=plan.layout.top - origin[1])
    leaves = quadtree(seen.xyz[:, :2], layout, 32)
    neighbours = Neighbours.of(seen.xyz[:, :2], seen.points, leaves.order)
    members = _members(unit_of(seen.xyz[:, :2], layout), layout.columns * layout.rows)
    return estimate_all(seen, neighbours, members, settings)[0]


_FIELDS = [("matern", 3.0, 0.1, 1, 3000)]
_MORE_FIELDS = [("gaussian", 3.0, 0.1, 5, 6000), ("matern", 3.0, 0.1, 5, 6000), ("exponential", 3.0, 0.3, 5, 6000)]


@pytest.mark.parametrize(
    ("family", "length", "noise", "fields", "count"),
    [*_FIELDS, *(pytest.param(*each, marks=pytest.mark.slow) for each in _MORE_FIELDS)],
)
def test_parameters_of_random_fields_are_recovered(
    family: str, length: float, noise: float, fields: int, count: int
) -> None:
    """The mean of several fields within 20 %: a single one's own variance scatters by 10 to 20 %."""
    found = [estimated(sample(family, length, seed, noise, count), family) for seed in range(fields)]
    assert {one.name for one in found} == {family}
    mean = np.exp(np.median([(np.log(f.variance), np.log(f.length), np.log(f.noise)) for f in found], axis=0))
    relative = mean / (1.0, length, noise)
    assert (np.abs(relative - 1) < 0.2).all(), relative


@thinned("runs", 1, 3)
def test_on_level_ground_the_whole_spread_of_the_heights_is_noise(runs: int) -> None:
    """A lake, an airfield: no signal at all. The noise is not bounded by the median of the deviations."""
    rng = np.random.default_rng(0)
    for _ in range(runs):
        place = rng.uniform(0, 250, (1000, 2)) + 1000
        found = estimated(np.column_stack([place, 100 + rng.normal(0, 0.05, 1000)]), "auto")
        assert found.noise == pytest.approx(0.05, rel=0.15)


def test_the_smoothest_and_the_roughest_family_are_told_apart() -> None:
    for family in ("gaussian", "exponential"):
        assert estimated(sample(family, 4.0, 3, 0.02, 1500), "auto").name == family
    assert set(FAMILIES) == {"gaussian", "matern", "exponential"}


class TestSigma:
    NOISE = 0.15

    @pytest.mark.parametrize("family", some(FAMILIES))
    def test_held_out_points_scatter_as_sigma_says(self, family: str) -> None:
        """Residual over √(σ² + noise²): σ is that of the surface, the held-out height has its own noise."""
        xyz = sample(family, 4.0, 7, self.NOISE, 6000)
        kept, held = xyz[600:], xyz[:600]
        model = built(terrain(kept))
        heights, sigmas = directly(model, held[:, :2])
        noise = np.array([unit.noise for unit in model.fit.units])[unit_at(model, held[:, :2])]
        normalised = (held[:, 2] - heights) / np.hypot(sigmas, noise)
        assert 0.9 < normalised.std() < 1.1
        assert abs(normalised.mean()) < 0.15

    @pytest.mark.slow
    def test_sigma_is_that_of_the_difference_from_the_truth(self) -> None:
        xyz = sample("matern", 4.0, 8, self.NOISE, 6000)
        truth = sample("matern", 4.0, 8, 0.0, 6000)
        kept, held = xyz[600:], truth[:600]
        model = built(terrain(kept))
        heights, sigmas = directly(model, held[:, :2])
        ratio = ((held[:, 2] - heights) / sigmas).std()
        assert 0.85 < ratio < 1.15

    def test_sigma_grows_away_from_the_data(self) -> None:
        xyz = sample("matern", 4.0, 9, self.NOISE, 1600)
        xyz = xyz[np.linalg.norm(xyz[:, :2] - [1020, 520], axis=1) > 6]
        model = built(terrain(xyz), **WIDE)
        _, sigmas = directly(model, np.array([[1020.0, 520.0], [1020, 524], [1007, 507]]))
        assert sigmas[0] > 1.3 * sigmas[1] > 1.5 * sigmas[2]


@pytest.fixture(scope="module")
def roof() -> NDArray[np.float64]:
    """Two planes with waves along them."""
    xy = scattered(60.0, 1600, 5)
    z = 106.0 - 0.4 * np.abs(xy[:, 0] - 30) + 0.4 * np.sin(xy[:, 1] / 8)
    return np.column_stack([xy, z + np.random.default_rng(5).normal(0, TestGrossErrors.NOISE, len(xy))])


class TestGrossErrors:
    NOISE = 0.05
    RIDGE = np.column_stack([np.full(31, 30.0), np.linspace(0, 60, 31), np.full(31, 106.0)])

    @staticmethod
    def ridge() -> MeasuredLine:
        xyz = TestGrossErrors.RIDGE.copy()
        xyz[:, 2] += 0.4 * np.sin(xyz[:, 1] / 8)
        return line(xyz)

    @staticmethod
    def spoiled(roof: NDArray[np.float64]) -> tuple[NDArray[np.float64], list[int]]:
        """Twelve errors of 20 noises anywhere, up and down, and four beside the ridge."""
        rng = np.random.default_rng(6)
        xyz, far = roof.copy(), np.abs(roof[:, 0] - 30) > 4
        single: list[int] = []
        beside = np.argsort(np.abs(np.abs(roof[:, 0] - 30) - 0.5))[:40]
        for k in [*beside, *rng.permutation(np.flatnonzero(far))]:
            apart = np.linalg.norm(roof[[*single], :2] - roof[k, :2], axis=1).min(initial=np.inf)
            if len(single) < (4 if k in beside else 16) and apart > 7:
                single.append(int(k))
        bad = single[4:]
        bad += single[:4]
        sign = np.where(np.arange(len(bad)) % 2 == 0, 1, -1)
        xyz[bad, 2] += 20 * TestGrossErrors.NOISE * sign
        return xyz, bad

    def nearest(self, xyz: NDArray[np.float64], k: int) -> int:
        return int(np.argsort(np.linalg.norm(xyz[:, :2] - xyz[k, :2], axis=1))[1])

    def test_two_neighbours_that_deviate_alike_contradict_all_others(self, roof: NDArray[np.float64]) -> None:
        """A small group whose border breaks off all round is wrong, or a stone; whoever knows it takes `gross=0`."""
        k = int(np.flatnonzero(np.abs(roof[:, 0] - 30) > 4)[107])
        near = np.flatnonzero(np.abs(roof[:, 1] - roof[k, 1]) < 14)
        xyz, k = roof[near], int(np.searchsorted(near, k))
        pair = [k, self.nearest(xyz, k)]
        xyz[pair, 2] += 20 * self.NOISE
        assert set(pair) <= set(built(terrain(xyz, self.ridge()), **WIDE).fit.gross.tolist())

    @pytest.fixture(scope="class")
    def model(self, roof: NDArray[np.float64]) -> tuple[Built, list[int]]:
        xyz, bad = self.spoiled(roof)
        return built(terrain(xyz, self.ridge()), **WIDE), bad

    def test_fault_17_planted_errors_are_flagged_and_few_others(self, model: tuple[Built, list[int]]) -> None:
        found, bad = model
        missed = sorted(set(bad) - set(found.fit.gross.tolist()))
        wrong = set(found.fit.gross.tolist()) - set(bad)
        assert missed == []
        assert len(wrong) <= 0.005 * found.fit.seen.points

    def test_residual_and_redundancy_are_those_of_the_error(self, model: tuple[Built, list[int]]) -> None:
        found, bad = model
        residual, redundancy, normalised = found.fit.residuals[bad].T
        assert ((redundancy > 0) & (redundancy <= 1)).all()
        # What the others predict is right to the noise of neighbours: the difference is the error itself.
        error = np.abs(residual)
        single = error[:12]
        assert np.abs(np.median(single) / (20 * self.NOISE) - 1) < 0.2
        assert (np.abs(normalised) > 5).all()
        label = found.fit.seen.record[bad[0]]
        assert label == bad[0] and found.fit.seen.group[bad[0]] == 0

    def test_a_flagged_point_does_not_bend_the_surface(
        self, model: tuple[Built, list[int]], roof: NDArray[np.float64]
    ) -> None:
        found, bad = model
        heights, _ = directly(found, np.ascontiguousarray(roof[bad, :2]))
        assert np.abs(heights - roof[bad, 2]).max() < 5 * self.NOISE

    @pytest.mark.slow
    def test_good_points_are_left_alone(self, roof: NDArray[np.float64]) -> None:
        assert len(built(terrain(roof, self.ridge())).fit.gross) <= 0.005 * len(roof)

    def test_none_is_sought_with_limit_zero(self, roof: NDArray[np.float64]) -> None:
        xyz, _ = self.spoiled(roof)
        found = built(terrain(xyz[:400], self.ridge()), gross=0.0, **WIDE).fit
        assert len(found.gross) == 0 and np.isfinite(found.residuals[:, 2]).mean() > 0.99


def test_crests_that_few_blocks_meet_still_choose_a_rough_function() -> None:
    """Leaves all over the area are asked too; smooth hills stay smooth."""
    crests = built(terrain(sampled(dunes(4), scattered(200.0, 1600, 1), 0.1, 1)), adapt=100.0).fit
    assert crests.whole.name == "matern"

    def hills(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(2.0 * np.sin(xy[:, 0] / 9) * np.cos(xy[:, 1] / 7))

    assert built(terrain(sampled(hills, scattered(60.0, 900, 1), 0.1, 1)), adapt=100.0).fit.whole.name == "gaussian"
