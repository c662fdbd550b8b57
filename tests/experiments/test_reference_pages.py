"""The reference pages name every option and entry that exists, and none that does not; examples parse."""

import json
import re
import shlex
from pathlib import Path

import click
import pytest
from tools.command import verbs

from photoplan.cli.lazy import spelled_out
from photoplan.cli.table import GROUPS as TABLE
from photoplan.cli.table import VERBS
from photoplan.io.project.file import project_schema

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [*sorted(DOCS.rglob("*.md")), ROOT / "README.md"]
#: Options of other programs on the pages.
OTHERS = {"--help"}
#: Verbs as they are typed, and the page that explains them; `dtm` and `view` are groups of verbs without options.
DTM_VERBS, VIEW_VERBS = TABLE["terrain"].verbs, TABLE["view"].verbs
GROUPS = {"dtm": DTM_VERBS, "view": VIEW_VERBS}
PLACES = {verb: "command-line" for verb in VERBS if verb not in {**GROUPS, **TABLE} or verb == "ortho"}
PLACES |= {f"dtm {verb}": "dtm" for verb in DTM_VERBS} | {f"view {verb}": "views" for verb in VIEW_VERBS}
PLACES |= dict.fromkeys(("convert", "fiducials", "interior", "tie", "control", "resect", "adjust"), "orientation")
PLACES |= {verb: verb for verb in ("mtf", "restore", "characterise", "sensor", "simulate")}


def long_options(text):
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text))


def command_of(verb):
    return verbs()[verb]


def options_of(verb):
    spelled = [o for parameter in command_of(verb).params for o in (*parameter.opts, *parameter.secondary_opts)]
    return {o for o in spelled if o.startswith("--")}


def section_of(verb):
    page = (DOCS / "reference" / f"{PLACES[verb]}.md").read_text("utf-8")
    section = re.search(rf"^## photoplan {verb}$(.*?)(?=^## |\Z)", page, re.M | re.S)
    assert section, f"no section on {verb}"
    return section[1]


def examples():
    """Calls of photoplan in blocks of the pages: page, verb, arguments. Lines that only show a form are left out."""
    for page in PAGES:
        text = page.read_text("utf-8")
        for block in re.findall(r"^```(?:console|text|bash)?\n(.*?)^```$", text, re.M | re.S):
            for line in block.replace("\\\n", " ").splitlines():
                call = re.match(r"(?:\$ )?(?:\.venv/bin/)?photoplan (.*)", line)
                if not call or re.search(r"…|\[options\]|\[-", call[1]):
                    continue
                words = shlex.split(re.split(r"\s+#", call[1])[0])
                if words[0] == "view":
                    words = ["view", *spelled_out(words[1:], VIEW_VERBS, TABLE["view"].words)]
                verb = " ".join(words[:2]) if words[0] in GROUPS else words[0]
                yield pytest.param(verb, words[len(verb.split()) :], id=f"{page.stem}: {call[1][:40]}")


EXAMPLES = list(examples())


@pytest.mark.parametrize("verb", PLACES)
def test_options_of_a_verb(verb):
    told, elsewhere = long_options(section_of(verb)), {"run": {"--plan"}}.get(verb, set())
    # Of a mosaic only those are listed that an orthophoto does not have, of an object those that a mosaic has not.
    same = {
        "mosaic": options_of("ortho") - {"--true", "--ground", "--method", "--fill", "--stack"},
        "object": options_of("mosaic") - {"--name", "--seams", "--feather", "--blend", "--sheets"},
    }.get(verb, set())
    others = {"--true", "--stack", "--name", "--seams", "--feather", "--blend", "--sheets"} if same else set()
    assert (told - elsewhere - (others - options_of(verb))) | same == options_of(verb)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_no_page_names_an_option_that_does_not_exist(page):
    known = set.union(*(options_of(verb) for verb in PLACES)) | OTHERS
    assert long_options(page.read_text("utf-8")) <= known


def test_examples_of_all_verbs_of_terrain_models_are_found():
    verbs = {parameter.values[0] for parameter in EXAMPLES}
    assert {f"dtm {verb}" for verb in DTM_VERBS} | {"monoplot", "ortho", "check", "init"} <= verbs


@pytest.mark.parametrize(("verb", "arguments"), EXAMPLES)
def test_example_is_understood(verb, arguments):
    assert verb in PLACES, f"photoplan has no verb {verb!r}"
    try:
        command_of(verb).make_context(verb, list(arguments))
    except click.UsageError as error:
        pytest.fail(f"photoplan {verb}: {error.format_message()}")


def test_figures_of_linear_prediction_on_the_pages_are_those_of_the_code():
    from photoplan.terrain import build, covariance
    from photoplan.terrain import observations as leaves
    from photoplan.terrain.observations import SHARE, BuildSettings

    page = " ".join((DOCS / "explanation" / "linear-prediction.md").read_text("utf-8").split())
    table = (DOCS / "reference" / "dtm.md").read_text("utf-8")
    (share,) = set(SHARE.values()) - {1.0}
    assert f"get {share:g} of it" in page and f"other classes: {share:g} of it" in table
    assert f"at most {leaves.CAPACITY} points" in page
    assert f"{covariance.POINTS} nearest points and {covariance.LINES} nearest line points" in page
    assert f"g = {min(covariance.GAPS):g} to {max(covariance.GAPS):g} half-value distances" in page
    assert f"`--gross` ({BuildSettings().gross:g})" in page
    assert f"| {build._REACH:g} spacings |" in table and build._WIDTH == 0.5  # "half the spacing"


def test_every_entry_of_the_project_file_is_explained():
    schema = json.loads(project_schema())
    # What marks look like has a page of its own.
    page = "".join((DOCS / "reference" / f"{name}.md").read_text("utf-8") for name in ("project-file", "marks"))
    tables = [schema, *schema["$defs"].values()]
    entries = {name for table in tables for name in table.get("properties", {})}
    headings = {"terrain", "objects", "orientation", "observations", "adjustment", "ortho", "cameras", "images"}
    missing = {e for e in entries if f"`{e}`" not in page and not (e in headings and f"[{e}" in page)}
    assert not missing - {"type"}


def test_toml_on_the_pages_is_toml():
    import tomllib

    blocks = [
        b for p in DOCS.rglob("*.md") for b in re.findall(r"^```toml\n(.*?)^```", p.read_text("utf-8"), re.M | re.S)
    ]
    assert len(blocks) >= 4
    for block in blocks:
        tomllib.loads(block)


def test_the_page_on_arrays_runs(tmp_path, monkeypatch, capsys):
    pytest.importorskip("xarray", reason="xarray is not installed")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", (DOCS / "howto" / "arrays.md").read_text("utf-8"), re.M | re.S)
    exec(compile("\n".join(blocks), "arrays.md", "exec"), {"__name__": "arrays"})
    assert (tmp_path / "ortho.tif").exists()
    assert "% valid, worst residual 0.0" in capsys.readouterr().out
