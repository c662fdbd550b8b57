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


class _Views(LazyGroup):
    """`photoplan view FILE …` is `photoplan view picture FILE …`, and `panorama` one with `--panorama cylinder`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args[:1] == ["panorama"]:
            args = ["picture", "--panorama", "cylinder", *args[1:]]
        given = not args or args[0] in (*self.verbs, *ctx.help_option_names)
        return super().parse_args(ctx, args if given else ["picture", *args])


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
