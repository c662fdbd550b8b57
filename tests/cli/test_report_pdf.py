"""Reports as PDF: pages of A4, words that can be read and sought, plots as lines, and what does not fit."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from tools.command import Here

from photoplan.findings import Chart, Estimate, Findings, Trace
from photoplan.report.files import ReportFile
from photoplan.report.page import findings_section, page, section, table

TEMPLATE = Path(__file__).resolve().parents[2] / "docs" / "templates" / "sensor-frame.toml"
_STRING = re.compile(rb"\(((?:[^()\\]|\\.)*)\)", re.DOTALL)


def words(path: Path) -> list[str]:
    """Return the words of each page, from the strings that its contents show, without spaces."""
    found = []
    for stream in re.findall(rb"stream\r?\n(.*?)endstream", path.read_bytes(), re.DOTALL):
        try:
            content = zlib.decompress(stream)
        except zlib.error:
            continue
        if b"BT" in content:
            parts = b"".join(_STRING.findall(content))
            parts = re.sub(rb"\\([()\\])", rb"\1", parts).replace(b"\0", b"").replace(b" ", b"")
            found.append(parts.decode("latin-1"))
    return found


@pytest.mark.drawn
def test_a_command_writes_its_report_as_pdf(photoplan: Here, tmp_path: Path) -> None:
    report = tmp_path / "sensor.pdf"
    said = photoplan("sensor", TEMPLATE, "--report", report)
    assert said.code == 0, said.err
    assert report.name in said.out
    assert report.read_bytes().startswith(b"%PDF")
    pages = words(report)
    assert len(pages) > 1
    for number, each in enumerate(pages, 1):
        assert f"page{number}of{len(pages)}" in each
    assert "figurevalueunitremark" in pages[0]
    assert b"/MediaBox [ 0 0 595.28 841.89 ]" in report.read_bytes()
    again = tmp_path / "again.pdf"
    assert photoplan("sensor", TEMPLATE, "--report", again).code == 0
    assert again.read_bytes() == report.read_bytes()


@pytest.mark.drawn
def test_plots_keep_their_words_and_long_tables_their_head(tmp_path: Path) -> None:
    x = np.linspace(0, 1, 20)
    chart = Chart("Curve", "Its caption.", "abscissa px", "ordinate", (Trace(x, x**2, style="line"),))
    found = Findings((Estimate("a", 1.2, 0.1, "gain <K> (1)", "px"),), plots=(chart,), title="Found")
    rows = [[f"row {k}", "word " * 30] for k in range(200)]
    document = [findings_section(found), section("Rows", [table(("name", "meaning"), rows)])]
    file = ReportFile(tmp_path / "a.pdf", report=True)
    file.draw(lambda _: page("Title", "From b.toml", [findings_section(found), *document[1:]]), None)
    pages = words(file.path)
    assert "gain<K>(1)" in pages[0]
    assert "Fromb.toml" in pages[0]
    assert "abscissapx" in "".join(pages)
    assert b"/Subtype /Image" not in file.path.read_bytes()
    assert all("namemeaning" in each for each in pages[1:])
    text = "".join(pages)
    assert [k for k in range(200) if f"row{k}word" not in text] == []


@pytest.mark.drawn
def test_words_without_end_are_cut_to_pages(tmp_path: Path) -> None:
    many = "A" * 30_000
    parts = [section("S" * 400, [table(("x", "y"), [[many, "\u6f22\u202e1"]]), f"<p>{'word ' * 4000}</p>"])]
    file = ReportFile(tmp_path / "a.pdf", report=True)
    file.draw(lambda _: page("T" * 3000, "", parts), None)
    pages = words(file.path)
    assert 5 < len(pages) < 40
    assert "".join(pages).count("A") >= 30_000


def test_other_endings_are_refused(photoplan: Here, tmp_path: Path) -> None:
    said = photoplan("sensor", TEMPLATE, "--report", tmp_path / "sensor.odt")
    assert said.code == 2
    assert ".html or .pdf" in said.err
