"""HTML of reports: everything in one document, safe whatever names it is given, fit for print."""

from __future__ import annotations

import base64
import html
import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

from photoplan.errors import UsageError
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.files import stated_text
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project
from photoplan.io.store import write_atomically
from photoplan.project.scene import input_files
from photoplan.report.drawing import keeping, load_matplotlib

_STYLE = """
:root { --ink: #1c2730; --soft: #5c6b77; --rule: #d7dee3; --accent: #0b5c8c; --ground: #f6f8f9; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 2.5rem 1.5rem 4rem; color: var(--ink); background: #fff;
  font: 15px/1.5 "Source Sans 3", "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
header { border-bottom: 3px solid var(--accent); padding-bottom: .8rem; margin-bottom: 1.6rem; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .8rem; padding-bottom: .25rem; border-bottom: 1px solid var(--rule); }
header p, figcaption, .more { color: var(--soft); }
header p { margin: 0; overflow-wrap: anywhere; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(17.5rem, 1fr)); gap: .8rem; margin: 0; }
.figures div { background: var(--ground); border-left: 3px solid var(--accent); padding: .7rem .9rem; }
.figures dd { margin: 0; font-size: 1.55rem; font-weight: 600; font-variant-numeric: tabular-nums; line-height: 1.2; }
.figures dt { font-weight: 600; font-size: .92rem; }
.figures div { display: flex; flex-direction: column; }
.figures dd:first-of-type { order: -1; }
.figures dd.more { font-size: .84rem; font-weight: 400; line-height: 1.35; margin: .1rem 0 0; }
figure { margin: 1.2rem 0 1.8rem; break-inside: avoid; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .88rem; max-width: 50rem; margin: .4rem auto 0; }
.scroll { overflow-x: auto; margin: .8rem 0 1.4rem; }
table { border-collapse: collapse; width: 100%; font-size: .88rem; }
th { text-align: left; color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--rule); }
th, td { padding: .3rem .8rem .3rem 0; vertical-align: top; }
td { border-bottom: 1px solid var(--rule); overflow-wrap: anywhere; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } thead { display: table-header-group; }
  .scroll { overflow: visible; }
  .figures { grid-template-columns: repeat(3, 1fr); }
  .figures div, header { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
@page { size: A4; margin: 16mm 15mm; }
"""
#: No script, no address outside the document: pictures come with it.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    number: bool = False
    """Aligned to the right."""


def text(value: str) -> str:
    """A value as it may stand in HTML: escaped, and without characters that turn or hide the text around them."""
    kept = "".join(c if unicodedata.category(c) not in ("Cc", "Cf", "Cs", "Co", "Cn") else "\ufffd" for c in value)
    return html.escape(kept, quote=True)


def page(title: str, subtitle: str, parts: Iterable[str]) -> str:
    """A whole document."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<header>\n<h1>{text(title)}</h1>\n<p>{text(subtitle)}</p>\n</header>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def section(title: str, parts: Iterable[str]) -> str:
    """A headed part of the document."""
    return f"<section>\n<h2>{text(title)}</h2>\n" + "\n".join(parts) + "\n</section>"


def headline(figures: Sequence[tuple[str, str, str]]) -> str:
    """Large figures: each its value, what it is, and a remark."""
    boxes = [
        f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd>"
        + (f'<dd class="more">{text(more)}</dd>' if more else "")
        + "</div>"
        for value, name, more in figures
    ]
    return '<dl class="figures">\n' + "\n".join(boxes) + "\n</dl>"


def figure(png: bytes, title: str, caption: str) -> str:
    """A picture with its caption."""
    data = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img alt="{text(title)}" src="data:image/png;base64,{data}">'
        f"<figcaption><b>{text(title)}.</b> {text(caption)}</figcaption></figure>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str | Cell]]) -> str:
    """A table; a column is headed as its first cell is aligned."""
    if not rows:
        return ""
    first = [isinstance(cell, Cell) and cell.number for cell in rows[0]]
    heads = "".join(_cell("th", Cell(name, number)) for name, number in zip(head, first))
    body = "\n".join("<tr>" + "".join(_cell("td", cell) for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def cells(row: Sequence[str], words: int = 0) -> list[Cell]:
    """A row whose first columns are words and the others numbers."""
    return [Cell(value, number >= words) for number, value in enumerate(row)]


def number(value: float, digits: int) -> str:
    """A number with so many digits after the point; a dash for NaN and infinity."""
    return f"{value:.{digits}f}" if isfinite(value) else "–"


def _cell(tag: str, cell: str | Cell) -> str:
    value = cell if isinstance(cell, Cell) else Cell(cell)
    return f"<{tag}" + (' class="number">' if value.number else ">") + f"{text(value.text)}</{tag}>"


@dataclass(frozen=True, eq=False)
class ReportFile:
    """A report or picture that can be written: seen before any work."""

    path: Path
    report: bool = False

    def draw(self, drawing: Callable[[Any], Any], result: Any) -> list[Path]:
        """Draw it from a result and write it; a drawing may return several by their places, or None."""
        printing = self.report and self.path.suffix.lower() == ".pdf"
        with ExitStack() as stack:
            plots = stack.enter_context(keeping()) if printing else {}
            content = drawing(result)
        if content is None:
            return []
        if printing:
            from photoplan.report.pdf import printed  # noqa: PLC0415 - for PDF alone

            return [self.write(printed(self._stated(content), plots))]
        each = content if isinstance(content, Mapping) else {self.path: content}
        return [replace(self, path=place).write(one) for place, one in each.items()]

    def _stated(self, content: str) -> str:
        """Return a document whose paths are written from its folder; pictures inside are left as they are."""
        parts = re.split(r"(data:image/[^\"]*)", content)
        parts[::2] = [stated_text(part, self.path.parent) for part in parts[::2]]
        return "".join(parts)

    def write(self, content: str | bytes) -> Path:
        """Write it whole or not at all; its folder is made. Returns its path."""
        if isinstance(content, str):
            content = self._stated(content).encode("utf-8", errors="replace")
        try:
            make_parents(self.path.parent)
        except OSError as error:
            raise disk_error(self.path, error) from None
        write_atomically(self.path, content)
        return self.path


def open_report(
    path: Path | None,
    inputs: Iterable[Path | str | None],
    *,
    overwrite: bool,
    table: Path | None = None,
    project: Path | None = None,
) -> ReportFile | None:
    """A report to be; None if none is asked for."""
    if path is None:
        return None
    if table is not None and table.resolve() == path.resolve():
        raise UsageError(f"{path}: report and table are the same file; give two names")
    opened = open_picture(path, inputs, overwrite=overwrite, project=project, what="a report")
    if path.suffix.lower() not in (".html", ".htm", ".pdf"):
        raise UsageError(f"{path}: a report is HTML or PDF; give a name that ends in .html or .pdf")
    return opened and replace(opened, report=True)


def open_picture(
    path: Path | None,
    inputs: Iterable[Path | str | None],
    *,
    overwrite: bool,
    project: Path | None = None,
    what: str = "a picture",
) -> ReportFile | None:
    """A picture to be; see `open_report`."""
    if path is None:
        return None
    files = [] if project is None else [project, *input_files(load_project(project))]
    check_output(path, [*files, *(source for source in inputs if source is not None)], overwrite=overwrite)
    load_matplotlib(what, f"leave {what.replace('a ', 'the ')} out")
    return ReportFile(path)
