"""The command `photoplan`: a table of verbs, errors, exit codes."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
import threading
import warnings
from collections.abc import Sequence

import click

from photoplan.cli.interrupt import CODE, catch_interrupts, stop_children
from photoplan.cli.lazy import LazyGroup
from photoplan.cli.output import printable
from photoplan.cli.verb import Verb
from photoplan.errors import PhotoplanError, PhotoplanWarning, ResourceError

#: A row for each command, in the order of a job; a group is a module of its own with one line here.
VERBS: dict[str, str | Verb] = {
    "init": Verb(
        "Write a project file from the files you have.",
        """Write DIR/project.toml from images, camera, orientation and terrain.

        Prints the path of the project file on stdout. Height systems must be stated by the files or declared. Without
        --orientation the images are to be oriented (tie, resect, adjust), and --crs is needed.
        """,
        "requests.project:InitRequest",
        "products.init:init_project",
    ),
    "convert": Verb(
        "Orientations from one file format to another.",
        """Write ORIENTATION, an orientation file or a project, in another format.

        What the other format cannot hold is reported on stderr. A lens that it cannot hold is refused unless
        --drop-lens is set.
        """,
        "requests.orient:ConvertRequest",
        "products.convert:convert",
    ),
    "fiducials": Verb(
        "Find the fiducial marks of film scans.",
        """Find the fiducial marks of scanned film photos, without approximate values.

        IMAGE… are scans, with --camera FILE; or one project file, whose film images are measured and which receives the
        marks. An image that fails does not stop the others; they are listed at the end (exit code 4).
        """,
        "requests.orient:FiducialsRequest",
        "products.film:locate_fiducials",
        {"pictures/": "report.fiducials:draw_marks"},
    ),
    "interior": Verb(
        "Interior orientation of film scans from their marks.",
        """Residuals, sigma0, scales, shear and film shrinkage of the scans in PROJECT.

        An image whose marks are missing, exchanged, mirrored or wrong does not stop the others; they are listed at the
        end (exit code 4).
        """,
        "requests.orient:InteriorRequest",
        "products.film:interior_orientations",
        {"report": "report.interior:interior_page", "plot": "report.interior:interior_plot"},
        record="interior",
    ),
    "tie": Verb(
        "Find tie points between images.",
        """Find points that several images of PROJECT have in common.

        They are written as a table (point, image, column, row, standard deviations), which becomes an entry of
        [observations] in PROJECT. Images that are not connected with the others are named.
        """,
        "requests.orient:TieRequest",
        "products.tie:find_ties",
        {"picture": "report.tie:draw_ties"},
    ),
    "control": Verb(
        "Propose control points from an orthophoto and heights.",
        """Propose control for the approximately oriented images of PROJECT.

        Patches of an orthophoto are found in the images. Their places with heights become ground points, written with
        the image points beside them (NAME_points.csv); both become entries of [observations] in PROJECT. Points that do
        not agree on one correction of an image's orientation are left out.
        """,
        "requests.orient:ControlRequest",
        "products.control:propose_control",
    ),
    "resect": Verb(
        "Orient single images by control points.",
        """Exterior orientation of single images by control points, without initial values.

        Writes center, angles and their standard deviations into PROJECT. An image that fails does not stop the others;
        they are listed at the end (exit code 4).
        """,
        "requests.orient:ResectRequest",
        "products.film:resect_project",
        {"report": "report.resect:resect_page"},
    ),
    "adjust": Verb(
        "Adjust a block of images (bundle adjustment).",
        """Orientations, points and cameras from all measurements of a project at once.

        Measurements are the files that [observations] names. Orientations and calibrated cameras are written into the
        project file (the one before is kept as *.previous.toml), a report and the points into the output folder.

        Images that cannot be oriented do not stop the others; they are listed at the end (exit code 4), and products
        leave them out.
        """,
        "requests.orient:AdjustRequest",
        "products.adjust.run:adjust_project",
        {"report": "report.adjust:adjust_page"},
    ),
    "check": Verb(
        "Validate a project and print what to expect of it.",
        """Open every input of PROJECT and print, image by image, what it promises.

        Ends with exit code 3 if orientations are implausible or another reading fits better, which is named, and with 4
        if files of some images cannot be used.
        """,
        "requests.project:CheckRequest",
        "products.check:check",
    ),
    "budget": Verb(
        "What limits the accuracy of products, cause by cause.",
        """Standard deviations of position on level ground, cause by cause, in the middle, at an edge and in a corner.

        For the images of PROJECT, or for a vertical image by numbers: --camera-constant and --height.
        """,
        "requests.project:BudgetRequest",
        "products.budget:budget_or_tables",
        {"picture": "report.budget:draw_picture"},
    ),
    "balance": Verb(
        "Even colours: tables by which images agree where they overlap.",
        """Find tables by which the images of PROJECT agree in colour where they overlap.

        Each image gets a file with a table for every band, and an entry `balance` in PROJECT: `ortho` and `mosaic`
        apply it from then on.
        """,
        "requests.ortho:BalanceRequest",
        "products.balance:balance_project",
        {"picture": "report.balance:draw_balance"},
    ),
    "seams": Verb(
        "Find where images of a mosaic are best joined.",
        """Find seams between the images of PROJECT where they are least seen.

        They run where two images show the same, around what stands out of the ground. The regions are a GeoPackage with
        a column `image`, which `photoplan mosaic --seams` takes and QGIS edits.
        """,
        "requests.ortho:SeamsRequest",
        "products.seams:make_seams",
        {"picture": "report.maps:seams_picture"},
    ),
    "ortho": Verb(
        "Make orthophotos.",
        """Make an orthophoto of each image: NAME_ortho.tif (a cloud-optimised GeoTIFF) and its run record.

        The same command continues a run that was interrupted.
        """,
        "requests.ortho:OrthoRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
    ),
    "mosaic": Verb(
        "Make one orthophoto of many images.",
        """Make one orthophoto of all images: each pixel from the best of those that see it.

        The area that no image sees is left empty and reported in square metres. The same command continues a run that
        was interrupted.
        """,
        "requests.ortho:MosaicRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
    ),
    "illumination": Verb(
        "Take the light on slopes, and haze, out of an orthophoto.",
        """Take the light on slopes, and haze, out of PICTURE, an orthophoto.

        Parameters are estimated from the picture and printed with standard deviations. If terrain casts its shadow on a
        slope, or a slope turns away from the sun, it is not corrected.
        """,
        "requests.ortho:IlluminationRequest",
        "products.illumination:correct_illumination",
        {"preview": "report.illumination:draw_light"},
    ),
    "object": Verb(
        "Make a product of each object alone.",
        """Make a product of each object in POLYGONS alone: NAME_object.tif, its pixels and no others.

        POLYGONS holds polygons with heights (GeoPackage, GeoJSON, Shapefile, DXF), CityJSON, or a mesh. Each pixel is
        taken from the best image that sees it. The same command continues a run that was interrupted.
        """,
        "requests.ortho:ObjectRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
    ),
    "surface": Verb(
        "Heights and grey values from all images at once.",
        """Compute heights and grey values from all images at once, each with its standard deviation.

        NAME.tif has the heights, NAME_sigma.tif their standard deviations, NAME_count.tif the images that see them,
        NAME_fit.tif the residuals around them, NAME_grey.tif the grey values of the surface, NAME_grey_sigma.tif their
        standard deviations. The heights serve as [terrain] of a project. The same command continues a run that was
        interrupted.
        """,
        "requests.surface:SurfaceRequest",
        "products.surface.run:surface_project",
        {"report": "report.surface:surface_page"},
        each="report.maps:surface_drawn",
    ),
    "register": Verb(
        "Compare two images to a small part of a pixel.",
        """Find by how much SECOND lies beside FIRST, patch by patch, to a small part of a pixel.

        Both have the same pixels, or places on one map. Each vector, in pixels of FIRST, is the distance of the content
        of a patch from its expected place in SECOND, with its standard deviation.
        """,
        "requests.measure:RegisterRequest",
        "products.register:register",
        {"picture": "report.register:draw_vectors"},
    ),
    "run": Verb(
        "Execute a plan written by `ortho --plan`.",
        """Execute PLAN, a GeoPackage written by `photoplan ortho PROJECT --plan PLAN`.

        Inputs that have changed since it was written are refused.
        """,
        "requests.ortho:RunRequest",
        "products.orthophoto.make:run_plan",
        each="report.products:draw_product",
    ),
    "dtm": "Terrain models: build, sample, contours, volumes …",
    "view": "Perspective views, with the ground of every pixel.",
    "monoplot": Verb(
        "Image points to ground points on a terrain model.",
        """Compute ground points of image points, with standard deviations.

        POINTS is a table with columns x, y (pixels; the middle of the upper-left one is 0, 0), or a vector file with
        points or lines in pixels. Points whose ray meets no terrain keep their row, with the reason.
        """,
        "requests.measure:MonoplotRequest",
        "products.monoplot:monoplot_file",
    ),
    "mtf": Verb(
        "Measure spread function and MTF from edges and patterns.",
        """Measure sharpness: edges are found, or given by --roi, and their spread function and MTF measured.

        With --pattern a test pattern is measured instead: bars (a window for each frequency group), a Siemens star, or
        a USAF-1951 target. If an image fails, the others are still measured, and it is listed at the end (exit code 4).
        Edges that are saturated, noisy, or beside texture give no figure.
        """,
        "requests.quality:MtfRequest",
        "products.mtf.patterns:measure_mtf",
        {"report": "report.mtf:mtf_page"},
        record="mtf",
        figures_first=True,
    ),
    "restore": Verb(
        "Restore images with a filter, given or measured.",
        """Restore images of any size: NAME_restored.tif (a cloud-optimised GeoTIFF) and its run record.

        Without --filter the sharpness of the images is measured at edges that they show, all together as images of one
        camera, and the filter follows from it; it is kept as a file. Noise grows by the figure that is printed first.
        If an image fails, the others are still restored (exit code 4). The same command continues a run that was
        interrupted.
        """,
        "requests.quality:RestoreRequest",
        "products.restore:restore",
        {"report": "report.restore:restore_page"},
        one_by_one=True,
    ),
    "characterise": Verb(
        "Know a camera from image series.",
        """Measure a camera in image series: noise, gain, linearity, dark signal, defects, light fall-off …

        SERIES is a TOML file that states which images are what (dark frames, flat frames, scenes …) and how they were
        exposed. Every analysis that they allow is made; the others are listed with what is missing.
        """,
        "requests.quality:CharacteriseRequest",
        "products.characterise.run:characterise",
        {"report": "report.characterise:characterise_page"},
        record="characterise",
        figures_first=True,
        files="written",
    ),
    "sensor": Verb(
        "Resolution, bandwidth and noise of a sensor.",
        "Print resolution, bandwidth, charge transfer and noise of the sensor that FILE (TOML) describes.",
        "requests.quality:SensorRequest",
        "products.sensor:describe_sensor",
        {"report": "report.sensor:sensor_page"},
        record="sensor",
        figures_first=True,
        files="written",
    ),
    "simulate": Verb(
        "Form an image of a scene with blur, noise, jitter …",
        """Form images of a scene with blur, noise, jitter, blooming and all else that a camera does.

        SCENE is an image file, or a pattern: flat, edge:ANGLE, bars:PERIOD,ANGLE, star:SECTORS, wedge:STEPS or
        discs:PITCH,DIAMETER. With --scene it is the terrain and the objects of a project, as its cameras see them.
        """,
        "requests.quality:SimulateRequest",
        "products.simulate:simulate",
    ),
    "report": Verb(
        "Join what the runs of a project found into one report.",
        """Write one quality report of PROJECT from the run records that its commands have left.

        Records (*.run.json) in the folder of the project and in the folders in it are read. Sections follow the chain:
        images, orientation, tie points and control, adjustment, terrain, products, colours and seams, accuracy. What is
        missing is named, and results whose inputs have changed since are marked as old.
        """,
        "requests.project:ReportRequest",
        "products.report:report_project",
        {"report": "report.project:project_page"},
    ),
    "info": Verb(
        "Show what a raster, project, plan or run record holds.",
        """Show what FILE holds: any file that a command takes or makes, or a folder of images.""",
        "requests.project:DescribeRequest",
        "products.describe:describe_file",
        {"picture": "report.restore:draw_filter"},
    ),
    "demo": Verb(
        "Make the orthophotos of the included real block.",
        """Copy the included drone block (18 reduced images of Brighton Beach) to FOLDER and make its orthophotos.

        Every step is the command that you would call yourself; it is printed before it runs. A project, images or
        products in FOLDER that differ from those of the demo stay as they are, unless --overwrite is given.
        """,
        "requests.ortho:DemoRequest",
        "products.orthophoto.make:make_demo",
    ),
}


@click.group(
    cls=LazyGroup,
    verbs=VERBS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="photoplan")
def photoplan() -> None:
    """Photographs with known geometry become measurable pictures.

    A job goes: init → (fiducials → tie → adjust) → check → ortho. Results are printed on stdout, talk and progress
    on stderr.
    Exit codes: 0 done, 1 failed, 2 wrong use, 3 bad input, 4 finished, but tiles or images failed, 5 out of disk or
    memory, 130 interrupted.
    """


def main() -> None:
    """Entry point of the command."""
    catch_interrupts()
    start()
    _leave(run())


def start() -> None:
    """Settings of a process that runs commands; before anything large is imported."""
    # The 100,000 objects of imports stay: to look through them for garbage again and again is 0.1 CPU s of each start.
    gc.set_threshold(200_000)
    # The fits of commands are small: waking the threads of linear algebra costs more than they save, and results would
    # depend on their number. Here, since it is read when NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Photos have no georeference. Here and not only where files are opened, since a filter there holds for one thread.
    warnings.filterwarnings("ignore", "Dataset has no geotransform")
    # A user can do nothing with a word of NumPy on an overflow: what comes of it is judged by its meaning.
    warnings.filterwarnings("ignore", "(overflow|underflow|divide by zero|invalid value) encountered", RuntimeWarning)
    warnings.filterwarnings("ignore", "(Mean of empty|All-NaN|Degrees of freedom)", RuntimeWarning)
    warnings.formatwarning = _warning
    # Of a damaged file rasterio cannot decode what GDAL says: two tracebacks each time. Ours do not come this way.
    usual, unraisable = sys.excepthook, sys.unraisablehook
    sys.excepthook = lambda kind, error, where: None if _undecoded(error) else usual(kind, error, where)
    sys.unraisablehook = lambda what: None if _undecoded(what.exc_value) else unraisable(what)


def _undecoded(error: BaseException | None) -> bool:
    return isinstance(error, UnicodeDecodeError)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a verb; every error becomes a message on stderr and an exit code."""
    try:
        code = photoplan.main(arguments, prog_name="photoplan", standalone_mode=False)
    except (click.exceptions.Abort, KeyboardInterrupt):
        stop_children()
        return _say("interrupted; the same command continues, or begins anew where nothing is kept", CODE)
    except click.ClickException as error:
        error.show()
        return 2
    except PhotoplanError as error:
        return _say(str(error), error.exit_code)
    except MemoryError:
        return _say("out of memory; give fewer --workers or less --memory", ResourceError.exit_code)
    except OSError as error:
        return _say(_os_message(error), 5 if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else 1)
    except Exception as error:
        if os.environ.get("PHOTOPLAN_TRACEBACK"):
            raise
        name = type(error).__name__
        return _say(f"{name}: {error} — a fault of photoplan; PHOTOPLAN_TRACEBACK=1 shows where", 1)
    return code if isinstance(code, int) else 0


def _say(message: str, code: int) -> int:
    click.echo(printable(f"photoplan: {message}"), err=True)
    return code


def _warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Our own warnings as messages, others as Python shows them."""
    if issubclass(category, PhotoplanWarning):
        return printable(f"photoplan: {message}\n")
    return f"{filename}:{lineno}: {category.__name__}: {message}\n"


def _os_message(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


def _leave(code: int) -> None:
    """Flush and exit; a reader that closed its end of a pipe (`| head`) is no error."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if code == 0 and all(thread.daemon or thread is threading.main_thread() for thread in threading.enumerate()):
        # All is written and closed; to take down what was imported, object by object, is 0.15 CPU s.
        atexit._run_exitfuncs()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
