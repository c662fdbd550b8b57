"""Descriptions of image formation models: TOML with one table for each part of `ImageModel`.

What a file may hold follows from the parts themselves: their fields, types, words and ranges.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pydantic import BeforeValidator, Field, Strict, create_model

from photoplan.errors import InputError
from photoplan.io.camera.model import Entry, Number
from photoplan.io.toml_file import read_entries
from photoplan.quality.formation.model import ImageModel

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
    """Model of a description.

    Raises
    ------
    InputError
        The file cannot be read, an entry is unknown or of a wrong type (the message names its line), or a value is
        outside its range.
    """
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
