"""Commands that make orthophotos, mosaics and objects, or print and write their plan."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photoplan.errors import UsageError
from photoplan.events import COMPILATIONS, SILENT, Events
from photoplan.findings import Result
from photoplan.io.disk import make_folder, received
from photoplan.io.project.file import load_project
from photoplan.io.store import write_atomically
from photoplan.plain import counted, pick
from photoplan.products.orthophoto.execution import execute_all, refuse_failed
from photoplan.products.orthophoto.finished import ProductResult, overview_path
from photoplan.products.orthophoto.plan import OrthoPlan, plan_orthophotos
from photoplan.products.run import Run, load_on_target
from photoplan.project.scene import Attempts, refuse_unusable
from photoplan.requests.ortho import DemoRequest, MosaicRequest, ObjectRequest, ProductRequest, RunRequest

if TYPE_CHECKING:
    from photoplan.products.orthophoto.plan_file import PlanReport


@dataclass(frozen=True, eq=False)
class ProductsReport(Result):
    """Products of a plan that was executed."""

    plan: OrthoPlan
    products: tuple[ProductResult, ...]
    folder: Path
    seconds: float
    compiled: tuple[int, float]
    """Kernels that were compiled, and seconds that this took."""
    quicklook: bool
    unusable: Mapping[str, str] = field(default_factory=dict)
    """Images that are left out since their files cannot be used, and why."""
    asked: int = 0
    """Number of images that were asked for."""

    def json_fields(self) -> dict[str, Any]:
        """Return the products, the seconds they took, and their folder."""
        return pick(self, "products", "seconds", "folder")

    def written(self) -> Sequence[Path]:
        """Return the files of all products."""
        return [path for product in self.products for path in product.written()]

    @property
    def figures(self) -> Sequence[str]:
        """Lines with pixels a second, anchors, hidden ground and the preview; none if tiles failed."""
        if any(product.failed for product in self.products):
            return ()
        kernels, compiled = self.compiled
        pixels = sum(p.grid.width * p.grid.height for p in self.plan.products) / 1e6
        compilation = f" ({compiled:.1f} s of them to compile {kernels} kernel{'s' * (kernels > 1)})" if kernels else ""
        line = (
            f"{self.plan.what} in {self.seconds:.1f} s{compilation} · {pixels:.1f} Mpx, "
            f"{pixels / (self.seconds - compiled):.3g} Mpx/s · {sum(r.cells for r in self.products)} cells, "
            f"worst anchor residual {max(r.residual for r in self.products):.3g} px"
        )
        filled = [r.filled for r in self.products if r.filled is not None]
        around = [_area([each[name] for each in filled]) for name in ("images", "surroundings")]
        for text, parts in (
            ("hidden {} m²", [r.hidden for r in self.products if r.hidden is not None]),
            ("gaps {} m²", [r.gaps for r in self.products if r.gaps is not None]),
            ("in no image {} m²", [r.bare for r in self.products if r.bare is not None]),
        ):
            line += f" · {text.format(_area(parts))}" if parts else ""
            if filled and text.startswith("hidden"):
                line += f", of it filled {around[0]} m² from images and {around[1]} m² from surroundings"
        return [line, *([f"quick look: {overview_path(self.plan, self.folder)}"] if self.quicklook else [])]

    def raise_failures(self) -> None:
        """Name the products that lack tiles, and the images that could not be used."""
        refuse_failed(self.products)
        refuse_unusable(self.unusable, self.asked)


def _area(parts: Sequence[float]) -> str:
    """Return a sum with all digits before the point."""
    whole = sum(parts)
    return f"{whole:,.0f}" if whole >= 1000 else f"{whole:.4g}"


def make_products(request: ProductRequest, events: Events = SILENT) -> ProductsReport | PlanReport:
    """Make orthophotos, a mosaic or products of single objects, or show the plan.

    Images whose files cannot be used are left out.

    Raises
    ------
    UsageError
        A product exists, an option cannot be, or `memory` does not suffice.
    InputError
        An input cannot be used.
    GeometryError
        No image sees the terrain, or an orientation cannot be right.
    """
    project, images, plan = load_on_target(request), request.images or None, _planner(request)
    attempts, again = Attempts(project, images), False
    for attempt in attempts:
        with attempt as usable:
            planned = plan(usable, images, events=events, force=request.force, **request.changes)
            left = {"unusable": attempts.left_out, "asked": len(project.select(images))}
            if request.dry_run or request.plan_file is not None:
                # Here, since plans as files need a library for vector data that a product does not: 30 MB of memory.
                from photoplan.products.orthophoto.plan_file import show_plan  # noqa: PLC0415

                report: ProductsReport | PlanReport = show_plan(planned, request, events, **left)
            else:
                execution, again = _Execution(planned, request.folder, Run.of(request, events, again)), True
                report = execution.report(execute_all(planned, request.folder, execution.run), **left)
    return report


def _planner(request: ProductRequest) -> Callable[..., OrthoPlan]:
    """Return what plans the products of a request; mosaics load vector files."""
    if isinstance(request, MosaicRequest):
        from photoplan.products.orthophoto.mosaic import plan_mosaic  # noqa: PLC0415

        return plan_mosaic
    if not isinstance(request, ObjectRequest):
        return plan_orthophotos
    from photoplan.io.project.model import Objects  # noqa: PLC0415
    from photoplan.products.orthophoto.mosaic import plan_objects  # noqa: PLC0415

    names = ("layer", "crs", "height_system", "offset", "sigma")
    stated = {name: value for name, value in pick(request, *names).items() if value is not None}
    polygons = Objects(file=str(request.polygons.absolute()), **stated)
    return partial(plan_objects, polygons=polygons, objects=request.objects, below=request.below)


def run_plan(request: RunRequest, events: Events = SILENT) -> ProductsReport:
    """Execute a plan that was written; inputs that have changed since are refused.

    Raises
    ------
    UsageError
        A product exists, or the plan states no folder and `output` is not set.
    InputError
        The file is no plan, or an input has changed since it was written.
    """
    from photoplan.products.orthophoto.plan_file import read_plan  # noqa: PLC0415

    plan, folder = read_plan(request.plan)
    folder = request.output or folder
    if folder is None:
        raise UsageError(f"{request.plan}: states a folder of products outside its own folder; give `output`")
    execution = _Execution(plan, folder, Run.of(request, events))
    return execution.report(execute_all(plan, folder, execution.run))


def make_demo(request: DemoRequest, events: Events = SILENT) -> ProductsReport:
    """Copy the included block to a folder, and make its project and its orthophotos as the commands would.

    Raises
    ------
    UsageError
        The folder holds other data, another project or other products, and `overwrite` is not set.
    """
    from photoplan.io.project.file import project_text  # noqa: PLC0415
    from photoplan.products.check import check_project  # noqa: PLC0415
    from photoplan.products.init import make_project  # noqa: PLC0415
    from photoplan.requests.project import InitRequest  # noqa: PLC0415

    folder, data = request.folder, request.folder / "data"
    received(folder)

    def put(path: Path, content: bytes) -> None:
        """Write a file unless it is there, or another one that must stay."""
        there = path.exists() or path.is_symlink()
        if there and path.is_file() and path.read_bytes() == content:
            return
        if there and not request.overwrite:
            raise UsageError(f"{path}: exists already and differs; choose another folder or give `overwrite`")
        make_folder(path.parent)
        write_atomically(path, content)

    with as_file(files("photoplan") / "demo_block") as block:
        for source in sorted(path for path in block.rglob("*") if path.is_file() and path.suffix != ".pyc"):
            put(data / source.relative_to(block), source.read_bytes())
    stated = InitRequest(
        folder=folder,
        images=(str(data / "images" / "*.jpg"),),
        camera=data / "int.yaml",
        orientation=data / "ext.csv",
        terrain=str(data / "dsm.tif"),
        height_system="same",
    )
    options = {name: getattr(stated, name) for name in ("camera", "orientation", "terrain", "height_system")}
    events.talk(_command("init", folder, images=f"'{stated.images[0]}'", **options))
    made = make_project(stated, events)
    # What a demo that was interrupted has written is the same; anything else is somebody's work.
    put(made.path, project_text(made.project).encode())
    events.talk(_command("check", made.path))
    project = load_project(made.path)
    events.talk(str(check_project(project)))
    events.talk(_command("ortho", made.path, resolution=f"{request.resolution:g}"))
    plan = plan_orthophotos(project, resolution=request.resolution, events=events)
    execution = _Execution(plan, folder / "products", Run.of(request, events))
    return execution.report(execute_all(plan, execution.folder, execution.run))


def _command(verb: str, argument: Path, **options: object) -> str:
    """Return the command that a user would call."""
    return f"$ photoplan {verb} {argument}" + "".join(f" --{n.replace('_', '-')} {v}" for n, v in options.items())


class _Execution:
    """The execution of a plan: it is announced, timed and reported."""

    def __init__(self, plan: OrthoPlan, folder: Path, run: Run) -> None:
        self.plan, self.folder, self.run = plan, folder, run
        self._started = time.perf_counter()
        self._compiled = COMPILATIONS.kernels, COMPILATIONS.seconds
        settings, tiles = plan.settings, counted(sum(len(p.plan.tiles) for p in plan.products), "tile")
        workers = "1 thread" if (run.workers, run.executor) == (1, "threads") else f"{run.workers} {run.executor}"
        run.events.talk(
            f"plan: {plan.what}, {tiles} · {settings.resolution:g} m · "
            f"kernel {settings.kernel} · {settings.exactness} · nodata {settings.nodata} · "
            f"hidden {settings.hidden}{settings.filling} · {workers}"
        )
        for line in plan.blind:
            run.events.talk(f"  note: left out: {line}")

    def report(self, products: Sequence[ProductResult], **left: Any) -> ProductsReport:
        """Return the products, also those whose tiles failed, with their figures, which are messages, too."""
        kernels, seconds = self._compiled
        report = ProductsReport(
            plan=self.plan,
            products=tuple(products),
            folder=self.folder,
            seconds=time.perf_counter() - self._started,
            compiled=(COMPILATIONS.kernels - kernels, COMPILATIONS.seconds - seconds),
            quicklook=self.run.quicklook,
            **left,
        )
        for line in report.figures:
            self.run.events.talk(line)
        return report
