"""Products under bad conditions: full disk, death, links to inputs, folders that cannot be written."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from tools.forked import scripted
from tools.thinned import some

from photoplan.errors import ResourceError, RunLocked, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io import product as product_module
from photoplan.io.product import ProductFile, check_output, check_product

GRID = MapGrid(1000, 2000, 1, 1200, 1000, "EPSG:32633")
PLACE = GRID.placement


def tile_of(index: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(index).integers(1, 250, (3, height, width), dtype=np.uint8)


def run(path: Path, **options: object) -> None:
    with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k", tile=128, **options) as file:  # type: ignore[arg-type]
        for index in sorted(set(range(len(file.windows))) - file.finished):
            window = file.windows[index]
            file.append(index, tile_of(index, window.height, window.width))
        file.complete()


class TestFault13Output:
    """An output that exists or is an input is refused before any work."""

    def test_fault_13_existing(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tif"
        path.write_text("precious")
        with pytest.raises(UsageError, match=r"a\.tif: exists already; .*`overwrite`") as error:
            run(path)
        assert error.value.exit_code == 2
        assert path.read_text() == "precious"
        assert list(tmp_path.iterdir()) == [path]
        run(path, overwrite=True)
        with rasterio.open(path) as file:
            assert file.shape == (1000, 1200)

    @pytest.mark.parametrize("kind", ["same", "symlink", "hardlink", "dots", "dangling"])
    def test_fault_13_an_input_also_by_a_link(self, tmp_path: Path, kind: str) -> None:
        source = tmp_path / "in.tif"
        source.write_text("precious")
        path = tmp_path / "out.tif"
        if kind == "same":
            path = source
        elif kind == "symlink":
            path.symlink_to(source)
        elif kind == "hardlink":
            path.hardlink_to(source)
        elif kind == "dots":
            (tmp_path / "sub").mkdir()
            path = tmp_path / "sub" / ".." / "in.tif"
        else:
            source = tmp_path / "absent.tif"
            path.symlink_to(source)
        with pytest.raises(UsageError, match="the output is the input"):
            run(path, overwrite=True, inputs=[source])
        assert kind == "dangling" or source.read_text() == "precious"

    def test_fault_13_a_folder(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="is a folder"):
            check_output(tmp_path, overwrite=True)

    def test_fault_13_a_file_that_appears_meanwhile(self, tmp_path: Path) -> None:
        path = tmp_path / "a.tif"
        with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k") as file:
            path.write_text("precious")
            for index in range(len(file.windows)):
                file.append_empty(index)
            with pytest.raises(UsageError, match="exists already"):
                file.complete()
        assert path.read_text() == "precious"


def test_fault_26_two_runs_on_one_output(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k") as first:
        first.append_empty(0)
        with pytest.raises(RunLocked, match="another run"):
            run(path)
        assert first.finished == {0}
    run(path)


KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
sys.path.insert(0, sys.argv[2])
import test_product_faults as here
from photoplan.io import product
from photoplan.io import store as naming

moment = sys.argv[3]
def die(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGKILL)
if moment == "append":
    encode = product.BlockCoder.encode
    count = iter(range(1000))
    product.BlockCoder.encode = lambda *a: die() if next(count) == 30 else encode(*a)
elif moment == "cog":
    product.write_cog = die
elif moment == "check":
    product.check_product = die
else:
    naming.sync_file = die
here.run(Path(sys.argv[1]), overwrite=sys.argv[4] == "old")
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("before", some(["absent", "old"], 1))
@pytest.mark.parametrize("moment", ["append", "cog", "check", "sync"])
def test_fault_03_killed_while_writing(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, moment: str, before: str
) -> None:
    """The name stays absent or old; the next run continues and its product equals an undisturbed one."""
    whole = tmp_path / "whole" / "a.tif"
    whole.parent.mkdir()
    run(whole)
    path = tmp_path / "a.tif"
    if before == "old":
        path.write_text("old")
    assert scripted(KILLED, tmp_path_factory.mktemp("said"), path, Path(__file__).parent, moment, before)[0] == -9
    assert path.read_text() == "old" if before == "old" else not path.exists()
    with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k", tile=128, overwrite=True) as file:
        assert len(file.finished) == (30 if moment == "append" else 80)
    run(path, overwrite=True)
    assert path.read_bytes() == whole.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tif", "whole"]


LIMITED = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
import test_product_faults as here
from photoplan.errors import ResourceError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
try:
    here.run(Path(sys.argv[1]), compress=sys.argv[4], overviews=sys.argv[5] == "1")
except ResourceError as error:
    print(error.exit_code, error)
"""

# A product needs a log of 80 records of 48 KiB (3.9 MB), the same as plain TIFF, and a third more with overviews.
_LOG = 80 * (128 * 128 * 3 + 48) + 44


@pytest.mark.skipif(os.name != "posix", reason="needs resource limits")
@pytest.mark.parametrize(
    ("limit", "compress", "overviews"),
    [(2_000_000, "none", "0"), (_LOG + 100, "deflate", "1"), (_LOG + 240_000, "none", "1")],
    ids=["log", "copy", "overviews"],
)
def test_fault_04_no_more_room(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, limit: int, compress: str, overviews: str
) -> None:
    path = tmp_path / "a.tif"
    words = path, Path(__file__).parent, limit, compress, overviews
    code, out = scripted(LIMITED, tmp_path_factory.mktemp("said"), *words)
    assert code == 0 and out.startswith(f"5 {tmp_path}")
    assert "finished tiles are kept" in out
    assert [p.name for p in tmp_path.iterdir()] == [".a.tif.tiles"]
    with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k", tile=128) as file:
        assert len(file.finished) == (40 if limit == 2_000_000 else 80)
    run(path)


@pytest.fixture
def small_disk(tmp_path: Path) -> object:
    """A file system of 16 MB; needs the right to mount."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "none", str(folder)]
    try:
        made = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    except OSError:
        made = False
    if not made:
        pytest.skip("needs the right to mount a small file system")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("free", some([2000, 4800, 8800, 10400, 15800], 0, 2, 4))
@pytest.mark.parametrize("compress", some(["none", "deflate", "jpeg"], 0, 2))
def test_fault_04_a_real_disk_runs_full(small_disk: Path, free: int, compress: str) -> None:
    """With less room than the product needs there is either the whole product or none, and never a part of it."""
    with (small_disk / "ballast").open("wb") as ballast:
        ballast.write(b"x" * ((16384 - free) * 1024))
    path = small_disk / "a.tif"
    try:
        run(path, compress=compress)
    except ResourceError as error:
        assert error.exit_code == 5
        names = {p.name for p in small_disk.iterdir()}
        assert names == {"ballast", ".a.tif.tiles"}
        (small_disk / "ballast").unlink()
        with ProductFile(path, PLACE, 3, np.dtype("uint8"), run_key="k", tile=128, compress=compress) as file:
            assert file.finished
        run(path, compress=compress)
    else:
        assert free > 8000, "a log and a product cannot fit"
    with rasterio.open(path) as file:
        if compress != "jpeg":
            np.testing.assert_array_equal(file.read()[:, :128, :128], tile_of(0, 128, 128))
        assert file.overviews(1)


def test_fault_04_what_was_written_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that loses blocks without a word is found out."""

    def lossy(source: Path, target: Path, *rest: object) -> None:
        with rasterio.open(source) as file:
            pixels, profile = file.read(), file.profile
        pixels[:, 140, 140] ^= 1
        with rasterio.open(target, "w", **profile) as file:
            file.write(pixels)
            file.build_overviews([2, 4, 8])

    monkeypatch.setattr(product_module, "write_cog", lossy)
    # Every tile is a sample here.
    monkeypatch.setattr(product_module, "_SAMPLES", 80)
    with pytest.raises(ResourceError, match="is not what was computed"):
        run(tmp_path / "a.tif")
    assert [p.name for p in tmp_path.iterdir()] == [".a.tif.tiles"]


def test_fault_04_a_product_without_its_overviews_is_found_out(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    run(path, compress="none", overviews=False)
    with rasterio.open(path) as file:
        profile = file.profile
    check_product(path, profile, [], lambda w: None, lossy=False, overviews=False)  # type: ignore[arg-type, return-value]
    with pytest.raises(Exception, match="overviews are missing"):
        check_product(path, profile, [], lambda w: None, lossy=False, overviews=True)  # type: ignore[arg-type, return-value]


class TestFault29Places:
    """A folder that cannot be written ends in an error with its path."""

    def test_fault_29_a_file_in_place_of_a_folder(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(UsageError, match=r"file/\.a\.tif\.lock: cannot be made"):
            run(tmp_path / "file" / "a.tif")

    def test_fault_29_a_folder_that_is_not_there(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"absent: no such folder; make it first"):
            run(tmp_path / "absent" / "a.tif")

    def test_fault_29_read_only_folder(self, tmp_path: Path) -> None:
        folder = tmp_path / "frozen"
        folder.mkdir()
        folder.chmod(0o555)
        frozen = ["chattr", "+i", str(folder)]
        if os.access(folder, os.W_OK):
            # The superuser writes where nobody may; only a file system's own flag stops it.
            try:
                made = subprocess.run(frozen, capture_output=True, check=False).returncode == 0
            except OSError:
                made = False
            if not made:
                folder.chmod(0o755)
                pytest.skip("the superuser can write everywhere here")
        try:
            with pytest.raises(UsageError, match=r"frozen/\.a\.tif\.lock: cannot be made .*choose a folder"):
                run(folder / "a.tif")
        finally:
            subprocess.run(["chattr", "-i", str(folder)], capture_output=True, check=False)
            folder.chmod(0o755)

    def test_fault_29_a_very_long_name(self, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match=r"cannot be made \(File name too long"):
            run(tmp_path / ("a" * 250 + ".tif"))
