"""TOML files as plain values, with the text for messages."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from photoplan.errors import InputError
from photoplan.io.plain_files import read_text
from photoplan.io.project.errors import explain

#: A project of 100,000 images stays far below; anything larger is not a project file.
MAX_BYTES = 200_000_000


def read_toml(path: Path, max_bytes: int = MAX_BYTES) -> tuple[dict[str, Any], str]:
    """Contents of a TOML file and its text.

    Raises
    ------
    InputError
        The file is missing, too large, not UTF-8 or not TOML; the message names the line.
    """
    text = read_text(path, max_bytes)
    try:
        return tomllib.loads(text), text
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None


_Model = TypeVar("_Model", bound=BaseModel)


def read_entries(path: Path, model: type[_Model], max_bytes: int = MAX_BYTES) -> _Model:
    """Contents of a TOML file as a checked value.

    Raises
    ------
    InputError
        The file cannot be read, or an entry is missing, unknown or wrong; the message names the entry and its line.
    """
    contents, text = read_toml(path, max_bytes)
    try:
        return model.model_validate(contents)
    except ValidationError as error:
        raise InputError(explain(error, contents, str(path), text)) from None
