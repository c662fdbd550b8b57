"""A folder that came from elsewhere: links under the names of working files, and names that lead out of a folder."""

from __future__ import annotations

import csv
import os
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import photoplan
from photoplan.errors import InputError, PhotoplanError, UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.io import disk
from photoplan.io.disk import FileLock, open_own, read_own, received
from photoplan.io.files import file_in
from photoplan.io.product import ProductFile
from photoplan.io.store import ResultLog, TileLog, is_unfinished, scratch, together, write_atomically
from photoplan.io.tables import split_line, write_table
from photoplan.io.vector_layer import read_plan_tables
from photoplan.report import page

posix = pytest.mark.skipif(os.name != "posix", reason="needs links")
GRID = MapGrid(0, 100, 1, 64, 64, "EPSG:32633")


def make(folder: Path) -> None:
    with ProductFile(folder / "a.tif", GRID.placement, 1, np.dtype("uint8"), run_key="k", tile=128) as file:
        file.append(0, np.ones((1, 64, 64), np.uint8))
        file.complete()


@posix
@pytest.mark.parametrize("kind", ["link", "dangling", "hard", "pipe", "device", "folder", "foreign"])
@pytest.mark.parametrize("name", [".a.tif.tiles", ".a.tif.lock"])
def test_working_files_follow_no_link_and_change_no_foreign_file(tmp_path: Path, name: str, kind: str) -> None:
    folder, victim = tmp_path / "received", tmp_path / "victim.txt"
    folder.mkdir()
    victim.write_text("precious")
    planted = folder / name
    {
        "link": lambda: planted.symlink_to(victim),
        "dangling": lambda: planted.symlink_to(tmp_path / "new"),
        "hard": lambda: planted.hardlink_to(victim),
        "pipe": lambda: os.mkfifo(planted),
        "device": lambda: planted.symlink_to("/dev/zero"),
        "folder": planted.mkdir,
        "foreign": lambda: planted.write_text("precious"),
    }[kind]()
    with pytest.raises(UsageError, match=r"\.a\.tif\.(tiles|lock): .*(remove it|move it away)"):
        make(folder)
    assert victim.read_text() == "precious" and not (tmp_path / "new").exists()
    assert kind != "foreign" or planted.read_text() == "precious"
    assert not (folder / "a.tif").exists()


@posix
def test_links_under_every_other_name_that_was_ever_used_are_passed_over(tmp_path: Path) -> None:
    folder, victim = tmp_path / "received", tmp_path / "victim.txt"
    folder.mkdir()
    victim.write_text("precious")
    pid = os.getpid()
    ends = ["pending", "unfinished", f"{pid}.part", "part", "part.tif", "plain.tif", "plain.tif.msk", f"{pid}.trial"]
    for name in ("a.tif", "a.run.json"):
        for end in ends:
            (folder / f".{name}.{end}").symlink_to(victim)
    with together():
        make(folder)
        write_atomically(folder / "a.run.json", b"{}")
    assert victim.read_text() == "precious" and (folder / "a.tif").stat().st_size > 0


@posix
def test_notes_and_records_that_never_end_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    (tmp_path / ".a.unfinished").symlink_to("/dev/zero")
    assert not is_unfinished(tmp_path / "a")
    os.mkfifo(tmp_path / "pipe")
    for name in (".a.unfinished", "pipe", "absent"):
        with pytest.raises(OSError):
            read_own(tmp_path / name)
    with pytest.raises(OSError, match="larger than 0 bytes"):
        read_own(tmp_path / "a", most=0)


def test_a_note_that_was_prepared_removes_nothing_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    other = tmp_path / ".other.unfinished"
    other.write_text("precious")
    state = (tmp_path / "in" / "a").write_text("1") and (tmp_path / "in" / "a").stat()
    identity = f"[{state.st_ino}, {state.st_size}, {state.st_mtime_ns}]"
    (tmp_path / "in" / ".a.unfinished").write_text(f'{{"files": ["a", "../other", "{other}"], "identity": {identity}}}')
    with together():
        write_atomically(tmp_path / "in" / "a", b"2")
    assert other.read_text() == "precious" and [p.name for p in (tmp_path / "in").iterdir()] == ["a"]
    for text in (
        "[]",
        '{"files": 1, "identity": 2}',
        "null",
        '{"files": [], "identity": [1, 2, 3]}',
        "[" * 9999,
        "\xff",
    ):
        (tmp_path / "in" / ".a.unfinished").write_text(text)
        assert not is_unfinished(tmp_path / "in" / "a")


@posix
@pytest.mark.parametrize("place", ["products", "products/deep"])
def test_a_link_inside_a_received_folder_does_not_lead_out_of_it(tmp_path: Path, place: str) -> None:
    home, outside = tmp_path / "received", tmp_path / "outside"
    for folder in (home / "inside", outside / "deep"):
        folder.mkdir(parents=True)
    (home / "products").symlink_to(outside)
    (home / "own").symlink_to(home / "inside")
    received(home)
    for act in (
        lambda: make(home / place),
        lambda: write_atomically(home / place / "a.csv", b""),
        lambda: TileLog(home / place / "log", "k"),
        lambda: FileLock(home / place / "lock").acquire(),
        lambda: disk.make_folder(home / place / "new"),
        lambda: write_atomically(home / "inside" / ".." / place / "a.csv", b""),
    ):
        with pytest.raises(
            UsageError, match=r"is a link that leads out of the folder of the project; .* give .*outside"
        ):
            act()
    assert sorted(p.name for p in outside.rglob("*")) == ["deep"]
    # Links that stay inside are followed, and so are those of the user's own.
    make(home / "own")
    (tmp_path / "mine").symlink_to(outside)
    write_atomically(tmp_path / "mine" / "a.csv", b"1")
    assert (home / "inside" / "a.tif").exists() and (outside / "a.csv").exists()


class TestNames:
    @pytest.mark.parametrize("name", ["one_ortho.tif", "Bild 1.tif", "übersicht.csv", "a.b.c", "東京.tif"])
    def test_plain_names_are_accepted(self, tmp_path: Path, name: str) -> None:
        assert file_in(tmp_path, name) == tmp_path / name

    @pytest.mark.parametrize(
        "name",
        ["", ".", "..", "../a", "a/b", "/etc/passwd", "a\\b", "..\\a", "C:a", "C:\\a", "a:b", "a\0b", "a\nb", ".hidden",
         "a.", "a ", " a", "con", "CON.tif", "nul.tif.x", "COM1.tif", "lpt¹.tif", "a" * 300, "ä" * 130,
         "a*", "a?", "a|b",
         "<a>", "\u202ea", "\ud800"],
    )  # fmt: skip
    def test_everything_else_is_refused_by_name(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(InputError, match="cannot be the name of a file"):
            file_in(tmp_path, name)


class TestDeadRuns:
    HOLDER = """
import sys, time
from pathlib import Path
from photoplan.io.store import scratch
with scratch(Path(sys.argv[1])) as folder:
    (folder / "x").write_text("1")
    print(folder, flush=True)
    time.sleep(99)
"""

    @posix
    def test_what_they_leave_goes_with_the_next_run_and_what_lives_stays(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("photoplan.io.store._TIDIED", set())
        children = [
            subprocess.Popen([sys.executable, "-c", self.HOLDER, tmp_path], stdout=subprocess.PIPE, text=True)
            for _ in range(2)
        ]
        folders = [Path(child.stdout.readline().strip()) for child in children]  # type: ignore[union-attr]
        children[0].kill()
        children[0].wait()
        dead = children[0].pid
        outside = tmp_path / "outside"
        outside.mkdir()
        (outside / "lock").touch()
        mine = [f".a.{os.getpid()}.part", ".a.b.part", "a.1.part", ".a.999999999999.part.txt", ".photoplan-notes"]
        for name in mine:
            (tmp_path / name).touch()
        left = [f".a.csv.{dead}.part", f".a.{dead}.trial", f".a.{dead}.partial.gpkg", f".a.tif.{dead}.0a1b2c3d.tif"]
        for name in left:
            (tmp_path / name).touch()
        (tmp_path / f".link.{dead}.part").symlink_to(outside / "lock")
        (tmp_path / ".photoplan-1-abc.part").symlink_to(outside)
        try:
            write_atomically(tmp_path / "b", b"1")
            there = {path.name for path in tmp_path.iterdir()}
            kept = {*mine, "b", "outside", folders[1].name, f".link.{dead}.part", ".photoplan-1-abc.part"}
            assert there == kept and (outside / "lock").exists() and (folders[1] / "x").exists()
        finally:
            children[1].kill()
            for child in children:
                child.communicate()

    def test_an_error_leaves_no_working_folder(self, tmp_path: Path) -> None:
        with pytest.raises(PhotoplanError), scratch(tmp_path) as folder:
            (folder / "x").touch()
            raise PhotoplanError
        assert not list(tmp_path.iterdir())


def test_logs_are_closed_and_opened_by_their_own_process(tmp_path: Path) -> None:
    with ResultLog(tmp_path / "a", "k", tmp_path / "l") as log:
        log.append(1, {"a": (1, 2)})
    descriptor = open_own(tmp_path / "a", os.O_RDONLY)
    assert os.get_inheritable(descriptor) is False
    os.close(descriptor)


class TestTables:
    NAMES = (
        "=1+1",
        "+cmd|' /C calc'!A0",
        "-2+3",
        "@SUM(A1)",
        "\t=1",
        " =1",
        "'=1",
        "''@a",
        "-",
        '="a",b',
        "a,b",
        'ü"x',
    )

    def test_spreadsheets_compute_no_name_and_names_come_back(self, tmp_path: Path) -> None:
        rows = [(name, -1.5, "-1.25e-3", float("nan"), "+7") for name in self.NAMES]
        write_table(tmp_path / "a.csv", ["name", "x", "y", "=z", "u"], rows)
        with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
            head, *found = list(csv.reader(file))
        assert head[3] == "'=z"
        for name, row in zip(self.NAMES, found, strict=True):
            assert not re.match(r"\s*[=+\-@\t\r]", row[0]), row
            assert row[1:] == ["-1.5", "-1.25e-3", "", "+7"]
            line = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()[1 + self.NAMES.index(name)]
            assert split_line(tmp_path, (1, line), ",")[0] in (name, name.strip())

    def test_no_writer_of_tables_stands_elsewhere(self) -> None:
        top = Path(photoplan.__file__).parent
        assert not [p for p in top.rglob("*.py") if re.search(r"csv\.(writer|DictWriter)", p.read_text())]


def test_names_in_reports_are_text() -> None:
    name = "<script>alert('x')</script>\"&"
    safe = "&lt;script&gt;"
    for made in (page.table(["name", name], [[name, name]]), page.figure(b"", name, name), page.text(name)):
        assert "<script>" not in made and safe in made


def test_a_plan_whose_tables_are_queries_without_end_is_refused(tmp_path: Path) -> None:
    endless = (
        "WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM t) SELECT 2 AS format, max(x) AS content FROM t"
    )
    for name in ("photoplan_plan", "tiles"):
        path = tmp_path / f"{name}.gpkg"
        with closing(sqlite3.connect(path)) as db, db:
            for table in {"photoplan_plan", "tiles"} - {name}:
                db.execute(f"CREATE TABLE {table} (format, content)")
            db.execute(f"CREATE VIEW {name} AS {endless}")
        with pytest.raises(InputError, match="it has no tables photoplan_plan and tiles"):
            read_plan_tables(path)
    with closing(sqlite3.connect(tmp_path / "big.gpkg")) as db, db:
        db.execute("CREATE TABLE tiles (x)")
        db.execute("CREATE TABLE photoplan_plan (format, content)")
        db.execute("INSERT INTO photoplan_plan VALUES (2, zeroblob(900000000))")
    with pytest.raises(InputError, match="not a plan of photoplan"):
        read_plan_tables(tmp_path / "big.gpkg")
