"""Reports and pictures as files: HTML, PDF and PNG, checked before any work."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from photoplan.errors import UsageError
from photoplan.io.disk import disk_error, make_parents
from photoplan.io.files import stated_text
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project
from photoplan.io.store import write_atomically
from photoplan.project.scene import input_files
from photoplan.report.page import keeping, load_matplotlib


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
