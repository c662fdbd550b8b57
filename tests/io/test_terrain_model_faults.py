"""Files of terrain models under bad conditions: death, full disk, links, damage, files made to do harm."""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.forked import scripted
from tools.small_model import LAYOUT, grid_unit, same_unit, unit_at, write_small

from photoplan.errors import InputError, ResourceError, RunLocked, UsageError
from photoplan.io.terrain import model_write as terrain_model_write
from photoplan.io.terrain.model import _UNIT, HEADER, LINES, MOST_BYTES, UNITS, ModelReader, unit_checksum
from photoplan.io.terrain.model_write import ModelWriter

PLACES = [(c, r) for r in range(LAYOUT.rows) for c in range(LAYOUT.columns)]

KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from tools import small_model
from photoplan.io import store as naming
from photoplan.io.terrain import model_write as module

moment = sys.argv[3]
def die(*args, **kwargs):
    os.kill(os.getpid(), signal.SIGKILL)
def after(function):
    def both(*args, **kwargs):
        function(*args, **kwargs)
        die()
    return both
if moment == "add":
    count = iter(range(1000))
    pack = module.pack_unit
    module.pack_unit = lambda unit: die() if next(count) == 5 else pack(unit)
elif moment == "layers":
    module.write_lines = after(module.write_lines)
elif moment == "raster":
    module.write_heights = after(module.write_heights)
elif moment == "tables":
    module.ModelWriter._check = die
else:
    naming.sync_file = die
small_model.write_small(Path(sys.argv[1]), overwrite=sys.argv[4] == "old")
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize(
    ("moment", "before"),
    [("add", "absent"), ("layers", "old"), ("raster", "absent"), ("tables", "old"), ("sync", "absent")],
)
def test_fault_03_killed_while_writing(tmp_path: Path, moment: str, before: str) -> None:
    """The name stays absent or old; the next run continues, and its model is that of an undisturbed one."""
    whole = write_small(tmp_path / "whole.gpkg")
    assert whole is not None
    folder = tmp_path / "there"
    folder.mkdir()
    path = folder / "m.gpkg"
    if before == "old":
        path.write_text("old")
    words = path, Path(__file__).parents[1], moment, before
    assert scripted(KILLED, tmp_path / "said", *words)[0] == -signal.SIGKILL
    assert path.read_text() == "old" if before == "old" else not path.exists()
    with ModelWriter(path, LAYOUT, "k", overwrite=True) as writer:
        assert len(writer.done()) == (5 if moment == "add" else len(PLACES))
        for column, row in writer.done():
            assert same_unit(writer.unit(column, row), unit_at(column, row))
    again = write_small(path, overwrite=True)
    assert again is not None and again.header.identity == whole.header.identity
    assert [f.name for f in folder.iterdir()] == ["m.gpkg"]


def test_fault_03_another_key_starts_afresh(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    write_small(path, stop_after=5)
    with ModelWriter(path, LAYOUT, "k") as writer:
        assert len(writer.done()) == 5
    with ModelWriter(path, LAYOUT, "another") as writer:
        assert writer.done() == frozenset()


FULL = """
import resource, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from tools import small_model
from photoplan.io.terrain.model import ModelReader
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), int(sys.argv[3])))
from photoplan.errors import PhotoplanError
try:
    small_model.write_small(Path(sys.argv[1]))
except PhotoplanError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@pytest.mark.skipif(os.name != "posix", reason="needs RLIMIT_FSIZE")
@pytest.mark.parametrize("allowed", [3_000, 30_000, 110_000, 190_000])
def test_fault_04_disk_full(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, allowed: int) -> None:
    """While units are added, and at each step of the assembly: exit 5, and nothing half-written stays."""
    path = tmp_path / "m.gpkg"
    words = path, Path(__file__).parents[1], allowed
    code, out = scripted(FULL, tmp_path_factory.mktemp("said"), *words)
    assert code == ResourceError.exit_code, out
    assert "m.gpkg" in out and "run the same command again" in out
    assert [f.name for f in tmp_path.iterdir()] == [".m.gpkg.units"]
    assert write_small(path) is not None
    assert [f.name for f in tmp_path.iterdir()] == ["m.gpkg"]


class TestFault13Output:
    def test_fault_13_existing(self, tmp_path: Path) -> None:
        path = tmp_path / "m.gpkg"
        path.write_text("precious")
        with pytest.raises(UsageError, match=r"m\.gpkg: exists already"):
            write_small(path)
        assert path.read_text() == "precious" and list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("kind", ["same", "symlink", "hardlink"])
    def test_fault_13_an_input_also_by_a_link(self, tmp_path: Path, kind: str) -> None:
        source = path = tmp_path / "in.gpkg"
        source.write_text("precious")
        if kind != "same":
            path = tmp_path / "out.gpkg"
            path.symlink_to(source) if kind == "symlink" else path.hardlink_to(source)
        with pytest.raises(UsageError, match="the output is the input"):
            write_small(path, overwrite=True, inputs=[source])
        assert source.read_text() == "precious"

    def test_fault_13_a_file_that_appears_meanwhile(self, tmp_path: Path) -> None:
        path = tmp_path / "m.gpkg"
        check = terrain_model_write.ModelWriter._check

        def meanwhile(*arguments: Any) -> None:
            check(*arguments)
            path.write_text("precious")

        with pytest.MonkeyPatch.context() as patch, pytest.raises(UsageError, match="exists already"):
            patch.setattr(terrain_model_write.ModelWriter, "_check", meanwhile)
            write_small(path)
        assert path.read_text() == "precious"


def test_fault_26_two_runs_on_one_output(tmp_path: Path) -> None:
    path = tmp_path / "m.gpkg"
    with ModelWriter(path, LAYOUT, "k") as first:
        with pytest.raises(RunLocked, match="another run"):
            write_small(path)
        assert first.done() == frozenset()
    assert write_small(path) is not None


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="needs a user that folders can be closed to")
def test_fault_29_read_only_folder(tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    with pytest.raises(UsageError, match="closed"):
        write_small(closed / "m.gpkg")


def test_fault_29_no_folder(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"absent.*no such folder; make it first"):
        write_small(tmp_path / "absent" / "m.gpkg")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("written") / "m.gpkg"
    write_small(path)
    return path.read_bytes()


@pytest.fixture
def model(tmp_path: Path, written: bytes) -> Path:
    path = tmp_path / "m.gpkg"
    path.write_bytes(written)
    return path


def change(path: Path, statement: str, *values: Any) -> None:
    with closing(sqlite3.connect(path)) as db, db:
        db.execute(statement, values)


def blob(path: Path, number: int = 0) -> bytes:
    with closing(sqlite3.connect(path)) as db:
        (content,) = db.execute(f"SELECT content FROM {UNITS} WHERE id = ?", (number,)).fetchone()
    return bytes(content)


@pytest.mark.parametrize("how", ["flipped", "cut", "exchanged", "number", "gone"])
def test_fault_08_a_damaged_unit_is_named(model: Path, how: str) -> None:
    content = bytearray(blob(model, 5))
    content[len(content) // 2] ^= 4
    if how == "flipped":
        change(model, f"UPDATE {UNITS} SET content = ? WHERE id = 5", bytes(content))
    elif how == "cut":
        change(model, f"UPDATE {UNITS} SET content = ? WHERE id = 5", blob(model, 5)[:-10])
    elif how == "exchanged":
        change(model, f"UPDATE {UNITS} SET (content, size, checksum) = "
               f"(SELECT content, size, checksum FROM {UNITS} WHERE id = 6) WHERE id = 5")  # fmt: skip
    elif how == "number":
        change(model, f"UPDATE {UNITS} SET low = low - 1 WHERE id = 5")
    else:
        change(model, f"UPDATE {UNITS} SET content = 'text' WHERE id = 5")
    reader = ModelReader(model)
    with pytest.raises(InputError, match=r"m\.gpkg: unit column 1 row 1: damaged") as error:
        reader.unit(1, 1)
    assert error.value.exit_code == 3
    assert same_unit(reader.unit(2, 1), unit_at(2, 1)), "the others are still read"


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_fault_08_a_file_cut_off(model: Path, share: float) -> None:
    """Every unit is whole or refused, whatever is missing."""
    whole = model.read_bytes()
    model.write_bytes(whole[: int(len(whole) * share)])
    try:
        reader = ModelReader(model)
    except InputError as error:
        assert "m.gpkg" in str(error)
        return
    for column, row in PLACES:
        try:
            assert same_unit(reader.unit(column, row), unit_at(column, row))
        except InputError as error:
            assert "m.gpkg" in str(error)


def test_fault_08_flipped_bytes_anywhere(model: Path) -> None:
    """Forty files with some random bytes changed: each unit is right or refused, never wrong."""
    whole = model.read_bytes()
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(40):
        spoilt = bytearray(whole)
        for at in rng.integers(100, len(whole), 40):
            spoilt[at] ^= int(rng.integers(1, 256))
        model.write_bytes(spoilt)
        try:
            reader = ModelReader(model)
            for column, row in PLACES:
                assert same_unit(reader.unit(column, row), unit_at(column, row))
        except InputError:
            refused += 1
    assert refused > 10


def replaced(path: Path, raw: bytes, size: int | None = None) -> ModelReader:
    """Put other bytes into the place of unit 0, with a checksum that is right."""
    packed = zlib.compress(raw)
    size = len(raw) if size is None else size
    checksum = unit_checksum(0, size, 100.0, 200.0, packed)
    row = size, checksum, packed
    change(
        path, f"UPDATE {UNITS} SET low = 100.0, high = 200.0, size = ?, checksum = ?, content = ? WHERE id = 0", *row
    )
    return ModelReader(path)


def head(meshes: int, vertices: int = 0, triangles: int = 0, faces: int = 0, datum: float = 0.0) -> bytes:
    return _UNIT.pack(b"PPU1", meshes, vertices, triangles, faces, datum)


def test_fault_07_a_stream_that_would_expand(model: Path) -> None:
    """One gigabyte of zeros behind a small head, and a head that promises as much: refused without the memory."""
    small = 2 * 4 * 2**2
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bomb = head(1) + bytes(small) + bytes(200_000_000)
    with pytest.raises(InputError, match="unit column 0 row 0: does not hold the 64 bytes that it promises"):
        replaced(model, bomb, 32 + small).unit(0, 0)
    del bomb
    with pytest.raises(InputError, match="unit column 0 row 0: promises"):
        replaced(model, head(4096, 2**31), 32 + small).unit(0, 0)
    with pytest.raises(InputError, match="damaged"):
        replaced(model, head(1) + bytes(small), MOST_BYTES + 1).unit(0, 0)
    stream = zlib.decompressobj()
    assert len(stream.decompress(zlib.compress(bytes(10**6)), 100)) == 100
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 400_000, "kilobytes: the bomb itself"


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"", "unit column 0 row 0: damaged"),
        (b"XXXX" + bytes(60), "not stored as this version reads it"),
        (head(0), "0 meshes along a side; 1 to 4096"),
        (head(5000), "5000 meshes along a side; 1 to 4096"),
        (head(1, datum=np.nan) + bytes(32), "infinite height"),
        (head(1) + 2 * np.full(4, np.inf, "<f4").view("<u1").reshape(-1, 4).T.tobytes(), "infinite height"),
    ],
)
def test_hostile_heads(model: Path, raw: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replaced(model, raw).unit(0, 0)


def spoilt_faces(name: str, value: Any) -> bytes:
    """The unit with the wall, with one array of its triangles spoilt, as bytes before compression."""
    from tools.small_model import LINED

    from photoplan.io.terrain.model import pack_unit

    unit = unit_at(*LINED)
    assert unit is not None and unit.faces is not None
    array = getattr(unit.faces, name)
    array.reshape(-1)[3] = value
    return zlib.decompress(pack_unit(unit)[0])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("corners", 10**6, "names a vertex that does not exist"),
        ("corners", -1, "names a vertex that does not exist"),
        ("start", 10**9, "not in the order of the meshes"),
        ("start", -5, "not in the order of the meshes"),
        ("vertices", np.nan, "a vertex outside of the unit, or not finite"),
        ("vertices", np.inf, "a vertex outside of the unit, or not finite"),
        ("vertices", 1e9, "a vertex outside of the unit, or not finite"),
    ],
)
def test_hostile_triangles(model: Path, name: str, value: Any, message: str) -> None:
    """Kernels follow these numbers without looking."""
    raw = spoilt_faces(name, value)
    packed = zlib.compress(raw)
    checksum = unit_checksum(5, len(raw), 100.0, 200.0, packed)
    row = len(raw), checksum, packed
    change(
        model, f"UPDATE {UNITS} SET low = 100.0, high = 200.0, size = ?, checksum = ?, content = ? WHERE id = 5", *row
    )
    with pytest.raises(InputError, match=f"unit column 1 row 1: .*{message}"):
        ModelReader(model).unit(1, 1)


def header_change(old: str, new: str) -> Callable[[Path], None]:
    return lambda path: change(path, f"UPDATE {HEADER} SET content = replace(content, ?, ?)", old, new)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        (header_change('"columns": 4', '"columns": 2000000000'), "at most 4000000 are allowed"),
        (header_change('"side": 40.0', '"side": NaN'), "finite numbers are needed"),
        (header_change('"side": 40.0', '"side": -1'), "finite numbers are needed"),
        (header_change('"layout"', '"outlay"'), "header of the terrain model is damaged"),
        (header_change("{", "[" * 5000), "header of the terrain model is damaged"),
        (header_change('"EPSG:32633"', "7"), "no CRS, or no text"),
        (lambda p: change(p, f"UPDATE {HEADER} SET format = 99"), "its layout is number 99, this version reads 1"),
        (lambda p: change(p, f"DELETE FROM {HEADER}"), "its layout is number None"),
        (lambda p: change(p, f"DROP TABLE {LINES}"), "the table photoplan_terrain_lines is missing"),
        (lambda p: change(p, f"UPDATE {UNITS} SET low = 'x' WHERE id = 3"), "unit 3: heights x to"),
        (lambda p: change(p, f"UPDATE {UNITS} SET high = 9e99 WHERE id = 3"), r"unit 3: heights .* to 9e\+99"),
        (lambda p: change(p, f"UPDATE {UNITS} SET id = 12 WHERE id = 3"), "unit 12: heights"),
    ],
)
def test_hostile_headers(model: Path, how: Callable[[Path], None], message: str) -> None:
    how(model)
    with pytest.raises(InputError, match=message) as error:
        ModelReader(model)
    assert "m.gpkg" in str(error.value)


def test_a_view_in_the_place_of_a_table(model: Path) -> None:
    """A view could compute without end; only plain tables are read."""
    change(model, f"ALTER TABLE {UNITS} RENAME TO other")
    endless = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id, 0.0 AS low FROM c"
    change(model, f"CREATE VIEW {UNITS} AS {endless}")
    with pytest.raises(InputError, match="the table photoplan_terrain_units is missing"):
        ModelReader(model)


def test_damaged_lists(model: Path) -> None:
    reader = ModelReader(model)
    assert reader.lines()
    change(model, f"UPDATE {LINES} SET checksum = checksum + 1 WHERE id = 2")
    with pytest.raises(InputError, match="line 2 'ridge': damaged"):
        ModelReader(model).lines()
    with closing(sqlite3.connect(model)) as db:
        for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            db.execute(f"DROP TRIGGER {name}")
    change(model, "UPDATE units SET sigma = 'much' WHERE fid = 1")
    with pytest.raises(InputError, match=r"units\.sigma: 'much' is no number"):
        ModelReader(model).figures()
    change(model, f"UPDATE {HEADER} SET domain = x'0102'")
    with pytest.raises(InputError, match="the border is damaged"):
        ModelReader(model).domain()


def test_a_folder_that_cannot_be_written_can_be_read(model: Path) -> None:
    """Reading makes no file beside the model."""
    before = sorted(model.parent.iterdir())
    mtime = model.stat().st_mtime_ns
    assert ModelReader(model).unit(0, 0) is not None
    assert sorted(model.parent.iterdir()) == before and model.stat().st_mtime_ns == mtime


def test_identity_knows_each_height(tmp_path: Path) -> None:
    from tools.small_model import write_units_of

    a = write_units_of(tmp_path / "a.gpkg", LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 4))
    b = write_units_of(tmp_path / "b.gpkg", LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 4))
    other = write_units_of(tmp_path / "c.gpkg", LAYOUT, lambda c, r: grid_unit(LAYOUT, c, r, 4, datum=150.0 + c))
    assert a.header.identity == b.header.identity != other.header.identity
