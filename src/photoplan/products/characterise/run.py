"""`photoplan characterise`: everything that a series of images shows about a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Estimate, Findings, Result, Table, raise_failed
from photoplan.io.product import check_output
from photoplan.io.raster import write_whole_image
from photoplan.io.series import Plane, Series, grey_step, largest_of_steps, read_series
from photoplan.io.store import write_atomically
from photoplan.io.tables import write_table
from photoplan.plain import pick, plain
from photoplan.products.characterise.data import SeriesData, SettingsRun, exposure_runs
from photoplan.products.characterise.registry import ANALYSES, Analysis
from photoplan.quality.camera.photon_transfer import FullWell, full_well
from photoplan.requests.quality import CharacteriseRequest

_LEAST = 4
#: Share of samples at the largest grey value from which on that is what stops them.
_MOSTLY = 0.5


def with_full_wells(data: SeriesData) -> SeriesData:
    """The same series with the grey values of full elements, where its flat frames show them; reads those frames."""
    wells: dict[str, FullWell] = {}
    for run in exposure_runs(data, ("flat",), _LEAST):
        for plane in data.planes:
            found = _find(data, run, plane)
            if found is not None and (plane.name not in wells or found.level_dn < wells[plane.name].level_dn):
                wells[plane.name] = found
    return replace(data, wells=wells) if wells else data


def full_well_notes(data: SeriesData) -> tuple[str, ...]:
    """Return notes on the full wells."""
    largest = data.series.saturation_dn
    below = f", below the largest grey value {largest:g}" if isfinite(largest) else ""
    return tuple(
        f"{f'{name}: ' if name else ''}the sensor is full at {well.level_dn:.4g} DN{below}: "
        f"samples from {well.least_dn:.4g} DN on count as saturated"
        for name, well in data.wells.items()
    )


def _find(data: SeriesData, run: SettingsRun, plane: Plane) -> FullWell | None:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    try:
        found = run.saturation(data, plane)
    except InputError:  # every level is cut off at the largest grey value: told by the analyses themselves
        return None
    if found is None or found.rule == "clipping" or levels[-1].saturated_share >= _MOSTLY:
        return None
    stack = data.stacks(run.settings[-1])[plane.name]
    seen = stack.mean if stack.counted is None else stack.mean[stack.counted]
    return full_well(seen, stack.level.temporal_variance, data.step)


def with_grey_step(data: SeriesData) -> SeriesData:
    """The same series with the distance of its grey values; reads a small part of some frames."""
    series, step = data.series, grey_step(data.series)
    stated = series.camera.saturation_dn is not None
    largest = series.saturation_dn if stated else largest_of_steps(series.saturation_dn, step)
    return replace(data, series=replace(series, saturation_dn=largest), step=step)


def step_notes(data: SeriesData) -> tuple[str, ...]:
    """Return notes on the steps of grey values."""
    if data.step < 2:
        return ()
    return (f"grey values come in steps of {data.step:g} DN: rounding is taken as that coarse",)


@dataclass(frozen=True, eq=False)
class AnalysisRun:
    """One analysis with its findings, or the reason why there are none."""

    analysis: Analysis
    outcome: Findings | None = None
    missing: str | None = None
    """Data that the series lacks for it."""
    failed: str | None = None
    """Reason why it stopped."""

    @property
    def state(self) -> str:
        """``done``, ``missing``, ``failed``, or ``possible`` in a dry run."""
        if self.missing is not None:
            return "missing"
        return "failed" if self.failed is not None else "possible" if self.outcome is None else "done"

    def json_fields(self) -> dict[str, Any]:
        """Without plots and files."""
        found: dict[str, Any] = {**pick(self.analysis, "name", "title"), "state": self.state}
        found |= {"reason": self.missing or self.failed} if self.missing or self.failed else {}
        return found if self.outcome is None else found | self.outcome.json_fields()


@dataclass(frozen=True, eq=False)
class CharacteriseReport(Result):
    """Findings of the analyses that a series allows."""

    series: Series
    runs: tuple[AnalysisRun, ...]
    tables: tuple[Path, ...]
    """Tables that were written, and what goes with them."""
    notes: tuple[str, ...] = ()
    """Notes on all analyses."""
    levels: tuple[float, ...] = ()
    """Grey value at which each plane saturates."""

    @property
    def failed(self) -> dict[str, str]:
        """Analyses that stopped, with the reason."""
        return {run.analysis.name: f"{run.analysis.name}: {run.failed}" for run in self.runs if run.failed is not None}

    def json_fields(self) -> dict[str, Any]:
        """Return facts of the series, and the analyses."""
        series = self.series
        return {
            "series": series.path,
            "camera": series.camera.model_dump(exclude_none=True),
            "frames": len(series.frames),
            **pick(series, "size", "saturation_dn"),
            **pick(self, "notes", written="tables", analyses="runs"),
        }

    def written(self) -> tuple[Path, ...]:
        """Return tables and what goes with them."""
        return self.tables

    def outcome(self) -> list[Findings]:
        """Return the findings of each analysis; in a dry run, which are possible."""
        possible = [Findings(title=f"{run.analysis.name}: possible") for run in self.runs if run.state == "possible"]
        return [*possible, *(replace(run.outcome, title=run.analysis.title) for run in self.runs if run.outcome)]

    def remarks(self) -> list[str]:
        """Return the notes on all analyses, then those on each."""
        own = [f"{run.analysis.name}: {note}" for run in self.runs if run.outcome is not None
               for note in run.outcome.notes]  # fmt: skip
        return [*self.notes, *own]

    def messages(self) -> list[str]:
        """Return what the series lacks, and how many analyses were done or can be."""
        lacking = [f"{run.analysis.name}: missing: {run.missing}" for run in self.runs if run.missing is not None]
        states = [run.state for run in self.runs]
        state = "possible" if "possible" in states else "done"
        return [
            *lacking,
            f"{len(self.series.frames)} frames, {len(self.series.reduced)} reduced figures: {states.count(state)} "
            f"analyses {state}, {len(lacking)} lack data",
        ]

    def raise_failures(self) -> None:
        """Name the analyses that stopped."""
        raise_failed(self.failed, sum(run.outcome is not None for run in self.runs), "analyses failed")


def characterise(request: CharacteriseRequest, events: Events = SILENT) -> CharacteriseReport:
    """Run the analyses that a series allows; one that fails does not stop the others.

    Raises
    ------
    UsageError
        An analysis is unknown, or an output exists.
    InputError
        The series cannot be used, or lacks what an analysis that was named needs.
    """
    chosen = _chosen(request.only)
    series = read_series(request.series)
    _check_outputs(request, series)
    data = SeriesData(series)
    runs = [AnalysisRun(analysis, missing=analysis.missing(data)) for analysis in chosen]
    _refuse_missing(request, runs)
    if request.dry_run:
        return CharacteriseReport(series, tuple(runs), ())
    events.begin("analyses", sum(run.missing is None for run in runs), "analyses")
    data = with_full_wells(with_grey_step(data))
    series = data.series
    for k, run in enumerate(runs):
        if run.missing is None:
            runs[k] = _run(run.analysis, data)
            events.done()
    notes = (*step_notes(data), *full_well_notes(data))
    written = _write_tables(request, series, runs)
    wells = [data.wells.get(plane.name) for plane in data.planes]
    levels = tuple(series.saturation_dn if well is None else well.level_dn for well in wells)
    return CharacteriseReport(series=series, runs=tuple(runs), tables=tuple(written), notes=notes, levels=levels)


def _chosen(only: Sequence[str]) -> list[Analysis]:
    known = {analysis.name: analysis for analysis in ANALYSES}
    unknown = [name for name in only if name not in known]
    if unknown:
        raise UsageError(f"`only` {unknown[0]}: no such analysis; known are {', '.join(known)}")
    return [analysis for analysis in ANALYSES if not only or analysis.name in only]


def _refuse_missing(request: CharacteriseRequest, runs: Sequence[AnalysisRun]) -> None:
    """Analyses that were named must be possible, and one at least of all."""
    lacking = [run for run in runs if run.missing is not None]
    if request.dry_run or not (request.only or len(lacking) == len(runs)):
        return
    if lacking:
        listed = "\n".join(f"  {run.analysis.name}: {run.missing}" for run in lacking)
        which = "an analysis that was named" if request.only else "any analysis"
        raise InputError(f"{request.series}: the series lacks what {which} needs:\n{listed}")


def _run(analysis: Analysis, data: SeriesData) -> AnalysisRun:
    try:
        return AnalysisRun(analysis, analysis.analyse(data))
    except ResourceError:
        raise
    except InputError as error:
        return AnalysisRun(analysis, failed=str(error))


def _check_outputs(request: CharacteriseRequest, series: Series) -> None:
    """Refuse outputs that exist or are inputs, before any work."""
    folder = request.csv
    if folder is None:
        return
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder}: is no folder; `csv` takes one")
    tables = list(folder.glob("*.csv"))
    if tables and not request.overwrite:
        raise UsageError(f"{folder}: holds tables; give `overwrite` to replace them, or another `csv`")
    inputs = {p.resolve() for p in series.inputs}
    for path in tables:
        if path.resolve() in inputs:
            raise UsageError(f"{path}: is an input of the series; give another `csv`")


def _write_tables(request: CharacteriseRequest, series: Series, runs: Sequence[AnalysisRun]) -> list[Path]:
    if request.csv is None:
        return []
    done = [(run.analysis.name, run.outcome) for run in runs if run.outcome is not None]
    tables = {"figures": _figure_table([(name, figure) for name, outcome in done for figure in outcome.figures])}
    tables |= {f"{name}_{stem}": table for name, outcome in done for stem, table in outcome.tables.items()}
    for name, table in tables.items():
        write_table(request.csv / f"{name}.csv", table.head, table.rows)
    files = {request.csv / name: content for _, outcome in done for name, content in outcome.files.items()}
    for path, content in files.items():
        check_output(path, list(series.inputs), overwrite=request.overwrite)
        if isinstance(content, bytes):
            write_atomically(path, content)
        elif isinstance(content, Table):
            write_table(path, content.head, content.rows)
        else:
            write_whole_image(path, content)
    return [*(request.csv / f"{name}.csv" for name in tables), *files]


def _figure_table(figures: Sequence[tuple[str, Estimate]]) -> Table:
    names = ("name", "plane", "at", "value", "sigma", "unit", "remark")
    rows = ((name, *(plain(v) for v in pick(figure, *names).values())) for name, figure in figures)
    return Table(("analysis", *names), tuple(tuple("" if v is None else v for v in row) for row in rows))
