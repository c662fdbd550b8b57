"""Groups of verbs that are imported only when they are used, so that `--help` answers at once."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import click

from photoplan.cli.output import spelled
from photoplan.cli.verb import Verb
from photoplan.errors import PhotoplanError

#: Commands that hold commands.
GROUPS = ("dtm", "view")


class LazyGroup(click.Group):
    """Lists verbs without importing them."""

    def __init__(self, *arguments: Any, verbs: Mapping[str, str | Verb], **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.verbs = verbs

    def invoke(self, ctx: click.Context) -> Any:
        """Run a verb; its errors name parameters as the verb's options."""
        try:
            return super().invoke(ctx)
        except PhotoplanError as error:
            verb = self.get_command(ctx, ctx.invoked_subcommand or "")
            error.args = (spelled(str(error), verb, ctx.find_root().command), *error.args[1:])
            raise

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the verb and what follows it, with the numbers of options that take several written apart."""
        if args and args[0] not in self.verbs and not args[0].startswith("-"):
            ctx.fail(f"No such command {args[0]!r}{self._meant(args[0], ctx)}")
        name, command, rest = super().resolve_command(ctx, args)
        return name, command, rest if command is None else apart(command, rest)

    def _meant(self, word: str, ctx: click.Context) -> str:
        """Return which commands a misspelt word may mean; those of groups, too."""
        places = {name: name for name in self.verbs}
        for name in self.verbs if ctx.parent is None else ():
            group = self.get_command(ctx, name) if name in GROUPS else None
            places |= {f"{verb} ({name})": f"{name} {verb}" for verb in getattr(group, "verbs", ())}
        close = get_close_matches(word, [place.split()[0] for place in places], n=3, cutoff=0.6)
        meant = [f"`{ctx.command_path} {full}`" for place, full in places.items() if place.split()[0] in close]
        return f"; did you mean {' or '.join(meant[:3])}?" if meant else f"; see `{ctx.command_path} --help`"

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the verbs, in the order of a job."""
        return list(self.verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a verb, made now; that of a group is imported."""
        verb = self.verbs.get(cmd_name)
        if isinstance(verb, str):
            command: click.Command = importlib.import_module(f"photoplan.cli.{cmd_name}").command
            return command
        return None if verb is None else verb.command(cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one line for each verb."""
        with formatter.section("Verbs"):
            formatter.write_dl(
                [(name, verb if isinstance(verb, str) else verb.short) for name, verb in self.verbs.items()]
            )


#: What may stand between numbers of one option: blanks, commas, semicolons.
_BETWEEN = re.compile(r"[,;\s]+")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*(e[-+]?\d+)?|\.\d+(e[-+]?\d+)?|nan|inf(inity)?)", re.IGNORECASE)
_NUMBERS = (type(click.INT), type(click.FLOAT))


def apart(command: click.Command, args: list[str]) -> list[str]:
    """Return arguments in which `1,2,3,4` and `1, 2, 3, 4` of an option of several numbers are four words."""
    counts = {
        word: option.nargs
        for option in command.params
        if isinstance(option, click.Option) and option.nargs > 1 and isinstance(option.type, _NUMBERS)
        for word in option.opts
    }
    out: list[str] = []
    k = 0
    while k < len(args):
        word, equals, value = args[k].partition("=")
        k += 1
        out.append(word if word in counts else args[k - 1])
        if args[k - 1] == "--":
            return out + args[k:]
        if word not in counts:
            continue
        numbers = [value] if equals else []
        while k < len(args) and (not numbers or len(_split(numbers)) < counts[word]) and _is_numbers(args[k]):
            numbers.append(args[k])
            k += 1
        found = _split(numbers)
        option = next(o for o in command.params if word in o.opts)
        if len(found) != counts[word]:
            named = f" ({option.metavar})" if isinstance(option, click.Option) and option.metavar else ""
            given = " ".join(numbers) or "none"
            needed = f"{word} takes {counts[word]} numbers{named}, with blanks or commas between"
            raise click.UsageError(f"{needed}; found {len(found)}: {given}")
        out += found
    return out


def _split(words: list[str]) -> list[str]:
    return [part for word in words for part in _BETWEEN.split(word) if part]


def _is_numbers(word: str) -> bool:
    """Return True if a word holds nothing but numbers and what separates them."""
    return all(_NUMBER.fullmatch(part) for part in _split([word]))
