"""Features and verified matches of many images: done image by image, in threads, kept on the disk."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.events import Events, Map
from photoplan.io.array_file import array_key, load_arrays, store_arrays
from photoplan.io.fingerprint import fingerprint
from photoplan.io.names import unique_stems
from photoplan.matching.features import Features, FeatureSettings, extract_features
from photoplan.matching.pairs import match_features, pairs_by_likeness
from photoplan.matching.verify import PairMatches, VerifySettings, verify_pair
from photoplan.products.tie.inputs import TieImage, guide_of

#: Changes when kept features or matches mean something else.
_FORM = 1
#: Images whose features are in memory with their descriptors.
_IN_MEMORY = 64
_FIELDS = ("xy", "scale", "angle", "strength", "descriptors")


@dataclass(frozen=True, eq=False)
class FeatureStore:
    """Features of all images, kept on the disk; descriptors of a few images are in memory."""

    folder: Path
    images: tuple[TieImage, ...]
    settings: FeatureSettings
    keys: tuple[str, ...] = field(init=False)
    paths: tuple[Path, ...] = field(init=False)
    _cached: Callable[[int], Features] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        facts = asdict(self.settings)
        keys = [array_key(_FORM, fingerprint(i.path).digest, facts, i.grey.area) for i in self.images]
        stems = unique_stems(i.name for i in self.images)
        object.__setattr__(self, "keys", tuple(keys))
        object.__setattr__(self, "paths", tuple(self.folder / f"{stems[i.name]}.features.npz" for i in self.images))
        object.__setattr__(self, "_cached", lru_cache(maxsize=_IN_MEMORY)(self._load))

    def __getitem__(self, k: int) -> Features:
        return self._cached(k)

    def _load(self, k: int) -> Features:
        kept = load_arrays(self.paths[k], self.keys[k])
        if kept is not None:
            return Features(*(kept[name] for name in _FIELDS))
        found = extract_features(self.images[k].grey, self.settings)
        store_arrays(self.paths[k], self.keys[k], {name: getattr(found, name) for name in _FIELDS})
        return found

    def places(self, k: int) -> Features:
        """Features without their descriptors."""
        f = self._load(k)
        return Features(f.xy, f.scale, f.angle, f.strength, np.empty((len(f), 0), np.uint8))


def find_features(store: FeatureStore, run: Map, events: Events) -> list[Features]:
    """Features of all images, without descriptors."""
    found = []
    for k, features in enumerate(run(store.places, range(len(store.images)))):
        width, height = store.images[k].grey.size
        events.done(1, width * height)
        found.append(features)
    return found


def like_pairs(store: FeatureStore, largest: int = 800) -> list[tuple[int, int]]:
    """Pairs that share large features."""
    coarse = []
    for k in range(len(store.images)):
        f = store[k]
        coarse.append(f.where(np.argsort(-f.scale, kind="stable")[:largest]))
    return pairs_by_likeness(coarse, largest)


def find_pairs(
    store: FeatureStore,
    pairs: Sequence[tuple[int, int]],
    settings: VerifySettings,
    run: Map,
    events: Events,
) -> list[PairMatches]:
    """Verified matches of the pairs; those that are not verified have none. Kept for each first image."""
    groups: dict[int, list[int]] = {}
    for i, j in pairs:
        groups.setdefault(i, []).append(j)

    def work(task: tuple[int, list[int]]) -> list[PairMatches]:
        return _of_image(store, task[0], task[1], settings)

    found: list[PairMatches] = []
    for (_, partners), part in zip(groups.items(), run(work, groups.items())):
        found += part
        events.done(len(partners))
    return found


def _of_image(store: FeatureStore, i: int, partners: list[int], settings: VerifySettings) -> list[PairMatches]:
    """Matches of one image with its partners."""
    facts = [(store.keys[j], repr(store.images[j].calibration), _place(store.images[j])) for j in (i, *partners)]
    key = array_key(_FORM, asdict(settings), facts)
    path = store.paths[i].with_name(store.paths[i].name.replace(".features.", ".pairs."))
    kept = load_arrays(path, key)
    if kept is None:
        found = [_pair(store, i, j, settings) for j in partners]
        start = np.cumsum([0, *(len(p) for p in found)])
        rows: NDArray[np.int64] = np.concatenate([np.empty((0, 2), np.int64), *(p.features for p in found)])
        store_arrays(path, key, {"start": start, "rows": rows, "tried": np.array([p.tried for p in found])})
        return found
    start, rows, tried = kept["start"], kept["rows"], kept["tried"]
    return [PairMatches(i, j, rows[start[k] : start[k + 1]], int(tried[k])) for k, j in enumerate(partners)]


def _place(image: TieImage) -> str:
    """What guides the matching."""
    if not image.placed or image.camera is None:
        return ""
    corners = image.on_ground(np.array([[0.0, 0.0], [image.grey.size[0], image.grey.size[1]]]))
    return repr((image.camera.center.tolist(), image.level, corners.tolist()))


def _pair(store: FeatureStore, i: int, j: int, settings: VerifySettings) -> PairMatches:
    a, b = store[i], store[j]
    one, other = store.images[i], store.images[j]
    matches = match_features(a, b, guide=guide_of(one, other, a.xy))
    xy = a.xy[matches[:, 0]], b.xy[matches[:, 1]]
    good = verify_pair(xy, (one.calibration, other.calibration), settings)
    return PairMatches(i, j, matches[good], len(matches))
