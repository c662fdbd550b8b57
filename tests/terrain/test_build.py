"""Models from measurements: no seams, sharp and decoupled breaklines, walls, form lines, borders, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tools.build_terrain import built, directly, line, scattered, surface_of, terrain
from tools.thinned import some

from photoplan.errors import GeometryError, InputError
from photoplan.products.dtm.build import describe_plan
from photoplan.surfaces.units import MeasuredTerrain
from photoplan.terrain.build import Built, plan_build
from photoplan.terrain.observations import BuildSettings


def smooth(XY: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(300.0 + 3 * np.sin(XY[:, 0] / 15) * np.cos(XY[:, 1] / 12))


def with_heights(xy: NDArray[np.float64], height, noise: float = 0.0, seed: int = 0) -> NDArray[np.float64]:  # type: ignore[no-untyped-def]
    return np.column_stack([xy, height(xy) + np.random.default_rng(seed).normal(0, noise, len(xy))])


class TestNoSeams:
    """Smooth ground, dense in one part, thin in the rest: grids of several widths adjoin."""

    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Built:
        dense = scattered(20.0, 650, 2) + 30
        xy = np.vstack([scattered(80.0, 600, 1), dense])
        return built(terrain(with_heights(xy, smooth, 0.02)), unit_meshes=16, grid_width=0.5, reach=12.0)

    def borders(self, model: Built, axis: int) -> NDArray[np.float64]:
        """Places on all inner borders of units, not only at posts."""
        layout = model.plan.layout
        xmin, ymin, xmax, ymax = layout.bounds
        across = layout.left + layout.side * np.arange(1, layout.columns)
        if axis == 1:
            across = layout.top - layout.side * np.arange(1, layout.rows)
        along = np.linspace(*((ymin, ymax) if axis == 0 else (xmin, xmax)), 1003)
        places = np.stack(np.meshgrid(across, along), axis=-1).reshape(-1, 2)
        return places if axis == 0 else places[:, ::-1]

    def test_grids_of_several_widths_adjoin(self, model: Built) -> None:
        assert len({unit.meshes for unit in model.units.values()}) >= 2 and len(model.units) > 50

    @pytest.mark.parametrize("axis", [0, 1])
    def test_surface_has_no_seam(self, model: Built, axis: int) -> None:
        places, step = self.borders(model, axis), np.eye(2)[axis] * 1e-6
        surface = surface_of(model)
        jump = surface.heights(places + step) - surface.heights(places - step)
        assert np.isfinite(jump).mean() > 0.8
        assert np.nanmax(np.abs(jump)) < 1e-3

    @pytest.mark.parametrize("axis", [0, 1])
    def test_prediction_has_no_seam_at_units_and_leaves(self, model: Built, axis: int) -> None:
        """The same place predicted as one of either unit: neighbours see the same patches."""
        leaves, origin = model.fit.leaves, model.plan.seen.origin[:2]
        step = np.eye(2)[axis] * 1e-7
        rng = np.random.default_rng(3)
        some = rng.choice(len(leaves.half), 150)
        edge = leaves.middle[some] + origin
        edge[:, axis] += leaves.half[some]
        edge[:, 1 - axis] += rng.uniform(-1, 1, 150) * leaves.half[some]
        jump = directly(model, edge + step)[0] - directly(model, edge - step)[0]
        assert np.isfinite(jump).sum() > 100
        assert np.nanmax(np.abs(jump)) < 1e-6

    @pytest.mark.slow
    def test_any_number_of_workers_gives_the_same(self, model: Built) -> None:
        again = built(
            terrain(model.plan.seen.xyz[: model.plan.seen.points] + model.plan.seen.origin),
            workers=1, unit_meshes=16, grid_width=0.5, reach=12.0,
        )  # fmt: skip
        assert again.units.keys() == model.units.keys()
        for key, unit in model.units.items():
            np.testing.assert_array_equal(unit.heights, again.units[key].heights)
            np.testing.assert_array_equal(unit.sigmas, again.units[key].sigmas)

    def test_surface_is_smooth_ground(self, model: Built) -> None:
        XY = np.random.default_rng(4).uniform(2, 78, (3000, 2))
        error = surface_of(model).heights(XY) - smooth(XY)
        assert np.sqrt(np.nanmean(error**2)) < 0.03


NOISE = 0.05
EVERY = np.linspace(0, 60, 61)


def roof(XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two planes; the ridge runs north at X = 30."""
    return np.asarray(100.0 - 0.5 * np.abs(XY[:, 0] - 30) + 0.05 * XY[:, 1])


def along(x: float, height, kind: str = "breakline", y: NDArray[np.float64] = EVERY, **more):  # type: ignore[no-untyped-def]
    xy = np.column_stack([np.full(len(y), x), y])
    return line(np.column_stack([xy, height(xy)]), kind, **more)


GROUND = scattered(60.0, 800, 8)
INNER = np.random.default_rng(9).uniform(4, 56, (3000, 2))


@pytest.fixture(scope="module")
def smeared() -> Built:
    """The ridge without its line."""
    return built(terrain(with_heights(GROUND, roof, NOISE)))


class TestRidge:
    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Built:
        return built(terrain(with_heights(GROUND, roof, NOISE), along(30.0, roof)))

    def test_both_planes_to_the_noise(self, model: Built) -> None:
        error = surface_of(model).heights(INNER) - roof(INNER)
        assert np.sqrt(np.mean(error**2)) < 0.5 * NOISE
        near = np.abs(INNER[:, 0] - 30) < 1.5
        assert np.sqrt(np.mean(error[near] ** 2)) < NOISE

    def test_the_crease_is_sharp(self, model: Built) -> None:
        """A tenth of a spacing beside the ridge the slopes are those of the planes; the ridge is not rounded off."""
        y = np.linspace(5, 55, 200)
        surface, h = surface_of(model), 0.15
        z = [surface.heights(np.column_stack([np.full(200, 30 + x), y])) for x in (-3 * h, -h, 0, h, 3 * h)]
        left, right = (z[1] - z[0]) / (2 * h), (z[4] - z[3]) / (2 * h)
        assert np.mean(left) == pytest.approx(0.5, abs=0.06) and np.mean(right) == pytest.approx(-0.5, abs=0.06)
        assert np.sqrt(np.mean((z[2] - 100 - 0.05 * y) ** 2)) < NOISE

    def test_without_the_line_it_would_be_rounded(self, smeared: Built) -> None:
        top = np.column_stack([np.full(200, 30.0), np.linspace(5, 55, 200)])
        assert np.mean(surface_of(smeared).heights(top) - roof(top)) < -0.02

    @pytest.mark.slow
    def test_what_happens_on_one_side_does_not_reach_the_other(self) -> None:
        """A bump of a metre on the left; with the line it moves the right side by a few per cent at most."""

        def bumped(XY: NDArray[np.float64]) -> NDArray[np.float64]:
            return roof(XY) + np.exp(-((XY[:, 0] - 28.5) ** 2 + (XY[:, 1] - 30) ** 2) / 2) * (XY[:, 0] < 30)

        options = {"filters": {"mass": NOISE}, "family": "matern", "gross": 0.0}
        right = np.column_stack([np.full(41, 31.0), np.linspace(20, 40, 41)])
        left = right - [2.5, 0]
        ridge = along(30.0, roof)
        models = [built(terrain(with_heights(GROUND, f, NOISE), ridge), **options) for f in (roof, bumped)]
        moved = [directly(models[1], at)[0] - directly(models[0], at)[0] for at in (left, right)]
        assert moved[0].max() > 0.7
        assert np.abs(moved[1]).max() < 0.06 * moved[0].max()

    def test_the_model_keeps_the_line(self, model: Built) -> None:
        (kept,) = model.lines
        assert kept.kind == "breakline" and kept.right is None and kept.on_grid.any()
        assert np.abs(kept.xyz[:, 2] - roof(kept.xyz[:, :2])).max() < 4 * NOISE
        assert (kept.sigmas[~kept.on_grid] < NOISE).all()


class TestLineThatEnds:
    """A breakline from the middle southwards: north of its end nothing is cut."""

    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Built:
        return built(terrain(with_heights(GROUND, smooth, NOISE), along(30.3, smooth, y=np.linspace(0, 30, 31))))

    def test_prediction_is_continuous_around_the_end(self, model: Built) -> None:
        for radius in (0.3, 2.0):
            phi = np.linspace(-np.pi / 2 + 0.02, 1.5 * np.pi - 0.02, 721)
            ring = np.column_stack([30.3 + radius * np.cos(phi), 30 + radius * np.sin(phi)])
            z, _ = directly(model, ring)
            assert np.abs(np.diff(z)).max() < 10 * radius * (phi[1] - phi[0]) * 0.4

    def test_no_jump_beyond_the_end(self, model: Built) -> None:
        y = np.linspace(30.05, 50, 100)
        west, east = (np.column_stack([np.full(100, 30.3 + e), y]) for e in (-1e-6, 1e-6))
        assert np.abs(directly(model, east)[0] - directly(model, west)[0]).max() < 1e-5
        surface = surface_of(model)
        assert np.abs(surface.heights(east) - surface.heights(west)).max() < 1e-5


class TestWall:
    HIGH = 3.0

    @pytest.fixture(scope="class")
    @classmethod
    def model(cls) -> Built:
        """Higher ground in the west; the wall runs north, so that its left side is the west."""
        height = lambda XY: 100.0 + cls.HIGH * (XY[:, 0] < 30)  # noqa: E731
        wall = along(30.0, lambda XY: np.full(len(XY), 100.0 + cls.HIGH), right=np.full(61, 100.0))
        return built(terrain(with_heights(GROUND, height, NOISE), wall))

    def test_both_heights_are_kept(self, model: Built) -> None:
        y = np.linspace(5, 55, 200)
        surface = surface_of(model)
        west, east = (surface.heights(np.column_stack([np.full(200, 30 + e), y])) for e in (-1e-3, 1e-3))
        assert np.abs(west - 100 - self.HIGH).max() < 3 * NOISE and np.abs(east - 100).max() < 3 * NOISE
        (kept,) = model.lines
        assert kept.right is not None
        np.testing.assert_allclose(kept.xyz[:, 2] - kept.right, self.HIGH, atol=4 * NOISE)

    def test_the_jump_stays_to_both_ends(self, model: Built) -> None:
        """Before, it closed from the last grid line or vertex on: half of it a millimetre beside the wall."""
        near = np.linspace(0.05, 0.5, 20)
        y = np.concatenate([near, 60 - near])
        surface = surface_of(model)
        west, east = (surface.heights(np.column_stack([np.full(40, 30 + e), y])) for e in (-1e-3, 1e-3))
        assert np.abs(west - 100 - self.HIGH).max() < 5 * NOISE and np.abs(east - 100).max() < 5 * NOISE

    def test_the_ground_beside_it_is_level(self, model: Built) -> None:
        expected = 100.0 + self.HIGH * (INNER[:, 0] < 30)
        error = surface_of(model).heights(INNER) - expected
        assert np.sqrt(np.mean(error**2)) < NOISE and np.abs(error).max() < 6 * NOISE

    @pytest.mark.slow
    def test_a_wall_drawn_the_other_way_round_is_the_same(self, model: Built) -> None:
        height = lambda XY: 100.0 + self.HIGH * (XY[:, 0] < 30)  # noqa: E731
        wall = along(30.0, lambda XY: np.full(len(XY), 100.0), y=EVERY[::-1], right=np.full(61, 100.0 + self.HIGH))
        turned = built(terrain(with_heights(GROUND, height, NOISE), wall))
        away = INNER[np.abs(INNER[:, 0] - 30) > 0.01]
        # Not to the bit: which of two equally near line points enter a block or a patch depends on their order.
        change = directly(turned, away)[0] - directly(model, away)[0]
        assert np.sqrt(np.mean(change**2)) < 0.2 * NOISE and np.abs(change).max() < NOISE


def test_a_form_line_bends_smoothly_and_is_met(smeared: Built) -> None:
    """The same roof: the surface passes through the line, but its slope changes gradually across."""
    model = built(terrain(with_heights(GROUND, roof, NOISE), along(30.0, roof, "formline")), filters={"formline": 0.01})
    y, h = np.linspace(5, 55, 100), 0.02
    z = [directly(model, np.column_stack([np.full(100, 30 + x), y]))[0] for x in (-2 * h, -h, 0, h, 2 * h)]
    top = np.column_stack([np.full(100, 30.0), y])
    without = directly(smeared, top)[0] - roof(top)
    missed = z[2] - roof(top)
    assert np.sqrt(np.mean(missed**2)) < min(NOISE, 0.6 * np.sqrt(np.mean(without**2)))
    bend = np.abs((z[4] - z[3]) - (z[1] - z[0])) / h
    assert bend.mean() < 0.25  # a crease would have 1


class TestWhereThereIsASurface:
    def ring(self, low: float, high: float, kind: str, heights: bool = True):  # type: ignore[no-untyped-def]
        xy = np.array([[low, low], [high, low], [high, high], [low, high], [low, low]], float)
        return line(np.column_stack([xy, smooth(xy) if heights else np.full(5, np.nan)]), kind, f"{kind} {low}")

    @pytest.mark.parametrize("heights", some([True, False], 1))
    def test_nothing_outside_a_border_or_in_a_hole(self, heights: bool) -> None:
        border, hole = self.ring(10.3, 50.7, "border", heights), self.ring(25.2, 33.4, "hole", heights)
        surface = surface_of(built(terrain(with_heights(GROUND, smooth, NOISE), border, hole)))
        within = lambda low, high: (low < INNER).all(axis=1) & (high > INNER).all(axis=1)  # noqa: E731
        expected = within(10.3, 50.7) & ~within(25.2, 33.4)
        near = np.zeros(len(INNER), bool)
        for edge in (10.3, 50.7, 25.2, 33.4):
            near |= (np.abs(INNER - edge) < 1e-3).any(axis=1)
        there = np.isfinite(surface.heights(INNER))
        np.testing.assert_array_equal(there[~near], expected[~near])

    def test_wide_gaps_stay_open_and_narrow_ones_are_bridged(self) -> None:
        x = GROUND[:, 0]
        strip = lambda XY: np.isfinite(model.heights(XY))  # noqa: E731
        for gap, open_ in ((6.0, False), (18.0, True)):
            xyz = with_heights(GROUND[((x < 20) | (x > 20 + gap)) & (GROUND[:, 1] < 24)], smooth, NOISE)
            model = surface_of(built(terrain(xyz), reach=6.0))
            middle = np.column_stack([np.full(50, 20 + gap / 2), np.linspace(7, 17, 50)])
            assert strip(middle).any() != open_ and strip(middle).all() != open_

    def test_units_without_data_are_empty(self) -> None:
        far = scattered(10.0, 200, 3) + np.array([200.0, 0.0])
        model = built(terrain(with_heights(np.vstack([scattered(10.0, 200, 2), far]), smooth)), unit_meshes=16)
        layout = model.plan.layout
        assert len(model.units) < 0.5 * layout.columns * layout.rows
        assert len(model.figures) == layout.columns * layout.rows
        empty = [f for f in model.figures if (f.column, f.row) not in model.units]
        assert all(np.isnan(f.low) and f.meshes == 0 for f in empty)

    def test_no_height_beyond_the_outline(self) -> None:
        surface = surface_of(built(terrain(with_heights(scattered(20.0, 100, 8), smooth, NOISE))))
        assert np.isfinite(surface.heights([[10.0, 10.0]])).all()
        assert np.isnan(surface.heights([[-8.0, 10], [28, 10], [10, -8], [10, 28]])).all()


class TestPlans:
    def test_grid_width_follows_the_spacing_and_is_round(self) -> None:
        for factor in (1.0, 10.0):
            xyz = with_heights(GROUND, smooth) * [factor, factor, 1]
            plan = plan_build(terrain(xyz), BuildSettings())
            assert 0.3 * factor < plan.width < 1.55 * factor
            assert plan.layout.side == plan.width * 64
            steps = plan.layout.left / plan.layout.side
            assert steps == pytest.approx(round(steps))

    def test_fault_16_points_that_determine_no_surface(self) -> None:
        t = np.linspace(0, 10, 20)
        for xyz, words in (
            (np.column_stack([t, 2 * t, t]), "one line"),
            (np.array([[0.0, 0, 0], [1, 1, 1]]), "at least three"),
        ):
            with pytest.raises(GeometryError, match=words):
                plan_build(terrain(xyz), BuildSettings())
        with pytest.raises(GeometryError, match="no points"):
            plan_build(MeasuredTerrain(), BuildSettings())

    def test_a_point_far_from_all_others_is_refused(self) -> None:
        xyz = np.vstack([with_heights(GROUND, smooth), [6.0e6, 5.0e6, 300.0]])
        with pytest.raises(InputError, match=r"far from all others.*`grid_width`"):
            plan_build(terrain(xyz), BuildSettings())

    @pytest.mark.parametrize("count", [3, 4, 9])
    def test_very_few_points_make_a_model(self, count: int) -> None:
        xy = scattered(10.0, 9, 1)[[0, 2, 6, 8, 4, 1, 3, 5, 7][:count]]
        model = built(terrain(np.column_stack([xy, 5 + xy @ [0.1, 0.2]])))
        middle = xy[:3].mean(axis=0)[None]
        np.testing.assert_allclose(surface_of(model).heights(middle), 5 + middle @ [0.1, 0.2], atol=0.01)

    @pytest.mark.parametrize("bad", [{"grid_width": 0}, {"reach": -1}, {"adapt": -0.1}, {"unit_meshes": 48},
                                     {"family": "cubic"}, {"filters": {"trees": 1.0}}, {"gross": np.nan}])  # fmt: skip
    def test_settings_say_what_is_allowed(self, bad: dict) -> None:  # type: ignore[type-arg]
        from photoplan.errors import UsageError

        with pytest.raises(UsageError, match=r"needed|are "):
            BuildSettings(**bad)


class TestFigures:
    """What a build says of itself."""

    def test_the_plan_names_the_grid_that_is_built(self) -> None:
        """Half the width where breaklines pass, unless a width is asked for."""
        xyz = with_heights(scattered(24.0, 144, 1), smooth, 0.02)
        edge = line(np.column_stack([np.full(9, 5.2), np.linspace(3, 9, 9), np.full(9, 300.0)]))
        for measured, asked, part in (
            (terrain(xyz, edge), None, 2),
            (terrain(xyz, edge), 1.0, 1),
            (terrain(xyz), None, 1),
            (terrain(xyz, replace(edge, kind="formline")), None, 1),
        ):
            model = built(measured, unit_meshes=4, adapt=0.0, grid_width=asked)
            widths = {unit.width for unit in model.units.values()}
            assert model.plan.finest == pytest.approx(model.plan.width / part)
            assert min(widths) == pytest.approx(model.plan.finest) and max(widths) == pytest.approx(model.plan.width)
            said = describe_plan(model.plan, measured, "EPSG:25832", None)
            assert (f"{model.plan.finest:g} m where breaklines pass" in said) == (part == 2)

    def test_sigma_of_posts_leaves_the_extrapolated_rim_out(self) -> None:
        """As in the middle of the square; with the rim it would be half as large again. All rim: all posts count."""
        xyz = with_heights(scattered(40.0, 500, 1), smooth, 0.05)
        model = built(terrain(xyz), unit_meshes=16, adapt=0.0)
        XY, sigmas = posts_of(model)
        inside = (np.abs(XY - 20) < 16).all(axis=1)
        middle, every = (np.sqrt((s**2).mean()) for s in (sigmas[inside], sigmas))
        assert every > 1.3 * middle
        assert model.sigma == pytest.approx(middle, rel=0.05)
        known = np.array([f.sigma for f in model.figures if np.isfinite(f.sigma)])
        assert known.min() <= model.sigma <= known.max() < every * 1.5
        sparse = built(terrain(np.array([[0.0, 0, 5], [9, 0, 6], [0, 9, 7], [9, 9, 7.5]])), unit_meshes=4)
        _, sigmas = posts_of(sparse)
        assert sparse.sigma == pytest.approx(np.sqrt((sigmas**2).mean()))


def posts_of(model: Built) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places (n, 2) and standard deviations of all posts that have a height."""
    places, sigmas = [], []
    for unit in model.units.values():
        along = np.arange(unit.meshes + 1) * unit.width
        x, y = np.meshgrid(unit.left + along, unit.top - along)
        known = np.isfinite(unit.sigmas)
        places.append(np.column_stack([x[known], y[known]]))
        sigmas.append(unit.sigmas[known].astype(float))
    return np.concatenate(places), np.concatenate(sigmas)
