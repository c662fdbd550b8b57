"""Tie points of a project: found, refined, written and entered into the project file."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.cameras.observed import ImagePoints
from photoplan.engine.steps import Steps, steps
from photoplan.errors import GeometryError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.image_points import write_image_points
from photoplan.io.lock import lock_of
from photoplan.io.naming import together
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.result_log import ResultLog
from photoplan.io.run_record import input_entry, run_key, run_times, write_run_record
from photoplan.matching.features import FeatureSettings, opencv
from photoplan.matching.grey import Grey, ReducedImage
from photoplan.matching.loops import Loops, close_loops
from photoplan.matching.refine import Refined, RefineSettings, reference_points, refine_tracks
from photoplan.matching.tracks import Tracks, TracksFound, build_tracks, connected_parts, thin_tracks
from photoplan.matching.verify import PairMatches, VerifySettings
from photoplan.plain import pick
from photoplan.products.init.match import some
from photoplan.products.tie.inputs import (
    FeatureStore,
    TieImage,
    chosen_pairs,
    find_features,
    find_pairs,
    like_pairs,
    open_images,
)
from photoplan.products.tie.rectified import carried_back, open_rectified
from photoplan.project.scene import input_files

#: Changes when kept results mean something else.
_FORM = 2
#: Longer sides are reduced before features are looked for, unless the scale is stated, pixels.
_LONGEST = 6000
#: Tracks that go into refinement for each that is wanted: some are lost there.
_SPARE = 1.5
#: Standard deviation of a feature's place that is not refined: at least this, and this part of its scale, pixels.
_FEATURE_SIGMA, _FEATURE_SHARE = 0.3, 0.2


@dataclass(frozen=True)
class TieRequest:
    """What is asked."""

    project: Path
    images: tuple[str, ...] = ()
    """Names or patterns; none: all."""
    pairs: str = "auto"
    """auto, all, or a file."""
    scale: float | None = None
    """Of the image in which features are looked for: 1, 0.5, 0.33 …; None: as the size of the images asks."""
    features: int = 4000
    """Features per image."""
    per_image: int = 500
    """Tie points that an image is to have."""
    refine: bool = True
    use_orientation: bool = True
    output: Path | None = None
    workers: int = 1
    overwrite: bool = False
    dry_run: bool = False

    @property
    def table(self) -> Path:
        """The table that is written."""
        return self.output or self.project.resolve().parent / "tie_points.csv"


@dataclass(frozen=True)
class TieReport:
    """What was found."""

    output: Path | None
    """The table of image points; None after a dry run."""
    images: tuple[str, ...]
    chosen: str
    """How pairs were chosen."""
    factor: int
    """Features were looked for in means of so many pixels along each side."""
    pairs: int
    verified: int
    tracks: int
    """Before thinning."""
    ambiguous: int
    """Dropped: two places in one image."""
    points: int
    rays: dict[int, int]
    """Number of points by their number of images."""
    per_image: dict[str, int]
    parts: tuple[tuple[str, ...], ...]
    """Images that hang together, the largest part first."""
    refined: Refined | None
    loops: Loops | None
    sigma: float
    """Median standard deviation of a coordinate, pixels."""
    notes: tuple[str, ...]
    sources: tuple[TieImage, ...] = ()
    """The images, as they were opened."""
    found: Tracks | None = None
    """The points; None after a dry run."""

    @property
    def unconnected(self) -> tuple[str, ...]:
        """Images outside the largest part."""
        return tuple(name for part in self.parts[1:] for name in part)

    def json_fields(self) -> dict[str, Any]:
        """Counts by name, without the points."""
        own = ("output", "chosen", "tracks", "ambiguous", "points", "rays", "per_image", "parts", "unconnected",
               "sigma", "loops", "notes")  # fmt: skip
        refined = self.refined
        return {
            **pick(self, *own),
            "images": len(self.images),
            "scale": 1 / self.factor,
            "pairs": {"tried": self.pairs, "verified": self.verified},
            "refined": refined and pick(refined, "correlation", "unsettled", "unlike", "uncertain"),
        }


def find_ties(request: TieRequest, events: Events = SILENT) -> TieReport:
    """Find tie points between the images of a project.

    Features, matches and refined places are kept in a file ``NAME.matches`` beside the output: a run that was
    interrupted continues, and another one with the same features begins with what is known.

    Parameters
    ----------
    request : TieRequest
    events : Events
        Told what is done next, and how far it is.

    Raises
    ------
    UsageError
        The output exists, or OpenCV is not installed.
    InputError
        An input cannot be used.
    GeometryError
        No two images have enough in common.
    """
    times, project = run_times(), load_project(request.project)
    names = project.select(request.images or None)
    output = _check(request, project, names)
    # What frames alone took is matched as it is; anything else is brought onto the map first.
    on_map = not all(isinstance(project.any_image(name), Image) for name in names)
    images, notes = (open_rectified if on_map else open_images)(project, names, request.use_orientation)
    factor = _factor(request, images)
    pairs, chosen = chosen_pairs(images, request.pairs)
    if request.dry_run:
        return _dry(names, pairs, chosen, factor, notes)
    entry = input_entry(request.project)
    settings, verify = FeatureSettings(request.features, factor), VerifySettings(threshold=2.0 * factor)
    log = ResultLog(output.with_suffix(".matches"), f"{_FORM} {settings} {verify}", lock_of(output))
    with log, steps(output.name, request.workers, events, log) as run:
        store = FeatureStore(tuple(images), settings, log)
        decides = [names, store.seen, settings, verify, pairs, request.per_image, request.refine]
        key = run_key("tie points", decides, ())
        events.begin("features", len(images), "images")
        features = find_features(store, run)
        pairs = like_pairs(store) if pairs is None else pairs
        events.begin("matching", len(pairs), "pairs")
        verified = [p for p in find_pairs(store, pairs, verify, run) if len(p)]
        _refuse_nothing(request, verified, len(pairs), names)
        found = build_tracks(features, verified, same=1.5 * factor)
        sizes = [image.grey.size for image in images]
        spare = found.tracks.of_tracks(thin_tracks(found.tracks, sizes, round(_SPARE * request.per_image)))
        events.begin("refining", unit="pairs")
        tracks, refined, loops = _refine(request, spare, images, factor, run.under(key))
    tracks = tracks.of_tracks(thin_tracks(tracks, sizes, request.per_image))
    if not len(tracks):
        raise GeometryError("no tie point is left after refinement; look at the images, or give `refine=False`")
    points = _points(tracks, names)
    if on_map:
        points = carried_back(tracks, images, points)
    with together():
        write_image_points(output, points)
        _enter(request.project, project, output)
        report = _report(names, chosen, factor, len(pairs), len(verified), found, tracks, notes)
        report = replace(report, output=output, refined=refined, loops=loops, sources=tuple(images), found=tracks)
        write_run_record(
            output,
            key=key,
            inputs=[entry, *(input_entry(i.path, name[1]) for i, name in zip(images, store.names))],
            run={"workers": request.workers, **times()},
            kind="tie points",
            product=report,
            settings=pick(request, "pairs", "features", "per_image", "refine", "use_orientation"),
        )
    return report


def _check(request: TieRequest, project: Project, names: Sequence[str]) -> Path:
    """The output, and everything that can be refused before any work."""
    if len(names) < 2:
        raise UsageError(f"{len(names)} image; tie points need two images at least")
    if request.features < 50 or request.per_image < 1:
        raise UsageError(
            f"{request.features} features and {request.per_image} points per image; 50 and 1 are the least"
        )
    opencv()
    output = request.table
    points = [project.resolve(file) for file in project.observations.image_points]  # an older run's among them
    inputs = [request.project, *(file for file in input_files(project) if file not in points)]
    if output.suffix.lower() in (".png", ".matches", ".json"):
        raise UsageError(f"{output}: a table is written; give it a name such as tie_points.csv")
    if not request.dry_run:
        check_output(output, inputs, overwrite=request.overwrite)
    return output


def _factor(request: TieRequest, images: Sequence[TieImage]) -> int:
    if request.scale is not None:
        if not 0.01 <= request.scale <= 1:
            raise UsageError(f"scale {request.scale:g}; a number from 0.01 to 1 is needed, such as 0.5")
        return round(1 / request.scale)
    longest = max(max(image.grey.size) for image in images)
    return max(1, -(-longest // _LONGEST))


def _dry(
    names: Sequence[str], pairs: list[tuple[int, int]] | None, chosen: str, factor: int, notes: list[str]
) -> TieReport:
    return TieReport(
        output=None,
        images=tuple(names),
        chosen=chosen,
        factor=factor,
        pairs=0 if pairs is None else len(pairs),
        verified=0,
        tracks=0,
        ambiguous=0,
        points=0,
        rays={},
        per_image={},
        parts=(),
        refined=None,
        loops=None,
        sigma=float("nan"),
        notes=tuple(notes),
    )


def _refuse_nothing(request: TieRequest, verified: Sequence[PairMatches], tried: int, names: Sequence[str]) -> None:
    if not verified:
        raise GeometryError(
            f"{request.project}: none of {tried} pairs of {len(names)} images ({some(list(names))}) could be verified: "
            "no overlap, or too little texture. Choose other images with `images`, give `pairs` all, more `features`, "
            "or another `scale`"
        )


def _refine(
    request: TieRequest, tracks: Tracks, images: Sequence[TieImage], factor: int, run: Steps
) -> tuple[Tracks, Refined | None, Loops | None]:
    """Tracks with standard deviations; first at the scale of the features, then at full resolution."""
    if not request.refine:
        sigma = np.maximum(_FEATURE_SIGMA * factor, _FEATURE_SHARE * tracks.scale)
        return replace(tracks, sigma=np.repeat(sigma[:, None], 2, axis=1)), None, None
    greys: list[Grey] = [image.grey for image in images]
    settings = RefineSettings()
    if factor > 1:
        small: list[Grey] = [ReducedImage(image.grey, factor) for image in images]
        rough = refine_tracks(_scaled(tracks, 1 / factor), small, replace(settings, sigma=np.inf), run=run)
        tracks = _scaled(rough.tracks, factor)
    loops = close_loops(tracks, reference_points(tracks, [g.size for g in greys]), greys, settings, run=run)
    refined = refine_tracks(tracks, greys, settings, loops.factor, run)
    return refined.tracks, refined, loops


def _scaled(tracks: Tracks, by: float) -> Tracks:
    """Tracks in another scale of the images; standard deviations are not carried over."""
    return replace(tracks, xy=(tracks.xy + 0.5) * by - 0.5, scale=tracks.scale * by)


def _points(tracks: Tracks, names: Sequence[str]) -> ImagePoints:
    digits = len(str(tracks.count))
    points = tuple(f"T{k + 1:0{digits}d}" for k in range(tracks.count))
    used, image = np.unique(tracks.image, return_inverse=True)
    return ImagePoints(
        images=tuple(names[k] for k in used),
        points=points,
        image=image.reshape(-1).astype(np.int64),
        point=tracks.track,
        xy=tracks.xy,
        sigma=tracks.sigma,
    )


def _enter(path: Path, project: Project, output: Path) -> None:
    """Add the table to [observations] image_points."""
    listed = project.observations.image_points
    if any(project.resolve(file) == output.resolve() for file in listed):
        return
    folder = path.resolve().parent
    whole = output.resolve()
    written = whole.relative_to(folder).as_posix() if whole.is_relative_to(folder) else os.fspath(whole)
    edit_project(path, ProjectChanges(tables={"observations": {"image_points": [*listed, written]}}))


def _report(
    names: Sequence[str],
    chosen: str,
    factor: int,
    pairs: int,
    verified: int,
    found: TracksFound,
    tracks: Tracks,
    notes: list[str],
) -> TieReport:
    rays, number = np.unique(tracks.rays, return_counts=True)
    per_image = np.bincount(tracks.image, minlength=len(names))
    parts = connected_parts(len(names), tracks)
    return TieReport(
        output=None,
        images=tuple(names),
        chosen=chosen,
        factor=factor,
        pairs=pairs,
        verified=verified,
        tracks=found.tracks.count,
        ambiguous=found.ambiguous,
        points=tracks.count,
        rays={int(k): int(n) for k, n in zip(rays, number)},
        per_image={name: int(n) for name, n in zip(names, per_image)},
        parts=tuple(tuple(names[k] for k in part) for part in parts),
        refined=None,
        loops=None,
        sigma=float(np.median(tracks.sigma)),
        notes=tuple(notes),
    )
