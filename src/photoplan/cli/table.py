"""The table of commands: one row each, with request, function, report and drawings, in the usual order of work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from photoplan.cli.verb import Verb, load
from photoplan.errors import UsageError
from photoplan.findings import Result

if TYPE_CHECKING:
    from photoplan.events import Events
    from photoplan.products.warmup import WarmupReport
    from photoplan.requests.project import SchemaRequest, WarmupRequest


@dataclass(frozen=True)
class VerbGroup:
    """Commands that belong together."""

    short: str
    verbs: Mapping[str, Verb]
    help: str = ""
    alone: bool = True
    """Its commands are called without the name of the group, too."""
    words: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Commands that words in their place stand for. The empty word is every other word, such as a file, and no word at
    all if the group explains itself (``-h``) by that command."""


_PROJECT: dict[str, Verb] = {
    "init": Verb(
        "Write a project file from the files you have.",
        """Write DIR/project.toml from images, camera, orientation and terrain.

        Prints the path of the project file on stdout. Height systems must be stated by the files or declared. Without
        --orientation, the images must be oriented afterwards (tie, resect, adjust), and --crs is required.
        """,
        "requests.project:InitRequest",
        "products.init:init_project",
    ),
    "check": Verb(
        "Validate a project and print what to expect of it.",
        """Open every input of PROJECT and print what to expect of each image.

        Ends with exit code 3 if orientations are implausible or another angle convention fits better, which is named,
        and with 4 if files of some images cannot be used.
        """,
        "requests.project:CheckRequest",
        "products.check:check",
        kernels="check",
    ),
    "budget": Verb(
        "List what limits the accuracy of products.",
        """Standard deviations of position on level ground, cause by cause, in the middle, at an edge and in a corner.

        For the images of PROJECT, or for a vertical image by numbers: --camera-constant and --height.
        """,
        "requests.project:BudgetRequest",
        "products.budget:budget_or_tables",
        {"picture": "report.project:draw_picture"},
    ),
    "info": Verb(
        "Show the content of a raster, project, plan or run record.",
        """Show the content of FILE: any file that a command reads or writes, or a folder of images.""",
        "requests.project:DescribeRequest",
        "products.describe:describe_file",
        {"picture": "report.restore:draw_filter"},
    ),
    "report": Verb(
        "Combine the results of a project's runs in one report.",
        """Write one quality report of PROJECT from the run records that its commands have left.

        Records (*.run.json) in the folder of the project and in the folders in it are read. Sections follow the chain:
        images, orientation, tie points and control, adjustment, terrain, products, colours and seams, accuracy. What is
        missing is named, and results whose inputs have changed since are marked as old.
        """,
        "requests.project:ReportRequest",
        "products.report:report_project",
        {"report": "report.project:project_page"},
    ),
    "schema": Verb(
        "Print the options of a command as JSON Schema.",
        """Print the options of the command VERB (two words for commands of a group) as JSON Schema; without VERB all
        commands with their groups.

        Types, limits, defaults and help are those of the command and of its request in Python.
        """,
        "requests.project:SchemaRequest",
        "cli.table:schema",
    ),
}

_ORIENT: dict[str, Verb] = {
    "convert": Verb(
        "Convert orientations from one file format to another.",
        """Write ORIENTATION, an orientation file or a project, in another format.

        What the other format cannot hold is reported on stderr. A lens that it cannot hold is refused unless
        --drop-lens is set.
        """,
        "requests.orient:ConvertRequest",
        "products.convert:convert",
    ),
    "fiducials": Verb(
        "Find the fiducial marks of film scans.",
        """Find the fiducial marks of film scans, without approximate values.

        IMAGE… are scans, with --camera FILE; or one project file, whose film images are measured and which receives the
        marks. An image that fails does not stop the others; they are listed at the end (exit code 4).
        """,
        "requests.orient:FiducialsRequest",
        "products.film:locate_fiducials",
        {"pictures/": "report.orientation:draw_marks"},
    ),
    "interior": Verb(
        "Compute the interior orientation of film scans.",
        """Residuals, sigma0, scales, shear and film shrinkage of the scans in PROJECT.

        An image whose marks are missing, exchanged, mirrored or wrong does not stop the others; they are listed at the
        end (exit code 4).
        """,
        "requests.orient:InteriorRequest",
        "products.film:interior_orientations",
        {"report": "report.orientation:interior_page", "plot": "report.orientation:interior_plot"},
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
        {"picture": "report.orientation:draw_ties"},
        kernels="tie",
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
        {"report": "report.orientation:resect_page"},
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
        kernels="adjust",
    ),
}

_ORTHO: dict[str, Verb] = {
    "images": Verb(
        "Make an orthophoto of each image.",
        """Make an orthophoto of each image: NAME_ortho.tif (a cloud-optimised GeoTIFF) and its run record.

        The same command continues a run that was interrupted.
        """,
        "requests.ortho:OrthoRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
        kernels="ortho",
    ),
    "mosaic": Verb(
        "Make one orthophoto of many images.",
        """Make one orthophoto of all images; each pixel comes from the best image that sees it.

        The area that no image sees is left empty and reported in square metres. The same command continues a run that
        was interrupted.
        """,
        "requests.ortho:MosaicRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
        kernels="mosaic",
    ),
    "object": Verb(
        "Make an orthophoto of each single object.",
        """Make an orthophoto of each object in POLYGONS: NAME_object.tif, without its surroundings.

        POLYGONS holds polygons with heights (GeoPackage, GeoJSON, Shapefile, DXF), CityJSON, or a mesh. Each pixel is
        taken from the best image that sees it. The same command continues a run that was interrupted.
        """,
        "requests.ortho:ObjectRequest",
        "products.orthophoto.make:make_products",
        each="report.products:draw_product",
        figures_first=True,
        kernels="mosaic",
    ),
    "balance": Verb(
        "Match the colours of overlapping images.",
        """Match the colours of the images of PROJECT where they overlap.

        Each image gets a file with a table for every band, and an entry `balance` in PROJECT: `ortho` and `mosaic`
        apply it from then on.
        """,
        "requests.ortho:BalanceRequest",
        "products.balance:balance_project",
        {"picture": "report.restore:draw_balance"},
    ),
    "seams": Verb(
        "Find the least visible seams of a mosaic.",
        """Find the least visible seams between the images of PROJECT.

        They run where two images look alike, and around anything that rises above the ground. The regions are a
        GeoPackage with a column `image`: edit it in QGIS, and pass it to `photoplan mosaic --seams`.
        """,
        "requests.ortho:SeamsRequest",
        "products.seams:make_seams",
        {"picture": "report.maps:seams_picture"},
    ),
    "illumination": Verb(
        "Correct an orthophoto for light on slopes, and for haze.",
        """Correct PICTURE, an orthophoto, for light on slopes, and for haze.

        Parameters are estimated from the orthophoto and printed with standard deviations. Slopes in the shadow of
        terrain, and slopes that turn away from the sun, are not corrected.
        """,
        "requests.ortho:IlluminationRequest",
        "products.illumination:correct_illumination",
        {"preview": "report.restore:draw_light"},
    ),
    "run": Verb(
        "Execute a plan written by `ortho --plan`.",
        """Execute PLAN, a GeoPackage written by `photoplan ortho PROJECT --plan PLAN`.

        The command stops if an input has changed since the plan was written.
        """,
        "requests.ortho:RunRequest",
        "products.orthophoto.make:run_plan",
        each="report.products:draw_product",
        kernels="ortho",
    ),
}

_TERRAIN: dict[str, Verb] = {
    "build": Verb(
        "Predict a terrain model from points and lines.",
        """Predict a terrain model from files of points and lines: text, LAS, LandXML, GeoPackage, Shapefile, DXF.

        Least-squares collocation filters the points; slopes break at breaklines. The same command continues a run that
        was interrupted while it wrote.
        """,
        "requests.terrain:BuildRequest",
        "products.dtm.build:dtm_build",
        {"report": "report.dtm:build_report"},
        kernels="terrain build",
    ),
    "info": Verb(
        "Show the content of a model.",
        "Show the figures of MODEL: units, lines, accuracy, gross errors. A raster is shown as by `photoplan info`.",
        "requests.terrain:InfoRequest",
        "products.describe:describe_terrain",
    ),
    "refine": Verb(
        "Replace parts of a model by a finer one.",
        """Write the terrain COARSE with the terrain FINE inside polygons, joined without a step.

        Both are terrain models or rasters of heights. Each mesh is divided by a whole number. Inside a band along the
        polygons' border the difference of the two is blended in; outside nothing changes.
        """,
        "requests.terrain:RefineRequest",
        "products.dtm.build:dtm_refine",
        record="refine",
    ),
    "sample": Verb(
        "Write heights and their standard deviations at points.",
        """Write the height of MODEL and its standard deviation at each of POINTS, a table: its columns, `height` and
        `sigma`.

        Both are empty where there is no model; a raster has no sigma.
        """,
        "requests.terrain:SampleRequest",
        "products.dtm.lines:dtm_sample",
        record="sample",
    ),
    "profile": Verb(
        "Write heights along lines.",
        """Write profiles of MODEL over LINES: a vector file of lines, or a table of points along them, in the model's
        CRS.

        There is a point wherever the surface bends: at grid lines, breaklines and edges of triangles; at a wall two.
        """,
        "requests.terrain:ProfileRequest",
        "products.dtm.lines:dtm_profile",
        {"outputs.png": "report.dtm:profile_picture"},
        record="profile",
    ),
    "contours": Verb(
        "Trace contour lines.",
        """Trace contour lines on MODEL's own surface: they bend sharply at breaklines, end at borders and at walls.

        Columns: height, is_index, depression. Higher ground is on a line's right. A post exactly at a level counts as
        above it.
        """,
        "requests.terrain:ContourRequest",
        "products.dtm.lines:make_contours",
        {"preview": "report.dtm:contours_picture"},
        record="contours",
        kernels="terrain contours",
    ),
    "shade": Verb(
        "Make a hillshade.",
        """Make a hillshade: grey values 1 to 255, 0 where MODEL has no terrain.

        Slopes are those of the model's surface at each pixel, so breaklines stay sharp.
        """,
        "requests.terrain:ShadeRequest",
        "products.dtm.rasters:dtm_shade",
        kernels="terrain shade",
    ),
    "slope": Verb(
        "Compute slope, slope classes or aspect.",
        """Compute the slope in degrees (float32), its classes (with a colour table), or the aspect.

        Places without terrain are NaN, or class 0.
        """,
        "requests.terrain:SlopeRequest",
        "products.dtm.rasters:dtm_slope",
    ),
    "tint": Verb(
        "Colour a model by height.",
        "Colour MODEL by height: red, green, blue, with a mask where it has no terrain.",
        "requests.terrain:TintRequest",
        "products.dtm.rasters:dtm_tint",
    ),
    "volume": Verb(
        "Compute cut and fill between two models.",
        """Compute cut, fill and net volume from terrain A to terrain B, with their accuracy.

        Cut is where A lies above B. Where one of the models has no height nothing is counted; that area is printed.
        """,
        "requests.terrain:VolumeRequest",
        "products.dtm.analyses:dtm_volume",
    ),
    "visible": Verb(
        "Map what can be seen from points.",
        """Map what can be seen: 1 visible, 0 hidden, 255 no terrain; for several observers first how many see it.

        Places without terrain block nothing.
        """,
        "requests.terrain:VisibleRequest",
        "products.dtm.analyses:dtm_visible",
    ),
    "flow": Verb(
        "Compute catchments and flow lengths.",
        """Compute upstream area, flow length, direction and catchment of every cell, in six bands of one raster.

        Pits are filled first; area and volume of the filling are printed.
        """,
        "requests.terrain:FlowRequest",
        "products.dtm.analyses:dtm_flow",
    ),
    "export": Verb(
        "Write a model as GeoTIFF, TIN or XYZ.",
        """Write MODEL as a raster (.tif), a triangulation (.obj, .ply, .xml = LandXML) or points (.xyz, .csv).

        Triangulations hold walls as vertical triangles (LandXML cannot); points are the posts and the lines' vertices.
        """,
        "requests.terrain:ExportRequest",
        "products.dtm.rasters:dtm_export",
    ),
}

_VIEW: dict[str, Verb] = {
    "picture": Verb(
        "Render terrain, rasters or images (this word may be left out).",
        """Render SOURCE, a project or terrain model, from a standpoint or with the camera of an image.

        The same command continues a run that was interrupted.
        """,
        "requests.view:ViewRequest",
        "report.views:labelled_picture",
        kernels="view",
    ),
    "sequence": Verb(
        "Render views along a path, and a film of them.",
        """Render SOURCE along a path: with --look-at towards one point, with --azimuth in one direction, else
        ahead.

        The same command continues a run that was interrupted; renderings that exist already are kept.
        """,
        "requests.view:SequenceRequest",
        "report.views:labelled_sequence",
    ),
    "matrix": Verb(
        "Compute the ground of every pixel as a raster.",
        """Compute the ground of every pixel of a view: E, N, H, distance, angle of incidence, size of the pixel,
        surface, normal.

        A GeoTIFF of nine bands; `photoplan view --matrix` paints it with other content.
        """,
        "requests.view:MatrixRequest",
        "products.view.make:view_matrix",
    ),
    "pick": Verb(
        "Convert pixels to ground points, and back.",
        """Find the ground of pixels of a view, and the pixels of ground points, with what is seen there.

        (0, 0) is the centre of the upper-left pixel.
        """,
        "requests.view:PickRequest",
        "products.view.measure:pick_points",
    ),
    "area": Verb(
        "Map the area that is seen, as a raster or a polygon.",
        "Map the area that the rendering shows: 1 seen, 0 not seen, 255 no terrain.",
        "requests.view:AreaRequest",
        "products.view.measure:visible_area",
    ),
    "skyline": Verb(
        "Trace the skyline, as a table or on the map.",
        """Find the skyline: in every column the highest ground that is seen, with its place in the rendering and on the
        map.

        With a photograph it is compared with the edge of the sky there, and the camera may be turned until both agree.
        """,
        "requests.view:SkylineRequest",
        "products.view.skyline:skyline",
    ),
}

_MEASURE: dict[str, Verb] = {
    "monoplot": Verb(
        "Compute ground points of image points on a terrain model.",
        """Compute ground points of image points, with standard deviations.

        POINTS is a table with columns x, y (pixels; the middle of the upper-left one is 0, 0), or a vector file with
        points or lines in pixels. Points whose ray meets no terrain keep their row, with the reason.
        """,
        "requests.measure:MonoplotRequest",
        "products.monoplot:monoplot_file",
    ),
    "register": Verb(
        "Measure the shift between two images, to subpixel accuracy.",
        """Measure the shift of SECOND against FIRST, patch by patch, to subpixel accuracy.

        Both have the same pixels, or places on one map. Each vector, in pixels of FIRST, is the distance of the content
        of a patch from its expected place in SECOND, with its standard deviation.
        """,
        "requests.measure:RegisterRequest",
        "products.register:register",
        {"picture": "report.orientation:draw_vectors"},
    ),
}

_QUALITY: dict[str, Verb] = {
    "mtf": Verb(
        "Measure spread function and MTF from edges and patterns.",
        """Measure sharpness: edges are found, or given by --roi, and their spread function and MTF measured.

        With --pattern a test pattern is measured instead: bars (a window for each frequency group), a Siemens star, or
        a USAF-1951 target. If an image fails, the others are still measured, and it is listed at the end (exit code 4).
        Edges that are saturated, noisy, or beside texture give no figure.
        """,
        "requests.quality:MtfRequest",
        "products.mtf.patterns:measure_mtf",
        {"report": "report.camera:mtf_page"},
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
        "Characterise a camera from image series.",
        """Measure a camera in image series: noise, gain, linearity, dark signal, defects, light fall-off …

        SERIES is a TOML file that states which images are what (dark frames, flat frames, scenes …) and how they were
        exposed. Every analysis that they allow is made; the others are listed with what is missing.
        """,
        "requests.quality:CharacteriseRequest",
        "products.characterise.run:characterise",
        {"report": "report.camera:characterise_page"},
        record="characterise",
        figures_first=True,
        files="written",
    ),
    "sensor": Verb(
        "Compute resolution, bandwidth and noise of a sensor.",
        "Print resolution, bandwidth, charge transfer and noise of the sensor that FILE (TOML) describes.",
        "requests.quality:SensorRequest",
        "products.sensor:describe_sensor",
        {"report": "report.camera:sensor_page"},
        record="sensor",
        figures_first=True,
        files="written",
    ),
    "simulate": Verb(
        "Simulate an image of a scene with blur, noise, jitter …",
        """Form images of a scene with blur, noise, jitter, blooming and all else that a camera does.

        SCENE is an image file, or a pattern: flat, edge:ANGLE, bars:PERIOD,ANGLE, star:SECTORS, wedge:STEPS or
        discs:PITCH,DIAMETER. With --scene it is the terrain and the objects of a project, as its cameras see them.
        """,
        "requests.quality:SimulateRequest",
        "products.simulate:simulate",
    ),
}

_ALONE: dict[str, Verb] = {
    "surface": Verb(
        "Compute heights and grey values from all images at once.",
        """Compute heights and grey values from all images at once, each with its standard deviation.

        NAME.tif has the heights, NAME_sigma.tif their standard deviations, NAME_count.tif the images that see them,
        NAME_fit.tif the residuals around them, NAME_grey.tif the grey values of the surface, NAME_grey_sigma.tif their
        standard deviations. The heights serve as [terrain] of a project. The same command continues a run that was
        interrupted.
        """,
        "requests.surface:SurfaceRequest",
        "products.surface.run:surface_project",
        {"report": "report.maps:surface_page"},
        each="report.maps:surface_drawn",
        kernels="surface",
    ),
    "demo": Verb(
        "Make orthophotos of the demo images in the package.",
        """Copy the included drone block (18 reduced images of Brighton Beach) to FOLDER and make its orthophotos.

        Every step is the command that you would call yourself; it is printed before it runs. A project, images or
        products in FOLDER that differ from those of the demo stay as they are, unless --overwrite is given.
        """,
        "requests.ortho:DemoRequest",
        "products.orthophoto.make:make_demo",
        kernels="ortho",
    ),
    "warmup": Verb(
        "Compile the kernels of commands before their first run.",
        """Compile what COMMAND… need for images of a kind, and keep it; without COMMAND all commands.

        A command that finds kernels missing does the same before its work. Kernels are compiled anew for another
        version of photoplan, Numba or Python, and on another kind of processor.
        """,
        "requests.project:WarmupRequest",
        "cli.table:warm_up",
    ),
}

#: Groups by their names, in the order of a job; `surface`, `demo` and `warmup` stand alone.
GROUPS: dict[str, VerbGroup] = {
    "project": VerbGroup("Create, check and describe projects.", _PROJECT),
    "orient": VerbGroup("Orient images: marks, tie points, control, adjustment.", _ORIENT),
    "ortho": VerbGroup(
        "Make an orthophoto of each image; group of the commands below.",
        _ORTHO,
        words={"": ("images",), "-h": ("images", "-h"), "--help": ("images", "-h")},
    ),
    "terrain": VerbGroup(
        "Work with terrain models: build, sample, contours, volumes …",
        _TERRAIN,
        """Terrain models with breaklines.

    The usual order is build → info → sample, contours … A MODEL is a file of `dtm build`, or a GeoTIFF of heights.
    """,
        alone=False,
    ),
    "view": VerbGroup(
        "Render perspective views, with the ground of every pixel.",
        _VIEW,
        """Perspective views of a project or a terrain model: photoplan view FILE --from X Y --look-at X Y -o PICTURE.

    `photoplan view panorama` looks all around (picture --panorama cylinder; --panorama sphere comes after it).

    Renderings can be measured: `matrix` gives the ground point of every pixel, `pick` that of single ones.
    """,
        alone=False,
        words={"": ("picture",), "panorama": ("picture", "--panorama", "cylinder")},
    ),
    "measure": VerbGroup("Measure in images.", _MEASURE),
    "quality": VerbGroup("Measure sharpness, noise and faults of images; apply filters.", _QUALITY),
}
#: Commands and groups by the first word after `photoplan`.
VERBS: dict[str, Verb | VerbGroup] = {
    **{name: verb for group in GROUPS.values() if group.alone for name, verb in group.verbs.items()},
    **_ALONE,
    **GROUPS,
    "dtm": replace(GROUPS["terrain"], short="Alias of `terrain`."),
}
del VERBS["images"]  # which is `ortho`
#: Headings of the help, and what stands below each.
HEADINGS: dict[str, tuple[str, ...]] = {
    "Project": tuple(_PROJECT),
    "Orientation": tuple(_ORIENT),
    "Orthophotos and mosaics": ("ortho", *(name for name in _ORTHO if name != "images")),
    "Terrain, surfaces and views": ("terrain", "surface", "view"),
    "Measuring": tuple(_MEASURE),
    "Quality of images and cameras": tuple(_QUALITY),
    "First steps": ("demo", "warmup"),
}


@dataclass(frozen=True)
class Schema(Result):
    """JSON Schema of a command's options, or the list of commands."""

    values: Mapping[str, Any]

    def json_fields(self) -> Mapping[str, Any]:
        """Return the schema itself."""
        return self.values

    def summary(self) -> list[str]:
        """Return the schema as JSON, which is what a person asked for."""
        from photoplan.plain import json_text

        return [json_text(self.values)]


def schema(request: SchemaRequest, events: Events) -> Schema:
    """Return the options of a command as JSON Schema, or all commands by group."""
    if not request.verb:
        groups = {name: {verb: row.short for verb, row in group.verbs.items()} for name, group in GROUPS.items()}
        return Schema({**groups, "": {name: row.short for name, row in _ALONE.items()}})
    row = command_at(request.verb)
    if row is None:
        raise UsageError(f"`verb` {' '.join(request.verb)} is no command; `photoplan schema` lists them")
    return Schema({**load(row.request).model_json_schema(), "title": " ".join(request.verb)})


def warm_up(request: WarmupRequest, events: Events) -> WarmupReport:
    """Compile the kernels of commands, a group's word standing for all of its commands."""
    from photoplan.products.warmup import warm_up as compile_kernels

    rows = [] if request.command else [row for group in GROUPS.values() for row in group.verbs.values()]
    rows += [] if request.command else _ALONE.values()
    for words in request.command:
        group, row = VERBS.get(words), command_at(words.split() or [words])
        if row is None and not isinstance(group, VerbGroup):
            raise UsageError(f"`command` {words} is no command; `photoplan schema` lists them")
        rows += group.verbs.values() if row is None and isinstance(group, VerbGroup) else [row] if row else []
    return compile_kernels(request, tuple(dict.fromkeys(row.kernels for row in rows if row.kernels)), events)


def command_at(words: Sequence[str]) -> Verb | None:
    """Return the command that words such as ``ortho mosaic`` or ``ortho`` name; None if there is none."""
    row: Verb | VerbGroup | None = VERBS.get(words[0])
    for word in words[1:]:
        row = row.verbs.get(word) if isinstance(row, VerbGroup) else None
    if isinstance(row, VerbGroup) and "" in row.words:
        row = row.verbs[row.words[""][0]]
    return row if isinstance(row, Verb) else None
