"""Heights from three lines of a turbulent flight, of a calm one, and of lines and frames together: rendered truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from products.test_surface import places
from tools.command import inside
from tools.facet_scene import Scene
from tools.strip_scene import CALM, CENTRE, GSD, HEIGHT_OF_A_PIXEL, SHAKEN, write_strips

pytestmark = pytest.mark.slow
WIDE, LONG = 18.0, 25.0
BOUNDS = (CENTRE[0] - WIDE, CENTRE[1] - LONG, CENTRE[0] + WIDE, CENTRE[1] + LONG)
#: One who rolls as much, but slowly: what a line sees does not move while it is exposed.
SLOW = replace(SHAKEN, vibration=(0.0, 0.0, 0.0))


def errors(scene: Scene, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Of the heights, pixels of parallax of the outermost lines; the same by their standard deviations."""
    heights, X, Y = places(folder / "surface.tif")
    sigma, *_ = places(folder / "surface_sigma.tif")
    assert np.isfinite(heights).all()
    off = heights - scene.heights(X, Y)
    return off / HEIGHT_OF_A_PIXEL, off / sigma


@pytest.mark.parametrize(
    ("like", "snr", "rms", "told"),
    [(SHAKEN, 50, 0.06, 1.35), (SLOW, 50, 0.02, 1.3), (CALM, 50, 0.02, 1.3), (SHAKEN, 10, 0.08, 1.35)],
    ids=["turbulent", "events", "calm", "turbulent, noise"],
)
def test_three_lines(tmp_path: Path, like: object, snr: float, rms: float, told: float) -> None:
    found = []
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        scene = write_strips(folder, like, seed, snr)  # type: ignore[arg-type]
        words = ["--resolution", 0.9, "--bounds", *BOUNDS, "--no-search", "--reach", 6, "--no-quicklook", "-q"]
        said = inside("surface", scene.path, *words)
        assert said.code == 0, said.err
        off, normalised = errors(scene, folder / "products")
        found.append((np.mean(off**2), np.mean(normalised**2), off.mean()))
    each = np.array(found)
    both = np.sqrt(each[:, :2].mean(axis=0))
    print("rms", both[0], "normalised", both[1], "bias", each[:, 2], GSD)
    assert both[0] < rms and 0.8 < both[1] < told and np.abs(each[:, 2]).max() < 0.03
