"""Requests: the options of an operation, each declared once with its type, limits, default and help.

The command line, the Python call, the JSON schema and the defaults that a project file may state come from one frozen
pydantic model. Modules of requests import nothing heavy, so that the help answers at once.
"""

from __future__ import annotations

import os
import re
import types
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, Self, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from photoplan.errors import UsageError
from photoplan.public import fitted

Part = TypeVar("Part", bound="Request")

#: Bounds of numbers, as pydantic calls them, and how messages call them.
_LIMITS = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}


def opt(help: str, default: Any = ..., **how: Any) -> Any:
    """Declare a field that is an option of the command line; without a default it is required.

    Beside limits: `section`, `metavar`, `flag` (its name), `off` (help of a flag that turns off what the field states),
    `other` (name of the opposite flag), `writes`, `listed` (values with commas, perhaps with the words of a message),
    `choices` (words, or a mapping from words to values), `folder`, `project`, `size`, `infinite` and `nan` (numbers
    that are not refused here); and `draws` for a dry run that draws what is asked all the same.
    """
    limits = {name: how.pop(name) for name in _LIMITS if name in how}
    if how.pop("infinite", False) or how.get("nan"):
        limits["allow_inf_nan"] = True
    return Field(default, description=help, json_schema_extra=how, **limits)


def arg(help: str = "", **how: Any) -> Any:
    """Declare a field that is a positional argument of the command line."""
    return opt(help, argument=True, **how)


def path_or(*words: str) -> BeforeValidator:
    """Return what makes a path of text, but for some words; values in place of a file stay as they are."""

    def path(value: Any) -> Any:
        if not isinstance(value, str | os.PathLike):
            return value
        return os.fspath(value) if os.fspath(value) in words else Path(value)

    return BeforeValidator(path)


class Request(BaseModel):
    """Options of an operation, checked when they are set."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False)

    def __init__(self, *values: Any, **named: Any) -> None:
        # Arguments of the command come first, also those of a class that derives from another one.
        declared = type(self).model_fields
        fields = sorted(declared, key=lambda name: not how_of(declared[name]).get("argument"))
        if len(values) > len(fields):
            raise UsageError(f"{type(self).__name__} takes {len(fields)} values at most, found {len(values)}")
        named = dict(zip(fields, values)) | named
        for name in set(named).intersection(fields):
            annotation = declared[name].annotation
            value, how = _parsed(named[name], annotation), how_of(declared[name])
            odd = isinstance(value, float) and value != value and how.get("nan")
            named[name] = value = value if odd else fitted(value, annotation, f"`{name}`")
            if how.get("project") and isinstance(value, Path) and (value / "project.toml").is_file():
                named[name] = value / "project.toml"
        try:
            super().__init__(**named)
        except ValidationError as error:
            # A field of several types has an error for each of them; the last one lists its words.
            errors = {each["loc"][:1]: each for each in error.errors()}
            raise UsageError("; ".join(_message(each, type(self)) for each in errors.values())) from None
        seen: dict[Path, str] = {}
        for name, paths in self.files_written().items():
            for path in paths:
                if len(paths) > len({each.resolve() for each in paths}):
                    raise UsageError(f"`{name}` {path}: one file twice; give each its own name")
                if (other := seen.setdefault(path.resolve(), name)) != name:
                    raise UsageError(f"{path}: `{other}` and `{name}` are the same file; choose two names")
        self.check()

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> dict[str, Any]:
        """Return the JSON schema without fields that are no options: they have no help and hold no request."""
        schema: dict[str, Any] = handler.resolve_ref_schema(handler(core))
        for name, field in cls.model_fields.items():
            kinds = get_args(field.annotation) or (field.annotation,)
            if field.description is None and not any(hasattr(kind, "model_fields") for kind in kinds):
                schema["properties"].pop(name, None)
        return schema

    def check(self) -> None:
        """Refuse values that are allowed one by one, but not together."""

    def json_fields(self) -> Mapping[str, Any]:
        """Return the options by name."""
        return dict(self)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values, checked; what was not set stays so."""
        return self.part(type(self), **changes)

    def part(self, other: type[Part], /, **changes: Any) -> Part:
        """Return the options that another class has, too, with other values; what was not set stays so."""
        return other(**{n: getattr(self, n) for n in other.model_fields if n in self.model_fields_set} | changes)

    @property
    def product(self) -> Path:
        """The file beside which pictures stand: the first that is written."""
        return next(path for paths in self.files_written().values() for path in paths)

    @property
    def drawn(self) -> Mapping[str, Path]:
        """Pictures and reports whose places follow from other options, by their keys in the table of verbs."""
        return {}

    @classmethod
    def may_be_stated(cls) -> dict[str, FieldInfo]:
        """Return the options that a project file may state: those that choose a method, and write and run nothing."""
        found: dict[str, FieldInfo] = {}
        for name, field in cls.model_fields.items():
            how = how_of(field)
            if isinstance(field.annotation, type) and issubclass(field.annotation, Request):
                found |= field.annotation.may_be_stated()
            elif not (set(how) & {"argument", "writes", "folder"} or how.get("section", "method") != "method"):
                found[name] = field
        return found

    def files_read(self) -> list[Path]:
        """Return the files that it reads, in the order of the fields."""
        return [path for paths in self._files(False).values() for path in paths]

    def files_written(self) -> dict[str, list[Path]]:
        """Return the files that it writes, by option."""
        return self._files(True)

    def _files(self, written: bool) -> dict[str, list[Path]]:
        found: dict[str, list[Path]] = {}
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if isinstance(value, Request):
                found |= value._files(written)
            elif how_of(field).get("writes", False) == written and (written or not how_of(field).get("folder")):
                values = value if isinstance(value, tuple) else (value,)
                found |= {name: [each for each in values if isinstance(each, Path)]}
        return found


def _parsed(value: Any, hint: Any) -> Any:
    """Return a value of a class with `parse` from its text, a value that a record states from its mapping."""
    for kind in get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,):
        if get_origin(kind) is tuple and hasattr(get_args(kind)[0], "parse"):
            each = (value,) if isinstance(value, str) else value
            return tuple(_parsed(one, get_args(kind)[0]) for one in each) if isinstance(each, list | tuple) else value
        if isinstance(value, str) and hasattr(kind, "parse"):
            return kind.parse(value)
        if isinstance(value, dict) and isinstance(kind, type) and (is_dataclass(kind) or issubclass(kind, Request)):
            try:
                return kind(**value)
            except TypeError as error:  # names that a data class has not, values that are no numbers
                raise UsageError(f"{kind.__name__} {value}: {error}") from None
    return value


def how_of(field: FieldInfo) -> Mapping[str, Any]:
    """Return what `opt` or `arg` declared of a field beside its type, default and limits."""
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def _message(error: Any, kind: type[Request]) -> str:
    """Return an error of pydantic in the grammar of our messages: what was given, what is accepted, what it means."""
    name, *inner = error["loc"] or ("",)
    field = kind.model_fields.get(str(name))
    if field is None:
        return f"{kind.__name__} has no option {name!r}; its options are {', '.join(kind.model_fields)}"
    if error["type"] == "missing" and not inner:
        return f"`{name}` is required"
    meaning = re.sub(r"\s*\[.*", "", field.description or "").rstrip(".")
    where = f"`{name}`" + "".join(f"[{part}]" for part in inner if isinstance(part, int))
    limits = {key: getattr(each, key) for each in field.metadata for key in _LIMITS if hasattr(each, key)}
    bounds = [f"{_LIMITS[key]} {limit:g}" for key, limit in limits.items()]
    if set(limits) == {"ge", "le"}:
        bounds = [f"from {limits['ge']:g} to {limits['le']:g}"]
    match error["type"]:
        case "greater_than" | "greater_than_equal" | "less_than" | "less_than_equal" if bounds:
            accepted = " and ".join(bounds)
        case "finite_number":
            accepted = "a finite number"
        case "literal_error":
            accepted = f"one of {error['ctx']['expected'].replace(chr(39), '')}"
        case _:
            return f"{where} {error['input']!r}: {str(error['msg']).removeprefix('Value error, ')} ({meaning})"
    return f"{where} {error['input']} must be {accepted} ({meaning[:1].lower()}{meaning[1:]})"


#: Options that many operations share; their order in a request is that of the help.
def crs_option(of: str = "terrain files that state none") -> Any:
    """Declare the CRS of inputs."""
    return opt(f"CRS of {of}.", None, section="input")


OVERWRITE: Any = opt("Replace files that exist.", False, section="run")
PROJECT: Any = arg("Project file, or the folder that holds `project.toml`.", project=True)
IMAGES: Any = opt("Images or patterns; may be repeated [all].", (), listed=True, metavar="NAME,…", section="input")
PICTURE: Any = opt("Write a drawing of the result.", True, flag="no-picture", section="result",
                   off="Write no drawing of the result.")  # fmt: skip
REPORT_FORMAT: Any = opt("Format of the report.", "html", section="result")
DRY_RUN: Any = opt("Print what would be done, and stop.", False, section="run")
_EXECUTORS = "threads, processes, or the address of a Dask scheduler, tcp://host:port."
EXECUTOR: Any = opt(_EXECUTORS, "threads", metavar="KIND", section="run")
MEMORY: Any = opt("Largest memory of the run, such as 2GB.", None, size=True, metavar="SIZE", section="run")
_WORKERS = "Number of parallel workers [all cores]."
WORKERS: Any = opt(_WORKERS, None, ge=1, section="run")
ONE_WORKER: Any = opt(_WORKERS, 1, ge=1, section="run")
"""For calls from Python that use one worker unless told otherwise; the command line uses all cores."""
TARGET: Any = opt(
    "Frame of the product: map, a name of [targets], wall:X,Y,Z,AZIMUTH[,TILT], vault:X,Y,Z,AZIMUTH,RADIUS[,TILT], "
    "column:X,Y,Z,AZIMUTH,RADIUS, or image:NAME[,DISTANCE] [map].", "map", metavar="WHAT"
)  # fmt: skip
BOUNDS: Any = opt("Part to process [all].", None, metavar="XMIN YMIN XMAX YMAX")
_BEYOND = "Accept coordinates far outside the area of use of their CRS."
BEYOND_AREA: Any = opt(_BEYOND, False, section="input")
