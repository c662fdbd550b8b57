"""Prediction: planes exactly, data exactly without noise, noise filtered; the same wherever it lies and is turned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.build_terrain import built, directly, line, scattered, surface_of, terrain

from photoplan.terrain.build import Built
from photoplan.terrain.predict import predict_lines


def hills(XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Waves of 30 to 45 m."""
    return np.asarray(200.0 + 2 * np.sin(XY[:, 0] / 7) * np.cos(XY[:, 1] / 5) + 0.02 * XY[:, 0])


def points(side: float = 60.0, count: int = 700, seed: int = 1, noise: float = 0.0) -> NDArray[np.float64]:
    xy = scattered(side, count, seed)
    return np.column_stack([xy, hills(xy) + np.random.default_rng(seed + 50).normal(0, noise, len(xy))])


INSIDE = np.random.default_rng(3).uniform(4, 47, (400, 2))
#: Units of 32 m with few posts: places are predicted themselves.
WIDE: dict[str, Any] = {"grid_width": 2.0, "unit_meshes": 16, "adapt": 0.0}


class TestPlane:
    SLOPES = np.array([0.31, -0.17])

    def plane(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(50.0 + XY @ self.SLOPES)

    @pytest.fixture(
        params=[
            "even",
            pytest.param("dense and thin", marks=pytest.mark.slow),
            "profiles",
            "with lines",
        ]
    )
    def model(self, request: pytest.FixtureRequest) -> Built:
        rng = np.random.default_rng(4)
        xy, lines = scattered(60.0, 500, 2), []
        if request.param == "dense and thin":
            xy = np.vstack([xy[::6], rng.uniform(20, 30, (900, 2)), rng.uniform(40, 41, (200, 2))])
        if request.param == "profiles":
            xy = np.stack(np.meshgrid(np.arange(0, 60, 1.0), np.arange(0.5, 60, 6)), axis=-1).reshape(-1, 2)
        if request.param == "with lines":
            for k, kind in enumerate(("breakline", "formline", "breakline")):
                way = np.array([[5.0, 10 + 9 * k], [30, 20 + 9 * k], [50, 12 + 9 * k]])
                lines.append(line(np.column_stack([way, self.plane(way)]), kind, f"l{k}"))
        return built(terrain(np.column_stack([xy, self.plane(xy)]), *lines), reach=20.0, grid_width=2.0)

    def test_a_plane_is_reproduced(self, model: Built) -> None:
        heights, _ = directly(model, INSIDE)
        np.testing.assert_allclose(heights, self.plane(INSIDE), atol=1e-6)
        # Posts are float32 above the unit's datum.
        np.testing.assert_allclose(surface_of(model).heights(INSIDE), self.plane(INSIDE), atol=5e-6)
        for element in model.lines:
            np.testing.assert_allclose(element.xyz[:, 2], self.plane(element.xyz[:, :2]), atol=1e-6)


class TestExactInterpolation:
    def test_heights_at_the_data(self) -> None:
        xyz = points()
        model = built(terrain(xyz), filters={"mass": 0.0}, gross=0.0, **WIDE)
        inner = xyz[(np.abs(xyz[:, :2] - 30) < 28).all(axis=1)]
        heights, sigmas = directly(model, np.ascontiguousarray(inner[:, :2]))
        np.testing.assert_allclose(heights, inner[:, 2], atol=1e-4)
        assert sigmas.max() < 0.01

    def test_posts_that_are_data(self) -> None:
        x, y = np.meshgrid(np.arange(33.0), np.arange(33.0))
        xy = np.column_stack([x.ravel(), y.ravel()])
        xyz = np.column_stack([xy, hills(xy)])
        model = built(terrain(xyz), filters={"mass": 0.0}, gross=0.0, grid_width=1.0, adapt=0.0)
        np.testing.assert_allclose(surface_of(model).heights(xy), xyz[:, 2], atol=1e-4)

    def test_a_breakline_without_noise_keeps_its_heights(self) -> None:
        xyz, way = points(noise=0.1), np.column_stack([np.linspace(5, 55, 61), np.linspace(30, 34, 61)])
        ridge = line(np.column_stack([way, hills(way)]))
        model = built(terrain(xyz, ridge), filters={"mass": 0.1, "breakline": 0.0}, **WIDE)
        (element,) = predict_lines(model.fit)
        # Every variance gets 1e-8 of the signal's, so that matrices can be factorised.
        assert np.abs(element.xyz[:, 2] - ridge.xyz[:, 2]).max() < 2e-3


@pytest.mark.slow
def test_noise_is_filtered_at_nine_points_per_mesh() -> None:
    """Meshes of 3 × 3 points: the error of prediction is at most half the noise of a point."""
    xyz, noise = points(90.0, 8100, 6, 0.2), 0.2
    model = built(terrain(xyz), grid_width=3.0, adapt=0.0, unit_meshes=8)
    left, top = model.plan.layout.left, model.plan.layout.top
    posts = np.stack(np.meshgrid(left + 3 * np.arange(40), top - 3 * np.arange(40)), axis=-1).reshape(-1, 2)
    posts = posts[(np.abs(posts - 45) < 44).all(axis=1)]
    error = surface_of(model).heights(posts) - hills(posts)
    assert np.sqrt(np.mean(error**2)) <= 0.5 * noise


@pytest.fixture(scope="module")
def xyz() -> NDArray[np.float64]:
    return points(noise=0.1)


@pytest.fixture(scope="module")
def way() -> NDArray[np.float64]:
    way = np.column_stack([np.linspace(5, 55, 26), 31 + 2 * np.sin(np.linspace(0, 3, 26))])
    return np.column_stack([way, hills(way)])


@pytest.fixture(scope="module")
def plain(xyz: NDArray[np.float64], way: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return directly(built(terrain(xyz, line(way)), **WIDE), INSIDE)


class TestInvariance:
    @pytest.mark.slow
    def test_shift(self, xyz: Any, way: Any, plain: Any) -> None:
        """By a million metres, a multiple of the units; in height too."""
        by = np.array([1_000_000.0, 6_400_000.0, 1000.0])
        model = built(terrain(xyz + by, line(way + by)), **WIDE)
        heights, sigmas = directly(model, INSIDE + by[:2])
        np.testing.assert_allclose(heights - by[2], plain[0], atol=2e-6)
        np.testing.assert_allclose(sigmas, plain[1], atol=2e-6)

    @pytest.mark.slow
    def test_another_order_of_points(self, xyz: Any, way: Any, plain: Any) -> None:
        """Blocks for the covariance function are drawn from the points: they may change it a little, no more."""
        model = built(terrain(xyz[::-1].copy(), line(way[::-1].copy())), **WIDE)
        heights, _ = directly(model, INSIDE)
        difference = (heights - plain[0]) / plain[1]
        assert difference.std() < 0.5

    @pytest.mark.parametrize("degrees", [pytest.param(90, marks=pytest.mark.slow), 30])
    def test_rotation(self, degrees: int, xyz: Any, way: Any, plain: Any) -> None:
        """By a right angle the units turn too; else other patches are joined, and the functions are other estimates."""
        angle = np.radians(degrees)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        about = lambda p: np.column_stack([(p[:, :2] - 32) @ turn.T + 32, p[:, 2:]])  # noqa: E731
        model = built(terrain(about(xyz), line(about(way))), **WIDE)
        heights, sigmas = directly(model, about(np.column_stack([INSIDE, INSIDE[:, 0]]))[:, :2].copy())
        difference = (heights - plain[0]) / plain[1]
        assert np.abs(difference).max() < 1e-6 if degrees == 90 else difference.std() < 0.5
        np.testing.assert_allclose(np.median(sigmas / plain[1]), 1, atol=0.1)


def test_places_without_leaves_near_have_no_height() -> None:
    model = built(terrain(points(count=200)))
    heights, sigmas = directly(model, np.array([[-500.0, 30.0], [30.0, 30.0]]))
    assert np.isnan(heights[0]) and np.isnan(sigmas[0]) and np.isfinite(heights[1])


def test_lines_share_the_height_of_a_common_vertex() -> None:
    common = [30.0, 30.0, 203.0]
    one = line([[10.0, 30, 201], common, [50.0, 33, 202]], name="one")
    two = line([[28.0, 8, 200], common], name="two")
    model = built(terrain(points(count=250, noise=0.1), one, two))
    a, b = predict_lines(model.fit)
    assert a.xyz[1, 2] == b.xyz[1, 2]


def test_borders_without_heights_keep_none() -> None:
    ring = np.array([[2.0, 2], [58, 2], [58, 58], [2, 58], [2, 2]])
    border = line(np.column_stack([ring, np.full(5, np.nan)]), "border")
    (element,) = predict_lines(built(terrain(points(count=200), border)).fit)
    assert element.kind == "border" and np.isfinite(element.xyz[:, :2]).all()
