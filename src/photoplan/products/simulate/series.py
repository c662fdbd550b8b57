"""The frames of a simulation as products of the one loop: the light by tiles, then exposed and written in order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.engine.executors import threads
from photoplan.engine.run import Kept, Made, Runner, Tally, Work
from photoplan.engine.steps import Item, Store, StoreSink, tell_kept
from photoplan.errors import ResourceError
from photoplan.events import Events
from photoplan.geometry.grid import Window
from photoplan.io.whole_image import write_whole_image
from photoplan.quality.formation.model import Frame, ImageModel, exposed, frame_light
from photoplan.quality.formation.optics import Light
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


@dataclass(eq=False)
class Series:
    """Frames that are formed one after the other, since automatic gain runs through them."""

    model: ImageModel
    scene: LightScene
    dtype: str
    exposures: Sequence[float]
    paths: Sequence[Path]
    store: Store | None
    """Has the light by tiles, and gain and facts of the frames that are written; its key says what decides both."""
    name: str
    """Of the scene, for the files."""
    _gain: float = 1.0
    _known: tuple[int, NDArray[np.float64]] | None = None
    """Light in memory, and the frame that it was sampled for."""

    def image(self, frame: int, gain: float = 1.0, facts: Mapping[str, object] | None = None) -> SimulatedImage:
        """A frame and what is known of it."""
        return SimulatedImage(self.paths[frame], frame, self.exposures[frame], gain, facts or {})

    def earlier(self, frame: int) -> tuple[float, float, Mapping[str, object]] | None:
        """Gain, gain of the next one, facts of a frame that an earlier run has written; None: it is to be formed."""
        index = -1 if self.store is None else self.store.index(("frame", frame))
        if self.store is None or index not in self.store.finished or not self.paths[frame].is_file():
            return None
        found: tuple[float, float, Mapping[str, object]] = self.store[index]
        return found

    def made(self, workers: int, events: Events) -> list[SimulatedImage]:
        """Form and write all frames.

        Raises
        ------
        ResourceError
            Disk or memory ran out; the same request goes on where it stopped.
        TilesFailed
            Light could not be computed.
        """
        assert self.store is not None
        tell_kept(self.paths[0].name, self.store, events)
        events.begin("images", len(self.paths), "images")
        try:
            with threads(workers) as pool:
                return Runner[SimulatedImage](pool, None, _ByImage(events)).run(self._works())
        except MemoryError:
            width, height = self.scene.size
            raise ResourceError(
                f"too little memory for an image of {self.scene.bands} × {width} × {height} pixels; cut the scene"
            ) from None

    def _works(self) -> Iterator[Work[SimulatedImage] | Kept[SimulatedImage]]:
        assert self.store is not None
        sampled = -1
        for frame in range(len(self.paths)):
            known = self.earlier(frame)
            if known is not None:
                self._gain = known[1]
                yield Kept(self.image(frame, known[0], known[2]), 0)
                continue
            # Light that is the same in all frames is sampled once.
            of = frame if self.model.jitter.sigma else 0
            light = frame_light(self.model, self.scene, of)
            tiles = [] if of == sampled else [Item(self._index(of, w), w, w.size) for w in light.tiles]
            sampled = of
            yield Work(
                name="",
                job=partial(_tile, light),
                tiles=tiles,
                count=0,
                sinks=(StoreSink(self.store),),
                complete=partial(self._complete, frame, of, light),
            )

    def _index(self, of: int, tile: Window) -> int:
        assert self.store is not None
        return self.store.index(("light", of, tile))

    def _complete(self, frame: int, of: int, light: Light, tally: Tally) -> SimulatedImage:
        store, path = self.store, self.paths[frame]
        assert store is not None
        tally.check(path)
        if self._known is None or self._known[0] != of:
            self._known = of, light.whole(lambda tile: store[self._index(of, tile)])
        formed = exposed(self.model, self._known[1], Frame(frame, self.exposures[frame], self._gain))
        tags = {"PHOTOPLAN_SCENE": self.name, "PHOTOPLAN_SEED": str(self.model.seed), "PHOTOPLAN_FRAME": str(frame)}
        write_whole_image(path, formed.values.astype(self.dtype, copy=False), tags)
        store.append(store.index(("frame", frame)), (formed.gain, formed.next_gain, dict(formed.facts)))
        self._gain = formed.next_gain
        return self.image(frame, formed.gain, formed.facts)


def _tile(light: Light, task: Item) -> Made:
    return Made(((light(task.value), None),))


@dataclass(frozen=True)
class _ByImage:
    """Events by images: their tiles are signs of life."""

    events: Events

    def begin(self, phase: str, units: int = 0, unit: str = "tiles") -> None:
        self.events.begin(phase, units, unit)

    def done(self, units: int = 1, pixels: int = 0) -> None:
        self.events.done(0, pixels)

    def talk(self, text: str) -> None:
        self.events.talk(text)

    def result(self, value: Any) -> None:
        self.events.done(1)
