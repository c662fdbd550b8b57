"""Commands made from requests: options, their sections, limits and messages; misspelt words; folders of projects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest
from tools.command import Here
from tools.small_block import Block

import photoplan as pp
from photoplan.cli.verb import Verb
from photoplan.errors import UsageError
from photoplan.request import OVERWRITE, Request, arg, opt


class Inner(Request):
    """A request in a request."""

    width: float = opt("Width of the thing, metres.", 1.0, gt=0, le=5)


class Outer(Request):
    """A request of every kind of option."""

    model: Path = arg("A model.")
    output: Path = opt("Raster to write.", metavar="TIF", writes=True)
    method: Literal["d8", "dinf"] = opt("How areas are summed.", "d8")
    bounds: tuple[float, float, float, float] | None = opt("Part.", None, section="input")
    scene: bool | None = opt("Side of the scene.", None, choices={"auto": None, "z<0": True})
    classes: tuple[float, ...] = opt("Limits.", (), listed=True, metavar="A,B")
    header: bool = opt("The first line is a head.", True, flag="no-header", off="The first line is a point.")
    inner: Inner = Inner()
    overwrite: bool = OVERWRITE


def test_values_are_checked_when_they_are_set() -> None:
    request = Outer("a.tif", output="b.tif", inner=Inner(width=2))
    assert (request.model, request.files_read(), request.files_written()["output"]) == (
        Path("a.tif"),
        [Path("a.tif")],
        [Path("b.tif")],
    )
    assert request.replace(method="dinf").inner.width == 2 and request == Outer(**dict(request))
    for values, says in (
        ({"inner": Inner}, "inner"),
        ({"method": "d9"}, r"`method` d9 must be one of d8 or dinf \(how areas are summed\)"),
        ({"bounds": (1, 2, 3)}, "3 values; needed are 4"),
        ({"width": 1}, "Outer has no option 'width'; its options are model, output"),
        ({"output": "a.tif", "model": "c"}, None),
        ({"output": Path("x/../b.tif")}, None),
    ):
        given = {"model": "a.tif", "output": "b.tif", **values}
        if says is None:
            Outer(**given)
            continue
        with pytest.raises(UsageError, match=says):
            Outer(**given)
    with pytest.raises(UsageError, match=r"`width` 6\.0 must be greater than 0 and at most 5 \(width of the thing"):
        Inner(width=6.0)
    with pytest.raises(UsageError, match="`output` is required"):
        Outer("a")


def test_two_outputs_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`output` and `preview` are the same file"):
        pp.ShadeRequest("m", output=tmp_path / "a.png", preview=tmp_path / "." / "a.png")


def test_options_of_the_command_come_from_the_fields() -> None:
    verb = Verb("Short.", "Long.", "x", "y")
    made: dict[str, object] = {}
    command = verb.command_of(Outer, "outer", lambda request, **_: made.update(request=request))
    words = [
        "m.tif",
        "-o",
        "o.tif",
        "--bounds",
        "1",
        "2",
        "3",
        "4",
        "--classes",
        "5,10",
        "--classes",
        "20",
        "--no-header",
        "--scene",
        "z<0",
        "--width",
        "3",
    ]
    command.main(words, standalone_mode=False)
    assert made["request"] == Outer(
        "m.tif",
        output="o.tif",
        bounds=(1, 2, 3, 4),
        scene=True,
        classes=(5, 10, 20),
        header=False,
        inner=Inner(width=3),
    )
    text = command.get_help(command.make_context("outer", ["m", "-o", "o"]))
    titles = [line for line in text.splitlines() if line.rstrip(":") in ("Input", "Result", "Method", "Run")]
    assert titles == ["Input:", "Result:", "Method:", "Run:"]
    assert text.index("Input:") < text.index("--bounds") < text.index("Result:") < text.index("--output")
    assert "[d8|dinf]" in text and "[default: d8]" in text and "--scene [auto|z<0]" in text


@dataclass(frozen=True)
class Pair:
    """A value that reads itself from text."""

    a: int
    b: int

    @classmethod
    def parse(cls, text: str) -> Pair:
        return cls(*map(int, text.split(":")))


class Both(Request):
    """A request that may hold another one, with an option that one of its classes judges."""

    inner: Inner | None = None
    pairs: tuple[Pair, ...] = opt("Pairs; may be repeated.", (), flag="pair")
    at: tuple[float, ...] | None = opt("A place.", None, nargs=2)
    roof: bool = opt("Show the roof, or the ground.", False, other="ground")
    limit: float = opt("Limit.", 1.0, nan=True)
    hidden: int = 3
    project: Path = arg(project=True)


def test_values_read_themselves_from_text_and_only_given_options_are_set(tmp_path: Path) -> None:
    made: list[Both] = []
    command = Verb("", "", "x", "y").command_of(Both, "both", lambda request, **_: made.append(request))
    (tmp_path / "project.toml").touch()
    for words in ((), ("--pair", "1:2", "--pair", "3:4", "--at", "1", "2", "--ground"), ("--width", "1")):
        command.main([str(tmp_path), *words], standalone_mode=False)
    bare, full, inner = made
    assert bare.model_fields_set == {"project"} and bare.inner is None and bare.project.name == "project.toml"
    assert full == Both(tmp_path, pairs=["1:2", Pair(3, 4)], at=(1, 2), roof=False) and full.inner is None
    assert full.model_fields_set == {"project", "pairs", "at", "roof"}
    assert inner.inner == Inner() and inner.inner.model_fields_set == {"width"}
    assert full.replace(at=None).model_fields_set == full.model_fields_set
    assert Both(tmp_path, inner={"width": 2}).inner == Inner(width=2)
    assert full.part(Inner, width=3) == Inner(width=3)
    assert not [p.name for p in command.params if p.name == "hidden"]
    assert Both(tmp_path, limit=float("nan")).limit != 1
    with pytest.raises(UsageError, match="NaN"):
        Inner(width=float("nan"))


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("mosiac", "`photoplan mosaic`"),
        ("volume", "`photoplan terrain volume`"),
        ("dtm shad", "`photoplan dtm shade`"),
        ("qqq", "see `photoplan --help`"),
    ],
)
def test_misspelt_commands_are_named(photoplan: Here, words: str, meant: str) -> None:
    said = photoplan(*words.split())
    assert said.code == 2 and meant in said.err


def test_a_folder_stands_for_its_project(photoplan: Here, small: Block) -> None:
    said = photoplan("check", small.project.parent, "--json")
    assert said.code == 0 and said.out == photoplan("check", small.project, "--json").out
    assert pp.load_project(small.project.parent) == pp.load_project(small.project)


@pytest.mark.parametrize(
    "words", [("tie", "{}"), ("dtm", "info", "{}"), ("mosaic", "project.toml", "-o", "{}"), ("report", "p", "-o", "{}")]
)
@pytest.mark.parametrize("kind", ["long", "loop"])
def test_names_that_no_file_can_have_are_refused(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    kind: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")
    said = Here(capsys)(*(word.format("x" * 3000 if kind == "long" else "loop") for word in words))
    assert said.code == 2 and "no file can be there" in said.err and "give another name" in said.err
