"""Mutations of valid files, and a runner that reads thousands of them and counts what goes wrong.

Every case runs in a child process: a traceback (an exception that is no `PhotoplanError`), a hang (too much time of
the processor), too much memory and a process that dies are told apart and counted.
"""

from __future__ import annotations

import json
import math
import os
import random
import re
import resource
import shutil
import sqlite3
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from photoplan.errors import PhotoplanError

#: Processor seconds that one case may take, and bytes that a process may add.
SECONDS, MEMORY = 20, 3 << 30
#: Values that files may hold instead of what belongs there.
ODD = (None, True, "", "x", "=1+1", [], {}, [[]], {"a": 1}, 0, -1, 1e308, -1e-300, 2**63, 10**40, 0.5, "1", [1, "a"])
WORDS = (
    "",
    "nan",
    "inf",
    "-1e999",
    "1" * 5000,
    "0x10",
    "1,5",
    "null",
    "-",
    '"',
    "é\u202e",
    "=cmd|' /C calc'!A0",
    "1e308",
    "0",
)


def _bits(raw: bytes, rng: random.Random) -> bytes:
    out = bytearray(raw)
    for _ in range(rng.choice((1, 3, 30))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _cut(raw: bytes, rng: random.Random) -> bytes:
    return raw[: rng.randrange(len(raw) + 1)]


def _removed(raw: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(raw) + 1)
    return raw[:a] + raw[a + rng.choice((1, 8, 100)) :]


def _repeated(raw: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(raw) + 1)
    return raw[:a] + raw[a : a + rng.choice((1, 20, 400))] * rng.choice((2, 50)) + raw[a:]


def _blanked(raw: bytes, rng: random.Random) -> bytes:
    a, n = rng.randrange(len(raw) + 1), rng.choice((1, 4, 8, 64))
    return raw[:a] + rng.choice((b"\0", b"\xff", b"\x7f")) * n + raw[a + n :]


def _words(raw: bytes, rng: random.Random) -> bytes:
    """A number or a word is another one."""
    text = raw.decode("utf-8", errors="surrogateescape")
    found = list(re.finditer(rng.choice((r"-?\d+(?:\.\d+)?", r"[A-Za-z_]+", r"[^\s,;=:\"'<>\[\]{}]+")), text))
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 4)))), key=lambda m: -m.start()):
        text = text[: match.start()] + rng.choice(WORDS) + text[match.end() :]
    return text.encode("utf-8", errors="surrogateescape")


def _lines(raw: bytes, rng: random.Random) -> bytes:
    """Lines are dropped, given twice or exchanged."""
    lines = raw.split(b"\n")
    for _ in range(rng.choice((1, 3))):
        a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
        kind = rng.randrange(3)
        if kind == 0 and len(lines) > 1:
            del lines[a]
        elif kind == 1:
            lines.insert(b, lines[a])
        else:
            lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def _nested(raw: bytes, rng: random.Random) -> bytes:
    """Brackets or elements in thousands of levels."""
    a = rng.randrange(len(raw) + 1)
    opened, closed = rng.choice(((b"[", b"]"), (b"{", b"}"), (b"(", b")"), (b"<a>", b"</a>"), (b'{"a":', b"}")))
    n = rng.choice((100, 100_000))
    return raw[:a] + opened * n + rng.choice((b"", b"1")) + closed * rng.choice((0, n)) + raw[a:]


def _json_value(raw: bytes, rng: random.Random) -> bytes:
    """A value of a JSON document is of another type."""
    first, *more = raw.split(b"\n") if b"\n{" in raw else [raw]
    try:
        document = json.loads(first)
    except ValueError:
        return _words(raw, rng)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, inner in items:
            places.append((value, key))
            walk(inner)

    walk(document)
    for holder, key in rng.sample(places, min(len(places), rng.choice((1, 1, 3)))):
        kind = rng.randrange(8)
        if kind == 0 and isinstance(holder, dict):
            holder.pop(key, None)
        elif kind == 1 and isinstance(holder, dict) and key in holder:
            holder[f"{key}x"] = holder.pop(key)
        elif isinstance(holder, dict) or key < len(holder):
            holder[key] = rng.choice(ODD)
    return b"\n".join([json.dumps(document).encode(), *more])


def _toml_value(raw: bytes, rng: random.Random) -> bytes:
    """A value behind an equals sign or a colon is of another type."""
    text = raw.decode("utf-8", errors="surrogateescape")
    found = list(re.finditer(r"(?m)(?<=[=:])[ ]*[^\n#]+", text))
    if not found:
        return _words(raw, rng)
    match = rng.choice(found)
    values = (
        "true",
        '"x"',
        "[]",
        "{}",
        "-1",
        "1e308",
        "nan",
        "inf",
        "9" * 30,
        "[[1]]",
        "1979-05-27T07:32:00Z",
        "''",
        "null",
    )
    return (text[: match.start()] + " " + rng.choice(values) + text[match.end() :]).encode("utf-8", "surrogateescape")


GENERIC = (_bits, _cut, _removed, _repeated, _blanked, _lines)
TEXT = (_words, _words, _toml_value, _nested, *GENERIC)
JSON = (_json_value, _json_value, _json_value, *TEXT)


def mutate_database(path: Path, rng: random.Random) -> None:
    """NULL, other types, dropped tables, renamed columns and damaged pages of an SQLite file."""
    with sqlite3.connect(path) as db:
        db.execute("PRAGMA writable_schema = ON")
        tables = [row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        tables = [t for t in tables if not t.startswith(("sqlite_", "rtree_"))] or ["x"]
        own = [t for t in tables if not t.startswith("gpkg_")]
        table = rng.choice(own if own and rng.random() < 0.7 else tables)
        columns = [row[1] for row in db.execute(f'PRAGMA table_info("{table}")')] or ["x"]
        column, kind = rng.choice(columns), rng.randrange(8)
        value = rng.choice((None, "x", b"\0\1\2", -1, 2**62, 1e308, "", "[" * 5000, float("inf"), "null", "{}"))
        try:
            for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                db.execute(f'DROP TRIGGER "{name}"')
            if kind <= 3:
                where = "" if kind <= 1 else ' WHERE rowid = (SELECT rowid FROM "' + table + '" LIMIT 1)'
                db.execute(f'UPDATE OR IGNORE "{table}" SET "{column}" = ?{where}', (value,))
            elif kind == 4:
                db.execute(f'DROP TABLE "{table}"')
            elif kind == 5:
                db.execute(f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "{column}_x"')
            elif kind == 6:
                db.execute(f'DELETE FROM "{table}"')
            else:
                db.execute(f'INSERT INTO "{table}" SELECT * FROM "{table}"')
        except sqlite3.Error:
            db.execute("DELETE FROM gpkg_contents WHERE 0 = 1") if "gpkg_contents" in tables else None
    db.close()


@dataclass(frozen=True)
class Reader:
    """A reader, and how to make a valid file of its format."""

    name: str
    make: Callable[[Path], Path]
    """Writes a valid file or folder into an empty folder, and returns what the reader is given."""
    read: Callable[[Path], Any]
    kind: str = "text"
    """text, json, binary or database: which mutations fit."""
    mutated: str | None = None
    """Name of the file that is mutated; None: that which is read, or any file of the folder."""


@dataclass
class Counts:
    """What came out of the cases."""

    cases: int = 0
    accepted: int = 0
    refused: int = 0
    faults: list[str] = field(default_factory=list)
    """One line for each traceback, hang, lack of memory or dead process."""
    kinds: Counter[str] = field(default_factory=Counter)


def _mutate(reader: Reader, folder: Path, given: Path, rng: random.Random) -> None:
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    target = folder / reader.mutated if reader.mutated else given if given.is_file() else rng.choice(files)
    if reader.kind == "database" and rng.random() < 0.8:
        mutate_database(target, rng)
        return
    raw = target.read_bytes()
    kinds = {"text": TEXT, "json": JSON}.get(reader.kind, GENERIC)
    for _ in range(rng.choice((1, 1, 2))):
        raw = rng.choice(kinds)(raw, rng)
    target.write_bytes(raw[: 4 << 20])


def _case(reader: Reader, seed: Path, place: Path, number: int) -> tuple[str, str]:
    """How one case ends, and what to tell of it."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(seed, place)
    given = place / (seed / "given.txt").read_text()
    (place / "given.txt").unlink()
    rng = random.Random(f"{reader.name} {number}")
    _mutate(reader, place, given, rng)
    used = resource.getrusage(resource.RUSAGE_SELF)
    resource.setrlimit(
        resource.RLIMIT_CPU, (math.ceil(used.ru_utime + used.ru_stime) + SECONDS, resource.RLIM_INFINITY)
    )
    try:
        reader.read(given)
    except PhotoplanError:
        return "refused", ""
    except MemoryError:
        return "memory", "MemoryError"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)
        own = next((f for f in reversed(last) if "photoplan" in f.filename), last[-1])
        return "traceback", f"{type(error).__name__}: {str(error)[:100]} ({Path(own.filename).name}:{own.lineno})"
    return "accepted", ""


def run(reader: Reader, folder: Path, count: int, first: int = 0) -> Counts:
    """Read `count` mutations of a reader's valid file; the valid file itself must be accepted."""
    seed = folder / "seed"
    seed.mkdir(parents=True)
    given = reader.make(seed)
    (seed / "given.txt").write_text(str(given.relative_to(seed)))
    reader.read(given)
    counts = Counts()
    number, end = first, first + count
    while number < end:
        into, out = os.pipe()
        child = os.fork()
        if child == 0:
            _child(reader, seed, folder / "case", range(number, end), out)
        os.close(out)
        with os.fdopen(into) as told:
            for line in told:
                how, what = line.rstrip("\n").split("\t", 1)
                _count(counts, reader, number, how, what)
                number += 1
        _, state = os.waitpid(child, 0)
        if number < end and (os.WIFSIGNALED(state) or os.WEXITSTATUS(state)):
            hang = os.WIFSIGNALED(state) and os.WTERMSIG(state) == 24
            _count(counts, reader, number, "hang" if hang else "died", f"status {state}")
            number += 1
    return counts


def _count(counts: Counts, reader: Reader, number: int, how: str, what: str) -> None:
    counts.cases += 1
    counts.accepted += how == "accepted"
    counts.refused += how == "refused"
    if how not in ("accepted", "refused"):
        counts.kinds[how] += 1
        counts.faults.append(f"{reader.name} case {number}: {how} {what}")


def _child(reader: Reader, seed: Path, place: Path, numbers: range, out: int) -> None:
    """Run cases, telling each; never returns."""
    try:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        with Path("/proc/self/statm").open() as file:
            now = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, now + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in numbers:
            how, what = _case(reader, seed, place, number)
            os.write(out, f"{how}\t{' '.join(what.split())}\n".encode(errors="replace"))
        os._exit(0)
    except BaseException:
        os._exit(7)
