"""One term for one thing: the glossary, its links, and words that pages and help do not use."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tools.command import verbs

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *(p for p in sorted(DOCS.rglob("*.md")) if "_build" not in p.parts)]
GLOSSARY = (DOCS / "reference" / "glossary.md").read_text("utf-8")
TERMS = {head: text.strip() for head, text in re.findall(r"^## (.*)\n\n(.*)$", GLOSSARY, re.M)}
#: Words that have another one in the glossary, or are no standard English, and what is written instead.
REFUSED = {
    r"[Pp]hotos?": "image",
    r"[Tt]ell|[Tt]ells|[Tt]old|[Tt]elling": "report, print, state, explain",
    r"[Pp]ictures?": "image, rendering, preview, drawing",
    r"[Vv]erbs?": "command",
    r"[Bb]eforehand": "a priori, first",
    r"[Tt]ill": "until",
    r"None: ": "None if",
}


def prose(page: str) -> str:
    """Return a page without code, links, references in italics, and headings that are commands; lines stay."""

    def blank(match: re.Match[str]) -> str:
        return " " + "\n" * match[0].count("\n")

    page = re.sub(r"^```.*?^ *```|^( +)```.*?^\1```", blank, page, flags=re.M | re.S)
    page = re.sub(r"(`+)(?:(?!\1).)+?\1", blank, page, flags=re.S)
    page = re.sub(r"\]\([^)]*\)", "]", page)
    page = re.sub(r"\*[^*\n]*“?User Manual[^*\n]*\*[^)]*", "", page)
    return re.sub(r"^#+ photoplan .*$", "", page, flags=re.M)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_uses_the_terms_of_the_glossary(page: Path) -> None:
    lines = prose(page.read_text("utf-8")).splitlines()
    found = [
        f"{n}: {match[0]} ({instead})"
        for n, line in enumerate(lines, 1)
        for word, instead in REFUSED.items()
        for match in re.finditer(rf"(?<![\w-])(?:{word})(?![\w-])", line)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", verbs())
def test_help_uses_the_terms_of_the_glossary(name: str) -> None:
    command = verbs()[name]
    texts = [command.help or "", *(getattr(parameter, "help", None) or "" for parameter in command.params)]
    found = [
        f"{match[0]} ({instead}): {text}"
        for text in texts
        for word, instead in REFUSED.items()
        for match in re.finditer(rf"(?<![\w./-])(?:{word})(?![\w-])", re.sub(r"`[^`]*`", "", text))
    ]
    assert not found, "\n".join(found)


def test_every_term_is_one_sentence_in_alphabetical_order() -> None:
    heads = re.findall(r"^## (.*)$", GLOSSARY, re.M)
    assert len(heads) >= 50 and heads == sorted(TERMS, key=str.casefold)
    for term, text in TERMS.items():
        assert text.endswith(".") and not re.search(r"[.!?] [A-Z]", text), term


def test_every_link_to_the_glossary_has_its_term() -> None:
    slugs = {re.sub(r"[^\w -]", "", term).strip().lower().replace(" ", "-") for term in TERMS}
    links = [slug for page in PAGES for slug in re.findall(r"glossary\.md#([\w-]+)", page.read_text("utf-8"))]
    assert len(set(links)) >= 10 and not set(links) - slugs
