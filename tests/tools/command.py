"""The command line as users have it: a process with an exit code and two streams."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import click
import pytest

from photoplan.cli.main import run
from photoplan.cli.table import GROUPS, VERBS
from photoplan.cli.telling import Telling
from photoplan.cli.verb import Verb

COMMAND = (sys.executable, "-m", "photoplan")
OPTIONS = ("--resolution", "1", "--tile", "128")
"""Of `photoplan ortho` for the small block: twenty tiles."""
SABOTEUR = Path(__file__).parent / "saboteur"


TEXTS = (".html", ".csv", ".json", ".svg", ".txt")


def unfinished_numbers(text: str) -> list[str]:
    """NaN and infinity as words of a text, but where it quotes what was given."""
    return re.findall(r"(?<![\w'\"./-])[-+±]?(?:nan|inf(?:inity)?)\b(?!['\"/-]|\.\w)", text, re.IGNORECASE)


def unfinished_in_files(folders: set[Path], since: float) -> dict[str, list[str]]:
    """The same in reports, tables and records written since a moment; pictures within reports are left out."""
    found = {}
    for path in (path for folder in folders if folder.is_dir() for path in folder.rglob("*")):
        if path.suffix in TEXTS and path.is_file() and path.stat().st_mtime >= since:
            found[str(path)] = unfinished_numbers(re.sub(r"base64,[^\"')]*", "", path.read_text(errors="replace")))
    return {path: words for path, words in found.items() if words}


def _no_number(word: str) -> None:
    raise AssertionError(f"JSON holds {word}")


@dataclass(frozen=True)
class Said:
    """What a command left behind."""

    code: int
    out: str
    err: str

    def __post_init__(self) -> None:
        assert "Traceback" not in self.err, self.err
        assert "a fault of photoplan" not in self.err, self.err
        if self.out.startswith("{"):
            json.loads(self.out, parse_constant=_no_number)


@dataclass(frozen=True)
class Undisturbed:
    """One quiet run of a whole block."""

    folder: Path
    said: Said

    def bytes_of(self, name: str) -> bytes:
        return (self.folder / f"{name}_ortho.tif").read_bytes()


def sabotage(**how: object) -> dict[str, str]:
    """Environment in which tiles behave badly, see `tools/saboteur/sitecustomize.py`."""
    path = os.pathsep.join(filter(None, [str(SABOTEUR), os.environ.get("PYTHONPATH", "")]))
    return {"PYTHONPATH": path, **{f"SABOTAGE_{key.upper()}": str(value) for key, value in how.items()}}


def process(*words: object, env: Mapping[str, str] | None = None, before: Sequence[str] = ()) -> Said:
    """Run the command to its end as a process of its own, `before` in front of it."""
    done = subprocess.run(
        [*before, *COMMAND, *map(str, words)],
        capture_output=True,
        text=True,
        timeout=1800,
        env={**os.environ, **(env or {})},
        check=False,
    )
    return Said(done.returncode, done.stdout, done.stderr)


@contextmanager
def counters() -> Iterator[list[tuple[str, int, int]]]:
    """Inside, keep the phases of commands: name, units that were promised, units that were done."""
    phases: list[tuple[str, int, int]] = []
    begin, more, done = Telling.begin, Telling.more, Telling.done

    def add(promised: int, finished: int) -> None:
        if phases:
            name, total, counted = phases[-1]
            phases[-1] = name, total + promised, counted + finished

    def beginning(self: Telling, phase: str, units: int = 0, unit: str = "tiles") -> None:
        phases.append((phase, units, 0))
        begin(self, phase, units, unit)

    def adding(self: Telling, units: int) -> None:
        add(units, 0)
        more(self, units)

    def finishing(self: Telling, units: int = 1, *rest: Any, **named: Any) -> None:
        add(0, units)
        done(self, units, *rest, **named)

    with pytest.MonkeyPatch.context() as patch:
        for name, method in (("begin", beginning), ("more", adding), ("done", finishing)):
            patch.setattr(Telling, name, method)
        yield phases


def unended(phases: Sequence[tuple[str, int, int]]) -> list[tuple[str, int, int]]:
    """Return the phases with a total at which their counter did not end.

    Planning again, without images that could not be read, begins anew: phases before it do not count.
    """
    last = max((at for at, phase in enumerate(phases) if phase[0] == "planning"), default=0)
    return [phase for phase in phases[last:] if phase[1] and phase[1] != phase[2]]


def inside(*words: object) -> Said:
    """Run the command to its end in the test's process, which costs no start; also in fixtures of whole modules."""
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as err, warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        with counters() as phases:
            code = run([str(word) for word in words])
    assert code not in (0, 4) or not unended(phases), phases
    return Said(code, out.getvalue(), err.getvalue())


#: A small process between: a child's peak memory begins with what its parent held when it was started.
_MEASURE = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, file=sys.stderr)
sys.exit(code)
"""


def peak_of(*words: object) -> tuple[Said, int]:
    """Run the command to its end; what it said, and its peak resident memory in bytes (Linux counts in KiB)."""
    said = process(*words, before=[sys.executable, "-S", "-c", _MEASURE])
    *lines, peak = said.err.strip().split("\n")
    return Said(said.code, said.out, "\n".join(lines)), int(peak) * 1024


def start(*words: object, env: Mapping[str, str] | None = None, before: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Start the command and come back at once; it leads a process group of its own, as in a terminal."""
    return subprocess.Popen(
        [*before, *COMMAND, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **(env or {})},
        start_new_session=True,
        preexec_fn=_listen if os.name == "posix" else None,
    )


def _listen() -> None:
    """A shell lets what it runs in the background ignore Ctrl-C, tests too; their commands are to hear it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def wait_for(condition: Callable[[], object], running: subprocess.Popen[str], seconds: float = 900) -> None:
    """Wait until something holds while a command runs."""
    end = time.monotonic() + seconds
    while not condition():
        assert running.poll() is None, running.communicate()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def patience(seconds: float) -> float:
    """A time as it is asked for; longer only where far more runs than the suite itself, two for each core."""
    return seconds * max(1.0, os.getloadavg()[0] / (2 * (os.cpu_count() or 1)))


@dataclass(frozen=True)
class Here:
    """The command inside the test's process: the same without start-up; for whatever needs no process."""

    capture: pytest.CaptureFixture[str]

    def __call__(self, *words: object) -> Said:
        self.capture.readouterr()
        since = time.time() - 0.01
        with warnings.catch_warnings():
            # The command hides what NumPy says; an ordinary run leaves nothing to hide, and no more does a refusal.
            warnings.simplefilter("error", RuntimeWarning)
            with counters() as phases:
                code = run([str(word) for word in words])
        said = Said(code, *self.capture.readouterr())
        assert code not in (0, 4) or not unended(phases), phases
        assert unknown_options([str(word) for word in words], said.err) == [], said.err
        # A refusal may say what was given, and the help what nodata is.
        assert code != 0 or "--help" in words or not unfinished_numbers(said.out + "\n" + said.err), said.out + said.err
        places = {Path(str(word)) for word in words if str(word).startswith(tempfile.gettempdir())}
        unfinished = unfinished_in_files({p if p.is_dir() else p.parent for p in places}, since) if code == 0 else {}
        assert not unfinished, unfinished
        return said


def verbs() -> dict[str, click.Command]:
    """Every verb by its words, as in ``"dtm build"``."""
    found = {name: row.command(name) for name, row in VERBS.items() if isinstance(row, Verb)}
    for name, group in (("dtm", GROUPS["terrain"]), ("view", GROUPS["view"])):
        found |= {f"{name} {word}": row.command(word) for word, row in group.verbs.items()}
    return {**found, "ortho": GROUPS["ortho"].verbs["images"].command("ortho")}


def options_of(command: click.Command) -> set[str]:
    """How the options of a verb are spelled."""
    return {o for p in command.params if isinstance(p, click.Option) for o in (*p.opts, *p.secondary_opts)} | {"--help"}


def unknown_options(words: Sequence[str], message: str) -> list[str]:
    """Options in a message that neither the verb that ran has nor one that the message names with them."""
    if message.startswith("Usage:") or " --version" in message:  # click names what it does not know
        return []
    known = verbs()
    own = next((known[w] for w in (" ".join(words[:2]), *words[:1]) if w in known), None)
    allowed = options_of(own) if own else set()
    for name, command in known.items():
        if re.search(rf"photoplan {name}\b", message):
            allowed |= options_of(command)
    parameters = {o[2:].replace("-", "_") for command in known.values() for o in options_of(command)}
    left = [word for word in re.findall(r"`([a-z_]+)`", message) if word in parameters]
    foreign = re.sub(r"(pyproj sync|colmap model_converter) --\w+", "", message)
    return left + [o for o in re.findall(r"(?<![\w-])--[a-z][a-z-]*", foreign) if o not in allowed]


def edit(path: Path, old: str, new: str) -> None:
    """Replace what stands in a text file once."""
    text = path.read_text()
    assert text.count(old) == 1, (old, text.count(old))
    path.write_text(text.replace(old, new))


def refused(photoplan: Here, project: Path, *words: object, image: str | None = None) -> str:
    """Return what `check` and `ortho` print when they refuse a project, or an image alone; neither leaves a product."""
    alone = () if image is None else ("--images", image)
    said = photoplan("check", project, *alone)
    assert said.code == 3, said
    said = photoplan("ortho", project, *OPTIONS, *words, *alone)
    assert said.code == 3, said
    assert said.out == ""
    assert not list(project.parent.glob("products/*.tif"))
    return said.err
