"""TOML files whose entries are checked: read, validated, and faults told with their lines."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from photoplan.errors import InputError
from photoplan.io.project.errors import explain
from photoplan.io.toml_file import MAX_BYTES, read_toml

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
