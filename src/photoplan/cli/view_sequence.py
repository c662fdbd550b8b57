"""`photoplan view sequence`: pictures along a path."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import NEW_FOLDER, PATH
from photoplan.cli.view_look import look_options, take_look
from photoplan.cli.view_options import camera_options, running_options, take_request, told


@click.command("sequence")
@camera_options
@look_options
@click.option("--path", "path", type=PATH, required=True, metavar="FILE", help="Stations: a table x, y, z; or points, "
              "or a line of a GeoPackage, GeoJSON, Shapefile or DXF.")  # fmt: skip
@click.option("--layer", help="Of the path's file.")
@click.option("--step", type=float, help="Between stations of a line, metres.")
@click.option("--video", type=PATH, metavar="MP4", help="A film of the pictures; needs ffmpeg.")
@click.option("--rate", type=float, default=25.0, show_default=True, help="Pictures of the film per second.")
@click.option("-o", "--output", type=NEW_FOLDER, required=True, metavar="FOLDER", help="For frame_00001.png and so on.")
@running_options
def command(**options: Any) -> None:
    """Pictures of SOURCE along a path: with --look-at towards one point, with --azimuth in one direction, else ahead.

    The same command continues a run that was interrupted; pictures that are there already are kept.
    """
    from photoplan.cli.output import say, show, show_json
    from photoplan.cli.telling import Telling
    from photoplan.errors import UsageError
    from photoplan.products.run import Run
    from photoplan.products.view.sequence import SequenceRequest, make_sequence, plan_sequence

    if options["camera"] is not None or options["position"] is not None:
        raise UsageError("standpoints of a sequence are those of its `path`; give neither `camera` nor `position`")
    along = options["look_at"] is None and options["azimuth"] is None
    options |= {"position": (0.0, 0.0)} | ({"azimuth": 0.0} if along else {})
    own = {name: options.pop(name) for name in ("path", "layer", "step", "video", "rate", "output")}
    view = take_request(options, **take_look(options))
    request = SequenceRequest(view=view, template=view.camera, along=along, **own)
    with Telling(options["quiet"]) as events:
        plans = plan_sequence(request)
        if options["dry_run"]:
            if options["as_json"]:
                tiles = sum(len(plan.tiles) for plan in plans)
                show_json({"frames": len(plans), "tiles": tiles, "first": plans[0], "last": plans[-1]})
            else:
                show(f"{len(plans)} pictures, the first and the last of them:")
                for line in [*told(plans[0]), *told(plans[-1])]:
                    show(line)
            return
        asked = {name: options[name] for name in ("workers", "executor", "memory", "overwrite")}
        made = make_sequence(request, plans, Run(**asked, quicklook=False, events=events))
    if options["as_json"]:
        show_json(made)
        return
    show(request.output if made.video is None else made.video)
    if not options["quiet"]:
        say(f"{len(made.frames)} pictures in {request.output}, {made.kept} of them of an earlier run")
