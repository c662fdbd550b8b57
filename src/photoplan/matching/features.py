"""Points that can be recognised in other images: SIFT (Lowe 2004), spread over the image, described by root-SIFT.

Root-SIFT is the square root of the descriptor divided by its sum: Euclidean distances then compare histograms properly
(Arandjelović and Zisserman 2012, section 2).
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.codec import storable
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.matching.grey import GreyImage, to_bytes

#: A descriptor's numbers are kept as bytes, this many to one: their squares sum up to its square.
DESCRIPTOR_UNIT = 512.0
#: Parts that are worked on are not smaller than this, reduced pixels.
_LEAST_TILE = 128
#: Pixels (reduced) around a tile that its features may use.
_MARGIN = 96
#: The image is divided into this many cells along each side, which get an equal share of the features.
_CELLS = 12


@dataclass(frozen=True)
class FeatureSettings:
    """How features are looked for; decides whether kept ones can be used again."""

    count: int = 4000
    """Features per image at most."""
    factor: int = 1
    """Grey values are means of this many pixels along each side."""
    contrast: float = 0.015
    """Least contrast of a feature, part of the range of grey values."""
    tile: int = 2048
    """Side of the parts that are worked on at once, pixels of the full image."""


@storable
@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image."""

    xy: NDArray[np.float64]
    """Column and row, shape (n, 2), pixels of the full image."""
    scale: NDArray[np.float64]
    """Standard deviation of the Gaussian at which the feature was found, (n,), pixels of the full image."""
    angle: NDArray[np.float64]
    """Direction of the strongest slope, (n,), radians from the column axis towards the row axis."""
    strength: NDArray[np.float64]
    """Contrast, (n,)."""
    descriptors: NDArray[np.uint8]
    """Root-SIFT, shape (n, 128), in `DESCRIPTOR_UNIT`."""

    def __len__(self) -> int:
        return len(self.xy)

    def where(self, keep: NDArray[Any]) -> Features:
        """The features at `keep` (mask or indices)."""
        return Features(
            xy=self.xy[keep],
            scale=self.scale[keep],
            angle=self.angle[keep],
            strength=self.strength[keep],
            descriptors=self.descriptors[keep],
        )


def opencv() -> Any:
    """OpenCV, with one thread: work is divided over images."""
    try:
        cv2 = importlib.import_module("cv2")
    except ImportError:
        raise UsageError("matching needs OpenCV; install it with: pip install 'photoplan[match]'") from None
    cv2.setNumThreads(1)
    return cv2


def extract_features(image: GreyImage, settings: FeatureSettings) -> Features:
    """The strongest features of every part of an image.

    The grey values of a tile are stretched to bytes by the range that the whole image has. A feature counts if its
    neighbourhood of six times its scale lies in the image's area and holds valid pixels only.
    """
    cv2 = opencv()
    limits = image.stretch()
    step = settings.contrast * 3  # OpenCV divides by the number of layers
    sift = cv2.SIFT_create(
        nOctaveLayers=3, contrastThreshold=step, edgeThreshold=10, sigma=1.6, enable_precise_upscale=True
    )
    width, height = (s // settings.factor for s in image.size)
    parts = []
    for core in Window(0, 0, width, height).tiles(max(_LEAST_TILE, settings.tile // settings.factor)):
        part = _tile_features(cv2, sift, image, core, limits, settings)
        parts.append(_spread(part, settings, image.size, share=2.0))
    return _spread(_joined(parts), settings, image.size)


def _tile_features(
    cv2: Any, sift: Any, image: GreyImage, core: Window, limits: tuple[float, float], settings: FeatureSettings
) -> Features:
    """Features whose place lies in the window `core`."""
    whole = Window(0, 0, *(s // settings.factor for s in image.size))
    wide = Window(core.col - _MARGIN, core.row - _MARGIN, core.width + 2 * _MARGIN, core.height + 2 * _MARGIN) & whole
    grey = image.reduced(wide, settings.factor)
    valid = np.isfinite(grey)
    found, descriptors = sift.detectAndCompute(to_bytes(grey, *limits), None)
    if not found:
        return no_features()
    xy = np.array([k.pt for k in found], np.float64)
    scale = np.array([k.size for k in found]) / 2
    at = xy + np.array([wide.col, wide.row])
    own = ((at >= (core.col - 0.5, core.row - 0.5)) & (at < (core.stop[0] - 0.5, core.stop[1] - 0.5))).all(axis=1)
    if not valid.all():
        # Distance to the next pixel without a value.
        room = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 3)
        i, j = np.clip(np.rint(xy).astype(int), 0, (wide.width - 1, wide.height - 1)).T
        own &= room[j, i] > 6 * scale
    keep = np.flatnonzero(own)
    p = descriptors[keep] / np.maximum(descriptors[keep].sum(axis=1, keepdims=True), 1e-9)
    k = settings.factor
    return Features(
        xy=(at[keep] + 0.5) * k - 0.5,
        scale=scale[keep] * k,
        angle=np.radians([found[i].angle for i in keep]),
        strength=np.array([found[i].response for i in keep], float),
        descriptors=np.clip(np.rint(np.sqrt(p) * DESCRIPTOR_UNIT), 0, 255).astype(np.uint8),
    )


def _spread(features: Features, settings: FeatureSettings, size: tuple[int, int], share: float = 1.0) -> Features:
    """At most `count` features: every cell of the image keeps its strongest, as many as all cells can have."""
    if len(features) <= settings.count * share and share == 1.0:
        return features
    cell = np.clip((features.xy / size * _CELLS).astype(int), 0, _CELLS - 1) @ (1, _CELLS)
    order = np.lexsort((-features.strength, cell))
    _, start, count = np.unique(cell[order], return_index=True, return_counts=True)
    rank = np.empty(len(features), int)
    rank[order] = np.arange(len(features)) - np.repeat(start, count)
    if share != 1.0:  # a tile: no cell of the image can need more than a few times its even share
        return features.where(rank < 8 * settings.count / _CELLS**2)
    best = np.lexsort((-features.strength, rank))
    return features.where(np.sort(best[: settings.count]))


def no_features() -> Features:
    """Return no feature at all."""
    empty = np.empty(0)
    return Features(
        xy=np.empty((0, 2)), scale=empty, angle=empty, strength=empty, descriptors=np.empty((0, 128), np.uint8)
    )


def _joined(parts: list[Features]) -> Features:
    parts = [no_features(), *parts]
    return Features(
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("xy", "scale", "angle", "strength", "descriptors"))
    )
