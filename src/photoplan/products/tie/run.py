"""Tie points of a project: found, refined, written and entered into the project file."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
from photoplan.io.tables import write_table
from photoplan.matching.features import Features, FeatureSettings, opencv
from photoplan.matching.grey import Grey, ReducedImage
from photoplan.matching.loops import Loops, close_loops
from photoplan.matching.refine import Refined, RefineSettings, reference_points, refine_tracks
from photoplan.matching.tracks import (
    Tracks,
    TracksFound,
    build_tracks,
    connected_parts,
    joined_tracks,
    thin_tracks,
    weak_images,
)
from photoplan.matching.verify import PairMatches, VerifySettings
from photoplan.plain import pick
from photoplan.products.init.match import some
from photoplan.products.tie.inputs import (
    FeatureStore,
    TieImage,
    chosen_pairs,
    find_features,
    find_pairs,
    further_pairs,
    like_pairs,
    open_images,
)
from photoplan.products.tie.rectified import carried_back, open_rectified
from photoplan.project.scene import input_files

#: Changes when kept results mean something else.
_FORM = 2
#: Longer sides are reduced before features are looked for, unless the scale is stated, pixels.
_LONGEST = 6000
#: Further levels of features for pairs of images that are not connected: the reduction, the number of features, both
#: in units of the first level's, and the contrast. Reduced images are not smaller than `_SMALLEST` pixels.
_LEVELS = ((2, 2, 0.01), (4, 2, 0.01), (1, 3, 0.005))
_SMALLEST = 200
#: Pairs of weakly connected images with fewer matches than this are tried again.
_PLENTY = 100
#: Reductions at which points of weakly connected images are refined that cannot be at full resolution.
_COARSER = (2, 4)
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
    levels: int = 4
    """Kinds of features that are tried at most: as stated; where images stay unconnected at half and a quarter of the
    scale, and more of them with less contrast."""
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

    @property
    def pairs_table(self) -> Path:
        """The table of all pairs beside it."""
        return self.table.with_name(f"{self.table.stem}_pairs.csv")


@dataclass(frozen=True)
class TriedPair:
    """A pair of images at one level of features."""

    first: str
    second: str
    scale: float
    """Of the images in which features were looked for."""
    features: int
    """Features per image at most."""
    matches: int
    """Features that look alike."""
    verified: int
    """Those that fit the geometry of the pair."""
    reason: str
    """Why it is not verified; empty if it is."""


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
    tried: tuple[TriedPair, ...] = ()
    """All pairs at all levels."""
    advice: str = ""
    """What may connect the images that are not; empty if all are."""
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
               "sigma", "loops", "notes", "advice")  # fmt: skip
        refined = self.refined
        return {
            **pick(self, *own),
            "images": len(self.images),
            "scale": 1 / self.factor,
            "pairs": {"tried": self.pairs, "verified": self.verified},
            "levels": list(dict.fromkeys((t.scale, t.features) for t in self.tried)),
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
        decides = [names, store.seen, settings, verify, pairs, request.levels, request.per_image, request.refine]
        key = run_key("tie points", decides, ())
        events.begin("features", len(images), "images")
        features = find_features(store, range(len(images)), run)
        pairs = like_pairs(store) if pairs is None else pairs
        levels = [_matched(store, features, pairs, verify, run, events)]
        if not on_map:
            _climb(request, levels, run, events)
        verified = len({(p.first, p.second) for level in levels for p in level.pairs if len(p)})
        tried = tuple(t for level in levels for t in level.tried(names))
        pairs = sorted({(p.first, p.second) for level in levels for p in level.pairs})
        _refuse_nothing(request, verified, len(pairs), names, levels)
        sizes = [image.grey.size for image in images]
        every = joined_tracks([level.found.tracks for level in levels])
        of = np.repeat([level.factor for level in levels], [level.found.tracks.count for level in levels])
        keep = thin_tracks(every, sizes, round(_SPARE * request.per_image))
        events.begin("refining", unit="pairs")
        parts = [(int(f), every.of_tracks(keep & (of == f))) for f in np.unique(of[keep])]
        tracks, refined, loops = _refine(request, parts, images, run.under(key))
    tracks = tracks.of_tracks(thin_tracks(tracks, sizes, request.per_image))
    if not len(tracks):
        raise GeometryError("no tie point is left after refinement; look at the images, or give `refine=False`")
    points = _points(tracks, names)
    if on_map:
        points = carried_back(tracks, images, points)
    with together():
        write_image_points(output, points)
        _enter(request.project, project, output)
        report = _report(names, chosen, levels, len(pairs), verified, tracks, notes)
        report = replace(report, output=output, refined=refined, loops=loops, sources=tuple(images), found=tracks)
        report = replace(report, tried=tried, advice=_advice(request, report, tried))
        _write_pairs(request.pairs_table, tried)
        write_run_record(
            output,
            key=key,
            inputs=[entry, *(input_entry(i.path, name[1]) for i, name in zip(images, store.names))],
            run={"workers": request.workers, **times()},
            kind="tie points",
            product=report,
            settings=pick(request, "pairs", "features", "levels", "per_image", "refine", "use_orientation"),
        )
    return report


def _check(request: TieRequest, project: Project, names: Sequence[str]) -> Path:
    """The output, and everything that can be refused before any work."""
    if len(names) < 2:
        raise UsageError(f"{len(names)} image; tie points need two images at least")
    if request.levels < 1:
        raise UsageError(f"`levels` {request.levels}; 1 is the least")
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
    if request.pairs not in ("auto", "all"):
        inputs.append(Path(request.pairs))
    if not request.dry_run:
        for file in (output, request.pairs_table):
            check_output(file, inputs, overwrite=request.overwrite)
    return output


def _factor(request: TieRequest, images: Sequence[TieImage]) -> int:
    if request.scale is not None:
        if not 0.01 <= request.scale <= 1:
            raise UsageError(f"scale {request.scale:g}; a number from 0.01 to 1 is needed, such as 0.5")
        return round(1 / request.scale)
    longest = max(max(image.grey.size) for image in images)
    return max(1, -(-longest // _LONGEST))


@dataclass(frozen=True, eq=False)
class _Level:
    """Pairs that were tried with one kind of features."""

    store: FeatureStore
    pairs: list[PairMatches]
    """Those that are not verified have no matches."""
    found: TracksFound

    @property
    def factor(self) -> int:
        return self.store.settings.factor

    def tried(self, names: Sequence[str]) -> Iterator[TriedPair]:
        """Every pair, with the reason where it is not verified."""
        for p in self.pairs:
            alike = p.tried < VerifySettings().least
            reason = "too few features look alike" if alike else "features that look alike fit no common geometry"
            own, reason = self.store.settings, "" if len(p) else reason
            scale = 1 / own.factor
            yield TriedPair(
                first=names[p.first],
                second=names[p.second],
                scale=scale,
                features=own.count,
                matches=p.tried,
                verified=len(p),
                reason=reason,
            )


def _matched(
    store: FeatureStore,
    features: list[Features],
    pairs: Sequence[tuple[int, int]],
    verify: VerifySettings,
    run: Steps,
    events: Events,
) -> _Level:
    events.begin("matching", len(pairs), "pairs")
    found = find_pairs(store, pairs, verify, run)
    return _Level(store, found, build_tracks(features, [p for p in found if len(p)], 1.5 * store.settings.factor))


def _climb(request: TieRequest, levels: list[_Level], run: Steps, events: Events) -> None:
    """Try pairs of weakly connected images with other features, level by level, until none is left; `levels` grow."""
    first = levels[0].store
    images, sizes = first.images, [min(image.grey.size) for image in first.images]
    for number, (factor, more, contrast) in enumerate(_LEVELS[: request.levels - 1], 1):
        reduced = factor * first.settings.factor
        if factor > 1 and (request.scale is not None or min(sizes) < _SMALLEST * reduced):
            continue
        weak = weak_images(len(images), joined_tracks([level.found.tracks for level in levels]))
        if not weak:
            return
        matches: dict[tuple[int, int], int] = {}
        for p in (p for level in levels for p in level.pairs):
            matches[p.first, p.second] = max(len(p), matches.get((p.first, p.second), 0))
        wanted = set(matches) | (further_pairs(images, weak) if request.pairs == "auto" else set())
        of_weak = set(weak)
        pairs = sorted(p for p in wanted if of_weak & set(p) and matches.get(p, 0) < _PLENTY)
        if not pairs:
            return
        settings = FeatureSettings(more * first.settings.count, reduced, contrast)
        store = FeatureStore(images, settings, first.log, number)
        which = sorted({k for pair in pairs for k in pair})
        events.talk(
            f"{len(weak)} of {len(images)} images are not connected: trying {len(pairs)} pairs with "
            f"{settings.count} features at scale 1/{reduced}"
        )
        events.begin("features", len(which), "images")
        features = find_features(store, which, run)
        levels.append(_matched(store, features, pairs, VerifySettings(threshold=2.0 * reduced), run, events))


def _write_pairs(path: Path, tried: Sequence[TriedPair]) -> None:
    """Write a table of all pairs at all levels."""
    write_table(path, [field.name for field in fields(TriedPair)], (astuple(each) for each in tried))


def _advice(request: TieRequest, report: TieReport, tried: Sequence[TriedPair]) -> str:
    """What failed of the images that are not connected, and what to change."""
    if not report.unconnected:
        return ""
    lost = set(report.unconnected)
    counts: dict[str, int] = {}
    for t in tried:
        if t.reason and lost & {t.first, t.second}:
            counts[t.reason] = counts.get(t.reason, 0) + 1
    levels = list(dict.fromkeys((t.features, t.scale) for t in tried))
    shown = ", ".join(f"{n} at scale {scale:.2g}" for n, scale in levels)
    why = "; ".join(f"{reason} ({n} times)" for reason, n in sorted(counts.items(), key=lambda c: -c[1]))
    every = len(report.images) * (len(report.images) - 1) // 2
    ways = [
        *(["`pairs` all"] if report.pairs < every and request.pairs == "auto" else []),
        f"`features` {2 * max(n for n, _ in levels)}",
        *(["`scale` 0.25 or smaller"] if all(scale > 0.25 for _, scale in levels) else []),
    ]
    return (
        f"features tried: {shown}. {why or 'No pair of them was chosen'}. Set " + ", ".join(ways) + ", measure points "
        "by hand in these images, or leave them out with `images`"
    )


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


def _refuse_nothing(
    request: TieRequest, verified: int, tried: int, names: Sequence[str], levels: Sequence[_Level]
) -> None:
    if not verified:
        kinds = ", ".join(f"{k.store.settings.count} features at scale 1/{k.factor}" for k in levels)
        raise GeometryError(
            f"{request.project}: none of {tried} pairs of {len(names)} images ({some(list(names))}) could be verified "
            f"({kinds}): no overlap, or too little texture. Choose other images with `images`, or set `pairs` to all, "
            "more `features`, or another `scale`"
        )


def _refine(
    request: TieRequest, parts: Sequence[tuple[int, Tracks]], images: Sequence[TieImage], run: Steps
) -> tuple[Tracks, Refined | None, Loops | None]:
    """Tracks with standard deviations; first at the scale of their features, then at full resolution.

    `parts` are the tracks of each scale, with its reduction. Tracks of weakly connected images that noise hides at full
    resolution get the place that they have in reduced images.
    """
    greys: list[Grey] = [image.grey for image in images]
    settings, own = RefineSettings(), []
    for factor, tracks in parts:
        if not request.refine:
            sigma = np.maximum(_FEATURE_SIGMA * factor, _FEATURE_SHARE * tracks.scale)
            own.append(replace(tracks, sigma=np.repeat(sigma[:, None], 2, axis=1)))
        elif factor > 1:
            small: list[Grey] = [ReducedImage(image.grey, factor) for image in images]
            rough = refine_tracks(_scaled(tracks, 1 / factor), small, replace(settings, sigma=np.inf), run=run)
            own.append(_scaled(rough.tracks, factor))
        else:
            own.append(tracks)
    tracks = joined_tracks(own)
    if not request.refine:
        return tracks, None, None
    loops = close_loops(tracks, reference_points(tracks, [g.size for g in greys]), greys, settings, run=run)
    refined = refine_tracks(tracks, greys, settings, loops.factor, run)
    kept = refined.tracks
    for factor in _COARSER:
        weak = weak_images(len(images), kept)
        if not weak or min(min(g.size) for g in greys) < _SMALLEST * factor:
            break
        # Of a track that keeps three rays, or all of them, the finer place counts.
        rays = _rays_in(tracks, kept)
        wanted = np.zeros(tracks.count, bool)
        wanted[tracks.track[np.isin(tracks.image, weak)]] = True
        sub = _scaled(tracks.of_tracks(wanted & (rays < 3) & (rays < tracks.rays)), 1 / factor)
        if not len(sub):
            continue
        small = [ReducedImage(image.grey, factor) for image in images]
        closed = close_loops(sub, reference_points(sub, [g.size for g in small]), small, settings, run=run)
        coarse = refine_tracks(sub, small, settings, closed.factor, run).tracks
        coarse = replace(_scaled(coarse, factor), sigma=coarse.sigma * factor)
        kept = joined_tracks([kept.of_tracks(_rays_in(kept, coarse) == 0), coarse])
    return kept, refined, loops


def _rays_in(tracks: Tracks, others: Tracks) -> NDArray[np.int64]:
    """How many points of each track belong to any of other tracks, which were made from the same features."""
    known = set(zip(others.image.tolist(), others.angle.tolist()))
    there = [key in known for key in zip(tracks.image.tolist(), tracks.angle.tolist())]
    return np.bincount(tracks.track[np.array(there, bool)], minlength=tracks.count)


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
    levels: Sequence[_Level],
    pairs: int,
    verified: int,
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
        factor=levels[0].factor,
        pairs=pairs,
        verified=verified,
        tracks=sum(level.found.tracks.count for level in levels),
        ambiguous=sum(level.found.ambiguous for level in levels),
        points=tracks.count,
        rays={int(k): int(n) for k, n in zip(rays, number)},
        per_image={name: int(n) for name, n in zip(names, per_image)},
        parts=tuple(tuple(names[k] for k in part) for part in parts),
        refined=None,
        loops=None,
        sigma=float(np.median(tracks.sigma)),
        notes=tuple(notes),
    )
