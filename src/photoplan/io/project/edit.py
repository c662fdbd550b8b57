"""Results written into an existing project file; comments, order and all other entries stay as they are."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import ValidationError
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Table

from photoplan.errors import InputError
from photoplan.io.files import MAX_BYTES_PLAIN_FILES as MAX_BYTES
from photoplan.io.files import read_text
from photoplan.io.project.file import parse_project
from photoplan.io.project.model import Project, turned_angles, turned_correlation
from photoplan.io.store import write_atomically


@dataclass(frozen=True)
class ProjectChanges:
    """Entries to set, as plain values (numbers, strings, lists, tables); None removes an entry."""

    images: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    """Entries of `[[images]]`, by the image's name."""
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Entries of `[cameras.NAME]`."""
    tables: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Entries of other tables: observations, orientation …"""


def edit_project(path: Path, changes: ProjectChanges) -> Project:
    """Set entries of a project file; the file before is kept beside it as ``NAME.previous.toml``.

    What is kept there already stays: the next one is ``NAME.previous-2.toml`` and so on.

    The changed file is checked before it replaces the old one, and appears complete or not at all.
    """
    text = read_text(path, MAX_BYTES)
    before = path.read_bytes()
    line_end = "\r\n" if b"\r\n" in before else "\n"
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    changes = _as_stated(document, changes)
    _set_images(document, changes.images, path)
    for name, entries in changes.cameras.items():
        cameras = _table(document.get("cameras", {}), f"{path}: cameras")
        if name not in cameras:
            raise InputError(f"{path}: camera {name!r} is not in the project")
        _set(_table(cameras[name], f"{path}: cameras.{name}"), entries)
    for name, entries in changes.tables.items():
        if name not in document:
            document.add(name, tomlkit.table())
        _set(_table(document[name], f"{path}: {name}"), entries)
    changed = document.as_string()
    project = parse_project(document.unwrap(), path.resolve().parent, str(path), changed)
    if changed != text:
        kept = path.with_suffix(".previous.toml")
        for number in count(2):
            if not os.path.lexists(kept) or (kept.is_file() and kept.read_bytes() == before):
                break
            kept = path.with_suffix(f".previous-{number}.toml")
        write_atomically(kept, before)
        write_atomically(path, changed.replace("\n", line_end).encode())
    return project


def _as_stated(document: tomlkit.TOMLDocument, changes: ProjectChanges) -> ProjectChanges:
    """Return the changes in the camera system of the file, whose scene may lie at z > 0; see `Orientation.scene`."""
    orientation = document.get("orientation", {})
    if not isinstance(orientation, Mapping) or orientation.get("scene", "z < 0") == "z < 0":
        return changes
    try:
        stated = Project.model_validate({**document.unwrap(), "folder": Path()})
    except ValidationError:  # parse_project names the entry that is wrong
        return changes
    unit, order = stated.orientation.angle_unit, stated.orientation.rotation
    cameras = {}
    for name, entries in changes.cameras.items():
        cameras[name] = new = {**entries}
        if "principal_point_mm" in new and "x0" in stated.cameras[name].odd_in_x:
            x, y = new["principal_point_mm"]
            new["principal_point_mm"] = [-x + 0.0, y]
        if isinstance(new.get("lens"), Mapping):
            odd = stated.cameras[name].odd_in_x
            new["lens"] = {key: -value if key in odd else value for key, value in new["lens"].items()}
    images = {}
    for name, entries in changes.images.items():
        images[name] = new = {**entries}
        if new.get("angles"):
            new["angles"] = list(turned_angles(new["angles"], unit, order))
        if new.get("correlation"):
            camera = stated.image(name).camera
            sigma = changes.cameras.get(camera, {}).get("sigma", stated.cameras[camera].sigma)
            of = stated.cameras[camera].model_copy(update={"sigma": sigma})
            new["correlation"] = list(turned_correlation(new["correlation"], order, of))
    return ProjectChanges(images, cameras, changes.tables)


def _set_images(document: tomlkit.TOMLDocument, images: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    listed = document.get("images", [])
    if not isinstance(listed, AoT | list):
        raise InputError(f"{path}: images must be written as [[images]]")
    tables = {str(_table(t, f"{path}: images[{k}]").get("name")): t for k, t in enumerate(listed, 1)}
    for name, entries in images.items():
        if name not in tables:
            raise InputError(f"{path}: image {name!r} is not in the project")
        _set(tables[name], entries)


def _table(value: Any, what: str) -> Any:
    if not isinstance(value, Mapping):
        raise InputError(f"{what}: a table is needed")
    return value


def _set(table: Table, entries: Mapping[str, Any]) -> None:
    """Set entries; new ones stand after the last one, before the comments that introduce the next table."""
    body = table.value.body
    last = max((at for at, (key, _) in enumerate(body) if key is not None), default=-1) + 1
    after: list[Any] = [item for _, item in body[last:]]
    del body[last:]
    for key, value in entries.items():
        if value is None:
            table.pop(key, None)
        elif key not in table or table[key] != _plain(value):
            table[key] = _item(value)
    for item in after:
        table.add(item)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value


def _item(value: Any) -> Any:
    """Tables and lists of a value stand in one line."""
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        for key, entry in value.items():
            inline[str(key)] = _item(entry)
        return inline
    return tomlkit.item(_plain(value))
