"""`photoplan view`: what is seen from a point."""

from __future__ import annotations

import click

from photoplan.cli.lazy import LazyGroup
from photoplan.cli.verb import Verb

#: A row for each command.
VERBS: dict[str, Verb] = {
    "picture": Verb(
        "A picture of terrain, rasters or photos (this word may be left out).",
        """Make a picture of SOURCE, a project or terrain model, from a standpoint or with an image's own camera.

        The same command continues a run that was interrupted.
        """,
        "requests.view:ViewRequest",
        "report.views:labelled_picture",
    ),
    "sequence": Verb(
        "Pictures along a path, and a film of them.",
        """Make pictures of SOURCE along a path: with --look-at towards one point, with --azimuth in one direction, else
        ahead.

        The same command continues a run that was interrupted; pictures that are there already are kept.
        """,
        "requests.view:SequenceRequest",
        "report.views:labelled_sequence",
    ),
    "matrix": Verb(
        "The ground of every pixel as a raster.",
        """Compute the ground of every pixel of a view: E, N, H, distance, angle of incidence, size of the pixel,
        surface, normal.

        A GeoTIFF of nine bands; `photoplan view --matrix` paints it with other content.
        """,
        "requests.view:MatrixRequest",
        "products.view.make:view_matrix",
    ),
    "pick": Verb(
        "Pixels to ground, ground to pixels.",
        """Find the ground of pixels of a view, and the pixels of ground points, with what is seen there.

        (0, 0) is the centre of the upper-left pixel.
        """,
        "requests.view:PickRequest",
        "products.view.measure:pick_points",
    ),
    "area": Verb(
        "What of the map is seen, as a raster or a polygon.",
        "Map the visible area, which the picture shows: 1 seen, 0 not seen, 255 no terrain.",
        "requests.view:AreaRequest",
        "products.view.measure:visible_area",
    ),
    "skyline": Verb(
        "The border between ground and sky, as a table or on the map.",
        """Find the skyline: in every column the highest ground that is seen, with its place in the picture and on the
        map.

        With a photograph it is compared with the edge of the sky there, and the camera may be turned until both agree.
        """,
        "requests.view:SkylineRequest",
        "products.view.skyline:skyline",
    ),
}


def spelled_out(words: list[str]) -> list[str]:
    """Return the words after `view` with their verb: a FILE is a picture of it, a panorama a picture all around."""
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
    help="""Perspective views of a project or a terrain model: photoplan view FILE --from X Y --look-at X Y -o PICTURE.

    `photoplan view panorama` looks all around (picture --panorama cylinder; --panorama sphere comes after it).

    Pictures can be measured: `matrix` gives the ground point of every pixel, `pick` that of single ones.
    """,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
