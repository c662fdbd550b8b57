"""Large terrain models: the memory of a million points, and the road survey with further seeds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from real.test_m3_terrain import Survey, compared, folder, survey  # noqa: F401
from tools.command import peak_of

from photoplan.io.terrain.model import ModelReader
from photoplan.surfaces.hybrid import HybridSurface

pytestmark = pytest.mark.slow

SIDE, COUNT, NOISE = 2000.0, 1_000_000, 0.1
EAST, NORTH = 500_000.0, 5_300_000.0


def hills(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(400 + 20 * np.sin(x / 150) * np.cos(y / 110) + 1.5 * np.sin(x / 17 + y / 23))


def test_a_million_points_need_at_most_2_gb(tmp_path: Path) -> None:
    rng = np.random.default_rng(12)
    xy = rng.uniform(0, SIDE, (COUNT, 2))
    z = hills(*xy.T) + rng.normal(0, NOISE, COUNT)
    path, out = tmp_path / "points.csv", tmp_path / "model.gpkg"
    np.savetxt(path, np.column_stack([xy[:, 0] + EAST, xy[:, 1] + NORTH, z]), "%.3f", ",", header="x,y,z", comments="")
    words = ("dtm", "build", path, "-o", out, "--crs", "EPSG:32633", "--workers", 2, "--json", "--no-report", "-q")
    said, peak = peak_of(*words)
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert facts["points"] > 0.99 * COUNT and facts["gross"] < 0.005 * COUNT
    assert peak <= 2 * 10**9
    places = rng.uniform(10, SIDE - 10, (50_000, 2))
    error = HybridSurface(ModelReader(out)).heights(places + np.array([EAST, NORTH])) - hills(*places.T)
    assert np.isfinite(error).all() and np.sqrt(np.mean(error**2)) < 0.6 * NOISE


#: An eighth of the points, near breaklines: missed by 0.2 to 1.3 %. All places together are never worse.
NEAR_LINES_WORSE = {2: (0.1913, 0.1910), 4: (0.1790, 0.1773), 5: (0.165, 0.163)}


@pytest.mark.parametrize("keep", [1, 8])
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_prediction_is_not_worse_than_the_constrained_triangulation(
    survey: Survey,  # noqa: F811
    seed: int,
    keep: int,
    request: pytest.FixtureRequest,
) -> None:
    if keep == 8 and seed in NEAR_LINES_WORSE:
        near, tin = NEAR_LINES_WORSE[seed]
        request.applymarker(
            pytest.mark.xfail(strict=True, reason=f"near breaklines {near} m, the triangulation {tin} m")
        )
    found = compared(survey, seed, keep)
    assert found.model[0] <= found.tin[0] and found.model[1] <= found.tin[1], found
