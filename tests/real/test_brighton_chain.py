"""The drone block from its images to orthophotos by commands alone, against the orientation of another program.

What the drone had written into its images is the start: position and gimbal. The reference (`ext.csv`) was determined
by COLMAP from the full images, with its own tie points and another adjustment, and then fitted to the point cloud of a
third program. Its horizontal datum is that of GNSS, its heights are the cloud's, 10 m away from the barometer's: so
blocks that know GNSS alone are compared after a similarity.

The camera file is that of the reference. Fewer features (900, at 0.4 of the resolution) keep this below half a
minute on two cores; with the command's own settings the figures are 4.2, 4.7, 2.4 cm and 0.082°, 0.048°, 0.024°.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from tools.command import edit, inside
from tools.drone_block import distance, write_control, write_images
from tools.kept import kept
from tools.matching import match
from tools.pictures import gray

pytest.importorskip("cv2")
# In every run tie points of this block are measured by `test_brighton_ties.py`, a real block is adjusted by
# `test_ign_block.py` and each command is tried in `tests/cli`; here one follows the other.
pytestmark = pytest.mark.slow


def command(*words: object) -> str:
    said = inside(*words)
    assert said.code == 0, said.err
    return said.out


@dataclass(frozen=True)
class Chain:
    folder: Path
    camera: Path
    heights: Path
    reference: Path

    def init(self, name: str, *options: object) -> Path:
        folder = self.folder / name
        images = ("--images", self.folder / "images" / "*.jpg", "--camera", self.camera, "--height-system", "same")
        command("init", folder, *images, "--crs", "EPSG:32615", *options)
        return folder / "project.toml"


@pytest.fixture(scope="module")
def chain(shared: Path, block: Path, tmp_path_factory: pytest.TempPathFactory) -> Chain:
    """Images as the drone wrote them, the reference as a project, and a project with tie points."""
    exif = shared / "data" / "drone_brighton" / "exif.csv"

    def make(folder: Path) -> None:
        write_images(block / "images", exif, folder / "images")
        for name in ("int.yaml", "dsm.tif", "ext.csv"):
            shutil.copy(block / name, folder)
        made = chain_in(folder)
        made.init("reference", "--orientation", folder / "ext.csv", "--terrain", made.heights)
        tie(made)

    folder = tmp_path_factory.mktemp("chain") / "copy"
    commands = ["photoplan.products.init", "photoplan.products.convert", "photoplan.products.tie"]
    shutil.copytree(kept("brighton-chain", make, commands, [block, exif]), folder)
    return chain_in(folder)


def chain_in(folder: Path) -> Chain:
    return Chain(folder, folder / "int.yaml", folder / "dsm.tif", folder / "reference" / "project.toml")


@pytest.fixture(scope="module")
def tied(chain: Chain) -> Path:
    return chain.folder / "gnss" / "project.toml"


def tie(chain: Chain) -> None:
    """Approximate orientations and positions from the images, tie points by command."""
    table = chain.folder / "approximate.csv"
    command("convert", chain.folder / "images", "--to", "csv", "--crs", "EPSG:32615", "-o", table)
    project = chain.init("gnss", "--orientation", table, "--positions", chain.folder / "images")
    edit(project, 'positions = "../images"', 'positions = "../images"\nsigma_position = [3.0, 5.0]\n#')
    command("tie", project, "--scale", 0.4, "--features", 900, "--per-image", 180, "--no-picture", "--workers", 2)


def test_what_the_drone_wrote_is_approximate(chain: Chain, tied: Path) -> None:
    """A check of the comparison too: it sees the errors of gimbal and GNSS."""
    off = distance(tied.parent / "project.previous.toml", chain.reference)
    print(f"\nas the drone wrote: {off}")
    assert 1.0 < np.abs(off.angles).max() < 6.0
    assert 0.3 < np.abs(off.positions).max() < 2.0
    assert off.shift[2] == pytest.approx(10.1, abs=0.2)


def test_positions_alone_orient_the_block(chain: Chain, tied: Path) -> None:
    folder = tied.parent
    found = json.loads(command("adjust", tied, "--json"))
    assert len(found["images"]) == 18
    off = distance(tied, chain.reference)
    print(f"\nGNSS: {off}")
    rms = [float(np.sqrt((v**2).mean())) for v in (off.positions, off.angles)]
    assert rms[0] <= 0.08 and np.abs(off.positions).max() <= 0.25  # flying height 41 m, 0.03 m pixels
    assert rms[1] <= 0.10 and np.abs(off.angles).max() <= 0.25
    assert np.abs(off.shift[:2]).max() < 1.0 and abs(off.shift[2] - 10.1) < 0.2
    for name in ("report.json", "image_points.csv"):
        assert "nan" not in (folder / "adjustment" / name).read_text().lower()
    assert "+nan" not in (folder / "adjustment" / "report.html").read_text()


def test_the_camera_constant_is_not_determined_by_such_a_block(chain: Chain, tied: Path) -> None:
    """It converges, and the standard deviation says what it is worth: several pixels."""
    said = inside("adjust", tied, "--calibrate", "c,k1,k2", "--dry-run", "--json")
    assert said.code == 0, said.err
    (camera,) = json.loads(said.out)["cameras"].values()
    print(f"\ncamera: {camera}")
    assert camera["parameters"]["c"]["sigma"] > 5.0


def test_without_any_orientation_to_orthophotos(chain: Chain, tied: Path, block: Path) -> None:
    """Eight control points, four check points, tie points; no position, no attitude.

    The orthophotos are compared with the coloured cloud by the rules of `test_brighton`. The control was taken from
    the reference and the same heights: what it tells is what the block makes of eight points.
    """
    measured, control = write_control(chain.folder / "survey", chain.reference, chain.heights)
    points = ("--image-points", tied.parent / "tie_points.csv", "--image-points", measured, "--control", control)
    project = chain.init("survey", *points, "--terrain", chain.heights, "--overwrite")
    text = project.read_text()
    project.write_text(text.replace("[observations]\n", "[observations]\nsigma_control = [0.03, 0.03]\n"))
    found = json.loads(command("adjust", project, "--json"))
    off = distance(project, chain.reference)
    accuracy = found["check_accuracy"]
    print(f"\nfrom nothing: {off}\ncheck points: {accuracy}")
    assert np.abs(off.shift).max() <= 0.25
    assert np.sqrt((off.positions**2).mean()) <= 0.08 and np.sqrt((off.angles**2).mean()) <= 0.10
    assert accuracy["RMSE_H"] <= 0.15 and accuracy["RMSE_V"] <= 0.2

    assert "all plausible" in command("check", project)
    command("ortho", project, "--resolution", 0.1, "--no-quicklook", "--workers", 2)
    cloud, kept = gray(block / "ref_ortho_from_cloud.tif"), []
    for path in sorted((project.parent / "products").glob("*_ortho.tif")):
        one = match(gray(path), cloud, patch=20.0, stride=10.0, search=1.0, filled=0.4)
        kept.append(one.keep(one.quality > 0.7))
    d = np.concatenate([[one.dx, one.dy] for one in kept], axis=1)
    rms = np.sqrt((d**2).mean(axis=1))
    print(f"orthophotos: {d.shape[1]} patches, rms {rms} m, mean {d.mean(axis=1)} m")
    assert d.shape[1] >= 180
    assert (rms <= 0.08).all()  # measured: 0.051 and 0.045; with the reference orientation 0.043 and 0.044
