"""Every product that runs, by its command: killed, starved, doubled, by more workers, it is the same in the end.

A product that is added runs by the one loop: an entry of `CASES` is all that it needs here.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.test_dtm_build import ground, ridge
from tools.forked import QUIET, Mishap, Ran, content, forked
from tools.landxml import write_landxml
from tools.real_projects import drone_project
from tools.recorded import checked
from tools.small_block import CRS, X0, Y0, texture, write_block, write_image
from tools.town import write_town

from photoplan.io.disk import FileLock, lock_of
from photoplan.io.store import record_path

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs fork, signals and limits")

Words = Callable[[Path, Path], list[object]]
"""Words of a command, from the folder of its inputs and one for its output."""

MODEL = """
seed = 3
[spread]
gaussian = 0.6
[jitter]
sigma = 0.2
[exposure]
light = 5000.0
[readout]
shot_noise = true
[gain]
factor = 0.04
[automatic_gain]
target = 100.0
least = 0.2
most = 5.0
frames = 2.0
[quantisation]
bits = 8
"""


def terrain(verb: str, *options: object) -> Words:
    """A raster of the terrain of the small block, some tiles of 512 or 256."""
    return lambda inputs, out: ["dtm", verb, inputs / "block" / "dem.tif", "-o", out / "product.tif", *options]


def ortho(inputs: Path, out: Path) -> list[object]:
    project = inputs / "block" / "project.toml"
    return ["ortho", project, "--images", "one", "--resolution", 1, "--tile", 128, "--no-quicklook", "--output", out]


def true_ortho(inputs: Path, out: Path) -> list[object]:
    """Of a house, a deck and a mast, with a raster of what they hide."""
    project = inputs / "block" / "town.toml"
    words = ["--true", "--hidden", "mark", "--resolution", 1, "--tile", 128, "--no-quicklook", "--output", out]
    return ["ortho", project, "--images", "one", *words]


def mosaic(inputs: Path, out: Path) -> list[object]:
    """Of ground with objects, blended by bands of detail."""
    project = inputs / "block" / "town.toml"
    bounds = ["--bounds", 500_200, 5_300_100, 500_520, 5_300_300, "--resolution", 1, "--tile", 128]
    blend = ["--feather", 24, "--blend", "multiband"]
    return ["mosaic", project, *bounds, *blend, "--sources", "--no-quicklook", "--output", out]


def seams(inputs: Path, out: Path) -> list[object]:
    words = ["--resolution", 4, "--no-picture", "-o", out / "product.gpkg"]
    return ["seams", inputs / "block" / "project.toml", *words]


def single(inputs: Path, out: Path) -> list[object]:
    """A house alone, in four tiles."""
    words = ["--objects", "house", "--resolution", 0.25, "--force", "--tile", 128, "--no-quicklook", "--output", out]
    return ["object", inputs / "block" / "town.toml", inputs / "block" / "town.gpkg", *words]


def direct(inputs: Path, out: Path) -> list[object]:
    return [*ortho(inputs, out), "--method", "direct", "--fill", 2]


def restore(inputs: Path, out: Path) -> list[object]:
    return ["restore", inputs / "scan.tif", "--filter", inputs / "weights.csv", "--no-quicklook", "--output", out]


def build(inputs: Path, out: Path) -> list[object]:
    return ["dtm", "build", inputs / "survey.xml", "-o", out / "product.gpkg", "--no-report"]


def volume(inputs: Path, out: Path) -> list[object]:
    both = [inputs / "block" / "dem.tif"] * 2
    words = ["--height-system", "same", "--resolution", 1.1, "--tolerance", 1]
    return ["dtm", "volume", *both, *words, "--difference", out / "product.tif"]


def simulate(inputs: Path, out: Path) -> list[object]:
    words = ["--model", inputs / "model.toml", "--size", 180, 40, "--frames", 3]
    return ["simulate", "star:12", *words, "--output", out / "product.tif"]


def tie(inputs: Path, out: Path) -> list[object]:
    project = inputs / "ties" / f"{out.name}.toml"  # the command adds its table
    if not project.exists():
        shutil.copy(inputs / "ties" / "project.toml", project)
    words = ["--features", 600, "--per-image", 60, "--scale", 0.3, "--no-picture"]
    return ["tie", project, "-o", out / "product.csv", *words]


def view(inputs: Path, out: Path) -> list[object]:
    words = ["--from", 500240, 5300150, "--height", 40, "--look-at", 500320, 5300210, "--size", 520, 515]
    return ["view", "--samples", 1, inputs / "block" / "dem.tif", *words, "-o", out / "product.png"]


CASES: dict[str, tuple[Words, str]] = {
    "ortho": (ortho, "one_ortho.tif"),
    "true": (true_ortho, "one_ortho.tif"),
    "mosaic": (mosaic, "mosaic.tif"),
    "seams": (seams, "product.gpkg"),
    "object": (single, "house_object.tif"),
    "direct": (direct, "one_ortho.tif"),
    "restore": (restore, "scan_restored.tif"),
    "simulate": (simulate, "product_0003.tif"),
    "tie": (tie, "product.csv"),
    "build": (build, "product.gpkg"),
    "shade": (terrain("shade", "--resolution", 1.1), "product.tif"),
    "slope": (terrain("slope", "--resolution", 1.1, "--classes", "5,10"), "product.tif"),
    "aspect": (terrain("slope", "--aspect", "--resolution", 1.1), "product.tif"),
    "tint": (terrain("tint", "--resolution", 1.1), "product.tif"),
    "export": (terrain("export", "--resolution", 1.1), "product.tif"),
    "visible": (terrain("visible", "--resolution", 1.1, "--from", 500300, 5300200), "product.tif"),
    "flow": (terrain("flow", "--resolution", 1.1), "product.tif"),
    "volume": (volume, "product.tif"),
    "view": (view, "product.png"),
}
"""Command and name of the product that comes last."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory, block: Path) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_town(write_block(folder / "block").project, (X0, Y0), 100.0, CRS)
    pixels = np.tile(texture(bands=1), (1, 5, 4))[:, :700, :700]
    write_image(folder / "scan.tif", np.ascontiguousarray(pixels), tiled=True)
    (folder / "weights.csv").write_text("0,-0.8,0\n-0.8,4.2,-0.8\n0,-0.8,0\n")
    (folder / "model.toml").write_text(MODEL)
    write_landxml(folder / "survey.xml", ground(250), {"ridge": ridge()})
    (folder / "ties").mkdir()
    drone_project(block, folder / "ties", "DJI_0025", "DJI_0026", "DJI_0033")
    return folder


class Product:
    """One case: runs of its command, each in a folder of its own."""

    def __init__(self, name: str, inputs: Path, folder: Path) -> None:
        self.words, self.last = CASES[name]
        self.inputs, self.folder = inputs, folder

    def run(self, out: Path, mishap: Mishap = QUIET, workers: int = 1, *more: object) -> Ran:
        out.mkdir(parents=True, exist_ok=True)
        words = [*self.words(self.inputs, out), *more]
        return forked([*words, "--workers", workers], out / "said", mishap)

    def path(self, out: Path) -> Path:
        return out / self.last

    def record(self, out: Path) -> dict[str, Any]:
        """The run record; frames of a simulation have one in common."""
        own = record_path(self.path(out))
        text = (own if own.exists() else out / "product.run.json").read_text()
        found: dict[str, Any] = json.loads(text.replace(str(out), "."))
        return found

    def figures(self, out: Path) -> dict[str, Any]:
        """What the record says of the product, but for what the run itself took."""
        return {k: v for k, v in self.record(out)["product"].items() if k not in ("seconds", "resumed_tiles")}

    def same(self, out: Path, undisturbed: Path) -> bool:
        """Whether product and figures are what they are without any mishap, and nothing else is left."""
        assert [p.name for p in out.iterdir() if p.name.startswith(".")] == []
        assert self.figures(out) == self.figures(undisturbed)
        return content(self.path(out)) == content(self.path(undisturbed))


#: Of these the loop is that of a product beside them: of `ortho` and, for maps of terrain, of `shade`.
LIKE_OTHERS = ("true", "direct", "slope", "aspect", "tint", "export")


@pytest.fixture(
    scope="module",
    params=[pytest.param(name, marks=pytest.mark.slow if name in LIKE_OTHERS else []) for name in CASES],
)
def product(request: pytest.FixtureRequest, inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Product:
    return Product(request.param, inputs, tmp_path_factory.mktemp(request.param))


@pytest.fixture(scope="module")
def quiet(product: Product) -> Ran:
    """A run that nothing happens to."""
    said = product.run(product.folder / "quiet")
    assert said.code == 0, said.err
    assert len(said.tasks) == len(set(said.tasks)) > 2
    return said


@pytest.fixture
def undisturbed(product: Product, quiet: Ran) -> Path:
    return product.folder / "quiet"


def test_faults_03_04_26_killed_then_starved_then_in_any_order(
    product: Product, quiet: Ran, undisturbed: Path, tmp_path: Path
) -> None:
    """A run that is killed halfway; the same command on a disk that runs full; the same with two workers.

    Nothing has the product's name before the end, nothing is computed twice, and the bytes are those of a quiet run.
    Each mishap by itself is in `make test-slow`.
    """
    half = round(0.5 * len(quiet.tasks))
    killed = product.run(tmp_path, Mishap(end_at=half))
    assert (killed.code, len(killed.tasks)) == (-9, half)
    nothing_made(product, tmp_path)
    full = starved(product, undisturbed, tmp_path)
    assert not set(killed.tasks) & set(full.tasks)
    again = product.run(tmp_path, Mishap(shuffled=True), 2)
    assert again.code == 0, again.err
    assert "finished already" in again.err or "of an earlier run are kept" in again.err
    # The task whose result found no room may have been counted before it was kept.
    done = killed.tasks + full.tasks[:-1]
    assert not set(done) & set(again.tasks)
    assert sorted({*done, *full.tasks, *again.tasks}) == sorted(quiet.tasks)
    assert len(again.tasks) == len(set(again.tasks)) < len(quiet.tasks)
    assert product.same(tmp_path, undisturbed)


def nothing_made(product: Product, out: Path) -> None:
    assert not product.path(out).exists() and not record_path(product.path(out)).exists()


def starved(product: Product, undisturbed: Path, out: Path) -> Ran:
    """A run on a full disk: exit code 5, which file and what to do; no half product."""
    room = product.path(undisturbed).stat().st_size // 2
    full = product.run(out, Mishap(most_bytes=room))
    assert full.code == 5, full.err
    assert str(out) in full.err and "free some space" in full.err
    nothing_made(product, out)
    assert not [p for p in out.iterdir() if ".part" in p.name or ".plain" in p.name]
    return full


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sign", "share", "code"),
    [
        pytest.param(signal.SIGKILL, 0.5, -9, id="killed halfway"),
        pytest.param(signal.SIGKILL, 1.0, -9, id="killed at the last task"),
        pytest.param(signal.SIGINT, 0.5, 130, id="interrupted"),
    ],
)
def test_faults_03_25_a_run_that_ended_early_goes_on(
    product: Product, quiet: Ran, undisturbed: Path, tmp_path: Path, sign: signal.Signals, share: float, code: int
) -> None:
    """Nothing has the product's name; the same command computes what is missing, and nothing twice."""
    at = min(round(share * len(quiet.tasks)), len(quiet.tasks) - 1)
    killed = product.run(tmp_path, Mishap(end_at=at, sign=sign))
    assert (killed.code, len(killed.tasks)) == (code, at)
    assert sign == signal.SIGKILL or "same command continues" in killed.err.splitlines()[-1]
    nothing_made(product, tmp_path)
    again = product.run(tmp_path)
    assert again.code == 0, again.err
    assert "finished already" in again.err or "of an earlier run are kept" in again.err
    assert not set(killed.tasks) & set(again.tasks)
    assert sorted(killed.tasks + again.tasks) == sorted(quiet.tasks)
    assert product.same(tmp_path, undisturbed)


@pytest.mark.slow
def test_fault_04_a_full_disk(product: Product, undisturbed: Path, tmp_path: Path) -> None:
    """With more room the same command goes on."""
    full = starved(product, undisturbed, tmp_path)
    again = product.run(tmp_path)
    assert again.code == 0, again.err
    assert not set(full.tasks[:-1]) & set(again.tasks)
    assert product.same(tmp_path, undisturbed)


@pytest.mark.slow
def test_fault_05_a_task_that_fails_for_a_moment_is_tried_again(
    product: Product, quiet: Ran, undisturbed: Path, tmp_path: Path
) -> None:
    said = product.run(tmp_path, Mishap(fail_at=1))
    assert said.code == 0, said.err
    assert sorted(said.tasks) == sorted(quiet.tasks) and product.same(tmp_path, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 4])
def test_fault_26_more_workers_in_any_order(
    product: Product, quiet: Ran, undisturbed: Path, tmp_path: Path, workers: int
) -> None:
    said = product.run(tmp_path, Mishap(shuffled=True), workers)
    assert said.code == 0, said.err
    assert sorted(said.tasks) == sorted(quiet.tasks) and product.same(tmp_path, undisturbed)


@pytest.mark.parametrize(
    "name", ["ortho", *(pytest.param(each, marks=pytest.mark.slow) for each in ("mosaic", "view"))]
)
def test_fault_26_processes(name: str, inputs: Path, tmp_path: Path) -> None:
    """The commands that can have processes for workers."""
    product = Product(name, inputs, tmp_path)
    for out, more in ((tmp_path / "threads", ()), (tmp_path / "processes", ("--executor", "processes"))):
        said = product.run(out, QUIET, 2, *more)
        assert said.code == 0, said.err
    assert product.same(tmp_path / "processes", tmp_path / "threads")


def test_fault_26_a_second_run_is_refused(product: Product, tmp_path: Path) -> None:
    first = product.path(tmp_path)
    locked = first.with_name("product.tif") if first.name.startswith("product_") else first
    with FileLock(lock_of(locked)):
        said = product.run(tmp_path)
    assert said.code == 2 and "another run" in said.err and said.tasks == []
    assert not first.exists()


def test_every_phase_counts_to_its_end(product: Product, quiet: Ran) -> None:
    counted = [(promised, done) for _, promised, done in quiet.phases if promised]
    assert counted and all(promised == done for promised, done in counted), quiet.phases


def test_the_record_answers_for_the_product(product: Product, quiet: Ran, undisturbed: Path) -> None:
    record = checked(product.record(undisturbed))
    files = [each for each in record["inputs"] if not each["path"].endswith("quiet.toml")]  # `tie` adds its table
    own = record_path(product.path(undisturbed))
    folder = own.parent if own.exists() else undisturbed
    assert files and all(each["size"] == (folder / each["path"]).stat().st_size for each in files)
    assert record["run"]["workers"] >= 1
