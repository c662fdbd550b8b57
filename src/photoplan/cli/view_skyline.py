"""`photoplan view skyline`: the border between ground and sky, and that of a photograph."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from photoplan.cli.options import PATH, ending
from photoplan.cli.view_options import camera_options, take_request

_OF_PHOTO = ("border", "search", "control", "picture", "refine", "focal", "refined")


@click.command("skyline")
@camera_options
@click.option("--matrix", type=PATH, help="Take the camera of this coordinate matrix.")
@click.option(
    "--photo", type=PATH, metavar="IMAGE", help="A photograph with the pixels of the picture: its sky's edge."
)
@click.option("--border", type=int, help="Pixels along the edges of the photograph that are no picture [0].")
@click.option("--search", type=int, help="Rows above and below the skyline to look for the edge [a tenth].")
@click.option("--control", type=PATH, metavar="TABLE", help="Points of the photograph: x, y, E, N, H, name.")
@click.option("--picture", type=PATH, metavar="PNG", help="The photograph with both lines.")
@click.option("--refine", is_flag=True, default=None, help="Turn the camera until both lines agree.")
@click.option("--focal", is_flag=True, default=None, help="Alter its camera constant, too.")
@click.option("--refined", type=PATH, metavar="TOML", help="Write the camera that was found.")
@click.option("-o", "--output", type=PATH, required=True, metavar="FILE", help="CSV, or GeoPackage of points.")
@ending()
def command(matrix: Path | None, output: Path, overwrite: bool, **options: Any) -> None:
    """The skyline: in every column the highest ground that is seen, with its place in the picture and on the map.

    With a photograph it is compared with the edge of the sky there, and the camera may be turned until both agree.
    """
    from photoplan.cli.output import say, show, show_json
    from photoplan.errors import UsageError
    from photoplan.products.view.photo import PhotoSkylineRequest
    from photoplan.products.view.skyline import SkylineRequest, skyline

    as_json, quiet, photo = options.pop("as_json"), options.pop("quiet"), options.pop("photo")
    given = {name: value for name in _OF_PHOTO if (value := options.pop(name)) is not None}
    if given and photo is None:
        raise UsageError(f"`{next(iter(given))}` belongs to a photograph; give `photo`, too")
    asked = None if photo is None else PhotoSkylineRequest(photo, **given)
    found = skyline(SkylineRequest(take_request(options, matrix=matrix), output, overwrite, asked))
    if as_json:
        show_json(found)
        return
    for path in (output, given.get("picture"), given.get("refined")):
        if path is not None:
            show(path)
    if found.match is not None and found.match.doubt is not None:
        say(found.match.doubt)
    if quiet:
        return
    if not len(found.points):
        show(f"none of {found.columns} columns shows ground with sky above it")
    else:
        away = found.points[:, 5]
        show(f"{len(found.points)} of {found.columns} columns, {away.min():.0f} to {away.max():.0f} m away")
    for line in [] if found.match is None else told(found):
        show(line)


def told(found: Any) -> list[str]:
    """What a photograph says, in lines."""
    lines = []
    both = [("as stated", found.before)] + ([("turned", found.match)] if found.refined is not None else [])
    for name, match in both:
        f = match.figures
        if "median_px" in f:
            lines.append(
                f"{name}: edge of the sky in {f['columns_compared']} columns, {f['median_distance_px']:.2f} px from "
                f"the skyline in the median, shifted by {f['median_px']:+.2f} px, spread {f['spread_px']:.2f} px"
            )
        else:
            lines.append(f"{name}: no edge of the sky was found near the skyline")
        if "control_points" in f:
            worst = max(match.control, key=lambda c: (c.dx == c.dx, abs(c.dx) + abs(c.dy)))
            lines.append(
                f"{name}: {f['control_points']} control points, rms {f['control_rms_px']:.2f} px per coordinate, "
                f"largest {worst.name}: {worst.dx:+.2f} {worst.dy:+.2f} px"
            )
    if found.refined is not None:
        r = found.refined
        rows = zip(r.names, r.after, r.sigma, r.before)
        lines += [f"{name} {after:.4f} ±{sigma:.4f} {r.unit} (was {before:.4f})" for name, after, sigma, before in rows]
        if r.constant is not None:
            lines.append(f"camera constant {r.constant[0]:.6f} ±{r.constant[1]:.6f} times that of its camera")
        lines.append(f"from {r.used} columns, of which about {r.correlated:.0f} err together; the standpoint was held")
    return lines
