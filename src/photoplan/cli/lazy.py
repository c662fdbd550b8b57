"""Groups of commands that are imported only when they are used, so that `--help` answers at once."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from typing import Any

import click

from photoplan.cli.output import spelled
from photoplan.cli.table import GROUPS, HEADINGS, VerbGroup
from photoplan.cli.verb import Verb
from photoplan.errors import PhotoplanError

_SETTINGS: dict[str, Any] = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class LazyGroup(click.Group):
    """Lists verbs without importing them."""

    def __init__(self, *arguments: Any, verbs: Mapping[str, Verb | VerbGroup], **options: Any) -> None:
        super().__init__(*arguments, context_settings=_SETTINGS, **options)
        self.verbs = verbs
        self.words: Mapping[str, tuple[str, ...]] = {}
        """Commands that words in place of a verb stand for, see `VerbGroup.words`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments; a word that is no verb may stand for one."""
        return super().parse_args(ctx, spelled_out(args, self.verbs, self.words))

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
        if ctx.parent is None:
            inner = {name: group for name, group in GROUPS.items() if not group.alone}
            places |= {f"{verb} ({name})": f"{name} {verb}" for name, group in inner.items() for verb in group.verbs}
        close = get_close_matches(word, [place.split()[0] for place in places], n=3, cutoff=0.6)
        meant = [f"`{ctx.command_path} {full}`" for place, full in places.items() if place.split()[0] in close]
        return f"; did you mean {' or '.join(meant[:3])}?" if meant else f"; see `{ctx.command_path} --help`"

    @property
    def own(self) -> click.Command | None:
        """Command that the name of the group alone stands for."""
        return self.get_command(click.Context(self), self.words[""][0]) if "" in self.words else None

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the verbs, in the order of a job."""
        return list(self.verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a verb or a group, made now."""
        verb = self.verbs.get(cmd_name)
        if isinstance(verb, VerbGroup):
            group = LazyGroup(cmd_name, verbs=verb.verbs, help=verb.help or verb.short)
            group.words = verb.words
            return group
        if verb is None:
            return None
        if self.words.get("") != (cmd_name,):
            return verb.command(cmd_name)
        # What the name of the group alone stands for has that name.
        command = verb.command(self.name or cmd_name)
        others = ", ".join(f"`{self.name} {name}`" for name in self.verbs if name != cmd_name)
        command.epilog = f"More: {others}."
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one line for each verb; those of the whole program below headings."""
        headings = HEADINGS if ctx.parent is None else {"Commands": tuple(self.verbs)}
        for heading, names in headings.items():
            with formatter.section(heading):
                formatter.write_dl([(name, self.verbs[name].short) for name in names])
        if ctx.parent is None:
            rest = set(self.verbs).difference(*headings.values())
            with formatter.section("Groups (their commands can also be called without the group name)"):
                formatter.write_dl([(name, verb.short) for name, verb in self.verbs.items() if name in rest])


def spelled_out(args: list[str], verbs: Iterable[str], words: Mapping[str, tuple[str, ...]]) -> list[str]:
    """Return arguments of a group with the verb that a word stands for, or that may be left out."""
    if not args and "-h" in words:
        return [*words[""]]
    if not args or args[0] in verbs:
        return args
    if args[0] in words:
        return [*words[args[0]], *args[1:]]
    return args if "" not in words or args[0] in _SETTINGS["help_option_names"] else [*words[""], *args]


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
