"""Runs that are killed, interrupted, starved or doubled: nothing half-made appears, and the same command goes on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import rasterio
from tools.command import OPTIONS, Here, Undisturbed, inside, patience, process, sabotage, start, wait_for
from tools.forked import Mishap, forked
from tools.small_block import NAMES, Block

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals and limits")

TILE_BYTES = 128 * 128 * 3
"""What a finished tile adds to the log, at least."""


def ortho(small: Block, *words: object) -> list[object]:
    """Words that make the first image's product, one tile after the other."""
    return ["ortho", small.project, *OPTIONS, "--images", "one", "--workers", 1, *words]


def tiles_done(folder: Path, name: str = "one") -> int:
    log = folder / f".{name}_ortho.tif.tiles"
    return log.stat().st_size // TILE_BYTES if log.exists() else 0


def left_behind(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir() if p.name.startswith(".")}


class TestFault03Killed:
    def test_fault_03_killed_while_an_old_product_is_replaced(self, small: Block, undisturbed: Undisturbed) -> None:
        """The name holds the old product; the same command completes the new one from the finished tiles."""
        folder = small.folder / "products"
        words = ortho(small, "--json", "--overwrite")
        folder.mkdir()
        (folder / "one_ortho.tif").write_text("old")
        running = start(*words, env=sabotage(hold=small.folder / "go", quick=2))
        wait_for(lambda: tiles_done(folder) >= 2, running)
        running.kill()
        running.communicate()
        product = folder / "one_ortho.tif"
        assert product.read_text() == "old"
        again = inside(*words)
        assert again.code == 0, again.err
        facts = json.loads(again.out)["products"][0]
        assert 2 <= facts["resumed_tiles"] < facts["tiles"]
        assert f"one_ortho: {facts['resumed_tiles']} of {facts['tiles']} tiles are finished already" in again.err
        assert product.read_bytes() == undisturbed.bytes_of("one")
        assert left_behind(folder) == set()

    def test_fault_03_worker_processes_end_with_a_killed_parent(
        self, small: Block, begun: Path, tmp_path: Path
    ) -> None:
        words = ["ortho", small.project, *OPTIONS, "--executor", "processes", "--workers", 2]
        running = start(*words, env=sabotage(hold=tmp_path / "go", begun=begun))
        children = at_work(begun, 2, running)
        running.kill()
        running.wait()
        gone, alive = psutil.wait_procs(children, timeout=patience(5))
        for child in alive:
            child.kill()
        assert len(gone) == 2

    def test_fault_03_another_command_does_not_take_the_tiles(self, small: Block, undisturbed: Undisturbed) -> None:
        """Tiles of other parameters are of no use; their log is started afresh."""
        folder = small.folder / "products"
        forked(ortho(small, "--kernel", "nearest"), small.folder / "said", Mishap(end_at=2))
        assert tiles_done(folder) >= 1
        again = inside(*ortho(small, "--json"))
        assert json.loads(again.out)["products"][0]["resumed_tiles"] == 0
        assert (folder / "one_ortho.tif").read_bytes() == undisturbed.bytes_of("one")

    def test_fault_03_a_killed_run_of_many_products_goes_on(self, small: Block, undisturbed: Undisturbed) -> None:
        folder = small.folder / "products"
        words = ["ortho", small.project, *OPTIONS, "--json"]
        running = start(*words, env=sabotage(hold=small.folder / "go", quick=2, image="three"))
        # Products come in the order of the project's images: one, three, two.
        # The first one is completed while the second one is held up.
        record = folder / "one_ortho.run.json"
        wait_for(lambda: tiles_done(folder, "three") >= 2 and record.exists(), running)
        running.kill()
        running.communicate()
        made = (folder / "one_ortho.tif").stat().st_mtime_ns
        again = inside(*words)
        assert again.code == 0, again.err
        assert "1 of 3 products are finished already" in again.err
        products = {p["image"]: p for p in json.loads(again.out)["products"]}
        assert products["one"]["resumed_tiles"] == products["one"]["tiles"]
        assert products["three"]["resumed_tiles"] >= 2
        assert products["two"]["resumed_tiles"] == 0
        assert (folder / "one_ortho.tif").stat().st_mtime_ns == made
        assert [(folder / f"{n}_ortho.tif").read_bytes() for n in NAMES] == [undisturbed.bytes_of(n) for n in NAMES]


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    """Where workers that are at a slow tile leave their numbers."""
    folder = tmp_path / "begun"
    folder.mkdir()
    return folder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB; needs the right to mount."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "none", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small file system")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


class TestFault04FullDisk:
    def test_fault_04_a_real_disk_runs_full(self, photoplan: Here, pristine: Block, small_disk: Path) -> None:
        """Three products and their logs need more than 1 MB: what is complete stays, and nothing else has a name."""
        words = ["ortho", pristine.project, *OPTIONS, "--output", small_disk, "--resolution", "0.7"]
        said = photoplan(*words)
        assert said.code == 5
        assert str(small_disk) in said.err
        for path in small_disk.glob("*.tif"):
            with rasterio.open(path) as file:
                assert file.read().any()
            assert str(path) in said.out.splitlines()
        assert not list(small_disk.glob(".*.part*")) + list(small_disk.glob(".*.plain*"))

    def test_fault_04_no_room_for_a_plan(self, photoplan: Here, pristine: Block, small_disk: Path) -> None:
        (small_disk / "ballast").write_bytes(b"x" * (1 << 20))
        said = photoplan("ortho", pristine.project, *OPTIONS, "--plan", small_disk / "p.gpkg")
        assert said.code == 5
        assert "p.gpkg" in said.err
        assert [p.name for p in small_disk.iterdir()] == ["ballast"]


def at_work(begun: Path, count: int, running: subprocess.Popen[str]) -> list[psutil.Process]:
    """The processes of a command that are at a tile, when there are so many."""
    wait_for(lambda: len(list(begun.iterdir())) >= count, running)
    return [psutil.Process(int(path.name)) for path in begun.iterdir()]


class TestFault05DeadWorkers:
    @pytest.mark.slow
    def test_fault_05_one_worker_is_killed(self, small: Block, undisturbed: Undisturbed, tmp_path: Path) -> None:
        victim = tmp_path / "victim"
        victim.touch()
        words = ["ortho", small.project, *OPTIONS, "--executor", "processes", "--workers", 2, "--images", "one"]
        said = process(*words, env=sabotage(once=victim))
        assert not victim.exists()
        assert said.code == 0, said.err
        assert (small.folder / "products" / "one_ortho.tif").read_bytes() == undisturbed.bytes_of("one")

    @pytest.mark.slow
    def test_fault_05_a_tile_that_always_kills_its_worker(self, small: Block, undisturbed: Undisturbed) -> None:
        """Tried three times, then listed with exit code 4; other products are there, and its other tiles are kept."""
        words = ["ortho", small.project, *OPTIONS, "--executor", "processes", "--workers", 2]
        said = process(*words, "--json", "--images", "one", "--images", "two", env=sabotage(deadly="one:3"))
        folder = small.folder / "products"
        assert said.code == 4
        assert "one_ortho.tif: tiles 3 (tile 3: its worker died, also when it ran alone)" in said.err
        one, two = json.loads(said.out)["products"]
        assert (one["failed_tiles"], two["failed_tiles"]) == ([3], [])
        assert not (folder / "one_ortho.tif").exists()
        assert (folder / "two_ortho.tif").read_bytes() == undisturbed.bytes_of("two")
        again = inside(*ortho(small, "--json"))
        facts = json.loads(again.out)["products"][0]
        assert facts["resumed_tiles"] == facts["tiles"] - 1
        assert (folder / "one_ortho.tif").read_bytes() == undisturbed.bytes_of("one")


class TestFault25Interrupts:
    @pytest.mark.parametrize(
        ("executor", "signals"),
        [
            ("threads", [signal.SIGTERM]),
            pytest.param("threads", [signal.SIGINT, signal.SIGINT], marks=pytest.mark.slow),
            pytest.param("processes", [signal.SIGINT], marks=pytest.mark.slow),
            pytest.param("processes", [signal.SIGTERM, signal.SIGTERM], marks=pytest.mark.slow),
        ],
        ids=["threads-TERM", "threads-INT-INT", "processes-INT", "processes-TERM-TERM"],
    )
    def test_fault_25_gone_in_5_seconds(
        self,
        small: Block,
        undisturbed: Undisturbed,
        begun: Path,
        tmp_path: Path,
        executor: str,
        signals: list[signal.Signals],
    ) -> None:
        """Tiles that never end do not hold it; all processes are gone, and the same command goes on."""
        folder = small.folder / "products"
        words = ["ortho", small.project, *OPTIONS, "--executor", executor, "--workers", 2, "--images", "one"]
        # The first tiles are quick, so that there is something to go on with.
        running = start(*words, env=sabotage(hold=tmp_path / "go", quick=2, begun=begun))
        wait_for(lambda: tiles_done(folder) >= 2, running)
        children = at_work(begun, 2 if executor == "processes" else 1, running)
        children = [child for child in children if child.pid != running.pid]
        within = patience(5)
        began = time.monotonic()
        for number in signals:
            # A terminal sends Ctrl-C to all processes of the job, `kill` a signal to one.
            send = os.killpg if number == signal.SIGINT else os.kill
            send(running.pid, number)
        out, err = running.communicate(timeout=4 * within)
        _, alive = psutil.wait_procs(children, timeout=max(0.1, within - (time.monotonic() - began)))
        assert time.monotonic() - began < within
        assert not alive
        assert running.returncode == 130
        assert "Traceback" not in err
        assert "same command continues" in err.splitlines()[-1]
        assert out == ""
        assert not (folder / "one_ortho.tif").exists()
        if signals == [signal.SIGTERM]:
            again = inside(*ortho(small, "--json"))
            assert json.loads(again.out)["products"][0]["resumed_tiles"] >= 2
            assert (folder / "one_ortho.tif").read_bytes() == undisturbed.bytes_of("one")

    def test_fault_25_ignored_stays_ignored(self, small: Block) -> None:
        """A command under `nohup` or in the background of a script does not mind Ctrl-C."""
        folder = small.folder / "products"
        go = small.folder / "go"
        ignoring = ["bash", "-c", 'trap "" INT; exec "$@"', "bash"]
        running = start(*ortho(small), env=sabotage(hold=go, quick=1), before=ignoring)
        wait_for(lambda: tiles_done(folder) >= 1, running)
        os.killpg(running.pid, signal.SIGINT)
        go.touch()
        running.communicate(timeout=60)
        assert running.returncode == 0

    def test_fault_25_it_ends_although_nobody_reads_what_it_says(self) -> None:
        """Whoever had started it is gone, and with that the other end of its errors."""
        away = "import os; r, w = os.pipe(); os.close(r); os.dup2(w, 2); "
        code = away + "from photoplan.cli.interrupt import _end; _end()"
        assert subprocess.run([sys.executable, "-c", code]).returncode == 130


class TestFault13And29Outputs:
    def test_fault_13_a_product_exists(self, photoplan: Here, small: Block) -> None:
        """Refused before any work, also where only one of the products exists."""
        folder = small.folder / "products"
        folder.mkdir()
        (folder / "two_ortho.tif").write_text("precious")
        said = photoplan("ortho", small.project, *OPTIONS)
        assert said.code == 2
        assert "two_ortho.tif exists; give --overwrite to replace it, or another --output" in said.err
        assert [p.name for p in folder.iterdir()] == ["two_ortho.tif"]
        assert (folder / "two_ortho.tif").read_text() == "precious"

    def test_fault_13_a_finished_run_is_not_repeated(self, photoplan: Here, small: Block) -> None:
        assert photoplan(*ortho(small)).code == 0
        said = photoplan(*ortho(small))
        assert (said.code, said.out) == (2, "")
        assert "one_ortho.tif exists" in said.err
        assert photoplan(*ortho(small, "--overwrite")).code == 0

    @pytest.mark.parametrize("kind", ["symlink", "hardlink", "folder"])
    def test_fault_13_an_input_under_a_products_name(self, photoplan: Here, small: Block, kind: str) -> None:
        """No link to any input is replaced, whichever product it would become; nothing is done before."""
        folder = small.folder / "products"
        target = small.images[NAMES.index("three")]
        before = target.read_bytes()
        if kind == "folder":
            folder.symlink_to(small.folder / "images")
            shutil.copy(target, small.folder / "images" / "two_ortho.tif")
            text = small.project.read_text().replace("images/three.tif", "images/two_ortho.tif")
            small.project.write_text(text)
            target = small.folder / "images" / "two_ortho.tif"
        else:
            folder.mkdir()
            link = folder / "two_ortho.tif"
            link.symlink_to(target) if kind == "symlink" else link.hardlink_to(target)
        said = photoplan("ortho", small.project, *OPTIONS, "--overwrite")
        assert said.code == 2
        assert "two_ortho.tif: the output is an input of the project" in said.err
        assert target.read_bytes() == before
        assert not (folder / "one_ortho.tif").exists()

    def test_fault_13_the_overview_and_the_plan_do_not_replace_inputs(self, photoplan: Here, small: Block) -> None:
        with rasterio.open(small.images[0]) as file:
            pixels = file.read()
        picture = small.folder / "products" / "ortho_overview.png"
        picture.parent.mkdir()
        with rasterio.open(picture, "w", driver="PNG", width=200, height=150, count=3, dtype="uint8") as file:
            file.write(pixels)
        before = picture.read_bytes()
        small.project.write_text(small.project.read_text().replace("images/one.tif", "products/ortho_overview.png"))
        said = photoplan("ortho", small.project, *OPTIONS, "--overwrite")
        assert said.code == 2
        assert "ortho_overview.png: the output is an input of the project" in said.err
        assert photoplan("ortho", small.project, *OPTIONS, "--no-quicklook").code == 0
        assert picture.read_bytes() == before
        terrain = small.terrain.read_bytes()
        link = small.folder / "link.gpkg"
        link.symlink_to(small.terrain)
        for path in (small.terrain, small.project, picture, link):
            said = photoplan("ortho", small.project, *OPTIONS, "--plan", path, "--overwrite")
            assert said.code == 2, path
            assert str(path) in said.err
        assert small.terrain.read_bytes() == terrain

    def test_fault_29_a_file_in_place_of_the_folder(self, photoplan: Here, pristine: Block, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        said = photoplan("ortho", pristine.project, *OPTIONS, "--output", tmp_path / "file")
        assert said.code == 2
        assert f"{tmp_path / 'file'}: " in said.err
        said = photoplan("ortho", pristine.project, *OPTIONS, "--output", tmp_path / "file" / "deeper")
        assert said.code == 2
        assert str(tmp_path / "file" / "deeper") in said.err
        said = photoplan("ortho", pristine.project, *OPTIONS, "--plan", tmp_path / "file" / "p.gpkg")
        assert said.code == 2
        assert str(tmp_path / "file") in said.err

    @pytest.mark.parametrize("verb", ["ortho", "plan", "init"])
    def test_fault_29_a_folder_that_cannot_be_written(
        self, photoplan: Here, pristine: Block, frozen: Path, verb: str
    ) -> None:
        words: list[object]
        if verb == "init":
            words = ["init", frozen, *pristine.init_options(), "--height-system", "same"]
        else:
            words = ["ortho", pristine.project, *OPTIONS]
            words += ["--output", frozen] if verb == "ortho" else ["--plan", frozen / "p.gpkg"]
        said = photoplan(*words)
        assert said.code in (2, 3)
        assert str(frozen) in said.err
        assert list(frozen.iterdir()) == []


@pytest.fixture
def frozen(tmp_path: Path) -> Iterator[Path]:
    """A folder that nobody can write, not even the superuser."""
    folder = tmp_path / "frozen"
    folder.mkdir()
    folder.chmod(0o555)
    if os.access(folder, os.W_OK):
        made = (
            shutil.which("chattr")
            and not subprocess.run(["chattr", "+i", str(folder)], capture_output=True, check=False).returncode
        )
        if not made:
            pytest.skip("the superuser can write everywhere here")
    yield folder
    if shutil.which("chattr"):
        subprocess.run(["chattr", "-i", str(folder)], capture_output=True, check=False)
    folder.chmod(0o755)


def test_fault_26_pixels_are_those_of_one_worker(undisturbed: Undisturbed) -> None:
    """The products that all others are compared with hold the images' texture, not a constant."""
    with rasterio.open(undisturbed.folder / "one_ortho.tif") as file:
        pixels, valid = file.read(), file.dataset_mask() > 0
    assert valid.mean() > 0.7
    assert np.std(pixels[:, valid]) > 20
