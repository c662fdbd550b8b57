"""The reference pages name every option and entry that exists, and none that does not."""

import importlib
import json
import re
from pathlib import Path

import pytest

from photoplan.cli.main import VERBS
from photoplan.io.project import project_schema

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "reference" / "command-line.md").read_text("utf-8")
#: Options of other programs on the pages.
OTHERS = {"--help"}


def long_options(text):
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text))


def options_of(verb):
    command = importlib.import_module(f"photoplan.cli.{verb}").command
    spelled = [o for parameter in command.params for o in (*parameter.opts, *parameter.secondary_opts)]
    return {o for o in spelled if o.startswith("--")}


@pytest.mark.parametrize("verb", VERBS)
def test_options_of_a_verb(verb):
    section = re.search(rf"^## photoplan {verb}$(.*?)(?=^## |\Z)", PAGE, re.M | re.S)
    assert section, f"no section on {verb}"
    elsewhere = {"run": {"--plan"}}.get(verb, set())
    assert long_options(section[1]) - elsewhere == options_of(verb)


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda p: p.stem)
def test_no_page_names_an_option_that_does_not_exist(page):
    known = set.union(*(options_of(verb) for verb in VERBS)) | OTHERS
    assert long_options(page.read_text("utf-8")) <= known


def test_every_entry_of_the_project_file_is_explained():
    schema = json.loads(project_schema())
    page = (DOCS / "reference" / "project-file.md").read_text("utf-8")
    tables = [schema, *schema["$defs"].values()]
    entries = {name for table in tables for name in table.get("properties", {})}
    headings = {"terrain", "orientation", "ortho", "cameras", "images"}
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
