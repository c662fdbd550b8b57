"""Frames of a series, one after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from photoplan.quality.formation.model import FormedImage, ImageModel, form_image


def form_series(
    model: ImageModel, scenes: Sequence[Any], exposures: Sequence[float] | None = None
) -> Iterator[FormedImage]:
    """A frame of each scene; automatic gain runs through them."""
    gain = 1.0
    for frame, (scene, exposure) in enumerate(zip(scenes, exposures or [1.0] * len(scenes), strict=True)):
        image = form_image(model, scene, frame, exposure, gain)
        gain = image.next_gain
        yield image
