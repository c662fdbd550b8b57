"""Messages name the options of the verb that runs, and the library names no option at all."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tools.command import inside, options_of, unfinished_in_files, unknown_options, verbs
from tools.small_block import write_block
from tools.thinned import examples

import photoplan
from photoplan.cli.main import photoplan as command
from photoplan.cli.options import listed
from photoplan.cli.output import spelled

SOURCE = Path(photoplan.__file__).parent
#: Options of other programs, and the names of colours in style sheets.
FOREIGN = re.compile(r"pyproj sync --file|colmap model_converter --output_type|(var\(|:root .*)--[a-z]+")
VERBS = verbs()
WORDS = sorted(
    {o.removeprefix("--").removeprefix("no-").replace("-", "_") for c in VERBS.values() for o in options_of(c)}
)


def test_no_word_of_numpy_reaches_a_user() -> None:
    """An overflow of absurd numbers, in a process of its own."""
    code = (
        "from photoplan.cli.main import start; start(); import numpy as np; from photoplan.io.orientation import text\n"
        "np.linalg.norm(np.full(3, 1e300)); np.nanmean([np.nan]); np.nanmax([np.nan])\n"
        "text.checked_rotation(np.full(9, 1e300), 'a.txt:1')"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "not a rotation matrix" in ran.stderr and "Warning" not in ran.stderr


def test_numbers_that_are_none_are_seen_in_files(tmp_path: Path) -> None:
    """What every command test asks of the reports and tables that were written."""
    for name, text, words in (
        ("a.csv", "x,y\n1,nan\n", ["nan"]),
        ("b.html", '<td>±inf</td><img src="data:image/png;base64,aa+nan/+inf==">', ["±inf"]),
        ("c.json", '{"name": "nan.tif", "note": "an information"}', []),
        ("d.tif", "nan", []),
    ):
        (tmp_path / name).write_text(text)
        assert unfinished_in_files({tmp_path}, 0.0).get(str(tmp_path / name), []) == words, name


def test_an_empty_name_is_no_path_in_any_command() -> None:
    """As `-o "$FORGOTTEN"` gives it."""
    paths = [p for verb in VERBS.values() for p in verb.params if isinstance(p.type, click.Path)]
    assert len(paths) > 50
    for parameter in paths:
        with pytest.raises(click.BadParameter, match="the name is empty"):
            parameter.type.convert(" ", parameter, None)


def test_no_folder_is_made_that_is_named_as_a_file(tmp_path: Path) -> None:
    """`mosaic --output m.tif` made a folder of this name."""
    folders = {name: [p for p in verb.params if getattr(p.type, "new_folder", False)] for name, verb in VERBS.items()}
    for name in ("ortho", "mosaic", "object", "run", "surface", "restore", "balance", "adjust", "view sequence"):
        assert any("--output" in p.opts for p in folders[name]), name
    (tmp_path / "old.tif").mkdir()
    for parameter in (p for mine in folders.values() for p in mine):
        with pytest.raises(click.BadParameter, match=r"'m\.TIF' is named as a file; give a folder"):
            parameter.type.convert("m.TIF", parameter, None)
        for fine in (tmp_path / "old.tif", tmp_path / "flight 1.2"):
            assert parameter.type.convert(str(fine), parameter, None) == fine


def test_the_library_names_no_option() -> None:
    """Strings, docstrings among them, outside the command line."""
    option = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
    found = []
    for path in sorted(SOURCE.rglob("*.py")):
        source = path.read_text()
        if path.relative_to(SOURCE).parts[0] == "cli" or not option.search(source):
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found += [f"{path}:{node.lineno}: {o}" for o in option.findall(FOREIGN.sub("", node.value))]
    assert found == []


def misnamed(text: str, known: set[str]) -> list[str]:
    """Options in a text that are not known."""
    return [o for o in re.findall(r"(?<![\w-])--[a-z][a-z-]*", FOREIGN.sub("", text)) if o not in known]


def test_strings_of_the_command_line_name_options_of_their_verbs() -> None:
    """Help, errors and talk of a verb's own file; what verbs share may name the options of any."""
    every = {o for verb in VERBS.values() for o in options_of(verb)}
    assert misnamed("either --images or --no-such-option", every) == ["--no-such-option"]
    wrong = []
    for path in sorted((SOURCE / "cli").glob("*.py")):
        module = f"photoplan.cli.{path.stem}"
        own = {
            o for verb in VERBS.values() if getattr(verb.callback, "__module__", "") == module for o in options_of(verb)
        }
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                # The demonstration shows the other verbs' command lines.
                known = every if "photoplan " in node.value or not own or path.stem == "demo" else own
                wrong += [f"{path.name}:{node.lineno}: {o}" for o in misnamed(node.value, known)]
    assert wrong == []


@settings(max_examples=examples(25, 100))
@given(st.sampled_from(sorted(VERBS)), st.lists(st.tuples(st.sampled_from(WORDS), st.booleans()), max_size=5))
def test_parameters_become_options_that_the_verb_has(name: str, words: list[tuple[str, bool]]) -> None:
    text = ", or ".join(f"give `{word}{'=False' * off}`" for word, off in words)
    said = spelled(text, VERBS[name])
    assert not [o for o in unknown_options(name.split(), said) if o.startswith("-")]
    assert re.sub(r"`[^`]*`|-[-a-z]+", "", said) == re.sub(r"`[^`]*`", "", text)
    assert spelled(said, VERBS[name]) == said


@pytest.mark.parametrize(
    ("verb", "text", "said"),
    [
        ("ortho", "give `overwrite` to replace it", "give --overwrite to replace it"),
        ("dtm build", "or `report=False`", "or --no-report"),
        ("tie", "or give `refine=False`", "or give --no-refine"),
        ("dtm sample", "a point (`decimal_comma` declares commas)", "a point (--decimal-comma declares commas)"),
        ("monoplot", "a point (`decimal_comma` declares commas)", "a point"),
        ("dtm visible", "give `points` X Y", "give --from X Y"),
        ("interior", "leave `report` out, and `with` alone", "leave --report out, and `with` alone"),
        ("check", "give `overwrite`; run `photoplan ortho`", "give `overwrite`; run `photoplan ortho`"),
    ],
)
def test_examples(verb: str, text: str, said: str) -> None:
    assert spelled(text, VERBS[verb]) == said


def test_a_verb_that_is_named_lends_its_options() -> None:
    text = "declare `angle_unit` gon to `photoplan init`; `overwrite`"
    assert spelled(text, VERBS["check"], command) == "declare --angle-unit gon to `photoplan init`; --overwrite"


def test_shared_options_are_one_in_all_verbs() -> None:
    """One declaration: the same spellings and kinds of value wherever a verb has the option."""
    for name in ("--json", "--overwrite", "--quiet", "--workers", "--bounds", "--dry-run"):
        found = [p for c in VERBS.values() for p in c.params if isinstance(p, click.Option) and name in p.opts]
        assert len(found) > 2
        assert len({(tuple(p.opts), p.nargs, p.multiple, p.is_flag, p.name) for p in found}) == 1, name
    for name, verb in VERBS.items():
        for option in (p for p in verb.params if "--output" in p.opts):
            assert option.opts == ["-o", "--output"], name
    without_talk = {name for name, command in VERBS.items() if "-q" not in options_of(command)}
    assert without_talk == set()


def test_images_with_commas_or_repeated(tmp_path: Path) -> None:
    own = tmp_path / "a,b.tif"
    own.touch()
    assert listed(["a, b", "c*"]) == ("a", "b", "c*")
    assert listed([str(own), "d,"]) == (str(own), "d")
    chosen = {name: p for name, c in VERBS.items() for p in c.params if "--images" in p.opts}
    assert len(chosen) > 15
    for name, option in chosen.items():
        assert option.multiple and option.callback(None, option, ["a,b", "c"]) == ("a", "b", "c"), name


def test_fault_08_bytes_that_are_no_text_in_words_of_gdal_are_not_shown() -> None:
    """Of damaged tags rasterio cannot decode what GDAL says, and shows tracebacks that nobody asked for."""
    program = (
        "import sys; from photoplan.cli.main import start; start()\n"
        "class Late:\n    def __init__(self, error): self.error = error\n"
        "    def __del__(self): raise self.error\n"
        "del_me = [Late(UnicodeDecodeError('utf-8', b'x', 0, 1, 'hidden')), Late(ValueError('shown'))]; del del_me\n"
        "raise UnicodeDecodeError('utf-8', b'x', 0, 1, 'hidden')\n"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "ValueError: shown" in said.stderr and "hidden" not in said.stderr, said.stderr


@pytest.mark.parametrize(
    "words", [("check",), ("check", "--json"), ("info",), ("budget",), ("ortho", "--images", "\x1b[2J")]
)
def test_names_do_not_command_the_terminal(tmp_path: Path, words: tuple[str, ...]) -> None:
    """Titles, colours, cleared screens and turned writing: they stand there as in JSON."""
    name = "one\x1b]0;title\x07\x1b[2J\r\x9b31m\u202e"
    project = write_block(tmp_path / "block").project
    project.write_text(project.read_text().replace('"one"', json.dumps(name)))
    said = inside(words[0], project, *words[1:])
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e]", said.out + said.err)
    assert "\\u001b" in said.out + said.err
    if "--json" in words:
        assert any(name == each for each in strings(json.loads(said.out)))


def strings(value: object) -> Iterator[str]:
    """Texts of plain values, keys too."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from (key, *strings(each))
    elif isinstance(value, list):
        for each in value:
            yield from strings(each)
    elif isinstance(value, str):
        yield value
