"""Control of the drone block from an old orthophoto, by commands, against the orientation of another program."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tools.command import edit, process
from tools.drone_block import distance, write_images
from tools.matching import match
from tools.pictures import gray

pytest.importorskip("cv2")


def command(*words: object) -> str:
    said = process(*words)
    assert said.code == 0, said.err
    return said.out


@pytest.fixture(scope="module")
def project(shared: Path, block: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Positions of the drone lie 10 m too low; control that is matched, twice, puts the block where it belongs."""
    tmp_path = tmp_path_factory.mktemp("control")
    write_images(block / "images", shared / "data" / "drone_brighton" / "exif.csv", tmp_path / "images")
    table, old = tmp_path / "approximate.csv", block / "ref_ortho_from_cloud.tif"
    command("convert", tmp_path / "images", "--to", "csv", "--crs", "EPSG:32615", "-o", table)
    files = ("--images", tmp_path / "images" / "*.jpg", "--camera", block / "int.yaml", "--terrain", block / "dsm.tif")
    words = (*files, "--crs", "EPSG:32615", "--height-system", "same")
    command("init", tmp_path / "reference", *words, "--orientation", block / "ext.csv")
    command("init", tmp_path / "block", *words, "--orientation", table, "--positions", tmp_path / "images")
    project = tmp_path / "block" / "project.toml"
    edit(project, 'positions = "../images"', 'positions = "../images"\nsigma_position = [3.0, 5.0]\n#')
    command("tie", project, "--scale", 0.5, "--features", 2500, "--per-image", 250, "--no-picture", "--workers", 2)
    command("adjust", project)
    edit(project, "[orientation]\n", '[adjustment]\ndrift = "shift"\n\n[orientation]\n')
    for search in (15, 3):
        options = ("--height-sigma", 0.3, "--search", search, "--workers", 2, "--overwrite")
        print(command("control", project, "--ortho", old, *options))
        command("adjust", project, "--overwrite")
    return project


def reference(project: Path) -> Path:
    return project.parent.parent / "reference" / "project.toml"


@pytest.mark.slow
def test_angles_from_the_old_orthophoto(project: Path) -> None:
    off = distance(project, reference(project))
    rms = float(np.sqrt((off.angles**2).mean()))
    print(f"angles {rms:.4f} degrees rms")
    assert rms <= 0.10


@pytest.mark.slow
def test_control_from_the_old_orthophoto(block: Path, project: Path) -> None:
    old = block / "ref_ortho_from_cloud.tif"
    off = distance(project, reference(project))
    print(f"\ncontrol of the old orthophoto: {off}")
    # Of the projection centres, 41 m above the ground: what the tilt of the whole block leaves.
    assert np.abs(off.shift).max() <= 0.4
    assert np.sqrt((off.positions**2).mean()) <= 0.08
    command("ortho", project, "--resolution", 0.1, "--no-quicklook", "--workers", 2)
    cloud, kept = gray(old), []
    for path in sorted((project.parent / "products").glob("*_ortho.tif")):
        one = match(gray(path), cloud, patch=20.0, stride=10.0, search=1.0, filled=0.4)
        kept.append(one.keep(one.quality > 0.7))
    d = np.concatenate([[one.dx, one.dy] for one in kept], axis=1)
    rms = np.sqrt((d**2).mean(axis=1))
    print(f"orthophotos: {d.shape[1]} patches, rms {rms} m, mean {d.mean(axis=1)} m")
    assert d.shape[1] >= 180
    assert (rms <= 0.08).all()
