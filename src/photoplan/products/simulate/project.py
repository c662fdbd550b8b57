"""Images that the cameras of a project would take of its terrain and objects, with the truth beside them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.errors import UsageError
from photoplan.events import SILENT, Events
from photoplan.io.disk import make_folder
from photoplan.io.product import check_output
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.run_record import record_path, recorded_result
from photoplan.plain import pick
from photoplan.products.dtm.raster import GridOptions
from photoplan.products.orthophoto.look import two_figures
from photoplan.products.simulate.form import Forming, SimulateReport, check_fit, stated_model
from photoplan.products.simulate.scene import TruthRaster, image_truth, true_orthophoto
from photoplan.project.cameras import camera_without_pixels
from photoplan.project.rendered import ProjectScene, ground_pixel

#: Shortest wavelength of the pattern, ground pixels.
_GRAIN = 8.0
_ORTHO = "true_orthophoto.tif"


@dataclass(frozen=True)
class SceneRequest:
    """What is asked."""

    project: Path
    """Terrain, objects, and oriented images; their files need not be there."""
    images: tuple[str, ...] = ()
    """Names or patterns; all if empty."""
    output: Path | None = None
    """Folder of the images; None: `rendered` beside the project."""
    model: Path | None = None
    """Description of the camera; None: light is sampled, nothing else."""
    texture: Path | None = None
    """Raster of the ground's colours; None: a pattern."""
    grain: float | None = None
    """Shortest wavelength of the pattern, metres; None: eight ground pixels of the first image."""
    truth: bool = False
    """Whether a raster beside each image says what its pixels show."""
    resolution: float | None = None
    """Of a true orthophoto of the scene, metres; None: there is none."""
    bounds: tuple[float, float, float, float] | None = None
    """Of the true orthophoto; None: those of the terrain."""
    seed: int | None = None
    """In place of the model's."""
    oversampling: int | None = None
    """Rays along a side of a pixel; None: 2."""
    dtype: str | None = None
    """Of the images; None: as the model's quantisation says, else uint8."""
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class SceneReport:
    """What was made, or would be."""

    images: tuple[SimulateReport, ...]
    """One for each image that was made now."""
    rasters: tuple[Path, ...]
    """Truth of the images, and the true orthophoto, as far as they were made now."""
    kept: tuple[Path, ...]
    """Files that an earlier run of the same command had made."""
    grain: float
    """Shortest wavelength of the pattern, metres."""

    def json_fields(self) -> dict[str, Any]:
        """The images with what is known of each, and all other files."""
        images = [
            {**image, **pick(report, "size", "bands", "dtype", "notes", run_record="record")}
            for report in self.images
            for image in report.json_fields()["images"]
        ]
        return {"images": images, **pick(self, "rasters", "kept", grain_m="grain")}


def simulate_project(request: SceneRequest, events: Events = SILENT) -> SceneReport:
    """Render images of a project and write them.

    Raises
    ------
    UsageError
        An option makes no sense, or an output exists that this very command has not made, or all of them do.
    InputError
        Project, texture or model cannot be used.
    GeometryError
        An image has nothing to look at.
    """
    project = load_project(request.project)
    names = project.select(request.images or None)
    if request.bounds is not None and request.resolution is None:
        raise UsageError("`bounds` are those of the true orthophoto; give its `resolution`, too")
    grain = two_figures(_GRAIN * ground_pixel(project)) if request.grain is None else request.grain
    if not 0 < grain < float("inf"):
        raise UsageError(f"grain {grain}; a positive number of metres is needed")
    works = list(_works(request, project, names, grain, events))
    kept, todo = _divided(works, project, request.overwrite)
    images: list[SimulateReport] = []
    rasters: list[Path] = []
    if not request.dry_run:
        make_folder(_folder(request, project))
    for work in todo:
        if isinstance(work, Forming):
            images.append(work.planned() if request.dry_run else work.form(events))
        else:
            rasters.append(work.path)
            if not request.dry_run:
                work.write()
    return SceneReport(tuple(images), tuple(rasters), tuple(kept), grain)


def _folder(request: SceneRequest, project: Project) -> Path:
    return request.output or project.folder / "rendered"


def _works(
    request: SceneRequest, project: Project, names: Sequence[str], grain: float, events: Events
) -> Iterator[Forming | TruthRaster]:
    """All that is asked for."""
    model, dtype = stated_model(request.model, request.seed, request.dtype)
    if dtype == "float32" and request.dtype is None:
        model, dtype = stated_model(request.model, request.seed, "uint8")
    k = request.oversampling or 2
    scene = ProjectScene.of(project, request.texture, grain, model.seed, k)
    stated = [project.ground.file, *(objects.file for objects in project.objects)]
    inputs = [project.resolve(file) for file in stated if file is not None]
    inputs += [] if request.texture is None else [request.texture]
    folder = _folder(request, project)

    def raster(kind: str, settings: dict[str, Any]) -> GridOptions:
        return GridOptions(
            kind=kind,
            settings=settings,
            inputs=inputs,
            workers=request.workers,
            overwrite=request.overwrite,
            events=events,
        )

    for name in names:
        seen, path = scene.seen_by(name), folder / f"{project.stems[name]}.tif"
        check_fit(seen, f"image {name!r}", model, request.model)
        settings = {"scene": _facts(project, name), "grain": grain, "oversampling": k, "seed": model.seed}
        yield Forming(
            kind="rendered image",
            name=name,
            scene=seen,
            model=model,
            dtype=dtype,
            frames=((path, 1.0),),
            output=path,
            inputs=[*inputs, *([] if request.model is None else [request.model])],
            settings=settings | {"model": model, "dtype": dtype},
            workers=request.workers,
            overwrite=request.overwrite,
        )
        if request.truth:
            camera = camera_without_pixels(project, name)
            truth = path.with_name(f"{path.stem}_truth.tif")
            yield image_truth(seen, camera, truth, raster("truth of a rendered image", settings))
    if request.resolution is not None:
        settings = {"scene": _facts(project, None), "grain": grain, "oversampling": k, "seed": model.seed}
        settings |= pick(request, "resolution", "bounds")
        options = raster("true orthophoto of a scene", settings)
        yield true_orthophoto(scene, request.resolution, request.bounds, folder / _ORTHO, options)


def _facts(project: Project, name: str | None) -> dict[str, Any]:
    """What a project says of its scene and of one image; None: of the scene alone."""
    said = project.model_dump_json(include={"crs", "terrain", "objects", "orientation"}, exclude_none=True)
    found: dict[str, Any] = json.loads(said)
    if name is not None:
        image = project.any_image(name)
        found["image"] = json.loads(image.model_dump_json(exclude_none=True, exclude={"file"}))
        if image.described_by is not None:
            found["camera"] = json.loads(project.cameras[image.described_by].model_dump_json(exclude_none=True))
    return found


def _divided(
    works: Sequence[Forming | TruthRaster], project: Project, overwrite: bool
) -> tuple[list[Path], list[Forming | TruthRaster]]:
    """Files that an earlier run of this command has made, and what is to be made; anything else there is refused.

    When all are there the earlier run was not interrupted: doing it again needs `overwrite`.
    """
    photos = {project.resolve(image.file).resolve() for image in project.images}
    kept: list[Path] = []
    todo: list[Forming | TruthRaster] = []
    for work in works:
        path, options = (work.output, work) if isinstance(work, Forming) else (work.path, work.options)
        if path.exists() and not record_path(path).exists() and path.resolve() in photos:
            raise UsageError(f"{path}: an image of the project that was not rendered; choose another output")
        if not overwrite and path.is_file() and recorded_result(path, options.key, lambda product, settings: True):
            kept.append(path)
            continue
        begun = isinstance(work, Forming) and work.begun
        check_output(path, options.inputs, overwrite=overwrite or begun)
        todo.append(work)
    if works and not todo:
        raise UsageError(f"{kept[0]}: exists already, as all others do; choose another output or say `overwrite`")
    return kept, todo
