"""Mappings that are bent: what they declare is measured where it is worst, and the reported residual holds."""

from __future__ import annotations

import numpy as np
import pytest
from tools.line_camera import LineCamera, line_camera
from tools.pinhole import vertical

from photoplan.cameras.base import project
from photoplan.geometry.grid import Breaks, MapGrid, Window
from photoplan.kernels.positions import positions
from photoplan.plan.anchors import AnchorRule, Anchors, compile_anchors
from photoplan.plan.ground import TileGround
from photoplan.targets.map import MapTarget

GRID = MapGrid(-290.0, -5.0, 0.05, 12_000, 12_000, "EPSG:25832")


def relief(window: Window) -> np.ndarray:
    """Hills of ±14 m about the datum, with noise of 2 m."""
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]]
    hills = 14 * np.sin(u / 400.0) * np.cos(v / 300.0)
    return (hills + np.random.default_rng(5).uniform(-2, 2, u.shape)).astype(np.float32)


def misses(camera: LineCamera, target: MapTarget, window: Window, h: np.ndarray, anchors: Anchors) -> np.ndarray:
    """Engine minus strict position of every pixel; NaN outside the image."""
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    truth = camera.strict(target.to_ground(np.stack([u, v, h.astype(float)], axis=-1)))[..., :2]
    w = anchors.source_window
    found = positions(anchors.arrays, h).astype(float) + np.array([w.col, w.row])
    inside = ((truth >= -0.5) & (truth <= np.array(camera.size) - 0.5)).all(axis=-1)
    assert inside.mean() > 0.9 and np.isfinite(found[inside]).all()
    return np.hypot(*np.moveaxis(found - truth, -1, 0))[inside]


def compiled(declared: str, window: Window, tolerance: float = 0.02) -> tuple[Anchors, np.ndarray]:
    camera, target, h = line_camera(declared), MapTarget(GRID), relief(window)
    anchors = compile_anchors(camera, TileGround.of(target, window, h), AnchorRule(tolerance, 2))
    assert anchors is not None
    return anchors, misses(camera, target, window, h, anchors)


@pytest.mark.parametrize("window", [Window(2000, 3000, 512, 512), Window(8123, 7777, 300, 301)])
def test_jitter_of_lines_lives_in_the_field_and_the_reported_residual_holds(window: Window) -> None:
    """5e-6 rad every 7 lines: 0.1 px, all of it between the probes of a smooth cell."""
    anchors, miss = compiled("field", window)
    assert len(anchors.corners) <= 32  # not 512 × 512 / 7
    assert anchors.residual <= 0.02
    assert miss.max() <= anchors.residual + 1e-4


def test_what_is_not_declared_is_not_seen() -> None:
    """The reason for declaring: the same camera, silent, reports less than the truth."""
    anchors, miss = compiled("silent", Window(2000, 3000, 512, 512))
    assert anchors.residual < 0.02
    assert miss.max() > 0.1


@pytest.mark.parametrize("tolerance", [0.02, 0.3])
def test_breaks_in_the_anchors_are_measured_where_they_are(tolerance: float) -> None:
    anchors, miss = compiled("anchors", Window(2000, 3000, 96, 96), tolerance)
    assert miss.max() <= anchors.residual + 1e-4
    assert miss.max() >= 0.25 * anchors.residual, "the bound is not far from the truth"


class Folded:
    """A wall of facets seen from above: its profile is bent at columns that are declared."""

    knots = np.array([-10.0, 60.0, 100.3, 171.5, 310.0])
    window = Window(0, 0, 300, 200)
    breaks = Breaks(columns=(60.0, 100.3, 171.5))

    def to_ground(self, uvh: np.ndarray) -> np.ndarray:
        u, v, h = np.moveaxis(np.asarray(uvh, float), -1, 0)
        X = np.interp(u, self.knots, [1000.0, 1003.0, 1004.0, 1007.0, 1014.0])
        Z = np.interp(u, self.knots, [100.0, 101.0, 103.5, 103.9, 109.0]) + h
        return np.stack([X, 2000.0 - 0.06 * v, Z], axis=-1)


def test_cells_of_a_folded_target_end_where_it_is_bent() -> None:
    camera, target, window = vertical(), Folded(), Folded.window
    h = np.random.default_rng(1).uniform(-0.5, 0.5, (window.height, window.width)).astype(np.float32)
    anchors = compile_anchors(camera, TileGround.of(target, window, h), AnchorRule(0.3, 2))
    assert anchors is not None
    v, u = np.mgrid[: window.height, : window.width].astype(float)
    truth = project(camera, target.to_ground(np.stack([u, v, h.astype(float)], axis=-1)))
    w = anchors.source_window
    miss = np.hypot(*np.moveaxis(positions(anchors.arrays, h).astype(float) + (w.col, w.row) - truth, -1, 0))  # noqa: RUF005
    assert miss.max() <= anchors.residual + 1e-4
    # Between the folds nothing is left: only the three columns that a fold crosses, at most a quarter of its bend each.
    assert set(np.unique(np.nonzero(miss > 1e-3)[1])) <= {60, 100}
    assert len(anchors.corners) == 6
