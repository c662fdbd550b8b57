"""The report of a restoration: checked before any work, written after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from photoplan.errors import UsageError
from photoplan.io.disk import write_atomically
from photoplan.io.product import check_output
from photoplan.io.raster import RasterReader
from photoplan.products.chromatic import model_figures
from photoplan.products.restore.details import compare
from photoplan.products.restore.execute import Job, RestoredImage
from photoplan.products.restore.filter import FoundFilter
from photoplan.products.restore.page import filter_facts
from photoplan.products.restore.run import RestoreReport
from photoplan.project.fall_off_reader import fall_off_line
from photoplan.quality.colour.model import ChromaticModel
from photoplan.report.restore_plots import RestorePlots
from photoplan.report.restore_report import RestoredFacts, restore_report


@dataclass(frozen=True, eq=False)
class ReportFile:
    """A report that can be written."""

    path: Path
    plots: RestorePlots

    def write(self, found: FoundFilter, jobs: Sequence[Job], made: RestoreReport) -> RestoreReport:
        """Write the report of images that are restored; returns what was made with the path of the report.

        No report is written where no image could be restored.

        Raises
        ------
        InputError
            An image changed meanwhile and is damaged.
        UsageError, ResourceError
            The report cannot be written.
        """
        if not made.images:
            return made
        by_path = {job.target: job for job in jobs}
        facts = [_facts(image, by_path[image.path]) for image in made.images]
        title = facts[0].name if len(facts) == 1 else f"{len(facts)} images"
        text = restore_report(title, filter_facts(found), facts, made.failed, self.plots)
        write_atomically(self.path, text.encode("utf-8", errors="replace"))
        return replace(made, report=self.path)


def open_report(path: Path, inputs: Sequence[Path], *, overwrite: bool = False) -> ReportFile:
    """A report to be, before any work.

    Raises
    ------
    UsageError
        The file exists and `overwrite` is False, is an input, does not end in .html, or matplotlib is missing.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"--report {path}: a report is written as HTML; give a name that ends in .html")
    check_output(path, inputs, overwrite=overwrite)
    return ReportFile(path, RestorePlots())


def _facts(image: RestoredImage, job: Job) -> RestoredFacts:
    aligned = job.reader.aligned
    before, after = RasterReader(job.reader.info.path), RasterReader(image.path)
    seen = compare(before, after)
    window, size = seen.window, job.reader.size
    clipped = sum(image.below) + sum(image.above)
    figures = (
        (f"{size[0]} × {size[1]}", "pixels", f"{len(image.below)} band(s) of {image.dtype}"),
        (f"{100 * image.clipped_share:.3g} %", "clipped", f"{clipped} values beyond what the type holds"),
        (f"{100 * image.valid_share:.4g} %", "valid pixels", ""),
        (f"{image.noise_gain:.3g} ×", "growth of noise", "the largest of all kernels"),
    )
    return RestoredFacts(
        image.image,
        figures,
        tuple(_band_rows(image)),
        seen.before,
        seen.after,
        f"Columns {window.col} to {window.stop[0] - 1}, rows {window.row} to {window.stop[1] - 1}",
        seen.ends,
        tuple(_notes(image, job)),
        () if aligned is None else tuple(_chromatic_rows(aligned.model)),
    )


def _notes(image: RestoredImage, job: Job) -> list[str]:
    notes = [f"The result is {image.path.name}; light: {job.reader.restorer.linearisation.describe()}."]
    if job.reader.lit is not None:
        notes.append(f"Before the filter: {fall_off_line(job.reader.lit.fall_off)}.")
    return notes


def _band_rows(image: RestoredImage) -> list[tuple[str, ...]]:
    """Clipped pixels of each band."""
    valid = image.valid_share * image.pixels
    return [
        (str(band), str(below), str(above), f"{100 * (below + above) / valid:.3g} %" if valid else "–")
        for band, (below, above) in enumerate(zip(image.below, image.above), start=1)
    ]


def _chromatic_rows(model: ChromaticModel) -> list[tuple[str, ...]]:
    return [
        (
            f"{band['band']} against {model.reference}",
            str(band["kind"]),
            f"{band['shift'][0]:+.3f}",
            f"{band['shift'][1]:+.3f}",
            f"{band['corner']:+.3f}",
            "–" if band["residual"] is None else f"{band['residual']:.3f}",
            str(band["count"] - band["rejected"]),
            str(band["rejected"]),
        )
        for band in model_figures(model)["bands"]
    ]
