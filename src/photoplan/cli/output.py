"""Results on stdout, messages on stderr, and parameters under their names on the command line.

The library names a parameter in backticks: ``give `overwrite` to replace it``. Here, and nowhere else, that becomes the
option of the verb that runs: ``give --overwrite to replace it``. `` `report=False` `` becomes ``--no-report``.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import click

_PARAMETER = re.compile(r"`([a-z][a-z0-9_]*)(=False)?`")
_DOUBT = re.compile(r"\s*(?:warning|note):")
#: Characters that move the cursor, colour, or turn the direction of writing: names of foreign files may hold them.
_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
_REMARK = re.compile(r" \(`[a-z][a-z0-9_]*`[^()`]*\)")


def spelled(text: str, verb: click.Command | None, group: click.Command | None = None) -> str:
    """Return a text of the library with its parameters as options and arguments."""
    if "`" not in text or verb is None:
        return text
    spellings: dict[str, str] = {}
    for command in reversed([verb, *_named(text, group)]):
        options = [p for p in command.params if isinstance(p, click.Option)]
        spellings |= {"--" + (p.name or "").replace("_", "-"): p.opts[-1] for p in options}
        spellings |= {o: o for p in options for o in (*p.opts, *p.secondary_opts)}
        arguments = [p for p in command.params if isinstance(p, click.Argument)]
        spellings |= {"--" + (p.name or "").replace("_", "-"): p.human_readable_name for p in arguments}

    def option(found: re.Match[str]) -> str:
        return spellings.get("--" + "no-" * bool(found[2]) + found[1].replace("_", "-"), found[0])

    return _REMARK.sub("", _PARAMETER.sub(option, text))


def _named(text: str, group: click.Command | None) -> list[click.Command]:
    if not isinstance(group, click.Group):
        return []
    names = dict.fromkeys(re.findall(r"`photoplan ([a-z]+)", text))
    found = [command for name in names if (command := group.get_command(click.Context(group), name))]
    return [getattr(command, "own", None) or command for command in found]


def printable(text: str) -> str:
    """Return a text in which what a terminal would obey stands as in JSON: ``\\u001b``."""
    return _COMMANDS.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def show(text: object) -> None:
    """Print a result on stdout."""
    click.echo(_spelled(text))


def show_json(values: object, **more: object) -> None:
    """Print a value as one JSON object on stdout, with `more` keys."""
    from photoplan.plain import json_text, plain  # bring NumPy, which --help does without

    show(json_text({**plain(values), **more} if more else values))


def say(text: object) -> None:
    """Say something on stderr."""
    click.echo(_spelled(text), err=True)


def is_doubt(text: str) -> bool:
    """Return whether a message says that a result is doubtful or that something was left out: `quiet` does not hide
    it."""
    return _DOUBT.match(text) is not None


def talking(quiet: bool) -> Callable[[str], None]:
    """Print messages on stderr; if `quiet`, those alone that begin with ``warning:`` or ``note:``."""

    def talk(text: str) -> None:
        if not quiet or is_doubt(text):
            say(text)

    return talk


def can_draw(wanted: bool, talk: Callable[[str], None], what: str = "picture") -> bool:
    """Return whether what is wanted can be drawn; `talk` says how, where matplotlib is missing."""
    from photoplan.report.page import has_matplotlib

    if wanted and not has_matplotlib():
        talk(f"no {what}: it needs matplotlib (pip install 'photoplan[report]')")
        return False
    return wanted


def _spelled(text: object) -> str:
    context = click.get_current_context(silent=True)
    plain = printable(str(text))
    return spelled(plain, context.command, context.find_root().command) if context else plain
