"""Make views: pictures and coordinate matrices, with what can be said of them before."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from photoplan import __version__
from photoplan.engine.executors import Workers
from photoplan.engine.run import Tally, Work
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.grid import Placement
from photoplan.io.disk import make_folder
from photoplan.io.image_form import ImageForm
from photoplan.io.matrix_file import BANDS, MatrixFile
from photoplan.io.naming import scratch, together, write_atomically
from photoplan.io.product import DESCRIPTION, ProductFile, check_output
from photoplan.io.run_record import input_entry, run_key, write_run_record
from photoplan.io.storage import PICTURES
from photoplan.plain import json_text, plain
from photoplan.plan.tiles import Tiles
from photoplan.products.run import Run, refuse_inputs
from photoplan.products.view.camera import CameraRequest, ViewCamera, view_camera
from photoplan.products.view.content import open_layers
from photoplan.products.view.first_look import FirstLook, first_look
from photoplan.products.view.ground import ViewGround, open_view_ground
from photoplan.products.view.job import LookRequest, ViewAddress, ViewJob, seen_surface
from photoplan.products.view.lines import LinesRequest, open_drawing
from photoplan.products.view.overlay import Lettering, Overlay, overlay
from photoplan.products.view.photo import ViewPhoto
from photoplan.products.view.result import ViewResult
from photoplan.products.view.stereo import Stereo, eyes
from photoplan.surfaces.seen_lines import LinesOfSight
from photoplan.terrain.options import Lighting

TILE = 512


@dataclass(frozen=True)
class ViewRequest:
    """What is asked."""

    source: Path
    """Project file or terrain model."""
    camera: CameraRequest | None
    """None: that of `matrix`."""
    output: Path | None = None
    """The picture (``.png``, ``.jpg`` or ``.tif``), or the matrix (``.tif``); None: nothing is written."""
    look: LookRequest = field(default_factory=LookRequest)
    kind: str = "picture"
    """`picture` or `matrix`."""
    matrix: Path | None = None
    """A coordinate matrix of the same view: nothing is looked for again."""
    farthest: float = math.inf
    """Beyond this distance nothing is seen, metres."""
    bound: float = 0.01
    """Largest error of ground coordinates across the line of sight, metres."""
    crs: str | None = None
    """CRS of a terrain model that does not state it."""
    water: float | None = None
    """Height of water that covers what is lower or has none, metres."""
    force: bool = False
    """Also where the point of view lies below the ground."""
    lines: tuple[LinesRequest, ...] = ()
    """What is drawn over the picture."""
    text_size: float = 13.0
    """Of labels, pixels."""
    lettering: Lettering | None = None
    """What draws texts; None: points have no labels."""
    svg: Path | None = None
    """A file for what is drawn, over the picture."""
    stereo: Stereo | None = None
    """A pair of pictures instead of one."""

    def __post_init__(self) -> None:
        if self.stereo is not None and (self.matrix or self.svg or self.look.photo or self.kind == "matrix"):
            raise UsageError("a stereo pair has two cameras; give no matrix, `photo` or `svg`")
        if self.svg is not None and not self.lines:
            raise UsageError(f"{self.svg}: nothing is drawn; give `lines`, too")
        if self.svg is not None and self.svg.suffix.lower() != ".svg":
            raise UsageError(f"{self.svg}: what is drawn is written as .svg")
        if not 4 <= self.text_size <= 400:
            raise UsageError(f"`text_size` {self.text_size} pixels; 4 to 400 are allowed")


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """A view before its pixels."""

    request: ViewRequest
    camera: ViewCamera
    first: FirstLook
    address: ViewAddress
    key: str

    @property
    def placement(self) -> Placement:
        """Of what is written: wider than the picture where a photo lies beside it."""
        photo, (width, height) = self.address.look.photo, self.camera.target.bundle.size
        beside = (photo is not None and photo.how == "beside") or (self.stereo is not None and self.stereo.beside)
        return Placement((2 * width if beside else width, height))

    @property
    def tiles(self) -> Tiles:
        """Tiles of what is written."""
        return Tiles.every(self.placement.window, TILE)

    @property
    def stereo(self) -> Stereo | None:
        """How a pair is made, its base in metres; None: there is one picture."""
        return None if self.request.stereo is None else self.request.stereo.stated(self.first.nearest)

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angles between the middles of opposite sides of the picture, degrees."""
        bundle = self.camera.target.bundle
        (w, h), panorama = bundle.size, self.camera.request.panorama is not None
        if panorama:
            return (self.camera.request.field_of_view or 360.0, math.nan)
        edges = np.array([(-0.5, (h - 1) / 2), (w - 0.5, (h - 1) / 2), ((w - 1) / 2, -0.5), ((w - 1) / 2, h - 0.5)])
        d = bundle.directions(edges)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        across, along = (float(np.degrees(np.arccos(np.clip(d[k] @ d[k + 1], -1, 1)))) for k in (0, 2))
        return across, along

    def json_fields(self) -> dict[str, Any]:
        """What will be seen."""
        return {
            **self.camera.json_fields(),
            "size": list(self.camera.target.bundle.size),
            "tiles": len(self.tiles),
            "field_of_view_deg": list(self.field_of_view),
            "farthest_m": self.request.farthest,
            "error_bound_m": self.request.bound,
            **({} if self.request.water is None else {"water_m": self.request.water}),
            **({} if self.stereo is None else {"stereo": self.stereo.how, "base_m": self.stereo.base}),
            "expected": self.first,
        }


def plan_view(request: ViewRequest) -> ViewPlan:
    """Put the camera on the ground and look what it will see; nothing is written.

    Raises
    ------
    UsageError
        The output exists or is an input, or a choice makes no sense.
    InputError
        A file cannot be used.
    GeometryError
        The point of view lies below the ground, or sees none of it.
    """
    ground = open_view_ground(request.source, request.crs, request.water)
    camera = view_camera(camera_request(request), ground, request.force)
    _check_driver(request)
    surface = seen_surface(ground, request.farthest, request.bound)
    first = first_look(camera.target, surface)
    if first.ground == 0 and not request.force:
        raise GeometryError(_sees_nothing(camera, ground))
    heights = (0.0, 1.0) if first.lowest is None or first.highest is None else _rounded(first.lowest, first.highest)
    contents = () if request.kind == "matrix" else request.look.contents
    light = Lighting(
        azimuth=request.look.azimuth, altitude=request.look.altitude, exaggeration=camera.request.exaggeration
    )
    layers = open_layers(contents, ground, light, heights)
    matrix = None if request.matrix is None else _fitting(request.matrix, camera)
    files = dict.fromkeys([*ground.files, *(f for each in layers for f in each.files)])
    photo = None if request.look.photo is None else ViewPhoto.open(request.look.photo, camera.target.bundle.size)
    files |= {each: None for each in (matrix, None if photo is None else photo.reader.path) if each is not None}
    files |= {each.path: None for each in request.lines if each.path is not None}
    inputs = [input_entry(path) for path in files]
    address = ViewAddress(
        source=str(request.source.resolve()),
        crs=request.crs,
        water=request.water,
        camera=camera.request,
        look=replace(request.look, contents=contents),
        heights=heights,
        farthest=request.farthest,
        bound=request.bound,
        matrix=None if matrix is None else str(matrix.resolve()),
        digests=tuple((str(Path(each["path"]).resolve()), each["sampled_sha256"]) for each in inputs),
    )
    told: list[Any] = [camera.request, _look_facts(address.look), heights, request.farthest, request.bound, TILE]
    if request.water is not None:
        told.append(("water", request.water))
    if request.lines:
        drawn = [(each.layer, each.interval, each.options) for each in request.lines]
        told += [drawn, request.text_size, request.lettering is not None]
    if request.stereo is not None:
        pair = request.stereo.stated(first.nearest)
        told += [pair, eyes(camera, pair.metres)]
    return ViewPlan(
        request=request, camera=camera, first=first, address=address, key=run_key(f"view {request.kind}", told, inputs)
    )


def camera_request(request: ViewRequest) -> CameraRequest:
    """The camera that is stated, or that of the matrix."""
    if request.camera is not None:
        return request.camera
    if request.matrix is None:
        raise UsageError("a view needs one `camera`: an image of the project, or a standpoint `position` X Y")
    return CameraRequest.from_dict(_stated_camera(MatrixFile(request.matrix)), str(request.matrix))


def _stated_camera(file: MatrixFile) -> dict[str, Any]:
    """Which camera a matrix says it is of."""
    try:
        return dict(json.loads(file.description)["camera"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file.info.path}: does not say which view it is of; make it again") from error


def _fitting(path: Path, camera: ViewCamera) -> Path:
    """A matrix, if it is of this view."""
    file = MatrixFile(path)
    stated = _stated_camera(file)
    if file.info.size != camera.target.bundle.size or stated != plain(camera.json_fields()["camera"]):
        raise InputError(f"{path}: is of another view; leave out the camera to take that of the matrix")
    return path


def _look_facts(look: LookRequest) -> dict[str, Any]:
    """What decides colours: of files the content counts, which is among the inputs."""
    contents = [
        (each.kind, "" if each.kind == "raster" else each.value, each.opacity, each.classes) for each in look.contents
    ]
    return {**vars(look), "contents": contents, "photo": look.photo and (look.photo.how, look.photo.opacity)}


def _check_driver(request: ViewRequest) -> None:
    if request.output is None:
        return
    suffix = request.output.suffix.lower()
    allowed = (".tif", ".tiff") if request.kind == "matrix" else (*PICTURES, ".tif", ".tiff")
    if suffix not in allowed:
        raise UsageError(f"{request.output}: a {request.kind} is written as {', '.join(allowed)}")


def _rounded(low: float, high: float) -> tuple[float, float]:
    """Heights of a ramp, rounded outwards to a tenth of their range."""
    step = 10 ** math.floor(math.log10(max(high - low, 1.0)))
    return math.floor(low / step) * step, math.ceil(high / step + 1e-9) * step


def _sees_nothing(camera: ViewCamera, ground: ViewGround) -> str:
    x, y, z = camera.target.center
    b = ground.bounds
    covered = "everywhere" if b is None else f"{b[0]:.0f} {b[1]:.0f} {b[2]:.0f} {b[3]:.0f}"
    return (
        f"from {x:.2f} {y:.2f} {z:.2f} no ground is seen; the terrain is {covered}. Check position, height and "
        "direction (or say `force` for a picture of the sky)"
    )


def make_view(plan: ViewPlan, run: Run) -> ViewResult:
    """Make the picture or the matrix of a plan; a run that was killed is continued by the same request.

    Raises
    ------
    UsageError
        The output exists or is an input.
    RunLocked
        Another run is writing it.
    TilesFailed
        A tile failed again and again; nothing stays under the name then.
    ResourceError
        Disk or memory ran out.
    """
    run.check()
    inputs = (Path(each) for each, _ in plan.address.digests)
    with run.runner(inputs, _output(plan).parent) as runner, together():
        work = view_work(plan, run, runner.workers)
        run.events.begin(work.name, work.count)
        result: ViewResult
        (result,) = runner.run([work])
    return result


def _output(plan: ViewPlan) -> Path:
    assert plan.request.output is not None
    return plan.request.output


def view_work(plan: ViewPlan, run: Run, workers: Workers) -> Work[ViewResult]:
    """A picture or matrix as one of the products of a run; its output is checked, and its folder made."""
    path, request = _output(plan), plan.request
    outputs = [path] if request.svg is None else [path, request.svg]
    refuse_inputs([Path(each) for each, _ in plan.address.digests], outputs)
    for each in outputs:
        check_output(each, [name for name, _ in plan.address.digests], overwrite=run.overwrite)
        make_folder(each.parent)
    is_matrix, placement = request.kind == "matrix", plan.placement
    file = ProductFile(
        path,
        placement,
        len(BANDS) if is_matrix else 3,
        np.dtype(np.float64 if is_matrix else np.uint8),
        run_key=plan.key,
        nodata="auto" if is_matrix else "mask",
        overviews=False,
        tile=TILE,
        overwrite=run.overwrite,
        inputs=[each for each, _ in plan.address.digests],
        threads=run.workers,
        driver=PICTURES.get(path.suffix.lower(), "COG"),
        form=ImageForm(descriptions=tuple(n for n, _ in BANDS), units=tuple(u for _, u in BANDS))
        if is_matrix
        else None,
    )
    tiles, job = plan.tiles, _job(plan)
    return Work(
        name=path.stem,
        job=job,
        tiles=tiles,
        count=len(tiles),
        sinks=(file,),
        complete=partial(_complete, plan, job.overlay, file, run.clock(workers)),
        scratch=partial(scratch, path.parent),
    )


def _job(plan: ViewPlan) -> ViewJob:
    """What workers are told; of a pair for both pictures."""
    if plan.stereo is None:
        return ViewJob(plan.address, plan.request.kind == "matrix", draw(plan, plan.camera))
    ground = open_view_ground(plan.request.source, plan.request.crs, plan.request.water)
    left, right = (
        ViewJob(replace(plan.address, camera=eye), overlay=draw(plan, view_camera(eye, ground, force=True)))
        for eye in eyes(plan.camera, plan.stereo.metres)
    )
    return replace(left, right=right, beside=plan.stereo.beside)


def draw(plan: ViewPlan, camera: ViewCamera) -> Overlay | None:
    """What is drawn over the picture of a camera; None: nothing."""
    request = plan.request
    if not request.lines:
        return None
    ground = open_view_ground(request.source, request.crs, request.water)
    reach = min(request.farthest, 1.5 * (plan.first.farthest or 0.0) + 1000.0)
    drawing = open_drawing(request.lines, ground, reach, camera.target.center)
    sight = LinesOfSight(camera.target, seen_surface(ground, request.farthest, request.bound))
    return overlay(drawing, sight, request.lettering, request.text_size)


def _complete(
    plan: ViewPlan,
    drawn: Overlay | None,
    file: ProductFile,
    times: Callable[[], dict[str, Any]],
    tally: Tally,
) -> ViewResult:
    tally.check(file.path)
    facts = plan.json_fields()
    names = ("standpoint", "camera", "earth_radius", "bend_per_metre", "error_bound_m", "water_m", "stereo", "base_m")
    told = {name: facts[name] for name in names if name in facts}
    tags = {
        "PHOTOPLAN_VERSION": __version__,
        "PHOTOPLAN_KEY": plan.key,
        DESCRIPTION: json_text(told, "view", indent=None),
    }
    made, svg = file.complete(tags), plan.request.svg
    if svg is not None and drawn is not None:
        fits = file.path.suffix.lower() in PICTURES and plan.placement.size == drawn.size
        below = file.path.name if fits and file.path.parent == svg.parent else None
        write_atomically(svg, drawn.svg(below).encode())
    ran, totals = times(), tally.totals
    result = ViewResult(
        path=file.path,
        size=plan.placement.size,
        tiles=len(plan.tiles),
        sky=totals["pixels"] - totals["ground"],
        rays=totals["pixels"],
        lost=totals["lost"],
        nearest=-totals["worst_nearness"] if "worst_nearness" in totals else None,
        farthest=totals.get("worst_distance"),
        resumed=tally.resumed,
        seconds=ran["seconds"],
        svg=svg,
        drawn=None if drawn is None else drawn.facts,
    )
    write_run_record(
        file.path,
        key=plan.key,
        inputs=[input_entry(path, digest) for path, digest in plan.address.digests],
        run=ran,
        kind=f"view {plan.request.kind}",
        product=result,
        settings={"look": plan.address.look, "farthest": plan.request.farthest},
        view=plan,
        bytes=made.bytes,
    )
    return result
