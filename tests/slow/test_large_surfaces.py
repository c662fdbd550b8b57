"""How exact surfaces from images are, and whether their standard deviations tell it: rendered truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from products.test_surface import judge, places
from tools.command import inside
from tools.facet_scene import GROUND, GSD, write_scene
from tools.small_block import CRS, X0, Y0

from photoplan.geometry.grid import Window
from photoplan.io.project.file import load_project
from photoplan.plan.footprint import Tile
from photoplan.products.surface.plan import SurfaceJob, plan_surface
from photoplan.requests.surface import SurfaceSettings

pytestmark = pytest.mark.slow
BOUNDS = (X0 - 30, Y0 - 45, X0 + 30, Y0 + 45)


@pytest.mark.parametrize(
    ("images", "base", "snr", "finest", "rms"),
    [
        (5, 60, 50, 3, 0.010),
        (3, 60, 50, 3, 0.010),
        (2, 48, 50, 3, 0.010),
        (5, 60, 10, 3, 0.025),
        (2, 48, 10, 3, 0.030),
        (5, 60, 50, 6, 0.015),
        (5, 60, 50, 12, 0.030),
        # Contrast of little more than the noise.
        (4, 60, 2.5, 6, 0.13),
        (3, 60, 3, 12, 0.25),
    ],
)
def test_heights_and_what_they_claim(
    tmp_path: Path, images: int, base: float, snr: float, finest: float, rms: float
) -> None:
    found, means = [], []
    # Means of scenes with so much noise differ by 0.03 of a pixel.
    for seed in range(4 if snr > 5 else 12):
        folder = tmp_path / str(seed)
        folder.mkdir()
        scene = write_scene(folder, images, seed=10 * seed, base=base, size=(240, 220), snr=snr, finest=finest)
        said = inside("surface", scene.path, "--resolution", 1.5, "--bounds", *BOUNDS, "--no-quicklook", "-q")
        assert said.code == 0, said.err
        judged = judge(scene, folder / "products")
        assert snr < 5 or abs(judged.error.mean()) < 0.005
        squares = (np.mean(values**2) for values in (judged.normalised, judged.grey_normalised))
        found.append((judged.rms, *np.sqrt([*squares])))
        means.append(judged.error.mean())
    both = np.sqrt(np.mean(np.square(found), axis=0))
    print(images, snr, finest, both, means)
    assert abs(np.mean(means)) < 0.03
    assert both[0] < rms and 0.8 < both[1] < 1.3
    # Waves of three pixels are more than the facets can follow where there is hardly any noise.
    assert snr < 5 or 0.9 < both[2] < (1.25 if finest == 3 and snr == 50 else 1.1)


def test_seams_between_tiles(tmp_path: Path) -> None:
    """The same ground as one tile and as two, each of which goes from coarse to fine by itself."""
    scene = write_scene(tmp_path, 4, seed=5, base=60, size=(280, 200))
    bounds = (X0 - 45, Y0 - 36, X0 + 45, Y0 + 36)
    plan = plan_surface(load_project(scene.path), SurfaceSettings(1.5, bounds=bounds))
    job = SurfaceJob(address=plan.address, grid=plan.grid, scheme=plan.scheme, start="terrain")
    width, height = plan.grid.width, plan.grid.height
    windows = (Window(0, 0, width, height), Window(0, 0, width // 2, height))
    windows += (Window(width // 2, 0, width - width // 2, height),)
    made = [job(Tile(n, window)) for n, window in enumerate(windows)]
    (whole, sigma), *halves = [[layer[0][0] for layer in one.layers[:2] if layer is not None] for one in made]
    off = np.abs(np.hstack([heights for heights, _ in halves]) - whole) / sigma
    seam = off[:, width // 2 - 4 : width // 2 + 4]
    print("sigma apart", np.median(off), np.percentile(off, 95), off.max(), "at the seam", np.median(seam), seam.max())
    assert np.median(seam) < 0.03 and seam.max() < 0.2 and np.percentile(off, 95) < 0.1


@pytest.mark.parametrize("snr", [50, 10])
def test_grey_values_are_closer_to_the_truth_than_any_orthophoto(tmp_path: Path, snr: float) -> None:
    """Of one image each, over the heights that were found and over the true ones."""
    scene = write_scene(tmp_path, 5, seed=3, base=60, size=(240, 220), snr=snr)
    words = ("--no-quicklook", "-q")
    said = inside("surface", scene.path, "--resolution", 1.5, "--bounds", *BOUNDS, *words)
    assert said.code == 0, said.err
    grey, X, Y = places(tmp_path / "products" / "surface_grey.tif")
    with rasterio.open(tmp_path / "products" / "surface_grey.tif") as file:
        bounds, transform = file.bounds, file.transform
    profile = {"driver": "GTiff", "width": X.shape[1], "height": X.shape[0], "count": 1, "dtype": "float64"}
    with rasterio.open(tmp_path / "true.tif", "w", **profile, crs=CRS, transform=transform) as file:
        file.write(scene.heights(X, Y), 1)
    around = [scene.grey(X + i, Y + j) for i in (-GSD / 4, GSD / 4) for j in (-GSD / 4, GSD / 4)]
    true = np.mean(around, axis=0)
    text = scene.path.read_text()
    errors = {}
    for name in ("products/surface.tif", "true.tif"):
        edit = text.replace(f"height = {GROUND}", f'file = "{name}"')
        assert edit != text
        scene.path.write_text(edit)
        folder = tmp_path / f"over_{Path(name).stem}"
        said = inside("ortho", scene.path, "-o", folder, "--resolution", GSD, "--bounds", *bounds, *words)
        assert said.code == 0, said.err
        for path in sorted(folder.glob("*.tif")):
            with rasterio.open(path) as file:
                one, there = file.read(1).astype(float), file.read_masks(1) > 0
            there &= np.isfinite(grey)
            errors[f"{name} {path.stem}"] = [_rms(values[there], true[there]) for values in (grey, one)]
            assert there.mean() > 0.9
    for name, (of_all, of_one) in errors.items():
        print(snr, name, f"{of_all:.3f} {of_one:.3f}")
    assert len(errors) == 10 and all(of_all < of_one for of_all, of_one in errors.values())


def _rms(values: np.ndarray, true: np.ndarray) -> float:
    """Of what is left beside a line; images may differ by gain and offset."""
    line = np.polyfit(true, values, 1)
    return float(np.std(values - np.polyval(line, true)) / line[0])
