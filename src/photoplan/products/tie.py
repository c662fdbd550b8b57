"""Tie points: features, matches and refined points between the images of a project."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import CentralCamera, Projection, Rays, project
from photoplan.cameras.curvature import MapProjection
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.observed import ImagePoints
from photoplan.engine.run import Steps, Store, steps
from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.disk import lock_of
from photoplan.io.files import ImageNames, fingerprint, read_text
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import read_observed_positions, write_image_points
from photoplan.io.product import check_output
from photoplan.io.project.edit import ProjectChanges, edit_project
from photoplan.io.project.file import load_project
from photoplan.io.project.model import Image, Project, interior_of, lens_of
from photoplan.io.raster import RasterReader
from photoplan.io.store import ResultLog, input_entry, run_key, run_times, together, write_run_record
from photoplan.io.tables import write_table
from photoplan.matching.features import (
    NEIGHBOURS,
    Calibration,
    Features,
    FeatureSettings,
    Grey,
    GreyImage,
    Guide,
    PairMatches,
    ReducedImage,
    Tracks,
    TracksFound,
    VerifySettings,
    all_pairs,
    build_tracks,
    connected_parts,
    extract_features,
    joined_tracks,
    match_features,
    no_features,
    opencv,
    pairs_by_distance,
    pairs_by_footprints,
    pairs_by_likeness,
    thin_tracks,
    verify_pair,
    weak_images,
)
from photoplan.matching.refine import Loops, Refined, RefineSettings, close_loops, reference_points, refine_tracks
from photoplan.plain import pick
from photoplan.plan.footprint import mean_gsd
from photoplan.products.init import some
from photoplan.products.rectify import rectify
from photoplan.project.cameras import check_camera_size, pose_of
from photoplan.project.ground import ground_of
from photoplan.project.scene import Scene, input_files, open_scene
from photoplan.requests.orient import TieRequest

#: Up to so many images all pairs are tried where nothing is known of their places.
FEW_IMAGES = 30
#: Where a feature is expected in another image by approximate orientation, it is looked for within this part of the
#: image's diagonal.
_SEARCH = 0.15
#: Part of the extent of the marks that is left out along the border of a scan: the marks themselves are no ground.
_FRAME = 0.02


class Placing(Projection, Rays, Protocol):
    """Geometry by which an image is placed: a central camera, or the map."""

    @property
    def center(self) -> NDArray[np.float64]:
        """From where it looks, (3,), metres."""
        ...


@dataclass(frozen=True, eq=False)
class TieImage:
    """An image and what is known of it."""

    name: str
    path: Path
    grey: GreyImage
    calibration: Calibration | None
    """None: a scan whose marks are not measured."""
    camera: Placing | None
    """Approximate orientation; None: not oriented, or not to be used."""
    level: float
    """Height of the ground below, metres; NaN: not known."""
    position: NDArray[np.float64] | None
    """Projection centre or antenna (3,), metres; None: not known."""
    geometry: str = ""
    """Values that decide its pixels in addition to its file."""

    @property
    def placed(self) -> bool:
        """Return whether orientation and height of the ground are known."""
        return self.camera is not None and bool(np.isfinite(self.level))

    def on_ground(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where rays of image points (n, 2) meet the level of the ground, (n, 3); NaN if they do not."""
        assert self.camera is not None
        origin, direction = self.camera.rays(xy, self.level)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.level - origin[:, 2:]) / direction[:, 2:]
            return np.where((direction[:, 2:] < 0) & (t > 0), origin + t * direction, np.nan)


def open_images(project_: Project, names: Sequence[str], use_orientation: bool) -> tuple[list[TieImage], list[str]]:
    """Open images of a project; return notes on what is unknown about some, too."""
    images = [project_.image(name) for name in names]
    positions = _positions(project_, use_orientation)
    cameras, levels = _placed(project_, images) if use_orientation else ([None] * len(images), [np.nan] * len(images))
    opened, notes = [], []
    for image, camera, level in zip(images, cameras, levels):
        reader = RasterReader(project_.resolve(image.file), alpha=image.alpha)
        calibration = _calibration(project_, image, reader.size)
        if calibration is None:
            notes.append(f"{image.name}: fiducial marks not measured, its pairs are verified without a camera")
        position = positions.get(image.name) if camera is None else camera.center
        grey = GreyImage(reader, _area(image, reader.size))
        opened.append(
            TieImage(
                name=image.name,
                path=reader.path,
                grey=grey,
                calibration=calibration,
                camera=camera,
                level=level,
                position=position,
            )
        )
    return opened, notes


def _calibration(project_: Project, image: Image, size: tuple[int, int]) -> Calibration | None:
    description = project_.cameras[image.camera]
    check_camera_size(project_, image, size)
    if not description.places(image.fiducials):
        return None
    return Calibration(interior_of(description, image, size), lens_of(description))


def _area(image: Image, size: tuple[int, int]) -> tuple[float, float, float, float] | None:
    """Return the area inside the fiducial marks of a scan."""
    if not image.fiducials:
        return None
    xy = np.array(list(image.fiducials.values()), float)
    low, high = xy.min(axis=0), xy.max(axis=0)
    inset = _FRAME * (high - low)
    xmin, ymin = np.maximum(low + inset, 0)
    xmax, ymax = np.minimum(high - inset, np.array(size) - 1)
    return float(xmin), float(ymin), float(xmax), float(ymax)


def _positions(project_: Project, use: bool) -> dict[str, NDArray[np.float64]]:
    """Return observed positions by the names of images."""
    if not use or project_.observations.positions is None:
        return {}
    orientation = project_.orientation
    form = TableFormat.of(orientation.angle_unit, orientation.rotation)
    table = read_observed_positions(
        project_.resolve(project_.observations.positions),
        form,
        crs=project_.crs,
        height_system=orientation.height_system,
    )
    found = ImageNames(image.name for image in project_.images).match(table.images)
    return {name: XYZ for name, XYZ in zip(found, table.XYZ) if name is not None}


def _placed(project_: Project, images: Sequence[Image]) -> tuple[list[CentralCamera | None], list[float]]:
    """Return the cameras of oriented images, and the height of the ground below each."""
    cameras: list[CentralCamera | None] = [None] * len(images)
    levels = np.full(len(images), np.nan)
    if project_.terrain is None:
        return cameras, levels.tolist()
    ground = ground_of(project_)
    for k, image in enumerate(images):
        description = project_.cameras[image.camera]
        if image.center is None or not description.places(image.fiducials):
            continue
        pose = pose_of(project_, image, ground)
        cameras[k] = oriented_camera(interior_of(description, image), lens_of(description), pose)
        levels[k] = float(ground.bare.heights(pose.center[:2]))
    if np.isfinite(levels).any():
        levels = np.where(np.isfinite(levels), levels, np.nanmedian(levels))
    return cameras, levels.tolist()


def chosen_pairs(images: Sequence[TieImage], how: Path | str) -> tuple[list[tuple[int, int]] | None, str]:
    """Return the pairs to compare, or None if features must decide, and how they were chosen."""
    if how == "all":
        return all_pairs(len(images)), "all pairs"
    if isinstance(how, Path):
        return _listed(images, how), f"pairs of {how}"
    if all(image.placed for image in images):
        border = [image.on_ground(_border(image.grey.size)) for image in images]
        outlines = [b[np.isfinite(b).all(axis=1), :2] for b in border]
        if min(map(len, outlines)) >= 3:
            return pairs_by_footprints(outlines), "pairs with common ground by approximate orientation"
    if all(image.position is not None for image in images):
        positions = np.array([image.position for image in images])
        return pairs_by_distance(positions), "pairs of neighbours by position"
    if len(images) <= FEW_IMAGES:
        return all_pairs(len(images)), "all pairs"
    return None, "pairs that share large features"


def _border(size: tuple[int, int]) -> NDArray[np.float64]:
    t = np.linspace(-0.5, 0.5, 5)
    edge = np.concatenate([np.stack([t, np.full(5, s)], axis=1)[:, ::d] for s in (-0.5, 0.5) for d in (1, -1)])
    return (edge + 0.5) * np.array(size) - 0.5


def _listed(images: Sequence[TieImage], path: Path) -> list[tuple[int, int]]:
    at = {image.name: k for k, image in enumerate(images)}
    names = ImageNames(at)
    found = set()
    for number, line in enumerate(read_text(path, 50_000_000).split("\n"), 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        words = [w.strip() for w in text.replace(";", ",").replace("\t", ",").split(",")]
        words = text.split() if len(words) == 1 else words
        if len(words) != 2:
            raise InputError(f"{path}:{number}: {len(words)} names; two images are needed in each line")
        try:
            known = [names.find(w) for w in words]
        except InputError as error:
            raise InputError(f"{path}:{number}: {error}") from None
        lost = [w for w, name in zip(words, known) if name is None]
        if lost:
            raise InputError(f"{path}:{number}: image {lost[0]!r} is not among the {len(images)} images of this run")
        i, j = sorted(at[name] for name in known if name is not None)
        if i == j:
            raise InputError(f"{path}:{number}: image {words[0]!r} is paired with itself")
        found.add((i, j))
    if not found:
        raise InputError(f"{path}: holds no pair; give the names of two images in each line")
    return sorted(found)


def guide_of(a: TieImage, b: TieImage, xy: NDArray[np.float64]) -> Guide | None:
    """Return where features of a are expected in b by approximate orientation; None if that is unknown."""
    if not (a.placed and b.placed):
        return None
    assert b.camera is not None
    return Guide(project(b.camera, a.on_ground(xy)), _SEARCH * float(np.hypot(*b.grey.size)))


#: Features of an image that are compared to find pairs, those of the largest scale.
_LARGEST = 800
#: Images whose features are in memory with their descriptors.
_IN_MEMORY = 64


@dataclass(frozen=True, eq=False)
class FeatureStore:
    """Features of all images, kept in a store; those of a few images are in memory."""

    images: tuple[TieImage, ...]
    settings: FeatureSettings
    log: Store
    """Its key holds the settings of the first level."""
    level: int = 0
    """Position of the settings among those that are tried."""
    names: tuple[tuple[str, ...], ...] = field(init=False)
    """Values that the features of each image depend on in addition to the settings."""
    _cached: Callable[[int], Features] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = tuple(
            (
                "features",
                fingerprint(i.path).digest,
                repr(i.grey.area),
                *([i.geometry] if i.geometry else []),
                *([repr(self.settings)] if self.level else []),
            )
            for i in self.images
        )
        object.__setattr__(self, "names", names)
        read = lru_cache(maxsize=_IN_MEMORY)(lambda k: self.log[self.log.index(names[k])])
        object.__setattr__(self, "_cached", read)

    def __getitem__(self, k: int) -> Features:
        return self._cached(k)

    @property
    def seen(self) -> list[tuple[str, ...]]:
        """Return the values that matches of each image depend on in addition to the settings."""
        return [(*name, repr(i.calibration), _place(i)) for name, i in zip(self.names, self.images)]


def find_features(store: FeatureStore, which: Sequence[int], run: Steps) -> list[Features]:
    """Find features of some images, without their descriptors; the others have none."""
    found = run(
        lambda i: extract_features(i.grey, store.settings),
        [store.images[k] for k in which],
        [store.names[k] for k in which],
        lambda i: int(np.prod(i.grey.size)),
    )
    out = [no_features()] * len(store.images)
    for k, f in zip(which, found):
        bare = np.empty((len(f), 0), np.uint8)
        out[k] = Features(xy=f.xy, scale=f.scale, angle=f.angle, strength=f.strength, descriptors=bare)
    return out


def further_pairs(images: Sequence[TieImage], weak: Sequence[int]) -> set[tuple[int, int]]:
    """Return pairs of weakly connected images: with all of a small block, else with more neighbours than usual."""
    if len(images) <= FEW_IMAGES:
        return {(min(i, j), max(i, j)) for i in weak for j in range(len(images)) if i != j}
    places = [image.position for image in images]
    if any(place is None for place in places):
        return set()
    XYZ = np.array(places, float)
    found = set()
    for i in weak:
        near = np.argsort(np.linalg.norm(XYZ - XYZ[i], axis=1), kind="stable")[1 : 2 * NEIGHBOURS + 1]
        found |= {(min(i, int(j)), max(i, int(j))) for j in near}
    return found


def like_pairs(store: FeatureStore) -> list[tuple[int, int]]:
    """Return pairs that share large features."""
    coarse = []
    for k in range(len(store.images)):
        f = store[k]
        coarse.append(f.where(np.argsort(-f.scale, kind="stable")[:_LARGEST]))
    return pairs_by_likeness(coarse)


def find_pairs(
    store: FeatureStore, pairs: Sequence[tuple[int, int]], settings: VerifySettings, run: Steps
) -> list[PairMatches]:
    """Find verified matches of the pairs; those that are not verified have none."""
    order = {first: number for number, first in enumerate(dict.fromkeys(i for i, _ in pairs))}
    # Pairs with a common first image follow each other: its features are in memory then.
    pairs = sorted(pairs, key=lambda pair: order[pair[0]])
    seen = store.seen
    names = [("pair", seen[i], seen[j]) for i, j in pairs]
    found = run(lambda pair: _pair(store, pair[0], pair[1], settings), pairs, names)
    return [PairMatches(i, j, features, tried) for (i, j), (features, tried) in zip(pairs, found)]


def _place(image: TieImage) -> str:
    """Return the approximate orientation that guides the matching, as text."""
    if not image.placed or image.camera is None:
        return ""
    corners = image.on_ground(np.array([[0.0, 0.0], [image.grey.size[0], image.grey.size[1]]]))
    return repr((image.camera.center.tolist(), image.level, corners.tolist()))


def _pair(store: FeatureStore, i: int, j: int, settings: VerifySettings) -> tuple[NDArray[np.int64], int]:
    """Return verified matches of a pair as indices of features, and the number of matches before."""
    a, b = store[i], store[j]
    one, other = store.images[i], store.images[j]
    matches = match_features(a, b, guide=guide_of(one, other, a.xy))
    xy = a.xy[matches[:, 0]], b.xy[matches[:, 1]]
    good = verify_pair(xy, (one.calibration, other.calibration), settings)
    return matches[good], len(matches)


_Floats = NDArray[np.float64]
#: Side of the pieces, pixels, and how many of an image are kept in memory.
_PIECE, _KEPT = 512, 32


@dataclass(frozen=True, eq=False)
class RectifiedPixels:
    """An image on the map."""

    scene: Scene
    grid: MapGrid
    _piece: Callable[[int, int], tuple[NDArray[Any], NDArray[np.bool_]]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_piece", lru_cache(maxsize=_KEPT)(self._made))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels of the map."""
        return self.grid.width, self.grid.height

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Read a window inside the image, shape (bands, height, width), and its validity."""
        bands, dtype = self.scene.reader.bands, self.scene.reader.dtype
        values = np.zeros((bands, window.height, window.width), dtype)
        valid = np.zeros((window.height, window.width), bool)
        for row in range(window.row // _PIECE, -(-window.stop[1] // _PIECE)):
            for col in range(window.col // _PIECE, -(-window.stop[0] // _PIECE)):
                place = Window(col * _PIECE, row * _PIECE, _PIECE, _PIECE) & self.grid.window
                common = place & window
                made, known = self._piece(col, row)
                there, here = common.slices(place), common.slices(window)
                values[:, here[0], here[1]] = made[:, there[0], there[1]]
                valid[here] = known[there]
        return values, valid

    def _made(self, col: int, row: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        place = Window(col * _PIECE, row * _PIECE, _PIECE, _PIECE) & self.grid.window
        g = self.grid
        part = MapGrid(
            left=g.left + place.col * g.resolution,
            top=g.top - place.row * g.resolution,
            resolution=g.resolution,
            width=place.width,
            height=place.height,
            crs=g.crs,
        )
        made = rectify(self.scene.reader, self.scene.camera, part, self.scene.ground.bare)
        return made.values, made.valid

    def carried(self, uv: _Floats) -> tuple[_Floats, _Floats]:
        """Return image points (n, 2) of points on the map (n, 2), and derivatives (n, 2, 2); NaN if there are none."""
        half = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        at = uv[:, None] + half
        g = self.grid
        XY = np.stack([g.left + (at[..., 0] + 0.5) * g.resolution, g.top - (at[..., 1] + 0.5) * g.resolution], axis=-1)
        # The slope of the ground has no part in what a piece shows around a point, its height has.
        heights = np.broadcast_to(np.asarray(self.scene.ground.bare.heights(XY[:, 0]))[:, None], XY.shape[:2])
        xy = project(self.scene.camera, np.concatenate([XY, heights[..., None]], axis=-1))
        return xy[:, 0], np.stack([xy[:, 1] - xy[:, 2], xy[:, 3] - xy[:, 4]], axis=-1)


@dataclass(frozen=True, eq=False)
class MapView:
    """A rectified image as a camera that looks straight down on the map."""

    grid: MapGrid

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels of the map."""
        return self.grid.width, self.grid.height

    field: ClassVar[None] = None
    """Maps are ideal."""
    breaks: ClassVar[None] = None
    """Maps are smooth."""

    @property
    def center(self) -> _Floats:
        """Above its middle, (3,)."""
        xmin, ymin, xmax, ymax = self.grid.bounds
        return np.array([(xmin + xmax) / 2, (ymin + ymax) / 2, 1.0])

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """Return (x, y, 1) of ground points (..., 3)."""
        return MapProjection(self.grid.placement).project_homogeneous(XYZ)

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[_Floats, _Floats]:
        """Return rays straight down, from a metre above the zero of heights."""
        xy, g = np.asarray(xy, float), self.grid
        X, Y = g.left + (xy[..., 0] + 0.5) * g.resolution, g.top - (xy[..., 1] + 0.5) * g.resolution
        down = np.broadcast_to([0.0, 0.0, -1.0], (*X.shape, 3))
        return np.stack([X, Y, np.ones_like(X)], axis=-1), down


def open_rectified(project_: Project, names: Sequence[str], use_orientation: bool) -> tuple[list[TieImage], list[str]]:
    """Open images of a project on the map at the coarsest of their resolutions, and note that."""
    if not use_orientation:
        raise UsageError("satellites and strips are matched on the map, by the orientation that they come with; use it")
    scenes = [open_scene(project_, name) for name in names]
    for name, scene in zip(names, scenes):
        if scene.footprint.bounds is None:
            raise InputError(f"image {name!r} sees nothing of the terrain; tie points are looked for on the map")
    resolution = float(f"{max(mean_gsd(scene.camera, scene.footprint) for scene in scenes):.3g}")
    opened = []
    for name, scene in zip(names, scenes):
        assert scene.footprint.bounds is not None
        grid = MapGrid.covering(scene.footprint.bounds, resolution, project_.crs)
        opened.append(
            TieImage(
                name=name,
                path=scene.reader.path,
                grey=GreyImage(RectifiedPixels(scene, grid)),
                calibration=None,
                camera=MapView(grid),
                level=0.0,
                position=None,
                geometry=repr((scene.address.facts, grid)),
            )
        )
    return opened, [f"matched on the map over the terrain, at {resolution:g} m"]


def carried_back(tracks: Tracks, images: Sequence[TieImage], points: ImagePoints) -> ImagePoints:
    """Return points found on the map as points in the images; tracks with fewer than two of them are dropped."""
    xy, sigma = np.full_like(points.xy, np.nan), np.full_like(points.xy, np.nan)
    good = np.zeros(len(points), bool)
    for k in np.unique(tracks.image):
        mine, pixels = np.flatnonzero(tracks.image == k), images[k].grey.pixels
        assert isinstance(pixels, RectifiedPixels)
        xy[mine], J = pixels.carried(tracks.xy[mine])
        sigma[mine] = np.sqrt((J**2 @ tracks.sigma[mine][:, :, None] ** 2)[..., 0])
        size = np.array(pixels.scene.camera.size)
        with np.errstate(invalid="ignore"):
            good[mine] = ((xy[mine] > -0.5) & (xy[mine] < size - 0.5)).all(axis=1) & (sigma[mine] > 0).all(axis=1)
    good &= np.bincount(points.point[good], minlength=len(points.points))[points.point] >= 2
    whole = ImagePoints(
        images=points.images,
        points=points.points,
        image=points.image,
        point=points.point,
        xy=np.where(good[:, None], xy, 0.0),
        sigma=np.where(good[:, None], sigma, 1.0),
    )
    return whole.where(good)


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
class TriedPair:
    """A pair of images at one level of features."""

    first: str
    second: str
    scale: float
    """Scale of the images in which features were looked for."""
    features: int
    """Features per image at most."""
    matches: int
    """Features that look alike."""
    verified: int
    """Number of matches that fit the geometry of the pair."""
    reason: str
    """Reason why it is not verified; empty if it is."""


@dataclass(frozen=True)
class TieReport(Result):
    """Tie points of a project, and how they were found."""

    output: Path | None
    """The table of image points; None after a dry run."""
    images: tuple[str, ...]
    chosen: str
    """Way in which pairs were chosen."""
    factor: int
    """Features were searched in means of so many pixels along each side."""
    pairs: int
    notes: tuple[str, ...]
    verified: int = 0
    tracks: int = 0
    """Before thinning."""
    ambiguous: int = 0
    """Dropped: two places in one image."""
    points: int = 0
    rays: Mapping[int, int] = field(default_factory=dict)
    """Number of points by their number of images."""
    per_image: Mapping[str, int] = field(default_factory=dict)
    parts: tuple[tuple[str, ...], ...] = ()
    """Connected images, the largest part first."""
    refined: Refined | None = None
    loops: Loops | None = None
    sigma: float = float("nan")
    """Median standard deviation of a coordinate, pixels."""
    tried: tuple[TriedPair, ...] = ()
    """All pairs at all levels."""
    advice: str = ""
    """Advice that may connect the other images; empty if all are connected."""
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

    def summary(self) -> Sequence[str]:
        """Return counts, the quality of the refinement, and the points of each image."""
        if not self.per_image:
            return [f"{len(self.images)} images, {self.pairs or 'not yet known number of'} pairs: {self.chosen}"]
        kinds = dict.fromkeys((t.scale, t.features) for t in self.tried)
        scales = [f"1/{1 / scale:.0f}" + (f" ({count})" if k else "") for k, (scale, count) in enumerate(kinds)]
        rows = {
            "images": f"{len(self.images)}, features at scale " + ", ".join(scales),
            "pairs": f"{self.pairs} tried ({self.chosen}), {self.verified} verified",
            "tracks": f"{self.tracks} found, {self.ambiguous} ambiguous ones dropped",
            "tie points": f"{self.points}, standard deviation {self.sigma:.2g} px (median)",
            "  in images": ", ".join(f"{rays}: {count}" for rays, count in self.rays.items()),
        }
        if self.refined is not None and self.loops is not None:
            r, loops = self.refined, self.loops
            origin = f"from {loops.count} loops" if loops.measured else "assumed, too few loops"
            fit = f"correlation {r.correlation:.2f} (median), sigma of the fit × {loops.factor:.2f} ({origin})"
            rows["refinement"] = fit
            rows["  left out"] = f"{r.unsettled} not found, {r.unlike} unlike, {r.uncertain} uncertain"
        width = max(map(len, self.per_image))
        return [
            *(f"{what:12} {text}" for what, text in rows.items()),
            f"{'image':{width}}  points",
            *(f"{name:{width}}  {count:6}" for name, count in self.per_image.items()),
        ]

    def messages(self) -> Sequence[str]:
        """Return the notes, and the images that are not connected with the others."""
        if len(self.parts) < 2:
            return noted(self.notes)
        head = f"{len(self.unconnected)} of {len(self.images)} images do not hang together with the others"
        lines = [f"no overlap: {head}:", *("  " + ", ".join(part) for part in self.parts[1:]), self.advice]
        return noted([*self.notes, "\n".join(lines)])


def find_ties(request: TieRequest, events: Events = SILENT) -> TieReport:
    """Find tie points between the images of a project.

    Features, matches and refined places are kept in a file ``NAME.matches`` beside the output: a run that was
    interrupted continues, and another one with the same features begins with what is known.

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
    longest = max(max(image.grey.size) for image in images)
    factor = max(1, -(-longest // _LONGEST)) if request.scale is None else round(1 / request.scale)
    pairs, chosen = chosen_pairs(images, request.pairs)
    if request.dry_run:
        count = 0 if pairs is None else len(pairs)
        return TieReport(
            output=None, images=tuple(names), chosen=chosen, factor=factor, pairs=count, notes=tuple(notes)
        )
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
        if not verified:
            kinds = ", ".join(f"{k.store.settings.count} features at scale 1/{k.factor}" for k in levels)
            raise GeometryError(
                f"{request.project}: none of {len(pairs)} pairs of {len(names)} images ({some(names)}) could be "
                f"verified ({kinds}): no overlap, or too little texture. Choose other images with `images`, or set "
                "`pairs` to all, more `features`, or another `scale`"
            )
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
        rays, number = np.unique(tracks.rays, return_counts=True)
        per_image = np.bincount(tracks.image, minlength=len(names))
        report = TieReport(
            output=output,
            images=tuple(names),
            chosen=chosen,
            factor=levels[0].factor,
            pairs=len(pairs),
            notes=tuple(notes),
            verified=verified,
            tracks=sum(level.found.tracks.count for level in levels),
            ambiguous=sum(level.found.ambiguous for level in levels),
            points=tracks.count,
            rays={int(k): int(n) for k, n in zip(rays, number)},
            per_image={name: int(n) for name, n in zip(names, per_image)},
            parts=tuple(tuple(names[k] for k in part) for part in connected_parts(len(names), tracks)),
            refined=refined,
            loops=loops,
            sigma=float(np.median(tracks.sigma)),
            tried=tried,
            sources=tuple(images),
            found=tracks,
        )
        report = replace(report, advice=_advice(request, report, tried))
        columns = [each.name for each in fields(TriedPair)]
        write_table(request.pairs_table, columns, (astuple(each) for each in tried))
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
    """Return the output; refuse before any work what can be refused."""
    if len(names) < 2:
        raise UsageError(f"{len(names)} image; tie points need two images at least")
    opencv()
    output = request.product
    points = [project.resolve(file) for file in project.observations.image_points]  # an older run's among them
    inputs = [request.project, *(file for file in input_files(project) if file not in points)]
    if isinstance(request.pairs, Path):
        inputs.append(request.pairs)
    if not request.dry_run:
        for file in (output, request.pairs_table):
            check_output(file, inputs, overwrite=request.overwrite)
    return output


@dataclass(frozen=True, eq=False)
class _Level:
    """Pairs that were tried with one kind of features."""

    store: FeatureStore
    pairs: list[PairMatches]
    """Results of all pairs; pairs that are not verified have no matches."""
    found: TracksFound

    @property
    def factor(self) -> int:
        return self.store.settings.factor

    def tried(self, names: Sequence[str]) -> Iterator[TriedPair]:
        """Yield every pair, with the reason if it is not verified."""
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


def _advice(request: TieRequest, report: TieReport, tried: Sequence[TriedPair]) -> str:
    """Return why images are not connected, and what to change."""
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


def _refine(
    request: TieRequest, parts: Sequence[tuple[int, Tracks]], images: Sequence[TieImage], run: Steps
) -> tuple[Tracks, Refined | None, Loops | None]:
    """Refine tracks at the scale of their features, then at full resolution; they get standard deviations.

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
    """Count the points of each track that belong to other tracks, made from the same features."""
    known = set(zip(others.image.tolist(), others.angle.tolist()))
    there = [key in known for key in zip(tracks.image.tolist(), tracks.angle.tolist())]
    return np.bincount(tracks.track[np.array(there, bool)], minlength=tracks.count)


def _scaled(tracks: Tracks, by: float) -> Tracks:
    """Return tracks in another scale of the images, without standard deviations."""
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
