"""Control points for a project from orthophotos."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.cameras.base import on_level
from photoplan.cameras.observed import GroundPoints, ImagePoints
from photoplan.engine.run import steps
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import Window
from photoplan.io.points import write_ground_points, write_image_points
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project, StatedTerrain
from photoplan.io.raster import RasterReader
from photoplan.io.store import recording
from photoplan.matching.features import GreyImage
from photoplan.matching.register import (
    ImageControl,
    OrthoPatch,
    Photo,
    Settings,
    best_place,
    control_of_image,
    ground_covariances,
    patch_on,
)
from photoplan.plain import pick
from photoplan.plan.footprint import image_border
from photoplan.project.cameras import central_without_pixels
from photoplan.project.ground import Ground
from photoplan.project.scene import Scene, input_files, open_scene
from photoplan.requests.orient import ControlRequest

#: Cells of the search at most, along each side.
_LARGEST = 600


@dataclass(frozen=True, eq=False)
class Ortho:
    """Orthophotos of one CRS."""

    readers: tuple[RasterReader, ...]

    @property
    def resolution(self) -> float:
        """Side of a pixel of the first one, metres."""
        to_map = self.readers[0].info.to_map
        assert to_map is not None
        return to_map[1]

    def read(
        self, bounds: tuple[float, float, float, float], factor: int
    ) -> tuple[NDArray[np.float32], tuple[float, float], float] | None:
        """Grey values of means of pixels inside map bounds, the map place of the first one's middle, and their side.

        From the first orthophoto that has values there; None if none has.
        """
        xmin, ymin, xmax, ymax = bounds
        for reader in self.readers:
            to_map = reader.info.to_map
            assert to_map is not None
            x0, step, _, y0, _, _ = to_map
            side = factor * step
            left, top = x0 - step / 2, y0 + step / 2
            first = np.array([np.ceil((xmin - left) / side), np.ceil((top - ymax) / side)]).astype(int)
            last = np.array([np.floor((xmax - left) / side), np.floor((top - ymin) / side)]).astype(int)
            low, high = np.maximum(first, 0), np.minimum(last, np.array(reader.size) // factor)
            if (high <= low).any():
                continue
            window = Window(int(low[0]), int(low[1]), *(int(v) for v in high - low))
            values = GreyImage(reader).reduced(window, factor)
            if np.isfinite(values).any():
                return values, (left + (low[0] + 0.5) * side, top - (low[1] + 0.5) * side), side
        return None


def choose_patches(
    ortho: Ortho, scenes: Sequence[Scene], grid: int, radius: int, search: float
) -> tuple[tuple[float, int, int, float], list[OrthoPatch]]:
    """Patches spread over what the images see: one in every square of the map, where its texture is best.

    Places where objects stand are not taken: whether the orthophoto shows them there or beside is not known.
    Squares are the `grid`-th part of a footprint. Patches are of the coarser resolution of orthophoto and photos.
    """
    seen = [_seen(scene) for scene in scenes]
    areas = [s for s in seen if s is not None]
    if not areas:
        raise GeometryError("none of the images looks at the ground; look at heights and orientation")
    gsd = float(np.median([np.sqrt(area.area / np.prod(size)) for area, size in areas]))
    factor = max(1, round(gsd / ortho.resolution))
    resolution = factor * ortho.resolution
    cells = int(np.ceil(search / resolution))
    if cells > _LARGEST:
        raise UsageError(
            f"`search` {search:g} m are {cells} pixels of {resolution:g} m; at most {_LARGEST} are searched; give "
            f"{_LARGEST * resolution:g} m or less, or a coarser orthophoto"
        )
    step = max(float(np.median([np.sqrt(area.area) for area, _ in areas])) / grid, resolution)
    union = shapely.unary_union([area for area, _ in areas])
    settings = (resolution, radius, cells, search)
    return settings, _in_squares(ortho, union, scenes[0].ground, step, resolution, radius, factor)


def _seen(scene: Scene) -> tuple[shapely.Geometry, tuple[int, int]] | None:
    """Footprint on the level of the ground below."""
    camera = scene.camera
    level = float(scene.ground.bare.heights(camera.vantage.point[:2]))
    if not np.isfinite(level):
        level = sum(scene.footprint.height_range) / 2
    if not np.isfinite(level):
        return None
    foot = on_level(camera, image_border(camera.size), level)[:, :2]
    area = shapely.convex_hull(shapely.MultiPoint(foot[np.isfinite(foot).all(axis=1)]))
    if scene.ground.bounds is not None:
        area = area.intersection(shapely.box(*scene.ground.bounds))
    return (area, camera.size) if area.area > 0 else None


def _in_squares(
    ortho: Ortho, union: shapely.Geometry, ground: Ground, step: float, resolution: float, radius: int, factor: int
) -> list[OrthoPatch]:
    xmin, ymin, xmax, ymax = union.bounds
    margin = (radius + 1) * resolution
    found = []
    for y in np.arange(ymin, ymax, step):
        for x in np.arange(xmin, xmax, step):
            if not union.intersects(shapely.box(x, y, x + step, y + step)):
                continue
            part = ortho.read((x - margin, y - margin, x + step + margin, y + step + margin), factor)
            if part is None or min(part[0].shape) <= 2 * radius + 2:
                continue
            values, (left, top), side = part
            v, u = np.indices(values.shape) * side
            values = np.where(ground.is_open(np.stack([left + u, top - v], axis=-1)), values, np.float32(np.nan))
            place = best_place(values, radius, radius)
            if place is None:
                continue
            col, row = place
            patch = values[row - radius : row + radius + 1, col - radius : col + radius + 1].astype(float)
            at = left + col * side, top - row * side
            v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] * side
            made = patch_on(patch, at, ground.bare.heights(np.stack([at[0] + u, at[1] - v], axis=-1)), side)
            if made is not None:
                found.append(made)
    return found


@dataclass(frozen=True)
class ControlReport(Result):
    """What was found."""

    output: Path | None
    """Table of ground points; None after a dry run."""
    image_points: Path | None
    patches: int
    """Patches chosen in the orthophoto."""
    resolution: float
    """In which they were matched, metres."""
    points: int
    images: tuple[ImageControl, ...]
    sigma: tuple[float, float, float]
    """Standard deviations of the ground points: horizontal, height (metres, medians), image (pixels, median)."""

    def json_fields(self) -> dict[str, Any]:
        """Every image with its counts."""
        own = ("output", "image_points", "patches", "resolution", "points")
        of_image = ("tried", "matched", "shift", "rms", "factor", "reasons")
        images = [{**pick(i, *of_image, image="name"), "kept": len(i.points)} for i in self.images]
        return {**pick(self, *own), "sigma": dict(zip(("plane", "height", "image"), self.sigma)), "images": images}

    def summary(self) -> Sequence[str]:
        """Return counts and standard deviations, and a line for each image."""
        if self.output is None:
            return [f"{self.patches} patches at {self.resolution:g} m"]
        plane, height, image = self.sigma
        width = max(5, *(len(i.name) for i in self.images))
        lines = [
            f"{self.points} control points of {self.patches} patches at {self.resolution:g} m; standard deviations "
            f"{plane:.2g} m, height {height:.2g} m, image {image:.2g} px (medians)",
            f"{'image':{width}}  tried found  kept  shift px          residual px",
        ]
        for i in self.images:
            numbers = zip((*i.shift, i.rms), (1, 1, 2))
            x, y, rms = (f"{v:.{digits}f}" if math.isfinite(v) else "–" for v, digits in numbers)
            counts = f"{i.tried:6} {i.matched:5} {len(i.points):5}"
            lines.append(f"{i.name:{width}} {counts}  {x:>7} {y:>7}  {rms:>10}")
        return lines

    def messages(self) -> Sequence[str]:
        """Return the images without control, with the reasons."""
        return [
            f"note: {i.name}: no control ({', '.join(f'{count} {reason}' for reason, count in i.reasons.items())})"
            for i in self.images
            if not len(i.points)
        ]


def propose_control(request: ControlRequest, events: Events = SILENT) -> ControlReport:
    """Match patches of an orthophoto in the photos of a project.

    Raises
    ------
    UsageError
        An output exists, or a number makes no sense.
    InputError
        An input cannot be used, or no image is oriented.
    GeometryError
        Nothing fits.
    """
    project = _with_heights(load_project(request.project), request)
    output, image_output = _check(request, project)
    chosen = project.select(request.images or None)
    names = [image.name for image in project.posed if image.center is not None and image.name in chosen]
    if not names:
        raise InputError(
            f"{request.project}: none of the images has an approximate orientation; give center and angles, or find "
            "some by `photoplan tie` and `photoplan adjust` with observed positions"
        )
    scenes = [open_scene(project, name) for name in names]
    ortho = _open_ortho(request, project)
    sizes, patches = choose_patches(ortho, scenes, request.grid, request.radius, request.search)
    settings = Settings(*sizes, request.correlation)
    cameras = [central_without_pixels(project, name) for name in names]
    photos = [Photo(camera, GreyImage(scene.reader)) for camera, scene in zip(cameras, scenes)]
    if request.dry_run or not patches:
        if not patches:
            raise GeometryError("the orthophoto has no textured place with heights that one of the images could see")
        return ControlReport(
            output=None,
            image_points=None,
            patches=len(patches),
            resolution=settings.resolution,
            points=0,
            images=(),
            sigma=(np.nan,) * 3,
        )
    covariances = ground_covariances(patches, request.ortho_sigma or ortho.resolution, request.height_sigma)
    # Images that take no part are no inputs.
    files = [project.resolve(project.image(name).file) for name in names]
    files += input_files(project.model_copy(update={"images": ()}))

    def work(k: int) -> ImageControl:
        return control_of_image(names[k], photos[k], patches, covariances, settings)

    with recording("control", request, [request.project, *request.ortho, *files, request.heights]) as record:
        events.begin("matching", len(names), "images")
        with steps(output.name, request.workers, events) as run:
            images = list(run(work, range(len(names))))
        ground, points = _tables(patches, covariances, images)
        if not len(points):
            raise GeometryError(_nothing(images))
        write_ground_points(output, ground)
        write_image_points(image_output, points)
        _enter(request.project, output, image_output)
        sigma = (*_medians(ground.sigma[:, [0, 2]]), float(np.median(points.sigma)))
        report = ControlReport(
            output=output,
            image_points=image_output,
            patches=len(patches),
            resolution=settings.resolution,
            points=len(ground),
            images=tuple(images),
            sigma=sigma,
        )
        record([output, image_output, request.project], report)
    return report


def _nothing(images: Sequence[ImageControl]) -> str:
    """Why no point came out."""
    found = sum(i.matched for i in images)
    advice = "give a larger `search`, another `correlation`, or an orthophoto of a similar date"
    if not found:
        reasons = sum((Counter(i.reasons) for i in images), Counter[str]())
        listed = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()) or "none is in an image"
        return f"no patch of the orthophoto was found in an image: {listed}; {advice}"
    tried = sum(i.tried for i in images)
    return f"{found} of {tried} patches were found, but they do not agree on an orientation of any image; {advice}"


def _medians(values: NDArray[np.float64]) -> tuple[float, float]:
    a, b = np.median(values, axis=0)
    return float(a), float(b)


def _with_heights(project: Project, request: ControlRequest) -> Project:
    if request.heights is None:
        return project
    system = request.height_system or (None if project.terrain is None else project.terrain.height_system)
    path = os.fspath(Path(request.heights).resolve())
    return project.model_copy(update={"terrain": StatedTerrain(file=path, height_system=system)})


def _check(request: ControlRequest, project: Project) -> tuple[Path, Path]:
    """Outputs, and everything that can be refused before any work."""
    for what, value, low in (
        ("`grid`", request.grid, 1),
        ("`search`", request.search, 0.0),
        ("`radius`", request.radius, 5),
        ("`height_sigma`", request.height_sigma, 0.0),
    ):
        if not (np.isfinite(value) and value >= low):
            raise UsageError(f"{what} {value:g}; {low:g} or more is needed")
    if not -1 <= request.correlation < 1:
        raise UsageError(f"`correlation` {request.correlation:g}; a number below 1 is needed, such as 0.7")
    if request.ortho_sigma is not None and not request.ortho_sigma > 0:
        raise UsageError(f"`ortho_sigma` {request.ortho_sigma:g}; a positive number of metres is needed")
    output = request.output or request.project.resolve().parent / "control.csv"
    image_output = output.with_name(f"{output.stem}_points{output.suffix or '.csv'}")
    if not request.dry_run:
        inputs = [request.project, *request.ortho]
        # Tables of an older run of this command may be replaced, those of other measurements may not.
        for path, own in ((output, project.observations.control), (image_output, project.observations.image_points)):
            older = [project.resolve(file) for file in own]
            others = [file for file in input_files(project) if file not in older]
            check_output(path, [*inputs, *others], overwrite=request.overwrite)
    return output, image_output


def _open_ortho(request: ControlRequest, project: Project) -> Ortho:
    readers: list[RasterReader] = []
    for path in request.ortho:
        reader = RasterReader(Path(path))
        info = reader.info
        if info.to_map is None or info.crs is None:
            raise InputError(f"{path}: an orthophoto with its place on the map and its CRS is needed")
        if info.contradiction is not None:
            raise InputError(f"{path}: {info.contradiction}")
        if not same_crs(info.crs, project.crs):
            raise InputError(
                f"{path}: in {crs_label(info.crs)}, the project is in {crs_label(project.crs)}; transform it with "
                "gdalwarp -t_srs"
            )
        _, xx, xy, _, yx, yy = info.to_map
        if xy or yx or xx <= 0 or abs(xx + yy) > 1e-6 * xx:
            raise InputError(f"{path}: pixels are not square, or the raster is not north-up; use gdalwarp first")
        if readers and abs(xx / Ortho((readers[0],)).resolution - 1) > 1e-4:
            first = f"{request.ortho[0]} are {Ortho((readers[0],)).resolution:g} m"
            raise InputError(
                f"{path}: pixels of {xx:g} m, those of {first}; orthophotos of one run need "
                "the same: use gdalwarp -tr, or a run for each with an `output` of its own"
            )
        readers.append(reader)
    return Ortho(tuple(readers))


def _tables(
    patches: Sequence[OrthoPatch], covariances: NDArray[np.float64], images: Sequence[ImageControl]
) -> tuple[GroundPoints, ImagePoints]:
    used = np.unique(np.concatenate([np.empty(0, np.int64), *(i.points for i in images)]))
    digits = max(3, len(str(len(patches))))
    names = tuple(f"C{k + 1:0{digits}d}" for k in used)
    XYZ = np.array([patches[k].XYZ for k in used]).reshape(-1, 3)
    C = covariances[used]
    sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2))
    ground = GroundPoints(names=names, XYZ=XYZ, sigma=sigma, check=np.zeros(len(used), bool), covariance=C)
    seen = [i for i in images if len(i.points)]
    none = np.empty(0, np.int64)
    points = ImagePoints(
        images=tuple(i.name for i in seen),
        points=names,
        image=np.concatenate([none, *(np.full(len(i.points), k, np.int64) for k, i in enumerate(seen))]),
        point=np.searchsorted(used, np.concatenate([none, *(i.points for i in seen)])).astype(np.int64),
        xy=np.concatenate([np.empty((0, 2)), *(i.xy for i in seen)]),
        sigma=np.concatenate([np.empty((0, 2)), *(i.sigma for i in seen)]),
    )
    return ground, points


def _enter(path: Path, output: Path, image_output: Path) -> None:
    """Add both tables to [observations]."""
    project = load_project(path)
    folder = path.resolve().parent
    entries: dict[str, Any] = {}
    for role, listed, file in (
        ("control", project.observations.control, output),
        ("image_points", project.observations.image_points, image_output),
    ):
        whole = file.resolve()
        if any(project.resolve(f) == whole for f in listed):
            continue
        written = whole.relative_to(folder).as_posix() if whole.is_relative_to(folder) else os.fspath(whole)
        entries[role] = [*listed, written]
    if entries:
        edit_project(path, ProjectChanges(tables={"observations": entries}))
