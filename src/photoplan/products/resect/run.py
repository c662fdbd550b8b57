"""`photoplan resect`: images of a project oriented by control points, one by one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.errors import PhotoplanError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.orientation.resection.model import ResectSettings
from photoplan.plain import pick
from photoplan.products.adjust.inputs import AdjustInputs, read_inputs
from photoplan.products.resect.image import ResectedImage, control_rows, resect_image

#: Control points from which an image is tried where none is named.
_LEAST = 3


@dataclass(frozen=True)
class ResectRequest:
    """What is asked."""

    project: Path
    images: tuple[str, ...] = ()
    """Names or patterns; none: all images with three control points or more."""
    image_points: tuple[Path, ...] = ()
    """Instead of those that [observations] names."""
    control: tuple[Path, ...] = ()
    """Instead of those that [observations] names."""
    sigma_image: float | None = None
    """Standard deviation of image coordinates, pixels; None: that of the project."""
    sigma_control: tuple[float, float] | None = None
    """Standard deviation of control, horizontal and height, metres; None: that of the project."""
    free: tuple[str, ...] = ()
    """Parameters of the camera that are unknowns: c, x0, y0."""
    unknown_camera_constant: bool = False
    """The stated camera constant is no start value either."""
    critical: float = 4.0
    dry_run: bool = False
    """Whether the project is left as it is."""


@dataclass(frozen=True, eq=False)
class ResectResult:
    """What came out."""

    project: Path
    images: tuple[ResectedImage, ...]
    failed: dict[str, str]
    """Images that could not be oriented, with the reason."""
    left_out: tuple[str, ...]
    """Images with fewer than three control points."""
    written: bool
    notes: tuple[str, ...]

    def json_fields(self) -> dict[str, Any]:
        """Failures as a list."""
        return {
            **pick(self, "project", "written", "images", "left_out", "notes"),
            "failed": [{"image": name, "reason": reason} for name, reason in self.failed.items()],
        }


def resect_project(request: ResectRequest, events: Events = SILENT) -> ResectResult:
    """Orient images by control and write the result into the project.

    Parameters
    ----------
    request : ResectRequest
    events : Events
        Told of every image.

    Raises
    ------
    UsageError
        Parameters of a camera should be free for several of its images.
    InputError
        Project or measurements cannot be used, or no image has three control points.
    """
    settings = ResectSettings(request.free, not request.unknown_camera_constant, request.critical)
    project = _overridden(load_project(request.project), request)
    names = project.select(request.images or None)
    inputs = read_inputs(project, names)
    counts = {name: len(control_rows(inputs, name)) for name in names}
    wanted = [n for n in names if request.images or counts[n] >= _LEAST]
    _refuse(inputs, wanted, counts, settings)
    done: list[ResectedImage] = []
    failed: dict[str, str] = {}
    for name in wanted:
        try:
            done.append(resect_image(inputs, project.image(name), settings))
        except PhotoplanError as error:
            text = str(error)
            failed[name] = text if repr(name) in text else f"image {name!r}: {text}"
        events.done()
    written = bool(done) and not request.dry_run
    if written:
        edit_project(request.project, _changes(done))
    left = tuple(n for n in names if n not in wanted)
    return ResectResult(request.project, tuple(done), failed, left, written, inputs.notes)


def _overridden(project: Project, request: ResectRequest) -> Project:
    """The project with the measurements that options name."""
    changes: dict[str, Any] = {
        "image_points": tuple(str(p.absolute()) for p in request.image_points),
        "control": tuple(str(p.absolute()) for p in request.control),
        "sigma_image": request.sigma_image,
        "sigma_control": request.sigma_control,
        # Positions take no part in a resection.
        "positions": None,
    }
    kept = {k: v for k, v in changes.items() if v or k == "positions"}
    return project.model_copy(update={"observations": project.observations.model_copy(update=kept)})


def _refuse(inputs: AdjustInputs, wanted: Sequence[str], counts: dict[str, int], settings: ResectSettings) -> None:
    if not wanted:
        most = max(counts.items(), key=lambda item: item[1])
        raise UsageError(
            f"none of the {len(counts)} images has {_LEAST} control points with three known coordinates; the most, "
            f"{most[1]}, has image {most[0]!r}. Check that points are called the same in image points and control"
        )
    if settings.free:
        project = inputs.project
        count = Counter(project.image(n).camera for n in wanted)
        camera, images = count.most_common(1)[0]
        if images > 1:
            raise UsageError(
                f"{', '.join(settings.free)} of camera {camera!r} cannot be found for {images} images one by one, as "
                "each gives another value; name one with `images`, or free the parameters in `photoplan adjust`"
            )


def _changes(done: Sequence[ResectedImage]) -> ProjectChanges:
    return ProjectChanges(
        images={r.image.name: r.image_entries for r in done},
        cameras={r.image.camera: r.camera_entries for r in done if r.camera_entries},
    )
