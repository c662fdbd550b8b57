"""Options of all views: from where, whereto and how."""

from __future__ import annotations

from typing import Any

import click

from photoplan.cli.options import PATH, ending, executor_option, memory_option, several, workers_option

_XY: dict[str, Any] = {"type": float, "nargs": 2, "default": None}
_CAMERA = ("position", "height", "altitude", "look_at", "azimuth", "pitch", "roll", "field_of_view", "size",
           "pixel_aspect", "panorama", "curvature", "refraction", "earth_radius", "exaggeration",
           "reference")  # fmt: skip


#: The terrain or project, and the camera.
camera_options = several(
    click.argument("source", type=PATH),
    click.option(
        "--camera", metavar="IMAGE|FILE", help="An image of the project, or a TOML file of the options below."
    ),
    click.option("--from", "position", metavar="X Y", help="Standpoint.", **_XY),
    click.option("--height", type=float, help="Eye above ground, metres [1.7]."),
    click.option("--altitude", type=float, help="Height of the eye in the terrain's system instead."),
    click.option("--look-at", metavar="X Y", help="Point of the ground in the middle of the picture.", **_XY),
    click.option("--look-at-height", type=float, help="Height of that point, if it is not on the ground."),
    click.option("--azimuth", type=float, help="Direction of view instead, degrees from grid north."),
    click.option("--pitch", type=float, help="Of the view above the horizon, degrees, with --azimuth [0]."),
    click.option("--roll", type=float, help="Of the camera, degrees clockwise [0]."),
    click.option("--fov", "field_of_view", type=float, help="Left to right, degrees [60; panoramas 360]."),
    click.option("--size", type=int, nargs=2, default=None, metavar="W H", help="Of the picture, pixels [1200 800]."),
    click.option("--pixel-aspect", type=float, help="Width of a pixel by its height [1]."),
    click.option("--panorama", type=click.Choice(["cylinder", "sphere"]), help="Instead of a plane picture."),
    click.option(
        "--curvature",
        type=click.Choice(["none", "bend", "strict"]),
        help="The earth: flat, lowered by s²/2R, or strict [standpoints bend, images as the project has it].",
    ),
    click.option("--refraction", type=float, help="Coefficient k [0.13]."),
    click.option("--earth-radius", type=float, help="R, metres [the ellipsoid's]."),
    click.option("--exaggeration", type=float, help="Factor of heights [1]."),
    click.option("--reference", type=float, help="Height that it leaves [where the picture's middle meets ground]."),
    click.option("--farthest", type=float, help="See no further than this, metres [all]."),
    click.option("--bound", type=float, help="Largest error of ground coordinates, metres [0.01]."),
    click.option(
        "--water", type=float, metavar="H", help="Height of water that covers what is lower or has no height."
    ),
    click.option("--crs", help="CRS of a terrain model that does not state it."),
    click.option("--force", is_flag=True, help="Also from below the ground, or where none is seen."),
)


#: How it is made.
running_options = several(workers_option, executor_option, memory_option, ending("Say what will be seen, and stop."))


def take_camera(options: dict[str, Any]) -> Any:
    """The camera, taken out of the options of a verb; None: none of its options is given."""
    import tomllib
    from pathlib import Path

    from photoplan.errors import InputError, UsageError
    from photoplan.products.view.camera import CameraRequest

    given = {name: value for name in _CAMERA if (value := options.pop(name)) is not None}
    height = options.pop("look_at_height")
    if height is not None:
        if "look_at" not in given:
            raise UsageError("`look_at_height` belongs to a point; give `look_at` X Y")
        given["look_at"] = (*given["look_at"], height)
    camera = options.pop("camera")
    if camera is None:
        return CameraRequest(**given) if given else None
    if not camera.lower().endswith(".toml"):
        return CameraRequest(image=camera, **given)
    try:
        stated = tomllib.loads(Path(camera).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{camera}: is no file of a camera ({error})") from error
    return CameraRequest.from_dict(
        {**stated, **{n: list(v) if isinstance(v, tuple) else v for n, v in given.items()}}, camera
    )


def take_request(options: dict[str, Any], **more: Any) -> Any:
    """The request, taken out of the options of a verb."""
    from photoplan.products.view.make import ViewRequest

    given = {name: value for name in ("farthest", "bound", "water") if (value := options.pop(name)) is not None}
    named = {name: options.pop(name) for name in ("source", "crs", "force")}
    return ViewRequest(camera=take_camera(options), **named, **given, **more)


def run_view(request: Any, options: dict[str, Any]) -> None:
    """Plan and make a view, or say what it would show."""
    from photoplan.cli.output import say, show, show_json
    from photoplan.cli.telling import Telling
    from photoplan.products.run import Run
    from photoplan.products.view.make import make_view, plan_view

    as_json, quiet, dry = options["as_json"], options["quiet"], options["dry_run"]
    with Telling(quiet) as events:
        plan = plan_view(request)
        if dry:
            if as_json:
                show_json(plan)
            else:
                for line in told(plan):
                    show(line)
            return
        for line in told(plan):
            events.talk(line)
        asked = {name: options[name] for name in ("workers", "executor", "memory", "overwrite")}
        result = make_view(plan, Run(**asked, quicklook=False, events=events))
    if as_json:
        show_json(result, view=plan)
        return
    show(result.path)
    if result.svg is not None:
        show(result.svg)
    if not quiet and result.drawn is not None:
        d = result.drawn
        room = f", no room for {d.unplaced}" if d.unplaced else ""
        say(f"{d.seen} of {d.features} lines and points are seen; {d.labels} labels{room}")
    if not quiet:
        share = result.sky / result.rays
        near = "" if result.nearest is None else f"; ground from {result.nearest:.4g} to {result.farthest:.6g} m"
        lost = result.lost / result.rays
        beyond = f" ({lost:.1%} downwards, past the terrain's border or through holes)" if lost else ""
        say(f"{result.size[0]} × {result.size[1]} pixels in {result.seconds:.1f} s, {share:.1%} sky{beyond}{near}")


def told(plan: Any) -> list[str]:
    """What a view will show, in lines."""
    x, y, z = plan.camera.target.center
    request, first = plan.camera.request, plan.first
    width, height = plan.camera.target.bundle.size
    across, along = plan.field_of_view
    what = f"image {request.image}" if request.image else f"azimuth {request.azimuth:.3f}°, pitch {request.pitch:.3f}°"
    upright = f" × {along:.4g}" if along == along else ""
    earth = "flat earth"
    if request.image and plan.camera.target.warps and plan.camera.earth_radius is None:
        earth = "earth and refraction as the project has them"
    elif plan.camera.earth_radius is not None:
        k = 0.13 if request.refraction is None else request.refraction
        earth = f"{request.curvature or 'bend'}: R = {plan.camera.earth_radius / 1000:.0f} km, k = {k:g}"
    if request.exaggeration != 1:
        earth += f"; heights × {request.exaggeration:g} about {request.reference:.2f} m"
    if plan.stereo is not None:
        earth += f"; {plan.stereo.how}, base {plan.stereo.base:g} m"
    lines = [
        f"standpoint {x:.2f} {y:.2f} {z:.2f}, {plan.camera.above_ground:.2f} m above ground",
        f"{what}; field of view {across:.4g}{upright}°; {width} × {height} pixels; {earth}",
    ]
    if first.nearest is None:
        return [*lines, "no ground is seen"]
    return [
        *lines,
        f"ground at {first.nearest:.4g} to {first.farthest:.4g} m, heights {first.lowest:.6g} to {first.highest:.6g} m"
        f", pixel {first.pixel:.3g} m in the median, {1 - first.ground:.0%} sky",
    ]
