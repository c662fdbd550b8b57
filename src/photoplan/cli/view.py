"""`photoplan view`: what is seen from a point."""

from __future__ import annotations

import click

from photoplan.cli.lazy import LazyGroup

#: Verb and its one-line help; the command is `photoplan.cli.view_<verb>:command`.
VERBS = {
    "picture": "A picture of terrain, rasters or photos (this word may be left out).",
    "sequence": "Pictures along a path, and a film of them.",
    "matrix": "The ground of every pixel as a raster.",
    "pick": "Pixels to ground, ground to pixels.",
    "area": "What of the map is seen, as a raster or a polygon.",
    "skyline": "The border between ground and sky, as a table or on the map.",
}


def spelled_out(words: list[str]) -> list[str]:
    """Words after `view` with their verb: a FILE is a picture of it, a panorama a picture all around."""
    if words[:1] == ["panorama"]:
        return ["picture", "--panorama", "cylinder", *words[1:]]
    return words if words[0] in VERBS else ["picture", *words]


class _Views(LazyGroup):
    """`photoplan view FILE …` is `photoplan view picture FILE …`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        help_only = not args or args[0] in ctx.help_option_names
        return super().parse_args(ctx, args if help_only else spelled_out(args))


command = _Views(
    name="view",
    verbs=VERBS,
    package="photoplan.cli.view_",
    help="""Perspective views of a project or a terrain model: photoplan view FILE --from X Y --look-at X Y -o PICTURE.

    `photoplan view panorama` looks all around (picture --panorama cylinder; --panorama sphere comes after it).

    Pictures can be measured: `matrix` gives the ground point of every pixel, `pick` that of single ones.
    """,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
