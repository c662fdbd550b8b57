"""Error budgets: causes, tables of the sources, and polynomials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, on_level
from photoplan.cameras.rpc import fit_rpc
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.grid import MapGrid
from photoplan.geometry.local import GeodeticGround
from photoplan.io.camera.satellite import rpc_text
from photoplan.io.disk import make_parents
from photoplan.io.files import unique_stems
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project, parse_project
from photoplan.io.project.model import Image, Project
from photoplan.io.store import recording, write_atomically
from photoplan.kernels.weights import KERNELS
from photoplan.plain import pick
from photoplan.plan.accuracy import (
    FILM_CORNER,
    SourceErrors,
    admissible_height_error,
    admissible_shift,
    displacement_by_height,
    displacement_by_kappa,
    displacement_by_tilt,
    figures_at,
    in_image,
    orientation_effect,
    resampling_sigma,
)
from photoplan.plan.footprint import footprint
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.error_model import height_errors, known_height_errors, source_errors
from photoplan.project.ground import Ground, ground_of
from photoplan.project.scene import input_files
from photoplan.requests.orient import ConvertRequest
from photoplan.requests.project import BudgetRequest
from photoplan.surfaces.hybrid import HeightErrors, StatedHeightErrors
from photoplan.targets.map import MapTarget

_GON = pi / 200
#: Flying heights and height errors of table 4.3, metres.
_HEIGHTS, _ERRORS = (750.0, 1500.0, 3750.0, 7500.0), (1.0, 5.0, 10.0, 25.0, 100.0)
#: The worked example: 0.1 mm at 1 : 5000 from images 1 : 10 000 with c = 150 mm, at the tangent 0.733 along each axis.
_PRODUCT, _MAP, _SCALE, _C, _W = 1e-4, 5000.0, 10_000.0, 0.150, 0.733
#: Standard deviations of the two images of §8.2.2: X0, Y0, Z0 (metres), ω, φ, κ (gon); c, flying height, scale number.
_IMAGES = {
    "5162": ((0.14, 0.16, 0.05), (0.0095, 0.0082, 0.0032)),
    "5164": ((0.24, 0.32, 0.19), (0.0227, 0.0134, 0.0063)),
}
_FLIGHT = (0.15324, 900.0, 6000.0)


@dataclass(frozen=True)
class SourceTables(Result):
    """Tables and examples that the source prints."""

    heights: tuple[tuple[float, ...], ...]
    """Table 4.3: radial displacement in the image corner, mm, by flying height and height error."""
    shift: float
    """Admissible error of X0, Y0 in the worked example of §4.8.2.1, metres."""
    height: float
    """Admissible error of Z0, metres."""
    tilt: float
    """Admissible error of ω and φ in the worked example of §4.8.2.2, gon."""
    kappa: float
    """Standard deviation of κ, gon."""
    images: dict[str, tuple[float, ...]]
    """§8.2.2: displacement in the image corner by X0, Y0, Z0, ω, φ, κ of two images, µm."""

    def json_fields(self) -> dict[str, Any]:
        """All figures with their units."""
        names = ("X0", "Y0", "Z0", "omega", "phi", "kappa")
        return {
            "table_4_3_mm": {
                f"{h:g} m": dict(zip(map("{:g} m".format, _ERRORS), row)) for h, row in zip(_HEIGHTS, self.heights)
            },
            "admissible": {
                "X0_Y0_m": self.shift,
                "Z0_m": self.height,
                "omega_phi_gon": self.tilt,
                "kappa_gon": self.kappa,
            },
            "orientation_8_2_2_um": {image: dict(zip(names, row)) for image, row in self.images.items()},
        }

    def summary(self) -> Sequence[str]:
        """Return the tables."""
        lines = ["Ecker 1991, table 4.3: radial displacement in the corner (r = 140 mm) by a height error, mm"]
        lines.append("  flying height" + "".join(f"{e:>7g} m" for e in _ERRORS))
        lines += [f"  {h:>11g} m" + "".join(f"{v:>9.1f}" for v in row) for h, row in zip(_HEIGHTS, self.heights)]
        lines += [
            "Ecker 1991, §4.8.2: admissible for 0.1 mm at 1 : 5000 in the corner, image 1 : 10 000, c = 150 mm",
            f"  X0, Y0   {self.shift:.2f} m",
            f"  Z0       {self.height:.2f} m",
            f"  ω, φ     {self.tilt:.3f} gon",
            f"  κ        {self.kappa:.3f} gon",
            "Ecker 1991, §8.2.2: displacement in the corner by the orientation's standard deviations, µm",
            "  image        X0     Y0     Z0      ω      φ      κ",
        ]
        return [*lines, *(f"  {name:<7}" + "".join(f"{v:>7.0f}" for v in row) for name, row in self.images.items())]


def source_tables() -> SourceTables:
    """Compute the tables and examples from the formulas of `photoplan.plan.accuracy`."""
    in_image = _PRODUCT * _MAP / _SCALE
    c, height, scale = _FLIGHT
    images = {}
    for name, (center, angles) in _IMAGES.items():
        omega, phi, kappa = (a * _GON for a in angles)
        effect = orientation_effect(center, (omega, phi, kappa), c, height, scale_number=scale, w=_W)
        images[name] = tuple(v * 1e6 for v in astuple(effect))
    return SourceTables(
        heights=tuple(
            tuple((displacement_by_height(FILM_CORNER, h, np.array(_ERRORS)) * 1000).tolist()) for h in _HEIGHTS
        ),
        shift=float(admissible_shift(in_image, _SCALE)),
        height=float(admissible_height_error(FILM_CORNER, _C * _SCALE, in_image)),
        tilt=float(in_image / displacement_by_tilt(_GON, _C, _W)),
        kappa=float(in_image / displacement_by_kappa(_GON, _C, _W)),
        images=images,
    )


#: Heights are taken further than those of the terrain, by this part of their range or of the distance from the camera.
_ROOM, _OF_DISTANCE = 0.1, 0.02


@dataclass(frozen=True)
class ImagePolynomials:
    """Residuals of the polynomials of an image, between the places of the fit."""

    image: str
    file: Path
    rms: tuple[float, float]
    """Root mean squares of column and row, pixels."""
    worst: float
    """Pixels."""
    heights: tuple[float, float]
    """For which they were fitted, in the ground's height system, metres."""


@dataclass(frozen=True)
class PolynomialsReport(Result):
    """Polynomials of the images of a project."""

    images: tuple[ImagePolynomials, ...]
    dry_run: bool

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that were written."""
        return tuple(each.file for each in self.images)

    def json_fields(self) -> dict[str, Any]:
        """Files, and the figures of each image."""
        return pick(self, "files", "images")

    def written(self) -> Sequence[Path]:
        """Return the files that were, or would be, written."""
        return self.files

    def messages(self) -> Sequence[str]:
        """Return how well the polynomials fit."""
        lines = [
            f"  {each.image}: off by at most {each.worst:.2g} px for heights from {each.heights[0]:.0f} to "
            f"{each.heights[1]:.0f} m"
            for each in self.images
        ]
        return [*lines, "  nothing is written"] if self.dry_run else lines


def write_polynomials(request: ConvertRequest) -> PolynomialsReport:
    """Fit polynomials to all images of a project over the heights that they see, and write ``IMAGE_RPC.TXT``.

    Raises
    ------
    UsageError
        A file exists.
    InputError
        The project cannot be used, or an image has no geometry yet.
    GeometryError
        An image sees no terrain, or does not look down.
    """
    project = load_project(request.orientation)
    folder = request.output or project.folder
    stems = unique_stems(image.file for image in project.images)
    outputs = {image.name: folder / f"{stems[image.file]}_RPC.TXT" for image in project.images}
    inputs = [request.orientation, *input_files(project)]
    for path in outputs.values():
        check_output(path, inputs, overwrite=request.overwrite)
    with recording("convert", request, inputs) as record:
        fitted = [_fit(project, name, path) for name, path in outputs.items()]
        report = PolynomialsReport(tuple(image for image, _, _ in fitted), request.dry_run)
        if request.dry_run:
            return report
        try:
            make_parents(folder)
        except OSError as error:
            raise InputError(f"{folder}: the folder cannot be made ({error.strerror or error})") from None
        for _, path, text in fitted:
            write_atomically(path, text.encode())
        record(report.files, report)
    return report


def _fit(project: Project, name: str, path: Path) -> tuple[ImagePolynomials, Path, str]:
    ground = ground_of(project)
    camera = camera_without_pixels(project, name)
    seen = footprint(camera, ground.bare, ground.bounds)
    if seen.bounds is None:
        raise GeometryError(f"image {name!r} sees nothing of the terrain; `photoplan check` reports where it looks")
    heights = _heights(camera, seen.height_range)
    try:
        found = fit_rpc(camera, GeodeticGround(project.crs, ground.working_system), heights)
    except GeometryError as error:
        raise GeometryError(f"image {name!r}: {error}") from None
    return (
        ImagePolynomials(image=name, file=path, rms=found.rms, worst=found.worst, heights=heights),
        path,
        rpc_text(found.functions),
    )


def _heights(camera: Camera, seen: tuple[float, float]) -> tuple[float, float]:
    """Return the heights of the fit: those that are seen, with a margin."""
    (low, high), top = seen, float(camera.vantage.point[2])
    room = max(_ROOM * (high - low), _OF_DISTANCE * (top - low))
    return max(low - room, camera.vantage.floor), min(high + room, (high + top) / 2)


#: Places of an image for which a budget is made.
PLACES = ("middle", "edge", "corner")
#: What is not an error of the project, but of making the product.
TERRAIN, RESAMPLING, ANCHORS = "terrain", "resampling", "anchors"
ORIENTATION, _USUAL = "orientation", "usual"
#: Errors whose cost is reported where nothing is stated: of heights and centres, metres, and of angles, in their unit.
_USUAL_HEIGHT, _USUAL_CENTER, _USUAL_ANGLE = 0.1, 0.1, 0.01
#: A vertical image that is stated by numbers lies here; the system does not matter.
_CRS, _STATION = "EPSG:32633", (500_000.0, 5_000_000.0)
#: Sides of the map of an image.
_MAP_BUDGET = 41


@dataclass(frozen=True, eq=False)
class ImageBudget:
    """Standard deviations of position √(σ_X² + σ_Y²) on level ground that an image gives, metres."""

    image: str
    gsd: float
    """Side of an image pixel on the ground in the middle, metres."""
    parts: dict[str, NDArray[np.float64]]
    """Contribution of every cause at `PLACES`."""
    total: NDArray[np.float64]
    """Total of all causes, at `PLACES`."""
    map: NDArray[np.float64]
    """The total over the image, rows downwards."""

    @property
    def limits(self) -> tuple[tuple[str, float], ...]:
        """At each place the largest contribution and its share of the variance."""
        names, values = list(self.parts), np.array(list(self.parts.values()))
        largest = values.argmax(axis=0)
        shares = (values.max(axis=0) / np.maximum(self.total, 1e-300)) ** 2
        return tuple((names[k], float(share)) for k, share in zip(largest, shares))

    def json_fields(self) -> dict[str, Any]:
        """Figures in metres, by cause and place."""
        return {
            "image": self.image,
            "gsd_m": self.gsd,
            "contributions_m": {name: dict(zip(PLACES, values.tolist())) for name, values in self.parts.items()},
            "total_m": dict(zip(PLACES, self.total.tolist())),
            "limited_by": {place: {"cause": n, "share": s} for place, (n, s) in zip(PLACES, self.limits)},
        }


@dataclass(frozen=True, eq=False)
class Budget(Result):
    """Budgets of images, and what stands for all of them."""

    images: tuple[ImageBudget, ...]
    notes: tuple[str, ...]

    @property
    def typical(self) -> ImageBudget:
        """The image with the median error in the corner."""
        order = np.argsort([image.total[-1] for image in self.images])
        return self.images[int(order[(len(order) - 1) // 2])]

    @property
    def worst(self) -> ImageBudget:
        """The image with the largest error in the corner."""
        return max(self.images, key=lambda image: float(image.total[-1]))

    def json_fields(self) -> dict[str, Any]:
        """All images."""
        return {"images": self.images, "typical": self.typical.image, "worst": self.worst.image, "notes": self.notes}

    def summary(self) -> Sequence[str]:
        """Return the budgets of the typical and of the worst image."""
        shown = [self.typical] if len(self.images) == 1 else [self.typical, self.worst]
        heads = [
            f"{len(self.images)} images; the typical one, {self.typical.image}",
            f"the worst one, {self.worst.image}",
        ]
        lines = []
        for head, image in zip(heads if len(self.images) > 1 else [self.typical.image], shown):
            lines += [f"{head} · GSD {image.gsd:.3g} m", *_table(image)]
        return lines

    def messages(self) -> Sequence[str]:
        """Return the notes."""
        return noted(self.notes)


def _table(image: ImageBudget) -> list[str]:
    wide = max(22, *(len(name) for name in image.parts))
    lines = [f"  {'standard deviation, m':<{wide}}" + "".join(f"{place:>10}" for place in PLACES)]
    for name, values in {**image.parts, "total": image.total}.items():
        lines.append(f"  {name:<{wide}}" + "".join(f"{v:>10.3f}" for v in values))
    lines.append(f"  {'total in image pixels':<{wide}}" + "".join(f"{v / image.gsd:>10.2f}" for v in image.total))
    limits = (f"{place}: {name} ({share:.0%})" for place, (name, share) in zip(PLACES, image.limits))
    return [*lines, "  limited by  " + " · ".join(limits)]


def budget_or_tables(request: BudgetRequest, events: Events = SILENT) -> Result:
    """Return the tables of the source if they are asked for, else the budget."""
    return source_tables() if request.tables else make_budget(request)


def make_budget(request: BudgetRequest) -> Budget:
    """Compute the error budget of every image of a project, or of a vertical image that numbers state.

    What a project does not state counts as free of error. Notes say so, how to state it, and what
    a usual error costs.

    Raises
    ------
    InputError
        Nothing is known of the errors of an image that is no central photograph.
    GeometryError
        An image does not look down on its ground.
    """
    if request.kernel not in KERNELS:
        raise UsageError(f"kernel {request.kernel!r}; allowed are {', '.join(KERNELS)}")
    project = _of_numbers(request) if request.project is None else load_project(request.project)
    project, notes = _stated(project, request)
    names, left_out = project.oriented(project.select(request.images or None))
    notes += [f"left out: {line}" for line in left_out]
    project, unknown = _completed(project, names)
    ground = ground_of(project)
    heights = height_errors(project)
    if heights == StatedHeightErrors(0.0) and TERRAIN not in unknown:
        notes.append("the terrain counts as free of error")
    budgets = tuple(_of_image(project, name, ground, heights, request) for name in names)
    posed = [image for image in map(project.any_image, names) if isinstance(image, Image)]
    if any(image.correlation is None for image in posed):
        notes.append("position and angles count as independent: no correlation is stated")
    found = Budget(budgets, tuple(notes))
    if not unknown:
        return found
    usual = _of_image(unknown[_USUAL], found.typical.image, ground, StatedHeightErrors(_USUAL_HEIGHT), request)
    return replace(found, notes=(*_of_unknown(unknown, usual, project), *notes))


def _completed(project: Project, names: Sequence[str]) -> tuple[Project, dict[str, Any]]:
    """Return the project with zeros for unstated errors; also their names, and it with usual errors instead."""
    unknown: dict[str, Any] = {}
    usual = project
    if known_height_errors(project) is None:
        unknown[TERRAIN] = True
        project = project.model_copy(update={"terrain": project.ground.model_copy(update={"sigma": 0.0})})
    lacking = {
        image.name
        for image in map(project.any_image, names)
        if isinstance(image, Image) and (image.sigma_center is None or image.sigma_angles is None)
    }
    if lacking:
        unknown[ORIENTATION] = len(lacking)

        def with_sigmas(of: Project, center: float, angle: float) -> Project:
            sigmas = {"sigma_center": (center,) * 3, "sigma_angles": (angle,) * 3, "correlation": None}
            images = [i.model_copy(update=sigmas) if i.name in lacking else i for i in of.images]
            return of.model_copy(update={"images": tuple(images)})

        usual = with_sigmas(usual, _USUAL_CENTER, _USUAL_ANGLE)
        project = with_sigmas(project, 0.0, 0.0)
    return project, {**unknown, _USUAL: usual} if unknown else {}


def _of_unknown(unknown: dict[str, Any], usual: ImageBudget, project: Project) -> list[str]:
    """Return notes on errors that are not stated: the total lacks them, what usual ones cost, how to state them."""
    notes = ["the total holds only what is stated"]
    middle, _, corner = usual.parts.get(TERRAIN, np.zeros(3))
    if TERRAIN in unknown:
        notes.append(
            f"terrain: not stated; {_USUAL_HEIGHT:g} m of height cost {middle:.3f} m in the middle, {corner:.3f} m in "
            "the corner. Give `sigma_terrain` METRES, or state sigma in [terrain]"
        )
    if ORIENTATION in unknown:
        parts = [v for name, v in usual.parts.items() if name not in (TERRAIN, RESAMPLING, ANCHORS)]
        middle, _, corner = np.sqrt(np.square(parts).sum(axis=0))
        unit = project.orientation.angle_unit
        notes.append(
            f"orientation: not stated of {unknown[ORIENTATION]} images; {_USUAL_CENTER:g} m of position and "
            f"{_USUAL_ANGLE:g} {unit} of angles cost {middle:.3f} m in the middle, {corner:.3f} m in the corner. Give "
            "`sigma_center` X Y Z and `sigma_angles` A B C; `photoplan adjust` and `resect` write them into the images"
        )
    return notes


def _of_numbers(request: BudgetRequest) -> Project:
    """Return a project of one vertical image over level ground."""
    side = request.pixel / 1000
    size = [max(1, round(mm / side)) for mm in request.format]
    assert request.height is not None
    return parse_project(
        {
            "format": 1,
            "crs": _CRS,
            "terrain": {"height": 0.0, "height_system": "same"},
            "orientation": {"height_system": "ellipsoidal", "angle_unit": request.angle_unit},
            "cameras": {
                "camera": {
                    "type": "frame",
                    "size": size,
                    "camera_constant_mm": float(request.camera_constant or 0.0),
                    "pixel_size_um": request.pixel,
                }
            },
            "images": [
                {
                    "name": "vertical image",
                    "file": "none.tif",
                    "camera": "camera",
                    "center": [*_STATION, float(request.height)],
                    "angles": [0.0, 0.0, 0.0],
                    "sigma_center": [0.0, 0.0, 0.0],
                    "sigma_angles": [0.0, 0.0, 0.0],
                }
            ],
        },
        Path.cwd(),
        "numbers",
    )


def _stated(project: Project, request: BudgetRequest) -> tuple[Project, list[str]]:
    """Return the project with the accuracies of the request; orientations then are not correlated."""
    given = {"sigma_center": request.sigma_center, "sigma_angles": request.sigma_angles}
    given = {name: value for name, value in given.items() if value is not None}
    notes = []
    if given:
        images = tuple(
            i.model_copy(update={**given, "correlation": None}) if isinstance(i, Image) else i for i in project.images
        )
        project = project.model_copy(update={"images": images})
    terrain = request.sigma_terrain
    if terrain is None and request.project is None:
        terrain = 0.0
    if request.project is None and len(given) < 2:
        missing = [name for name in ("sigma_center", "sigma_angles") if name not in given]
        notes.append("free of error, as nothing is stated: " + ", ".join(f"`{name}`" for name in missing))
    if terrain is not None:
        project = project.model_copy(update={"terrain": project.ground.model_copy(update={"sigma": terrain})})
    return project, notes


def _of_image(
    project: Project, name: str, ground: Ground, heights: HeightErrors, request: BudgetRequest
) -> ImageBudget:
    camera = camera_without_pixels(project, name)
    whole = source_errors(project, project.any_image(name), ground, camera, in_image(request.kernel, request.tolerance))
    w, h = camera.size
    level = _level(camera, ground, name)
    far = [(w - 1) / 2, (h - 1) / 2]
    edges = [(0.0, far[1]), (w - 1.0, far[1]), (far[0], 0.0), (far[0], h - 1.0)]
    corners = [(x, y) for x in (0.0, w - 1.0) for y in (0.0, h - 1.0)]
    xy = np.array([tuple(far), *edges, *corners])
    columns, rows = np.meshgrid(np.linspace(0, w - 1, _MAP_BUDGET), np.linspace(0, h - 1, _MAP_BUDGET))
    every = np.concatenate([xy, np.stack([columns.ravel(), rows.ravel()], axis=1)])
    XY = on_level(camera, every, level)[:, :2]
    sigma = heights.sigmas(XY)
    sigma = np.where(np.isfinite(sigma), sigma, np.nanmedian(sigma) if np.isfinite(sigma).any() else np.nan)
    parts: dict[str, NDArray[np.float64]] = {}
    none = replace(whole, causes=(), image=0.0)
    by_name: dict[str, SourceErrors] = {}
    for cause in whole.causes:
        before = by_name.get(cause.name, none)
        by_name[cause.name] = replace(before, causes=(*before.causes, cause))
    by_name[RESAMPLING] = replace(none, image=resampling_sigma(request.kernel))
    by_name[ANCHORS] = replace(none, image=in_image("", request.tolerance))
    runs, _ = _level_figures(none, XY, level)
    parts[TERRAIN] = np.hypot(*runs.T) * sigma
    for cause_name, errors in by_name.items():
        parts[cause_name] = _level_figures(errors, XY, level)[1]
    total = np.sqrt(sum(np.square(values) for values in parts.values()))
    total = np.asarray(total, float)
    if not np.isfinite(total[:9]).all():
        raise GeometryError(
            f"image {name!r}: does not look down on the ground everywhere; a budget is for such that do"
        )
    # The worst edge and the worst corner by the total.
    at = [0, 1 + int(total[1:5].argmax()), 5 + int(total[5:9].argmax())]
    middle = _level_figures(replace(none, image=np.sqrt(0.5)), XY[:1], level)[1]
    kept = {cause: values[at] for cause, values in parts.items() if values[at].any()}
    return ImageBudget(
        image=name, gsd=float(middle[0]), parts=kept, total=total[at], map=total[9:].reshape(_MAP_BUDGET, _MAP_BUDGET)
    )


def _level(camera: Camera, ground: Ground, name: str) -> float:
    """Return the height of the ground below an image."""
    height = float(ground.bare.heights(camera.vantage.point[:2]))
    if not np.isfinite(height) and ground.bounds is not None:
        low, high = ground.bare.height_range(np.array(ground.bounds))
        height = float(low + high) / 2
    if not height < camera.vantage.point[2]:
        raise InputError(
            f"image {name!r}: the ground below it is at {height:.0f} m, the camera at {camera.vantage.point[2]:.0f}"
        )
    return height


def _level_figures(
    errors: SourceErrors, XY: NDArray[np.float64], level: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the run of rays per metre of height (n, 2), and errors of position on level ground (n,), metres."""
    grid = MapGrid(
        left=float(np.nanmin(XY[:, 0])), top=float(np.nanmax(XY[:, 1])), resolution=1.0, width=1, height=1, crs=_CRS
    )
    uv = np.stack([XY[:, 0] - grid.left - 0.5, grid.top - 0.5 - XY[:, 1]], axis=1)
    figures = figures_at(errors, MapTarget(grid), np.column_stack([uv, np.full(len(XY), level)]))
    return figures[:, :2], np.sqrt(figures[:, 2] + figures[:, 4])
