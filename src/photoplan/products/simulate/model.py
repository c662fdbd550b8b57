"""Descriptions of image formation models: TOML with one table for each part of `ImageModel`.

What a file may hold follows from the parts themselves: their fields, types, words and ranges. And its frames: light by
tiles, then each frame exposed and written, all as steps that are kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, Strict, create_model

from photoplan.engine.steps import Steps, Store
from photoplan.errors import InputError
from photoplan.io.camera.model import Entry, Number
from photoplan.io.plain_files import read_entries
from photoplan.io.whole_image import write_whole_image
from photoplan.quality.formation.model import FormedFrame, ImageModel, exposed, frame_light
from photoplan.quality.formation.scenes import LightScene

#: A description with a table of defects for every element of a large sensor stays below.
_MAX_BYTES = 20_000_000
_PLAIN: dict[Any, Any] = {
    float: Number,
    int: Annotated[int, Strict(), Field(ge=0, le=2**62)],
    bool: Annotated[bool, Strict()],
}
#: Of a pair for which one number stands for both directions.
_EVEN = BeforeValidator(lambda value: (value, value) if isinstance(value, float | int) else value)


def entry_of(part: Any) -> type[Entry]:
    """What a TOML table may say of a part: an entry for each field; what is left out stands for the default."""
    kinds = get_type_hints(part)
    entries: dict[str, Any] = {}
    for field in dataclasses.fields(part):
        kind = _strict(kinds[field.name])
        if field.name in ("gaussian", "width") and kind is not Number:
            kind = Annotated[kind, _EVEN]
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        entries[field.name] = (kind, ...) if required else (kind | None, None)
    return create_model(part.__name__, __base__=Entry, **entries)


def _strict(kind: Any) -> Any:
    """The type of an entry for the type of a field: a number is no text, a table is a part."""
    if dataclasses.is_dataclass(kind):
        return entry_of(kind)
    if kind in _PLAIN or get_origin(kind) is Literal:
        return _PLAIN.get(kind, kind)
    inner: Any = tuple(each if each is ... else _strict(each) for each in get_args(kind) if each is not type(None))
    return tuple.__class_getitem__(inner) if get_origin(kind) is tuple else inner[0]


def read_model(path: Path) -> ImageModel:
    """Model of a description."""
    return model_of(read_entries(path, entry_of(ImageModel), _MAX_BYTES), str(path))


def model_of(described: Entry, source: str) -> ImageModel:
    """Model of checked entries; the message of an `InputError` begins with the source."""
    try:
        made: ImageModel = _made(ImageModel, described)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    return made


def _made(kind: Any, value: Any) -> Any:
    """A value of a field's type from what an entry holds."""
    part: Any = next((each for each in (kind, *get_args(kind)) if dataclasses.is_dataclass(each)), None)
    if part is None:
        return value
    if isinstance(value, tuple):
        return tuple(_made(part, each) for each in value)
    kinds = get_type_hints(part)
    return part(**{key: _made(kinds[key], each) for key, each in value if each is not None})


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
    dtype: str,
    tags: Mapping[str, str],
    run: Steps,
    store: Store,
) -> list[SimulatedImage]:
    """Form frames one after the other, since automatic gain runs through them, and write each."""
    images: list[SimulatedImage] = []
    gain, light = 1.0, None
    for n, (path, exposure) in enumerate(frames):
        if light is None or model.jitter.sigma:
            sampled = frame_light(model, scene, n)
            # Put together for the first frame that needs it, once: light may be the same in all of them.
            light = cache(partial(sampled.whole, run(sampled, sampled.tiles, pixels=lambda tile: tile.size)))
        again = store.index(("frame", n)) in store.finished and not is_kept(store, n, path)
        name = ("frame", n, "again") if again else ("frame", n)
        ((own, gain, facts),) = run(
            partial(_write, model, light, path, dtype, tags), [FormedFrame(n, exposure, gain)], [name]
        )
        images.append(SimulatedImage(path=path, frame=n, exposure=exposure, gain=own, facts=facts))
    return images


def _write(
    model: ImageModel,
    light: Callable[[], NDArray[np.float64]],
    path: Path,
    dtype: str,
    tags: Mapping[str, str],
    frame: FormedFrame,
) -> tuple[float, float, dict[str, object]]:
    """Expose and write a frame; its gain, that of the next one, and what is known of it."""
    made = exposed(model, light(), frame)
    values = made.values.astype(dtype, copy=False)
    write_whole_image(path, values, {**tags, "PHOTOPLAN_FRAME": str(frame.number)})
    return made.gain, made.next_gain, dict(made.facts)
