"""Real towns, rendered from six images and put together again: what is seen is there once, and where it stands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tools.depth_buffer import depth_buffer, hidden_in_buffer
from tools.rendered_block import edge_shifts, judge, pixels_of, rendered_mosaic, seen, shifts, upper_edges
from tools.rendered_city import City, delft, zurich

from photoplan.cameras.base import project
from photoplan.io.project.file import load_project
from photoplan.project.rendered import ProjectScene
from photoplan.surfaces.objects import ObjectSurface

PIXEL = 0.2
NAMES = [f"i{k}" for k in range(1, 7)]


@pytest.mark.slow
@pytest.mark.parametrize("town", [delft, zurich])
def test_a_city_is_seen_once_and_where_it_stands(
    shared: Path, tmp_path: Path, town: Callable[[Path, Path], City]
) -> None:
    city = town(tmp_path, shared / "data" / "cityjson_lod2")
    images = rendered_mosaic(city.path, city.path, city.bounds, PIXEL)
    mosaic = tmp_path / "project" / "mosaic.tif"
    truth = seen(city.path, mosaic)
    judged = judge(truth, mosaic, images, NAMES)
    assert judged.visible > 500_000 and (~truth.visible).sum() > 500
    assert judged.right >= 0.998 and judged.double == 0 and judged.wrong <= 10, judged
    true, _ = pixels_of(tmp_path / "rendered" / "true_orthophoto.tif")
    found = shifts(judged, true, truth)
    assert len(found) > 2000 and np.sqrt((found**2).mean()) < 0.05 and np.abs(found).max() < 0.3
    scene = ProjectScene.of(load_project(city.path), None, 1.0, 0, 1)
    surface = scene.ground.surface
    assert isinstance(surface, ObjectSurface)
    edges = edge_shifts(judged, true, truth, upper_edges(surface, truth.grid, 20.0 * PIXEL))
    edges = np.abs(edges[np.isfinite(edges)])
    agree = np.array([agreement(scene, name, truth.XYZ, sees) for name, sees in zip(NAMES, truth.sees)])
    print(town.__name__, judged.visible, judged.right, judged.wrong, judged.double)
    print("windows", len(found), np.sqrt((found**2).mean()), np.abs(found).max())
    print("edges", len(edges), np.sqrt((edges**2).mean()), np.percentile(edges, 95), edges.max(), (edges > 0.5).sum())
    print("depth buffer", agree)
    # An edge is moved most where a wall that is darker or brighter than both sides shares its pixels.
    assert len(edges) > 80 and np.sqrt((edges**2).mean()) < 0.2 and (edges <= 0.5).mean() > 0.97
    assert agree.min() >= 0.998


def agreement(scene: ProjectScene, name: str, XYZ: np.ndarray, sees: np.ndarray) -> float:
    """Share of the places in an image on whose visibility rays and a depth buffer agree (four parts a pixel)."""
    camera = scene.seen_by(name).camera
    surface = scene.ground.surface
    assert isinstance(surface, ObjectSurface)
    x, y = XYZ[..., 0], XYZ[..., 1]
    corner = [(x.min() - 200, y.min() - 200), (x.max() + 200, y.min() - 200), (x.max() + 200, y.max() + 200)]
    corner.append((x.min() - 200, y.max() + 200))
    ground = np.c_[corner, scene.ground.bare.heights(corner)]
    triangles = np.concatenate([surface.faces.corners, ground[[[0, 1, 2], [0, 2, 3]]]])
    inside = ((project(camera, XYZ) >= -0.5) & (project(camera, XYZ) <= np.array(camera.size) - 0.5)).all(axis=-1)  # type: ignore[arg-type]
    hidden = hidden_in_buffer(camera, XYZ, depth_buffer(camera, triangles, 4), 4, 0.25)
    return float((hidden == ~sees)[inside].mean())
