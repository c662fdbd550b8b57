"""Click commands made from requests: options, defaults of the project file, the run, drawings, printed results."""

from __future__ import annotations

import importlib
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

import click
from click.core import ParameterSource

from photoplan.cli.options import BYTES, NEW_FOLDER, PATH, all_cores, listed
from photoplan.cli.output import can_draw, say, show, show_json, spelled, talking
from photoplan.errors import InputError, UsageError

if TYPE_CHECKING:
    from photoplan.report.files import ReportFile
    from photoplan.request import Request

#: Sections of the help, in their order.
SECTIONS = {"input": "Input", "result": "Result", "method": "Method", "run": "Run"}


@dataclass(frozen=True)
class Verb:
    """A command: a row of `photoplan.cli.table`. Functions are written ``module:name``, without ``photoplan.``."""

    short: str
    help: str
    request: str
    make: str
    draw: Mapping[str, str] = field(default_factory=dict)
    """Functions that draw a file (picture, report) from the result. A key is an option, an option with an ending (such
    as ``outputs.png``), or a key of `Request.drawn`. The function of a folder, such as ``pictures/``, returns drawings
    by path; `make` has checked the paths."""
    each: str = ""
    """Function that draws each part of the result as soon as it is announced to the events, and the result at the end.
    It takes the part, the request, and a function that reports whether a wanted drawing is possible, and returns
    messages."""
    record: str = ""
    """Kind of the run record, for operations that write none themselves."""
    one_by_one: bool = False
    """Products get their names as they are finished, not all at the end together with what is drawn."""
    figures_first: bool = False
    """Figures are printed before the files, and these in the order of the options."""
    files: str = ""
    """Key of the JSON that lists all files, if there is one instead of a key for each drawing."""
    kernels: str = ""
    """Name in the list of kernels (`kernels/signatures.txt`), which are compiled before the work."""

    def command(self, name: str) -> click.Command:
        """Return the click command."""
        return self.command_of(load(self.request), name, partial(command, self))

    def command_of(self, kind: type[Request], name: str, call: Callable[..., None]) -> click.Command:
        """Return the click command of a request; `call` takes the request and the two options of what is printed."""
        made = VerbCommand(name, callback=call, help=self.help)
        made.kind = kind
        made.params = [
            *_parameters(kind, made.section_of),
            click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON object on stdout."),
            click.Option(["-q", "--quiet"], is_flag=True, help="No progress on stderr; warnings stay."),
        ]
        return made


class VerbCommand(click.Command):
    """A command made from a request; its help lists options by section."""

    kind: type[Request]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.section_of: dict[str, str] = {"as_json": "run", "quiet": "run", "help": "run"}
        """Section of each option, by its name."""

    def invoke(self, ctx: click.Context) -> Any:
        """Call the operation with the request; a value that nobody gave is left out, since it may be the project's."""
        given = dict(ctx.params)
        as_json, quiet = given.pop("as_json"), given.pop("quiet")
        place, stated = self._stated(ctx)
        for option in self.params:
            name = option.name or ""
            if ctx.get_parameter_source(name) is not ParameterSource.DEFAULT:
                stated.pop(name, None)
            elif given.get(name) == option.default:
                given.pop(name, None)
        assert self.callback is not None
        try:
            request = _request(self.kind, given | stated)
        except UsageError as error:
            if stated and str(error) != _refusal(self.kind, given):
                # The file states fields, not options of the command line.
                raise InputError(f"{place} {str(error).replace('`', '')}") from None
            raise
        return ctx.invoke(self.callback, request=request, as_json=as_json, quiet=quiet)

    def _stated(self, ctx: click.Context) -> tuple[str, dict[str, Any]]:
        """Return where the project states options of the command, ``[defaults.COMMAND]``, and these.

        Raises
        ------
        InputError
            The project states options that no command takes from it, of this command or another one.
        """
        project = ctx.params.get(_project_of(self.kind))
        if project is None:
            return "", {}
        from photoplan.io.files import resolve_input
        from photoplan.io.project.file import stated_defaults

        folder, tables = stated_defaults(project)
        for verb, values in tables.items():
            row = ctx.obj((verb,))  # the table's `command_at`
            kind = load(row.request) if row is not None else None
            known = kind.may_be_stated() if kind is not None and _project_of(kind) else {}
            for name, value in values.items():
                if name not in known:
                    these = f"these are {', '.join(known)}" if known else f"{verb} has none"
                    place = f"{project}: [defaults.{verb}] {name}"
                    raise InputError(f"{place}: no option that a project may state; {these}")
                hint = known[name].annotation
                words = [word for each in get_args(hint) if get_origin(each) is Literal for word in get_args(each)]
                if Path in (hint, *get_args(hint)) and isinstance(value, str) and value not in words:
                    values[name] = resolve_input(folder, value)
        return f"{project}: [defaults.{self.name}]", tables.get(self.name or "", {})

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, those of a section together."""
        for section, title in SECTIONS.items():
            rows = [
                p.get_help_record(ctx) for p in self.get_params(ctx) if self.section_of.get(p.name or "") == section
            ]
            if rows := [(row[0], spelled(row[1], self)) for row in rows if row is not None]:
                with formatter.section(title):
                    formatter.write_dl(rows)


def load(place: str) -> Any:
    """Return what ``module:name`` below photoplan names."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(f"photoplan.{module}"), name)


def command(verb: Verb, request: Any, as_json: bool, quiet: bool) -> None:
    """Run the operation of a verb, draw its pictures and reports, and print the result."""
    from photoplan.io.store import recording, together

    drawn = _drawn(verb, request, talking(quiet))
    opened = {path: _opened(path, key, request) for path, key in drawn.items()}
    recorded = verb.record and not getattr(request, "dry_run", False)
    grouped = bool(opened) and not verb.one_by_one
    with (
        recording(verb.record, request, request.files_read()) if recorded else nullcontext() as record,
        together() if grouped else nullcontext(),
    ):
        run = _Run(verb, request, quiet, files_at_once=not (grouped or as_json))
        with run.events as events:
            if verb.kernels:
                load("products.warmup:compile_before")(verb.kernels, request, events)
            result = load(verb.make)(request, events)
            if all(part is not result for part in events.results):
                run.draw(result)
        made: list[Path] = []
        for path, file in opened.items():
            made += file.draw(load(verb.draw[drawn[path]]), result) if file is not None else []
        first = [path for key, path in request.drawn.items() if path in made and key not in type(request).model_fields]
        files = [*first, *result.written(), *(path for path in made if path not in first)]
        if record is not None:
            record(files, result)
    if verb.figures_first:
        order = [path for paths in request.files_written().values() for path in paths]
        files.sort(key=lambda path: order.index(path) if path in order else len(order))
    if as_json:
        show_json(result, **({verb.files: files} if verb.files else _drawn_keys(verb, request, made, files)))
    else:
        # A project that was changed is recorded, and no product.
        rest = [file for file in files if file not in request.files_read() and file not in run.shown]
        for line in (*result.summary(), *rest) if verb.figures_first else (*rest, *result.summary()):
            show(line)
    for remark in result.remarks():
        say(remark)
    for message in result.messages():
        if not as_json or message.startswith(("note:", "warning:")):
            run.once(message)
    result.raise_failures()


class _Run:
    """Printer of files and messages of a run: of each part of the result as soon as it is complete, and once each."""

    def __init__(self, verb: Verb, request: Any, quiet: bool, files_at_once: bool) -> None:
        from photoplan.cli.telling import Telling

        self._verb, self._request, self._files_at_once = verb, request, files_at_once
        self.events = Telling(quiet, self._announced)
        self.shown: set[object] = set()
        """Files and messages that were printed."""

    def once(self, message: str) -> None:
        """Print a message, unless it was printed before."""
        if message not in self.shown:
            self.events.talk(message)
        self.shown.add(message)

    def draw(self, part: object) -> None:
        """Draw a part of the result, if the verb draws parts, and print the messages of the drawing."""
        if self._verb.each:
            for line in load(self._verb.each)(part, self._request, lambda wanted: can_draw(wanted, self.once)):
                self.once(line)

    def _announced(self, part: object) -> None:
        from photoplan.findings import Result

        if isinstance(part, Result):
            for path in part.written() if self._files_at_once else ():
                if path not in self.shown:
                    show(path)
                self.shown.add(path)
            for line in part.messages():
                self.once(line)
            self.draw(part)


def _drawn(verb: Verb, request: Any, talk: Callable[[str], None]) -> dict[Path, str]:
    """Return the pictures and reports to be drawn, each with its key in `Verb.draw`.

    They are files that options name, files whose places follow from other options (`Request.drawn`), and the picture
    beside the product. The last two are left out with a message if matplotlib is missing.
    """
    from photoplan.request import how_of

    dry_run = getattr(request, "dry_run", False)
    if dry_run and not how_of(type(request).model_fields["dry_run"]).get("draws"):
        return {}
    found: dict[Path, str] = {}
    for name, paths in request.files_written().items():
        for path in paths:
            for key in (name, name + path.suffix.lower(), f"{name}/"):
                if key in verb.draw:
                    found[path] = key
    for key, path in request.drawn.items():
        if dry_run or getattr(request, key, True) is not None or can_draw(True, talk, key):
            found[path] = key
    picture = _picture_beside(verb, request)
    if picture and not dry_run and can_draw(True, talk):
        found[request.product.with_suffix(".png")] = picture
    return found


def _picture_beside(verb: Verb, request: Any) -> str | None:
    """Return the option that asks for a picture beside the product, without naming it."""
    return next((name for name in verb.draw if getattr(request, name, None) is True), None)


def _drawn_keys(verb: Verb, request: Any, made: list[Path], files: list[Path]) -> dict[str, Any]:
    """Return the keys of the JSON that name what was drawn, None for a drawing that was not made."""
    options = type(request).model_fields
    keys: dict[str, Any] = {}
    for name in options:
        if name in verb.draw and options[name].annotation is not bool:
            path = request.drawn.get(name, getattr(request, name))
            keys[name] = path if path in made else None
    if set(request.drawn) - set(options):
        keys["files"] = files
    if _picture_beside(verb, request):
        keys["picture"] = next((path for path in made if path not in keys.values()), None)
    return keys


def _opened(path: Path, key: str, request: Any) -> ReportFile | None:
    """Return a picture, a report or a folder of pictures that can be written; its place is checked before any work."""
    from photoplan.report.files import ReportFile, open_picture, open_report
    from photoplan.report.page import load_matplotlib

    if key.endswith("/"):
        load_matplotlib("a picture", "leave the pictures out")
        return ReportFile(path)
    opening, overwrite = open_report if key == "report" else open_picture, getattr(request, "overwrite", False)
    return opening(path, request.files_read(), overwrite=overwrite, project=getattr(request, "project", None))


def _project_of(kind: type[Request]) -> str:
    """Return the option that states the project; empty if there is none."""
    from photoplan.request import how_of

    return next((name for name, entry in kind.model_fields.items() if how_of(entry).get("project")), "")


def _refusal(kind: type[Request], given: Mapping[str, Any]) -> str:
    """Return the message by which a request refuses what is given; empty if it does not."""
    try:
        _request(kind, dict(given))
    except UsageError as error:
        return str(error)
    return ""


def _request(kind: type[Request], given: dict[str, Any]) -> Request:
    """Return the request, with the requests that it holds; options that were not given keep their defaults."""
    values: dict[str, Any] = {}
    # Of several mistakes that of the last option is named: the first ones may lack what only all of them make whole.
    for name, entry in reversed(kind.model_fields.items()):
        if (group := _group_of(entry.annotation)) is not None:
            told = any(given.get(each) not in (None, ()) for each in group.model_fields)
            if told or group is entry.annotation:
                values[name] = _request(group, given)
        elif name in given and (value := given.pop(name)) is not None and value != ():
            values[name] = value
    return kind(**values)


def _group_of(annotation: Any) -> type[Request] | None:
    """Return the request that a field holds, perhaps if any of its options is given; None if it holds none."""
    kinds = [each for each in get_args(annotation) or (annotation,) if each is not type(None)]
    return kinds[0] if len(kinds) == 1 and hasattr(kinds[0], "model_fields") else None


def _parameters(kind: type[Request], section_of: dict[str, str]) -> Iterator[click.Parameter]:
    """Yield the parameters of a request, those of the requests that it holds among them; a field without help is
    none."""
    for name, entry in kind.model_fields.items():
        if (group := _group_of(entry.annotation)) is not None:
            yield from _parameters(group, section_of)
        elif entry.description is not None:
            how = entry.json_schema_extra if isinstance(entry.json_schema_extra, dict) else {}
            if not how.get("argument"):
                section_of[name] = str(how.get("section") or ("result" if how.get("writes") else "method"))
            yield _parameter(name, entry, how)


def _parameter(name: str, entry: Any, how: Mapping[str, Any]) -> click.Parameter:
    hint, optional = entry.annotation, False
    if get_origin(hint) in (Union, types.UnionType):
        kinds = [each for each in get_args(hint) if each is not type(None)]
        hint, optional = (kinds[0] if len(kinds) == 1 or kinds[0] is not str else str), True
    more: dict[str, Any] = {"metavar": how["metavar"]} if "metavar" in how else {}
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        if parts[-1] is not Ellipsis or ("nargs" in how and get_origin(parts[0]) is not tuple):
            more["nargs"], hint = how.get("nargs", len(parts)), parts[0]
        else:
            hint = parts[0]
            if get_origin(hint) is tuple:
                more["nargs"], hint = how.get("nargs", len(get_args(hint))), get_args(hint)[0]
            more["multiple"] = True
            if how.get("listed"):
                more["callback"] = partial(_numbers, how["listed"]) if hint in (int, float) else _words
    parsed = False
    if hasattr(hint, "parse"):
        # A value of a class that reads itself from text.
        hint, parsed = str, True
        if how.get("listed") and "multiple" not in more:
            more |= {"multiple": True, "callback": lambda context, parameter, given: ",".join(given) or None}
    choices = how.get("choices")
    if get_origin(hint) is Literal and not choices:
        # With a name of its own the request alone judges the value.
        choices, hint = None if "metavar" in how else [str(each) for each in get_args(hint)], str
    if isinstance(choices, Mapping):
        more["callback"] = partial(_value_of, choices)
    kind: Any = click.Choice(choices) if choices else BYTES if how.get("size") else hint
    if hint is Path:
        kind = NEW_FOLDER if how.get("folder") else PATH
    if isinstance(more.get("callback"), partial) and not choices:
        kind = str
    if how.get("argument"):
        if more.pop("multiple", False):
            more["nargs"] = -1
        return click.Argument([name], type=kind, required=entry.is_required(), **more)
    flag = "--" + str(how.get("flag", name.replace("_", "-")))
    default = None if entry.is_required() else entry.get_default(call_default_factory=True)
    if hint is bool and not choices:
        if "off" in how:
            return click.Option([name, flag], is_flag=True, flag_value=False, default=True, help=how["off"])
        other = how.get("other") or (f"no-{flag[2:]}" if default or optional else "")
        names = [name, flag + (f"/--{other}" if other else "")]
        return click.Option(names, is_flag=True, default=None if optional else default, help=entry.description)
    if name == "workers":
        more["callback"], kind, default = all_cores, click.IntRange(1), None
    names = [name, *(["-o"] if name in ("output", "outputs") else []), flag]
    if isinstance(choices, Mapping):
        default = next((word for word, value in choices.items() if value == default), None)
    shown = default is not None and default != () and "[" not in (entry.description or "")
    shown = shown and not parsed
    default = default if shown else None  # what is stated in words is left to the request
    needed = entry.is_required() or bool(how.get("required"))
    return click.Option(
        names, type=kind, required=needed, help=entry.description, default=default, show_default=shown, **more
    )


def _value_of(choices: Mapping[str, Any], context: click.Context, parameter: click.Parameter, word: str | None) -> Any:
    return None if word is None else choices[word]


def _words(context: click.Context, parameter: click.Parameter, given: tuple[str, ...]) -> tuple[str, ...]:
    return listed(given)


def _numbers(
    needed: str | bool, context: click.Context, parameter: click.Parameter, given: tuple[str, ...]
) -> tuple[float, ...]:
    try:
        return tuple(float(word) for text in given for word in text.replace(",", " ").split())
    except ValueError:
        example = f", such as {parameter.metavar}" if parameter.metavar else ""
        needed = needed if isinstance(needed, str) else f"numbers with commas are required{example}"
        raise click.BadParameter(f"{parameter.name} {' '.join(given)}: {needed}", context, parameter) from None
