"""The frames of a simulation: light by tiles, then each frame exposed and written, all as steps that are kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.steps import Steps, Store
from photoplan.io.whole_image import write_whole_image
from photoplan.quality.formation.model import Frame, ImageModel, exposed, frame_light
from photoplan.quality.formation.scenes import LightScene


@dataclass(frozen=True)
class SimulatedImage:
    """One frame."""

    path: Path
    frame: int
    exposure: float
    gain: float
    """Automatic gain."""
    facts: Mapping[str, object]


def is_kept(store: Store, frame: int, path: Path) -> bool:
    """Whether an earlier run has written a frame, and it is there."""
    return store.index(("frame", frame)) in store.finished and path.is_file()


def count_parts(model: ImageModel, scene: LightScene, frames: int) -> int:
    """Tiles of light and frames that `form_frames` makes."""
    tiles = len(frame_light(model, scene, 0).tiles)
    return frames + tiles * (frames if model.jitter.sigma else 1)


def form_frames(
    model: ImageModel,
    scene: LightScene,
    frames: Sequence[tuple[Path, float]],
    how: tuple[str, Mapping[str, str]],
    run: Steps,
    store: Store,
) -> list[SimulatedImage]:
    """Form frames one after the other, since automatic gain runs through them, and write each.

    Parameters
    ----------
    model, scene
    frames : sequence of (Path, float)
        File and exposure of each.
    how : (str, mapping)
        Type of the pixels, and tags of the files.
    run, store
        Make the parts, and keep them.
    """
    images: list[SimulatedImage] = []
    gain, light = 1.0, None
    for n, (path, exposure) in enumerate(frames):
        if light is None or model.jitter.sigma:
            sampled = frame_light(model, scene, n)
            # Put together for the first frame that needs it, once: light may be the same in all of them.
            light = cache(partial(sampled.whole, run(sampled, sampled.tiles, pixels=lambda tile: tile.size)))
        again = store.index(("frame", n)) in store.finished and not is_kept(store, n, path)
        name = ("frame", n, "again") if again else ("frame", n)
        ((own, gain, facts),) = run(partial(_write, model, light, path, how), [Frame(n, exposure, gain)], [name])
        images.append(SimulatedImage(path, n, exposure, own, facts))
    return images


def _write(
    model: ImageModel,
    light: Callable[[], NDArray[np.float64]],
    path: Path,
    how: tuple[str, Mapping[str, str]],
    frame: Frame,
) -> tuple[float, float, dict[str, object]]:
    """Expose and write a frame; its gain, that of the next one, and what is known of it."""
    made = exposed(model, light(), frame)
    values = made.values.astype(how[0], copy=False)
    write_whole_image(path, values, {**how[1], "PHOTOPLAN_FRAME": str(frame.number)})
    return made.gain, made.next_gain, dict(made.facts)
