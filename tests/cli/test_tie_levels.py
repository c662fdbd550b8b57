"""`photoplan tie` tries other features where images stay unconnected, and reports what failed."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from tools.command import Here
from tools.small_block import write_image

from photoplan.io.points import read_image_points
from photoplan.matching.features import Tracks, weak_images

SIZE, SHIFT = (640, 480), 110


def noisy_strip(folder: Path, count: int, noise: float, shift: int = SHIFT) -> Path:
    """A strip over flat ground of coarse, weak texture, seen through independent noise of single pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    ground = rng.normal(size=(SIZE[1], SIZE[0] + shift * count))
    ground = sum(gaussian_filter(ground, s) * s for s in (3.0, 6.0, 12.0))
    ground *= 20.0 / ground.std()
    lines = ['crs = "EPSG:32633"', "[cameras.cam]", 'type = "frame"', f"size = {list(SIZE)}", "focal_px = 600"]
    for k in range(count):
        seen = ground[:, shift * k : shift * k + SIZE[0]] + rng.normal(scale=noise, size=SIZE[::-1])
        write_image(folder / f"i{k}.tif", np.clip(128 + seen, 0, 255).astype(np.uint8)[None])
        lines += ["[[images]]", f'name = "i{k}"', f'file = "i{k}.tif"', 'camera = "cam"']
    project = folder / "project.toml"
    project.write_text("\n".join(lines) + "\n")
    return project


def tracks_of(rows: Sequence[tuple[int, ...]]) -> Tracks:
    """Tracks by the images that see them."""
    track = np.concatenate([np.full(len(r), k) for k, r in enumerate(rows)])
    image = np.concatenate([np.array(r) for r in rows])
    one = np.ones(len(track))
    return Tracks(track, image, np.zeros((len(track), 2)), one, one, np.ones((len(track), 2)))


def test_images_that_a_model_does_not_reach_are_weak() -> None:
    """Two common points with each neighbour are no connection unless a third image sees them."""
    chain = [(0, 1, 2)] * 25 + [(1, 2, 3)] * 25
    assert weak_images(5, tracks_of(chain)) == [4]
    assert weak_images(5, tracks_of([*chain, *[(3, 4)] * 200])) == [0, 1, 2]
    assert weak_images(5, tracks_of([*chain, *[(2, 3, 4)] * 25])) == []
    assert weak_images(3, tracks_of([(0, 1)] * 30)) == [2]
    assert weak_images(2, tracks_of([(0, 1)])) == []


def test_other_features_connect_images_that_the_first_do_not(photoplan: Here, tmp_path: Path) -> None:
    """Few features and half of an image in common: as stated they connect nothing; the next levels connect all."""
    project = noisy_strip(tmp_path, 3, noise=6.0, shift=330)
    words = ("tie", project, "--features", 50, "--per-image", 60, "--workers", 1, "--no-picture")
    alone = photoplan(*words, "--levels", 1, "-o", tmp_path / "one.csv", "--json", "-q")
    assert alone.code == 3 or json.loads(alone.out)["unconnected"], alone
    said = photoplan(*words, "-o", tmp_path / "all.csv", "--json")
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert found["unconnected"] == [] and found["advice"] == ""
    assert min(found["per_image"].values()) >= 10
    assert "3 of 3 images are not connected: trying 3 pairs with 100 features at scale 1/2" in said.err
    with (tmp_path / "all_pairs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {float(row["scale"]) for row in rows} >= {1.0, 0.5}
    assert all(bool(row["reason"]) == (row["verified"] == "0") for row in rows)
    # The strip moves by whole pixels; points of all levels are right.
    points = read_image_points(tmp_path / "all.csv")
    at = {(points.points[p], points.images[i]): xy for p, i, xy in zip(points.point, points.image, points.xy)}
    moved = [at[name, "i0"] - at[name, "i1"] for name in points.points if {(name, "i0"), (name, "i1")} <= set(at)]
    assert len(moved) >= 10 and np.abs(np.median(moved, axis=0) - [330, 0]).max() < 0.2
    # The same command continues with what is kept, and comes to the same.
    before = (tmp_path / "all.csv").read_bytes()
    again = photoplan(*words, "-o", tmp_path / "all.csv", "--overwrite", "--json")
    assert again.code == 0 and (tmp_path / "all.csv").read_bytes() == before


def test_points_that_noise_hides_are_refined_in_reduced_images(photoplan: Here, tmp_path: Path) -> None:
    """Features match, but no patch at full resolution does: at half of it they do."""
    project = noisy_strip(tmp_path, 3, noise=15.0)
    words = ("--features", 300, "--per-image", 60, "--workers", 1, "--no-picture", "--json", "--levels", 1)
    said = photoplan("tie", project, *words)
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert found["unconnected"] == [] and min(found["per_image"].values()) >= 20
    assert 0.05 < found["sigma"] < 0.4


def test_what_cannot_be_connected_says_what_was_tried(photoplan: Here, tmp_path: Path) -> None:
    project = noisy_strip(tmp_path, 3, noise=4.0)
    noise = np.random.default_rng(1).integers(0, 255, (1, SIZE[1], SIZE[0])).astype(np.uint8)
    write_image(tmp_path / "i2.tif", noise)
    said = photoplan("tie", project, "--features", 300, "--per-image", 50, "--workers", 1, "--no-picture", "-q")
    assert said.code == 0, said.err
    # Quiet hides progress, and not that a result is doubtful.
    assert "1 of 3 images do not hang together" in said.err and "i2" in said.err
    assert "features tried: 300 at scale 1, 600 at scale 0.5, 900 at scale 1" in said.err
    assert "(6 times)" in said.err or "times)" in said.err
    assert "--features 1800" in said.err and "--images" in said.err


@pytest.mark.parametrize("levels", [0, 5])
def test_levels_are_one_to_four(photoplan: Here, tmp_path: Path, levels: int) -> None:
    said = photoplan("tie", noisy_strip(tmp_path, 2, 1.0), "--levels", levels)
    assert said.code == 2 and "levels" in said.err
