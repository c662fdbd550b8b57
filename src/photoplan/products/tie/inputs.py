"""What tie points start from: images with what is known of their cameras and places, pairs, features and matches.

Images and pairs are tasks; their features and verified matches are kept on the disk.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import CentralCamera, Projection, Rays, project
from photoplan.cameras.build import oriented_camera
from photoplan.engine.steps import Steps, Store
from photoplan.errors import InputError
from photoplan.io.fingerprint import fingerprint
from photoplan.io.names import ImageNames
from photoplan.io.observed_positions import read_observed_positions
from photoplan.io.orientation.table import TableFormat
from photoplan.io.plain_files import read_text
from photoplan.io.project.cameras import interior_of, lens_of
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.raster import RasterReader
from photoplan.matching.features import Features, FeatureSettings, extract_features, no_features
from photoplan.matching.grey import GreyImage
from photoplan.matching.pairs import (
    NEIGHBOURS,
    Guide,
    all_pairs,
    match_features,
    pairs_by_distance,
    pairs_by_footprints,
    pairs_by_likeness,
)
from photoplan.matching.verify import Calibration, PairMatches, VerifySettings, verify_pair
from photoplan.project.ground import ground_of
from photoplan.project.image_size import check_camera_size
from photoplan.project.posed import pose_of

#: Up to so many images all pairs are tried where nothing is known of their places.
FEW_IMAGES = 30
#: Where a feature is expected in another image by approximate orientation, it is looked for within this part of the
#: image's diagonal.
_SEARCH = 0.15
#: Part of the extent of the marks that is left out along the border of a scan: the marks themselves are no ground.
_FRAME = 0.02


class Placing(Projection, Rays, Protocol):
    """What tells where an image lies: a central camera, or the map."""

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
    """What decides its pixels beside its file."""

    @property
    def placed(self) -> bool:
        """Whether orientation and height of the ground are known."""
        return self.camera is not None and bool(np.isfinite(self.level))

    def on_ground(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where rays of image points (n, 2) meet the level of the ground, (n, 3); NaN for those that do not."""
        assert self.camera is not None
        origin, direction = self.camera.rays(xy, self.level)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.level - origin[:, 2:]) / direction[:, 2:]
            return np.where((direction[:, 2:] < 0) & (t > 0), origin + t * direction, np.nan)


def open_images(project_: Project, names: Sequence[str], use_orientation: bool) -> tuple[list[TieImage], list[str]]:
    """The images of a project, and notes on what is not known of some."""
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
    """Inside of the fiducial marks of a scan."""
    if not image.fiducials:
        return None
    xy = np.array(list(image.fiducials.values()), float)
    low, high = xy.min(axis=0), xy.max(axis=0)
    inset = _FRAME * (high - low)
    xmin, ymin = np.maximum(low + inset, 0)
    xmax, ymax = np.minimum(high - inset, np.array(size) - 1)
    return float(xmin), float(ymin), float(xmax), float(ymax)


def _positions(project_: Project, use: bool) -> dict[str, NDArray[np.float64]]:
    """Observed positions by the images' names."""
    if not use or project_.observations.positions is None:
        return {}
    orientation = project_.orientation
    form = TableFormat(angle_unit=orientation.angle_unit, rotation=orientation.rotation)
    table = read_observed_positions(
        project_.resolve(project_.observations.positions),
        form,
        crs=project_.crs,
        height_system=orientation.height_system,
    )
    found = ImageNames(image.name for image in project_.images).match(table.images)
    return {name: XYZ for name, XYZ in zip(found, table.XYZ) if name is not None}


def _placed(project_: Project, images: Sequence[Image]) -> tuple[list[CentralCamera | None], list[float]]:
    """Cameras of the oriented images, and the height of the ground below each."""
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


def chosen_pairs(images: Sequence[TieImage], how: str) -> tuple[list[tuple[int, int]] | None, str]:
    """Pairs to look at and how they were chosen; None: the features must tell."""
    if how == "all":
        return all_pairs(len(images)), "all pairs"
    if how != "auto":
        return _listed(images, Path(how)), f"pairs of {how}"
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
    """Where features of a are to be expected in b by approximate orientation; None if that is not known."""
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
    """What the features of each image depend on beside the settings."""
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
        """What matches of each image depend on beside the settings."""
        return [(*name, repr(i.calibration), _place(i)) for name, i in zip(self.names, self.images)]


def find_features(store: FeatureStore, which: Sequence[int], run: Steps) -> list[Features]:
    """Features of some images, without their descriptors; the others have none."""
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
    """Pairs of weakly connected images with the others: all of a small block, else twice the usual neighbours."""
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
    """Pairs that share large features."""
    coarse = []
    for k in range(len(store.images)):
        f = store[k]
        coarse.append(f.where(np.argsort(-f.scale, kind="stable")[:_LARGEST]))
    return pairs_by_likeness(coarse)


def find_pairs(
    store: FeatureStore, pairs: Sequence[tuple[int, int]], settings: VerifySettings, run: Steps
) -> list[PairMatches]:
    """Verified matches of the pairs; those that are not verified have none."""
    order = {first: number for number, first in enumerate(dict.fromkeys(i for i, _ in pairs))}
    # Pairs with a common first image follow each other: its features are in memory then.
    pairs = sorted(pairs, key=lambda pair: order[pair[0]])
    seen = store.seen
    names = [("pair", seen[i], seen[j]) for i, j in pairs]
    found = run(lambda pair: _pair(store, pair[0], pair[1], settings), pairs, names)
    return [PairMatches(i, j, features, tried) for (i, j), (features, tried) in zip(pairs, found)]


def _place(image: TieImage) -> str:
    """What guides the matching."""
    if not image.placed or image.camera is None:
        return ""
    corners = image.on_ground(np.array([[0.0, 0.0], [image.grey.size[0], image.grey.size[1]]]))
    return repr((image.camera.center.tolist(), image.level, corners.tolist()))


def _pair(store: FeatureStore, i: int, j: int, settings: VerifySettings) -> tuple[NDArray[np.int64], int]:
    """Verified matches of a pair as indices of features, and the number of matches before."""
    a, b = store[i], store[j]
    one, other = store.images[i], store.images[j]
    matches = match_features(a, b, guide=guide_of(one, other, a.xy))
    xy = a.xy[matches[:, 0]], b.xy[matches[:, 1]]
    good = verify_pair(xy, (one.calibration, other.calibration), settings)
    return matches[good], len(matches)
