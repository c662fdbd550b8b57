"""`balance`, `seams` and `surface` with other workers than threads: a Dask cluster by its address, processes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
from tools.command import Here
from tools.facet_scene import GROUND, write_scene
from tools.small_block import X0, Y0, Block

from photoplan.products.surface import plan as surface_plan
from photoplan.products.surface import run as surfaces


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Two Dask workers inside this process."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        yield cluster.scheduler_address


def regions(path: Path) -> dict[str, Any]:
    meta, _, geometry, columns = pyogrio.raw.read(path)
    return dict(zip(columns[meta["fields"].tolist().index("image")], shapely.from_wkb(geometry)))


def both(photoplan: Here, block: Block, out: Path, executor: str) -> tuple[dict[str, str], dict[str, Any]]:
    """Tables and regions, found by an executor in a folder that holds nothing else then."""
    tables, project = out / "tables", block.folder / f"{out.name}.toml"
    shutil.copy(block.project, project)
    words = ("--executor", executor, "--workers", 2, "--no-picture", "-q")
    said = photoplan("balance", project, "-o", tables, "--resolution", 2, *words)
    assert said.code == 0, said.err
    said = photoplan("seams", block.project, "-o", out / "seams.gpkg", "--resolution", 4, *words)
    assert said.code == 0, said.err
    assert {path.name for path in out.iterdir()} == {"tables", "seams.gpkg", "seams.run.json"}
    assert not [path for path in tables.iterdir() if path.name.startswith(".")]
    return {path.name: path.read_text() for path in tables.glob("*.toml")}, regions(out / "seams.gpkg")


def same(first: tuple[dict[str, str], dict[str, Any]], second: tuple[dict[str, str], dict[str, Any]]) -> bool:
    apart = [first[1][name].symmetric_difference(second[1][name]).area for name in first[1]]
    return first[0] == second[0] and first[1].keys() == second[1].keys() and max(apart) == 0


@pytest.mark.slow
def test_fault_26_the_same_tables_and_regions(small: Block, capsys: pytest.CaptureFixture[str], address: str) -> None:
    photoplan, folder = Here(capsys), small.folder / "found"
    found = {}
    for name, executor in (("threads", "threads"), ("cluster", address), ("processes", "processes")):
        (folder / name).mkdir(parents=True)
        found[name] = both(photoplan, small, folder / name, executor)
    assert len(found["threads"][0]) == 3 and len(found["threads"][1]) > 1
    assert same(found["threads"], found["cluster"]) and same(found["threads"], found["processes"])


@pytest.mark.slow
def test_fault_26_the_same_bytes_of_a_surface(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heights, grey values and all that is beside them, in two tiles."""
    for module in (surface_plan, surfaces):
        monkeypatch.setattr(module, "TILE", 128)
    scene, made = write_scene(tmp_path, 3), {}
    words = ("surface", scene.path, "--resolution", 0.5, "--bounds", X0 - 18, Y0 - 34, X0 + 18, Y0 + 34)
    words += ("--start", GROUND, "--residuals", "--workers", 2, "--no-quicklook", "-q", "--points", "points.ply")
    for name, executor in (("threads", "threads"), ("cluster", address), ("processes", "processes")):
        out = tmp_path / name
        said = Here(capsys)(*words[:-1], out / "points.ply", "--executor", executor, "-o", out)
        assert said.code == 0, said.err
        made[name] = {path.name: path.read_bytes() for path in out.iterdir() if path.suffix != ".json"}
        assert json.loads((out / "surface.run.json").read_text())["product"]["tiles"] == 2
    assert len(made["threads"]) == 8
    assert made["threads"] == made["cluster"] and made["threads"] == made["processes"]


@pytest.mark.slow
def test_reference_on_a_cluster(small: Block, capsys: pytest.CaptureFixture[str], address: str) -> None:
    photoplan, folder = Here(capsys), small.folder
    words = ("mosaic", small.project, "--resolution", 4, "--no-quicklook", "--name", "reference")
    assert photoplan(*words).code == 0
    found = []
    for name, executor in (("a", "threads"), ("b", address)):
        words = ("--reference", folder / "products" / "reference.tif", "--resolution", 2, "--executor", executor)
        said = photoplan("balance", small.project, "-o", folder / name, *words, "--no-picture", "-q")
        assert said.code == 0, said.err
        found.append({path.name: path.read_text() for path in (folder / name).glob("*.toml")})
    assert found[0] == found[1]


@pytest.mark.slow
def test_fault_05_an_image_that_no_worker_can_read(
    small: Block, capsys: pytest.CaptureFixture[str], address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from photoplan.products import seams as run

    def broken(*given: Any) -> Any:
        raise OSError("the disk has gone")

    monkeypatch.setattr(run, "shown", broken)
    words = ("seams", small.project, "--resolution", 4, "--no-picture", "-q", "--executor", address)
    said = Here(capsys)(*words)
    assert said.code == 4 and "the disk has gone" in said.err and "nothing is written" in said.err
    assert not list((small.folder / "products").iterdir())


@pytest.mark.parametrize("verb", ["balance", "seams"])
@pytest.mark.parametrize("executor", ["fibres", "tcp://127.0.0.1:9"])
def test_workers_that_cannot_be(small: Block, capsys: pytest.CaptureFixture[str], verb: str, executor: str) -> None:
    """What is no executor is refused, also by a dry run; a dry run asks no cluster."""
    said = Here(capsys)(verb, small.project, "--executor", executor, "--dry-run", "--resolution", 8)
    if executor == "fibres":
        assert said.code == 2 and "fibres" in said.err
    else:
        assert said.code == 0 and "3 images" in said.out
    assert not list(small.folder.glob("balance*")) and not (small.folder / "products").exists()


def test_images_pickle_small(small: Block) -> None:
    """What goes to a worker with an image is its own description, however many images there are."""
    import pickle

    from photoplan import load_project
    from photoplan.events import SILENT
    from photoplan.products.balance import survey
    from photoplan.products.seams import _images, _Map

    project = load_project(small.project)
    found = survey(project, project.select(None), 8.0, None, SILENT)
    one, job = _images(found)[0], _Map(found.grid, found.tiles.side)
    assert len(pickle.dumps((job, one))) < 5000
    made = pickle.loads(pickle.dumps(job))(pickle.loads(pickle.dumps(one)))
    assert all(np.array_equal(a.values, b.values, equal_nan=True) for a, b in zip(made, job(one)))
