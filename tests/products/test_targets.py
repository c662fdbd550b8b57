"""Products on a wall and on a vault: two images of a surface behind a pillar, against rays that are traced."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import from_origin
from scipy.ndimage import binary_dilation, binary_erosion
from tools.command import Said, inside
from tools.target_scene import GREY, PIXEL, Made, barrel, texture, wall, write

from photoplan.io.vector_layer import read_features


@pytest.fixture(scope="module", params=[wall, barrel], ids=["wall", "vault"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return write(request.param(), tmp_path_factory.mktemp(request.param.__name__))


def run(verb: str, made: Made, *words: object) -> Said:
    said = inside(verb, made.path, "--target", made.place.stated, "--bounds", *made.place.bounds, *words)
    assert said.code == 0, said.err
    return said


def read(path: Path) -> NDArray[np.float64]:
    with rasterio.open(path) as file:
        assert file.crs is None
        return file.read(1, masked=True).astype(float).filled(np.nan)


def test_orthophotos_show_the_surface_and_leave_out_what_the_pillar_hides(made: Made, tmp_path: Path) -> None:
    run("ortho", made, "--resolution", PIXEL, "--hidden", "nodata", "--output", tmp_path)
    u, v = made.place.grid()
    for number, shot in enumerate(made.place.shots):
        found, sees = read(tmp_path / f"i{number}_ortho.tif"), made.place.sees(shot)
        shown, inner = np.isfinite(found), binary_erosion(sees, iterations=2)
        off = np.abs(found - shot.gain * texture(u, v))[inner]
        print(made.place.stated, number, "rms", np.sqrt(np.nanmean(off**2)), "apart", (shown ^ sees).mean())
        assert np.sqrt(np.mean(off**2)) < 1.0
        # Beside what hides and along the border of the image a pixel decides.
        assert not (shown & ~binary_dilation(sees, iterations=4)).any() and 0.4 < shown.mean() < 0.97
    with rasterio.open(tmp_path / "i0_ortho.tif") as file:
        assert file.tags()["PHOTOPLAN_TARGET"] == made.place.stated
        assert file.bounds == pytest.approx(made.place.bounds)


def test_a_mosaic_fills_what_one_image_does_not_see_from_the_other(made: Made, tmp_path: Path) -> None:
    words = ["--resolution", PIXEL, "--sources", "--accuracy", "--relief-sigma", 0.005, "--output", tmp_path]
    run("mosaic", made, *words)
    u, v = made.place.grid()
    found, owner = read(tmp_path / "mosaic.tif"), np.nan_to_num(read(tmp_path / "mosaic_sources.tif")).astype(int)
    seen = [made.place.sees(shot) for shot in made.place.shots]
    gain = np.array([np.nan, *(shot.gain for shot in made.place.shots)])[owner]
    for row, sees in enumerate(seen, 1):
        assert not ((owner == row) & ~binary_dilation(sees, iterations=4)).any()
        alone = binary_erosion(sees & ~seen[2 - row], iterations=4)
        assert alone.sum() > 300 and (owner[alone] == row).all()
    off = np.abs(found - gain * texture(u, v))[binary_erosion(seen[0] | seen[1], iterations=2) & (owner > 0)]
    print(made.place.stated, "rms", np.sqrt(np.mean(off**2)), "beyond 14:", (off > 14).mean())
    assert (off > 14).mean() < 0.004 and np.sqrt(np.mean(off[off < 14] ** 2)) < 1.0
    with rasterio.open(tmp_path / "mosaic_accuracy.tif") as file:
        sigma = file.read(masked=True).filled(np.nan)
    # Of the surface as stated; along u and v that, the standpoint and its angles, at five metres.
    assert np.nanmedian(sigma[2]) == pytest.approx(0.005, rel=0.01)
    assert 0.008 < np.nanmedian(sigma[0]) < 0.02 and 0.008 < np.nanmedian(sigma[1]) < 0.02
    assert len(read_features(tmp_path / "mosaic_seams.gpkg", "Polygon").items) >= 2


def test_seams_and_balance_join_two_exposures(made: Made, tmp_path: Path) -> None:
    run("seams", made, "--resolution", 2 * PIXEL, "--output", tmp_path / "seams.gpkg")
    regions = read_features(tmp_path / "seams.gpkg", "Polygon").items
    assert {feature.name for feature in regions} == {"i0", "i1"}
    u0, v0, u1, v1 = made.place.bounds
    for feature in regions:
        left, bottom, right, top = feature.geometry.bounds
        assert u0 - 0.1 < left < right < u1 + 0.1 and v0 - 0.1 < bottom < top < v1 + 0.1
    # The command states the tables in the project.
    copy = Made(made.place, made.path.with_name("balanced.toml"))
    copy.path.write_text(made.path.read_text())
    said = run("balance", copy, "--reference-image", "i0", "--resolution", 2 * PIXEL, "--degree", 0, "--json",
               "--output", tmp_path / "balance")  # fmt: skip
    found = json.loads(said.out)
    # A gain of 0.85 is 20 grey values; what is left is held down by what overlaps cannot determine.
    assert found["rms_before"][0] > 15 and found["rms_after"][0] < found["rms_before"][0] / 2


def test_an_object_is_shown_alone(made: Made, tmp_path: Path) -> None:
    said = inside("object", made.path, made.path.parent / "pillar.obj", "--target", made.place.stated, "--bounds",
                  *made.place.bounds, "--resolution", PIXEL, "--output", tmp_path)  # fmt: skip
    assert said.code == 0, said.err
    (path,) = tmp_path.glob("*_object.tif")
    found = read(path)
    shown = np.isfinite(found)
    assert shown.sum() > 200 and np.abs(found[binary_erosion(shown, iterations=3)] - GREY).max() < 3


def test_a_target_of_the_project_has_a_relief_of_its_own(made: Made, tmp_path: Path) -> None:
    """A raster of offsets that is flat gives the picture of the number, to the last bit; one over another wall is
    refused."""
    u0, v0, u1, v1 = made.place.bounds
    path = made.path.parent / "relief.tif"
    step = 0.25
    size = round((u1 - u0) / step), round((v1 - v0) / step)
    with rasterio.open(path, "w", driver="GTiff", width=size[0], height=size[1], count=1, dtype="float32",
                       transform=from_origin(u0, v1, step, step)) as file:  # fmt: skip
        file.write(np.full(size[::-1], 0.0, np.float32), 1)
        file.update_tags(PHOTOPLAN_TARGET=made.place.stated)
    project = made.path.with_name("named.toml")
    text = made.path.read_text()
    named = f'[targets.south]\nframe = "{made.place.stated}"\nrelief = "relief.tif"\n'
    project.write_text(text.replace("[cameras.c]", named + "[cameras.c]"))
    words = ("--images", "i0", "--resolution", PIXEL, "--hidden", "nodata", "--output")
    said = inside("ortho", project, "--target", "south", *words, tmp_path / "named")
    assert said.code == 0, said.err
    run("ortho", made, *words, tmp_path / "plain")
    named, plain = (read(tmp_path / name / "i0_ortho.tif") for name in ("named", "plain"))
    assert np.nanmax(np.abs(named - plain)) <= 1 and (np.isfinite(named) ^ np.isfinite(plain)).mean() < 0.001
    with rasterio.open(path, "r+") as file:
        file.update_tags(PHOTOPLAN_TARGET="wall:0,0,0,90")
    said = inside("ortho", project, "--target", "south", *words, tmp_path / "other")
    assert said.code == 3 and "its heights lie over wall:0,0,0,90, not over" in said.err, said.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--target", "wall:500000,5300000,100,180"), "it has no end; set --bounds"),
        (("--relief", 1), "--relief and --relief-sigma require --target"),
        (("--target", "south"), "target south; give `map`, `wall:"),
        (("--target", "wall:500000,5300000,100,0", "--bounds", -2, -1, 2, 1), "it stands behind the target"),
        (("--target", "wall:500000,5300000,100,180", "--bounds", 2, -1, -2, 1), "are empty"),
        (("--target", "wall:500000,5300000,100,180", "--bounds", -2, -1, 2, 1, "--relief", "nan"), "relief: "),
        (("--target", "wall:500000,5300000,100,180", "--bounds", -2, -1, 2, 1, "--relief-sigma", -1), "sigma: "),
        (("--target", "wall:500000,5300000,100,180", "--bounds", -2, -1, 2, 1, "--relief", "i0.tif"), "i0.tif"),
        (("--target", "wall:1e300,5300000,100,180", "--bounds", -2, -1, 2, 1), "wall:1e300"),
        (("--target", "itself", "--bounds", -2, -1, 2, 1), "target itself; give `map`"),
    ],
)
def test_what_cannot_be_is_refused(words: tuple[object, ...], told: str, tmp_path: Path) -> None:
    made = write(wall(), tmp_path, '[targets.itself]\nframe = "itself"\n')
    said = inside("ortho", made.path, "--resolution", PIXEL, "--output", tmp_path / "o", *words)
    assert said.code in (2, 3, 4) and told in said.err, said.err


def test_a_plan_on_a_target_is_executed(made: Made, tmp_path: Path) -> None:
    run("mosaic", made, "--resolution", PIXEL, "--plan", tmp_path / "plan.gpkg", "--output", tmp_path / "planned")
    said = inside("run", tmp_path / "plan.gpkg")
    assert said.code == 0, said.err
    run("mosaic", made, "--resolution", PIXEL, "--output", tmp_path / "direct")
    a, b = (read(tmp_path / name / "mosaic.tif") for name in ("planned", "direct"))
    assert np.array_equal(a, b, equal_nan=True)
