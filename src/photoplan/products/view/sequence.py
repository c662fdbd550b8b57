"""Views along a path: numbered pictures in a folder, and a film of them."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from photoplan.engine.executors import Workers
from photoplan.engine.run import Kept, Work
from photoplan.errors import PhotoplanError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.io.product import check_output
from photoplan.io.store import give_name, recorded_result, run_key, scratch, together
from photoplan.products.run import Run
from photoplan.products.view.camera import open_view_ground
from photoplan.products.view.lines import cameras, stations
from photoplan.products.view.make import ViewPlan, plan_view, view_work
from photoplan.requests.view import CameraRequest, SequenceRequest, ViewRequest


@dataclass(frozen=True, eq=False)
class SequencePlan(Result):
    """Pictures of a sequence before they are made."""

    plans: list[ViewPlan]

    def written(self) -> list[Path]:
        """Return no file: none is written."""
        return []

    def summary(self) -> list[str]:
        """Return how many pictures there are, and the first and the last of them."""
        first, last = self.plans[0], self.plans[-1]
        return [f"{len(self.plans)} pictures, the first and the last of them:", *first.summary(), *last.summary()]

    def json_fields(self) -> dict[str, Any]:
        """Return counts, and the first and the last picture."""
        tiles = sum(len(plan.tiles) for plan in self.plans)
        return {"frames": len(self.plans), "tiles": tiles, "first": self.plans[0], "last": self.plans[-1]}


@dataclass(frozen=True)
class Sequence(Result):
    """Pictures of a sequence, and the film of them."""

    frames: tuple[Path, ...]
    kept: int
    """Pictures of an earlier run."""
    video: Path | None

    def written(self) -> list[Path]:
        """Return the film, or the folder of the pictures."""
        return [self.frames[0].parent if self.video is None else self.video]

    def messages(self) -> list[str]:
        """Return how many pictures there are."""
        return [f"{len(self.frames)} pictures in {self.frames[0].parent}, {self.kept} of them of an earlier run"]

    def json_fields(self) -> dict[str, Any]:
        """Return files and counts."""
        folder = self.frames[0].parent
        return {"folder": folder, "frames": len(self.frames), "kept": self.kept, "video": self.video}


def plan_sequence(request: SequenceRequest) -> list[ViewPlan]:
    """Put all cameras on the ground; nothing is written.

    Raises
    ------
    UsageError
        The path does not fit the request, or a film is asked for where there is no ffmpeg.
    InputError
        A file cannot be used.
    GeometryError
        A standpoint lies below the ground or sees none of it; its picture is named.
    """
    if request.video is not None and shutil.which("ffmpeg") is None:
        raise UsageError(
            f"{request.video}: a film needs ffmpeg, which is not found on the PATH; install it, or leave `video` out "
            "(the pictures are numbered, so that any program can join them)"
        )
    places = stations(request.path, request.layer, request.step, open_view_ground(request.source, request.crs))
    looking = {"azimuth": 0.0} if request.along else {}
    template = (request.camera or CameraRequest()).part(CameraRequest, position=(0.0, 0.0), **looking)
    plans = []
    for k, camera in enumerate(cameras(template, places, request.along), 1):
        name = request.output / f"frame_{k:05d}.png"
        try:
            plans.append(plan_view(request.part(ViewRequest, camera=camera, output=name)))
        except PhotoplanError as error:
            raise type(error)(f"picture {k} of {len(places)}: {error}") from None
    # One range of heights for all, or colours would change from one picture to the next.
    lows, highs = zip(*(plan.address.heights for plan in plans))
    heights = (min(lows), max(highs))
    return [
        replace(
            plan, address=replace(plan.address, heights=heights), key=run_key("view sequence", [plan.key, heights], [])
        )
        for plan in plans
    ]


def view_sequence(request: SequenceRequest, events: Events = SILENT) -> SequencePlan | Sequence:
    """Plan and make pictures along a path, and a film of them; those that are there already are kept. For errors see
    `make_sequence`.
    """
    plans = plan_sequence(request)
    return SequencePlan(plans) if request.dry_run else make_sequence(request, plans, Run.of(request, events))


def make_sequence(request: SequenceRequest, plans: list[ViewPlan], run: Run) -> Sequence:
    """Make all pictures in one run, and the film; those of an earlier run that would be equal are kept.

    Raises
    ------
    UsageError
        A picture of another view stands in the way; see `make_view` for the rest.
    """
    run.check()
    kept = [_is_made(plan) for plan in plans]
    inputs = [name for name, _ in plans[0].address.digests]
    for plan, there in zip(plans, kept):
        if not there and plan.request.output is not None:
            check_output(plan.request.output, inputs, overwrite=run.overwrite)
    if request.video is not None:
        check_output(request.video, inputs, overwrite=run.overwrite)
    tiles = [len(plan.tiles) for plan in plans]

    def works(workers: Workers) -> Iterator[Work[Path] | Kept[Path]]:
        for plan, there, count in zip(plans, kept, tiles):
            assert plan.request.output is not None
            if there:
                yield Kept(plan.request.output, count)
            else:
                work = view_work(plan, run, workers)
                told: Any = replace(work, complete=_path_of(work))
                yield told

    run.events.begin(request.output.name, sum(tiles))
    with run.runner(map(Path, inputs), request.output.resolve().parent) as runner, together():
        frames: list[Path] = runner.run(works(runner.workers))
    more = sorted({*request.output.glob("frame_*.png")} - {plan.request.output for plan in plans})
    if more:
        run.events.talk(
            f"note: {request.output} holds {len(more)} more pictures, of another run or path, {more[0].name} "
            "the first of them: remove them before other programs join the pictures"
        )
    if request.video is not None:
        write_film(request.video, request.output, request.rate, len(frames))
    return Sequence(tuple(frames), sum(kept), request.video)


def _is_made(plan: ViewPlan) -> bool:
    path = plan.request.output
    return path is not None and path.is_file() and bool(recorded_result(path, plan.key, lambda product, settings: True))


def _path_of(work: Work[Any]) -> Any:
    """Completes a picture, and tells its path only."""
    return lambda tally: work.complete(tally).path


def write_film(path: Path, folder: Path, rate: float, count: int) -> None:
    """Join the first `count` pictures of a folder by ffmpeg (H.264; sides are made even)."""
    pictures = str(folder / "frame_%05d.png")
    words = ["ffmpeg", "-y", "-loglevel", "error", "-framerate", f"{rate:g}", "-i", pictures, "-pix_fmt", "yuv420p"]
    words += ["-frames:v", str(count), "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]
    with scratch(path.parent) as made:
        part = made / "film.mp4"
        said = subprocess.run([*words, str(part)], capture_output=True, text=True, check=False)
        if said.returncode != 0 or not part.is_file():
            last = " ".join(said.stderr.split())[-300:]
            raise PhotoplanError(f"{path}: ffmpeg could not join the pictures in {folder}, which are complete ({last})")
        give_name(part, path)
