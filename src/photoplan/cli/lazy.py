"""Groups of verbs that are imported only when they are used, so that `--help` answers at once."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import click

from photoplan.cli.output import spelled
from photoplan.errors import PhotoplanError


class LazyGroup(click.Group):
    """Lists verbs without importing them."""

    def __init__(self, *arguments: Any, verbs: Mapping[str, str], package: str, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.verbs = verbs
        self.package = package
        """What a verb's name is appended to, to give the module that holds its `command`."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a verb; its errors name parameters as the verb's options."""
        try:
            return super().invoke(ctx)
        except PhotoplanError as error:
            verb = self.get_command(ctx, ctx.invoked_subcommand or "")
            error.args = (spelled(str(error), verb, ctx.find_root().command), *error.args[1:])
            raise

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The verbs, in the order of a job."""
        return list(self.verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of a verb, imported now."""
        if cmd_name not in self.verbs:
            return None
        command: click.Command = importlib.import_module(self.package + cmd_name).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """One line for each verb."""
        with formatter.section("Verbs"):
            formatter.write_dl(list(self.verbs.items()))
