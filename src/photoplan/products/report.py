"""Quality report of a project: figures, warnings and gaps of all that its runs have recorded."""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from photoplan.errors import InputError, PhotoplanError
from photoplan.events import SILENT, Events
from photoplan.findings import Bars, Estimate, Findings, Result, Table, known
from photoplan.geometry.crs import crs_label
from photoplan.io.files import build, fingerprint, json_object, read_text, relative_path
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.products.budget import PLACES, Budget, budget_or_tables
from photoplan.products.check import ProjectCheck, check_project
from photoplan.project.scene import input_files
from photoplan.requests.project import BudgetRequest, ReportRequest

#: Largest run record and report of an adjustment, all records together, bytes; the most records that are read.
_MAX_BYTES, _ALL_BYTES, _MOST_RECORDS = 64_000_000, 1_000_000_000, 5000
#: Letters of a foreign text, notes and figures of a record, rows of a table that a report takes.
_LETTERS, _NOTES, _FIGURES, MOST_ROWS = 400, 20, 40, 500
#: Results that a warning names.
_NAMED = 4

#: Sections in the order of the chain, with the kinds of their records.
_SECTIONS: dict[str, tuple[str, ...]] = {
    "Orientation": ("interior", "fiducials", "resect", "convert"),
    "Tie points and control": ("tie points", "control"),
    "Adjustment": ("adjust",),
    "Terrain": ("terrain model", "surface", "refine", "volume", "volume difference"),
    "Products": ("orthophoto", "mosaic", "object"),
    "Colours and seams": ("balance", "seams", "illumination"),
}
#: All others but those of views and of rasters made of terrain, which stand with the products.
_OTHERS = "Other measurements"
_RASTERS = ("hillshade", "slope", "slope classes", "aspect", "tints", "heights", "visibility", "flow", "contours")
#: Sections without which a chain is incomplete, and the command that fills each.
_WANTED = {
    "Tie points and control": ("tie points", "no tie points were sought: run `photoplan tie`"),
    "Adjustment": ("adjustment", "no adjustment was run: run `photoplan adjust`"),
    "Products": ("products", "no orthophoto or mosaic was made: run `photoplan ortho` or `photoplan mosaic`"),
    "Colours and seams": ("balance", "colours were not balanced, and no seams sought: run `photoplan balance`"),
}
#: Figures of a kind: place in the record, name, unit.
_KNOWN: dict[str, tuple[tuple[str, str, str], ...]] = {
    "tie points": (
        ("points", "tie points", ""),
        ("tracks", "tracks before the choice", ""),
        ("ambiguous", "ambiguous tracks", ""),
        ("pairs.tried", "pairs of images tried", ""),
        ("pairs.verified", "pairs of images verified", ""),
        ("sigma", "standard deviation of an image point", "px"),
        ("loops.factor", "misclosure of loops over expected", ""),
    ),
    "control": (
        ("points", "ground points", ""),
        ("patches", "patches sought", ""),
        ("sigma.plane", "standard deviation, horizontal", "m"),
        ("sigma.height", "standard deviation, height", "m"),
        ("sigma.image", "standard deviation, image", "px"),
    ),
    "adjust": (
        ("sigma0", "sigma0", ""),
        ("image_residual_rms_px", "image residuals, root mean square", "px"),
        ("measurements", "measurements", ""),
        ("points", "points", ""),
        ("unknowns", "unknowns", ""),
        ("redundancy", "redundancy", ""),
        ("mean_images_of_a_point", "images of a point, mean", ""),
        ("iterations", "iterations", ""),
    ),
    "terrain model": (
        ("points", "points", ""),
        ("units", "units", ""),
        ("noise", "standard deviation of mass points", "m"),
        ("sigma", "standard deviation of posts", "m"),
        ("spread", "normalised residuals, spread", ""),
    ),
    "surface": (
        ("sigma", "standard deviation of heights, median", "m"),
        ("sigma_px", "the same as parallax", "px"),
        ("valid_share", "posts with a height, share", ""),
        ("misfit_share", "heights that fit badly, share", ""),
        ("redundancy", "redundancy", ""),
    ),
    "balance": (
        ("resolution", "pixel of the comparison", "m"),
        *((f"rms_before.{k}", f"differences before, band {k + 1}", "DN") for k in range(4)),
        *((f"rms_after.{k}", f"differences after, band {k + 1}", "DN") for k in range(4)),
    ),
    "seams": (
        ("resolution", "pixel of the seams", "m"),
        ("found", "fine detail differs along seams by", "DN"),
        ("halfway", "halfway between the images by", "DN"),
    ),
}
#: Units of figures of other records, by how their names end.
_UNITS = {
    "m": "m", "m2": "m²", "m3": "m³", "px": "px", "deg": "°", "um": "µm", "mm": "mm", "dn": "DN", "e": "e",
    "percent": "%", "seconds": "s",
}  # fmt: skip


class _Lenient(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", protected_namespaces=())


class _Input(_Lenient):
    path: str = Field(max_length=4000)
    size: int | None = None
    sampled_sha256: str | None = Field(None, max_length=200)


class _Ran(_Lenient):
    finished: datetime | None = None


class _Entry(_Lenient):
    """A run record as far as a report looks at it."""

    file: str = Field(max_length=4000)
    kind: str | None = Field(None, max_length=200)
    product: dict[str, Any] = {}
    settings: dict[str, Any] | None = None
    project: dict[str, Any] | None = None
    inputs: tuple[_Input, ...] = Field((), max_length=200_000)
    run: _Ran = _Ran()


@dataclass(frozen=True)
class RunRecord:
    """A run record, and whether what it describes is that of the project as it is."""

    path: Path
    name: str
    """Its product, from the folder of the project."""
    kind: str
    finished: datetime | None
    product: Mapping[str, Any]
    settings: Mapping[str, Any]
    poses: Mapping[str, tuple[Any, Any]]
    """Centre and angles of images as they took part, where it states them."""
    inputs: tuple[_Input, ...]
    old: tuple[str, ...] = ()
    """Changes since, one sentence each; empty if there are none."""

    def json_fields(self) -> dict[str, Any]:
        """Name, kind, time and what has changed since."""
        return {"name": self.name, "kind": self.kind, "finished": self.finished, "old": self.old}

    @property
    def when(self) -> str:
        """The time at which it was finished, to the minute."""
        return "" if self.finished is None else f"{self.finished:%Y-%m-%d %H:%M} UTC"


@dataclass(frozen=True, eq=False)
class ProjectReport(Result):
    """Quality report of a project."""

    project: Path
    title: str
    warnings: tuple[str, ...]
    """Old and unreadable records, and failures."""
    missing: Mapping[str, str]
    """Steps that the chain lacks, and the commands that make them."""
    notes: tuple[str, ...]
    """Notes of all runs."""
    sections: tuple[Findings, ...]
    records: tuple[RunRecord, ...]

    def written(self) -> Sequence[Path]:
        """Return nothing: only the report is written."""
        return ()

    def json_fields(self) -> dict[str, Any]:
        """Return the sections by title."""
        return {
            "project": self.project,
            "warnings": self.warnings,
            "missing": self.missing,
            "notes": self.notes,
            "sections": {each.title: each for each in self.sections},
            "records": self.records,
        }

    def outcome(self) -> Sequence[Findings]:
        """Return the sections; the first lists what is missing."""
        return (*([Findings(refused=self.missing, title="Missing")] if self.missing else []), *self.sections)

    def messages(self) -> Sequence[str]:
        """Return the warnings."""
        return [f"warning: {each}" for each in self.warnings]


def report_project(request: ReportRequest, events: Events = SILENT) -> ProjectReport:
    """Join what the runs of a project have recorded into one report.

    Records in the folder of the project and in the folders directly in it are read. Files that a record names are
    looked at only if the project names them, too, or if they lie in its folder.

    Raises
    ------
    InputError
        The project file is wrong.
    """
    project = load_project(request.project)
    folder = request.project.resolve().parent
    records, warnings = _records(folder)
    inputs = {file.resolve() for file in input_files(project)}
    records = _judged(records, project, request.project.resolve(), folder, inputs)
    reasons: dict[str, list[str]] = {}
    for record in records:
        for why in record.old:
            reasons.setdefault(why, []).append(record.name)
    for why, names in reasons.items():
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        warnings.append(f"old, {why}: {', '.join(names[:_NAMED])}{more}")
    by_section: dict[str, list[RunRecord]] = {title: [] for title in (*_SECTIONS, _OTHERS)}
    for record in records:
        by_section[_section_of(record.kind)].append(record)
    missing: dict[str, str] = {}
    for title, (what, why) in _WANTED.items():
        if not by_section[title]:
            missing[what] = why
    if project.terrain is None:
        missing["terrain"] = "the project states none: add [terrain]"
    sections = [_images(project, request.checked, warnings, missing)]
    for title, several in by_section.items():
        if title == "Adjustment":
            sections.append(_adjustment(several, warnings))
        elif title == "Products":
            sections.append(_products(several))
        elif title != _OTHERS:
            sections.append(_listed(title, several))
    sections.append(_accuracy(request, by_section["Adjustment"], missing))
    if by_section[_OTHERS]:
        sections.append(_listed(_OTHERS, by_section[_OTHERS]))
    notes = [
        f"{each.name}: {note}"
        for each in records
        for note in _notes(_report_of(each, []) if each.kind == "adjust" else each.product)
    ]
    return ProjectReport(
        project=request.project,
        title=folder.name,
        warnings=tuple(dict.fromkeys(warnings)),
        missing=missing,
        notes=tuple(dict.fromkeys(notes)),
        sections=tuple(each for each in sections if each.figures or each.tables or each.notes or each.refused),
        records=tuple(records),
    )


def _section_of(kind: str) -> str:
    found = next((title for title, kinds in _SECTIONS.items() if kind in kinds), None)
    products = kind in _RASTERS or kind.startswith(("view", "rendered"))
    return found or ("Products" if products else _OTHERS)


def _records(folder: Path) -> tuple[list[RunRecord], list[str]]:
    """Return the records of a project in the order of their times, and what is wrong with others."""
    paths = [*folder.glob("*.run.json"), *(p for f in _folders(folder) for p in f.glob("*.run.json"))]
    found, warnings, size = [], [], 0
    for path in sorted(paths)[:_MOST_RECORDS]:
        name = _text(relative_path(path, folder))
        try:
            size += path.lstat().st_size
            if size > _ALL_BYTES:
                raise InputError(f"all records together hold more than {_ALL_BYTES} bytes")
            found.append(_read(path, folder))
        except (InputError, OSError) as error:
            warnings.append(f"{name}: is left out: {_fault(error, path)}")
    if len(paths) > _MOST_RECORDS:
        warnings.append(f"{len(paths)} run records; the first {_MOST_RECORDS} are read")
    return sorted(found, key=lambda each: (each.finished or datetime.min.replace(tzinfo=UTC), each.name)), warnings


def _folders(folder: Path) -> list[Path]:
    """Return the folders in a folder; links lead elsewhere."""
    try:
        return [each for each in folder.iterdir() if not each.is_symlink() and each.is_dir()]
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror})") from None


def _json_of(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file that is no link, pipe or device."""
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is no plain file")
    return json_object(read_text(path, _MAX_BYTES), str(path))


def _read(path: Path, folder: Path) -> RunRecord:
    values = _json_of(path)
    if not {"file", "key", "versions"} <= values.keys():
        raise InputError(f"{path}: is no run record of photoplan")
    entry = build(_Entry, values, str(path))
    product = entry.product
    kind = entry.kind or ("mosaic" if "images" in product else "orthophoto" if "image" in product else "product")
    poses = {}
    images = (entry.project or {}).get("images")
    for each in images if isinstance(images, list) else []:
        if isinstance(each, dict) and isinstance(each.get("name"), str):
            poses[each["name"]] = each.get("center"), each.get("angles")
    finished = entry.run.finished
    try:
        finished = finished and finished.replace(tzinfo=finished.tzinfo or UTC).astimezone(UTC)
    except (OverflowError, ValueError):  # a year that UTC does not have
        finished = None
    shown = Path(entry.file).name if Path(entry.file).name == entry.file else path.name.removesuffix(".run.json")
    name = _text(relative_path(path.parent / shown, folder))
    return RunRecord(
        path=path,
        name=name,
        kind=_text(kind),
        finished=finished,
        product=product,
        settings=entry.settings or {},
        poses=poses,
        inputs=entry.inputs,
    )


def _judged(
    records: Sequence[RunRecord], project: Project, file: Path, folder: Path, inputs: set[Path]
) -> list[RunRecord]:
    """Return the records with what has changed since."""
    digests: dict[Path, str | None] = {}

    def digest(path: Path) -> str | None:
        if path not in digests:
            try:
                digests[path] = fingerprint(path).digest
            except PhotoplanError:
                digests[path] = None
        return digests[path]

    def changes(record: RunRecord) -> Iterator[str]:
        changed: list[str] = []
        for each in record.inputs:
            try:
                path = (record.path.parent / each.path).resolve()
                # The project file is changed by each step that enters its results.
                if path == file or not (path in inputs or path.is_relative_to(folder)):
                    continue
                if not path.is_file():
                    changed.append(f"{path.name} is missing")
                elif path.stat().st_size != each.size or digest(path) != each.sampled_sha256:
                    changed.append(f"{path.name} has changed")
            except (OSError, ValueError, RuntimeError):
                continue
        yield from map(_text, changed[:3])
        if len(changed) > 3:
            yield f"{len(changed) - 3} more inputs have changed or are missing"
        moved = [name for name, pose in record.poses.items() if name in now and _plain(now[name]) != _plain(pose)]
        if moved:
            yield f"the orientation of {_counted(len(moved), 'image')} has changed"
        elif not record.poses and record.kind in _AFTER and record.finished and any(record.finished < t for t in steps):
            yield f"images were oriented again on {max(steps):%Y-%m-%d %H:%M} UTC"
        if record.path.name.endswith(f"{Path(record.name).stem}.run.json") and not _there(record, folder):
            yield "its product is missing"

    now = {image.name: (getattr(image, "center", None), getattr(image, "angles", None)) for image in project.images}
    steps = [each.finished for each in records if each.kind in ("adjust", "resect") and each.finished is not None]
    steps = steps[-1:]
    return [replace(record, old=tuple(changes(record))) for record in records]


#: Kinds whose results depend on orientations and whose records do not state these.
_AFTER = ("control", "balance", "seams", "surface")


def _there(record: RunRecord, folder: Path) -> bool:
    try:
        return (folder / record.name).exists()
    except (OSError, ValueError):
        return False


def _plain(pose: tuple[Any, Any]) -> list[Any]:
    return [list(part) if isinstance(part, list | tuple) else part for part in pose]


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" + ("" if count == 1 else "s")


def _text(value: object) -> str:
    """Return a foreign text in one line, cut."""
    text = " ".join(str(value).split())
    return text if len(text) <= _LETTERS else text[: _LETTERS - 1] + "…"


def _number(value: Any) -> float:
    """Return a foreign number; NaN if it is none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan


def _at(values: Any, place: str) -> Any:
    """Return the value at a place such as ``pairs.tried``; None if there is none."""
    for part in place.split("."):
        if isinstance(values, Mapping):
            values = values.get(part)
        elif isinstance(values, list) and part.isdigit() and int(part) < len(values):
            values = values[int(part)]
        else:
            return None
    return values


def _notes(product: Mapping[str, Any]) -> list[str]:
    """Return notes and advice of a record."""
    found = [product.get("advice"), *(n if isinstance(n := product.get("notes"), list) else [n])]
    return [_text(each) for each in found if isinstance(each, str) and each.strip()][:_NOTES]


def _figures(record: RunRecord, values: Mapping[str, Any], at: str = "") -> list[Estimate]:
    """Return the figures of a record: those that are known by its kind, else all that are numbers with a name."""
    if record.kind in _KNOWN:
        return [
            Estimate(place.replace(".", "_"), _number(_at(values, place)), label=label, unit=unit, at=at)
            for place, label, unit in _KNOWN[record.kind]
            if math.isfinite(_number(_at(values, place)))
        ]
    listed = values.get("figures")
    if isinstance(listed, list):
        return [
            Estimate(
                name=_text(each.get("name", "")),
                value=_number(each.get("value")),
                sigma=_number(each.get("sigma")),
                label=_text(each.get("label") or each.get("name", "")),
                unit=_text(each.get("unit") or ""),
                plane=_text(each.get("plane") or ""),
                at=" ".join(filter(None, [at, _text(each.get("at") or "")])),
            )
            for each in listed[:_FIGURES]
            if isinstance(each, dict)
        ]
    return [
        Estimate(
            name=_text(name),
            value=_number(value),
            sigma=_number(_at(values, f"sigma_{name}")),
            label=_text(_words(name)),
            unit=_unit(name),
            at=at,
        )
        for name, value in values.items()
        if math.isfinite(_number(value)) and not name.startswith("sigma_")
    ][:_FIGURES]


def _words(name: str) -> str:
    last = name.rpartition("_")[2]
    return (name.removesuffix(f"_{last}") if last in _UNITS and last != name else name).replace("_", " ")


def _unit(name: str) -> str:
    return _UNITS.get(name.rpartition("_")[2].lower(), "")


def _listed(title: str, records: Sequence[RunRecord]) -> Findings:
    """Return the figures of records, each under its name, and a table of them."""
    if not records:
        return Findings(title=title)
    several = len(records) > 1
    figures = [f for each in records for f in _figures(each, each.product, each.name if several else "")]
    return Findings(tuple(figures[:MOST_ROWS]), tables={_key(title): _overview(records)}, title=title)


def _key(title: str) -> str:
    return re.sub(r"\W+", "_", title.lower())


def _overview(records: Sequence[RunRecord]) -> Table:
    rows = tuple((each.name, each.kind, each.when, _state(each)) for each in records[:MOST_ROWS])
    return Table(
        ("result", "kind", "finished", "state"),
        rows,
        _first("Results and their run records", len(records)),
        printed=True,
    )


def _first(caption: str, count: int) -> str:
    """Return the caption of a table that has so many rows, but for those beyond the most."""
    return f"{caption}." if count <= MOST_ROWS else f"{caption}: the first {MOST_ROWS} of {count}."


def _state(record: RunRecord) -> str:
    return f"old: {record.old[0]}" if record.old else "as the project is"


def _images(project: Project, check: bool, warnings: list[str], missing: dict[str, str]) -> Findings:
    """Return the images and cameras of a project, and what its check finds."""
    names = [image.name for image in project.images]
    oriented = [name for name in names if project.any_image(name).unoriented is None]
    figures = [
        Estimate("images", len(names), label="images"),
        Estimate("oriented", len(oriented), label="images with orientation"),
        Estimate("cameras", len(project.cameras), label="cameras"),
    ]
    rows: tuple[tuple[str | float, ...], ...] = ()
    notes = [f"CRS: {crs_label(project.crs)}"]
    if len(oriented) < len(names):
        missing["orientation"] = f"{_counted(len(names) - len(oriented), 'image')} of {len(names)} have none"
    try:
        found: ProjectCheck | None = check_project(project) if check and oriented else None
    except PhotoplanError as error:
        found = None
        missing["check"] = _text(error)
    if found is not None:
        sizes = [each.gsd for each in found.images if math.isfinite(each.gsd)]
        figures += known(
            Estimate("sensible_resolution_m", found.sensible_resolution, label="sensible resolution", unit="m"),
            Estimate("smallest_gsd_m", min(sizes, default=math.nan), label="smallest mean GSD", unit="m"),
            Estimate("largest_gsd_m", max(sizes, default=math.nan), label="largest mean GSD", unit="m"),
        )
        notes += [*found.advice]
        warnings += [_text(f"check: {each}") for each in (*found.implausible, *found.unusable.values())]
        rows = tuple(
            (each.image, each.tilt_deg, each.gsd, 100 * each.on_terrain, each.relief_px, each.fault or "")
            for each in found.images[:MOST_ROWS]
        )
    head = ("image", "tilt °", "GSD m", "on terrain %", "1 m of height px", "fault")
    tables = (
        {"images": Table(head, rows, _first("Images as the check of the project finds them", len(names)))}
        if rows
        else {}
    )
    return Findings(tuple(figures), tables=tables, notes=tuple(notes), title="Images and cameras")


def _adjustment(records: Sequence[RunRecord], warnings: list[str]) -> Findings:
    """Return the last adjustment, with the figures of its report."""
    if not records:
        return Findings(title="Adjustment")
    last = records[-1]
    values = _report_of(last, warnings)
    figures = _figures(last, values)
    redundancy, sigma0 = _number(values.get("redundancy")), _number(values.get("sigma0"))
    if redundancy > 0:
        figures = [replace(f, sigma=sigma0 / math.sqrt(2 * redundancy)) if f.name == "sigma0" else f for f in figures]
    gross = values.get("gross_errors")
    count = len(gross) if isinstance(gross, list) else _number(values.get("rejected"))
    figures += known(Estimate("gross_errors", count, label="gross errors"))
    groups = _members(values.get("groups"))
    rows = tuple(
        (
            _text(each.get("name", "")),
            _number(each.get("count")),
            _number(each.get("redundancy")),
            _number(each.get("rms")),
            _text(each.get("unit", "")),
            _number(each.get("found_to_stated")),
        )
        for each in groups[:MOST_ROWS]
    )
    tables = {"adjustments": _overview(records)}
    if rows:
        head = ("observations", "number", "redundancy", "residuals", "unit", "found ÷ stated")
        tables["groups"] = Table(head, rows, "Groups of observations; found ÷ stated is the root of the variance "
                                 "factor.")  # fmt: skip
    return Findings(tuple(figures), tables=tables, title="Adjustment")


def _members(values: Any) -> list[dict[str, Any]]:
    return [each for each in values if isinstance(each, dict)] if isinstance(values, list) else []


def _report_of(record: RunRecord, warnings: list[str]) -> Mapping[str, Any]:
    """Return the report that an adjustment left beside its record, or what the record itself states."""
    path = record.path.with_name("report.json")
    if not path.exists():
        return record.product
    try:
        return {**record.product, **_json_of(path)}
    except InputError as error:
        warnings.append(f"{Path(record.name).parent.as_posix()}/report.json: is left out: {_fault(error, path)}")
        return record.product


def _fault(error: Exception, path: Path) -> str:
    """Return a message on a file without its folder, which is not for those who get the report."""
    return _text(str(error).replace(f"{path}: ", "").replace(str(path), path.name))


def _products(records: Sequence[RunRecord]) -> Findings:
    """Return orthophotos, mosaics and other rasters in a table, with what all of them state together."""
    if not records:
        return Findings(title="Products")
    rows: list[tuple[str | float, ...]] = []
    for each in records[:MOST_ROWS]:
        p = each.product
        share = 100 * _number(p.get("valid_share"))
        resolution = _number(each.settings.get("resolution"))
        rows.append((each.name, each.kind, resolution, share, _number(p.get("worst_anchor_residual_px")),
                     _number(p.get("accuracy_m")), each.when, _state(each)))  # fmt: skip
    shown = [tuple("" if isinstance(v, float) and math.isnan(v) else v for v in row) for row in rows]
    head = ("product", "kind", "pixel m", "filled %", "approximation px", "accuracy m", "finished", "state")
    worst = max((v for row in rows if isinstance(v := row[4], float) and math.isfinite(v)), default=math.nan)
    gaps = [(each.name, _number(each.product.get("outside_m2"))) for each in records if each.kind == "mosaic"]
    figures = [
        Estimate("products", len(records), label="products"),
        Estimate("old_products", sum(bool(each.old) for each in records), label="of these old"),
        *known(Estimate("worst_anchor_residual_px", worst, label="largest approximation error", unit="px")),
        *known(*(Estimate("outside_m2", v, label="area in no image", unit="m²", at=name) for name, v in gaps)),
    ]
    return Findings(
        tuple(figures),
        tables={"products": Table(head, tuple(shown), _first("Products", len(records)))},
        title="Products",
    )


def _accuracy(request: ReportRequest, adjustments: Sequence[RunRecord], missing: dict[str, str]) -> Findings:
    """Return what check points show, and the error budget of the project."""
    figures: list[Estimate] = []
    if adjustments:
        check = _report_of(adjustments[-1], []).get("check_accuracy")
        for key, label in (("RMSE_H", "horizontal"), ("RMSE_V", "height"), ("RMSE_3D", "in space")):
            value = _number(_at(check, key))
            figures += known(Estimate(f"check_{key}", value, label=f"check points, {label}", unit="m"))
    if not figures:
        missing["check points"] = "no adjustment has any: accuracy is only what the adjustment and the budget expect"
    try:
        budget = budget_or_tables(BudgetRequest(project=request.project)) if request.checked else None
    except PhotoplanError as error:
        budget, missing["error budget"] = None, _text(error)
    if not isinstance(budget, Budget):
        return Findings(tuple(figures), title="Accuracy")
    one = budget.typical
    figures += [
        Estimate(f"budget_{place}_m", float(value), label=f"standard deviation of position, {place}", unit="m",
                 remark=f"budget of {one.image}")
        for place, value in zip(PLACES, one.total)
    ]  # fmt: skip
    bars = {name: float(values[-1]) for name, values in one.parts.items()} | {"total": float(one.total[-1])}
    caption = f"Contributions to the standard deviation of position in the corner of {one.image}, the typical image."
    plots = (Bars("Error budget", caption, bars, "standard deviation m"),) if max(bars.values()) > 0 else ()
    return Findings(tuple(figures), plots=plots, notes=tuple(map(_text, budget.notes)), title="Accuracy")
