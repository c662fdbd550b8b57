"""Features and verified matches of many images: images and pairs are tasks, their results kept on the disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.steps import Steps, Store
from photoplan.io.fingerprint import fingerprint
from photoplan.matching.features import Features, FeatureSettings, extract_features
from photoplan.matching.pairs import match_features, pairs_by_likeness
from photoplan.matching.tracks import Tracks
from photoplan.matching.verify import PairMatches, VerifySettings, verify_pair
from photoplan.products.tie.inputs import TieImage, guide_of

#: Images whose features are in memory with their descriptors.
#: Features of an image that are compared to find pairs, those of the largest scale.
_LARGEST = 800
_IN_MEMORY = 64


@dataclass(frozen=True, eq=False)
class FeatureStore:
    """Features of all images, kept in a store; those of a few images are in memory."""

    images: tuple[TieImage, ...]
    settings: FeatureSettings
    log: Store
    """Its key holds the settings."""
    names: tuple[tuple[str, ...], ...] = field(init=False)
    """What the features of each image depend on beside the settings."""
    _cached: Callable[[int], Features] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        names = tuple(("features", fingerprint(i.path).digest, repr(i.grey.area)) for i in self.images)
        object.__setattr__(self, "names", names)
        read = lru_cache(maxsize=_IN_MEMORY)(lambda k: self.log[self.log.index(names[k])])
        object.__setattr__(self, "_cached", read)

    def __getitem__(self, k: int) -> Features:
        return self._cached(k)


def find_features(store: FeatureStore, run: Steps) -> list[Features]:
    """Features of all images, without their descriptors."""
    images = store.images
    found = run(
        lambda i: extract_features(i.grey, store.settings), images, store.names, lambda i: int(np.prod(i.grey.size))
    )
    return [Features(f.xy, f.scale, f.angle, f.strength, np.empty((len(f), 0), np.uint8)) for f in found]


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
    known = [(*store.names[k], repr(i.calibration), _place(i)) for k, i in enumerate(store.images)]
    names = [("pair", known[i], known[j]) for i, j in pairs]
    found = run(lambda pair: _pair(store, pair[0], pair[1], settings), pairs, names)
    return [PairMatches(i, j, features, tried) for (i, j), (features, tried) in zip(pairs, found)]


def digest_of(tracks: Tracks, *more: object) -> str:
    """Digest of places that are to be refined, and of whatever else decides the result."""
    digest = hashlib.sha256(repr(more).encode())
    for values in (tracks.track, tracks.image, tracks.xy, tracks.scale, tracks.angle):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


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
