"""`photoplan dtm`: terrain models."""

from __future__ import annotations

from photoplan.cli.lazy import LazyGroup
from photoplan.cli.verb import Verb

VERBS: dict[str, Verb] = {
    "build": Verb(
        "Predict a terrain model from points and lines.",
        """Predict a terrain model from files of points and lines: text, LAS, LandXML, GeoPackage, Shapefile, DXF.

        Least-squares collocation filters the points; slopes break at breaklines. The same command continues a run that
        was interrupted while it wrote.
        """,
        "requests.terrain:BuildRequest",
        "products.dtm.build:dtm_build",
        {"report": "report.dtm:build_report"},
    ),
    "info": Verb(
        "Show what a model holds.",
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
        "Heights and their standard deviations at points.",
        """Write the height of MODEL and its standard deviation at each of POINTS, a table: its columns, `height` and
        `sigma`.

        Both are empty where there is no model; a raster has no sigma.
        """,
        "requests.terrain:SampleRequest",
        "products.dtm.lines:dtm_sample",
        record="sample",
    ),
    "profile": Verb(
        "Heights along lines.",
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
        "Contour lines.",
        """Trace contour lines on MODEL's own surface: they bend sharply at breaklines, end at borders and at walls.

        Columns: height, is_index, depression. Higher ground is on a line's right. A post exactly at a level counts as
        above it.
        """,
        "requests.terrain:ContourRequest",
        "products.dtm.lines:make_contours",
        {"preview": "report.dtm:contours_picture"},
        record="contours",
    ),
    "shade": Verb(
        "Hillshade.",
        """Make a hillshade: grey values 1 to 255, 0 where MODEL has no terrain.

        Slopes are those of the model's surface at each pixel, so breaklines stay sharp.
        """,
        "requests.terrain:ShadeRequest",
        "products.dtm.rasters:dtm_shade",
    ),
    "slope": Verb(
        "Slope, slope classes or aspect.",
        """Compute the slope in degrees (float32), its classes (with a colour table), or the aspect.

        Places without terrain are NaN, or class 0.
        """,
        "requests.terrain:SlopeRequest",
        "products.dtm.rasters:dtm_slope",
    ),
    "tint": Verb(
        "Height tints.",
        "Colour MODEL by height: red, green, blue, with a mask where it has no terrain.",
        "requests.terrain:TintRequest",
        "products.dtm.rasters:dtm_tint",
    ),
    "volume": Verb(
        "Cut and fill between two models.",
        """Compute cut, fill and net volume from terrain A to terrain B, with their accuracy.

        Cut is where A lies above B. Where one of the models has no height nothing is counted; that area is printed.
        """,
        "requests.terrain:VolumeRequest",
        "products.dtm.analyses:dtm_volume",
    ),
    "visible": Verb(
        "What can be seen from points.",
        """Map what can be seen: 1 visible, 0 hidden, 255 no terrain; for several observers first how many see it.

        Places without terrain block nothing.
        """,
        "requests.terrain:VisibleRequest",
        "products.dtm.analyses:dtm_visible",
    ),
    "flow": Verb(
        "Catchments and flow lengths.",
        """Compute upstream area, flow length, direction and catchment of every cell, in six bands of one raster.

        Pits are filled first; area and volume of the filling are printed.
        """,
        "requests.terrain:FlowRequest",
        "products.dtm.analyses:dtm_flow",
    ),
    "export": Verb(
        "GeoTIFF, TIN or XYZ of a model.",
        """Write MODEL as a raster (.tif), a triangulation (.obj, .ply, .xml = LandXML) or points (.xyz, .csv).

        Triangulations hold walls as vertical triangles (LandXML cannot); points are the posts and the lines' vertices.
        """,
        "requests.terrain:ExportRequest",
        "products.dtm.rasters:dtm_export",
    ),
}


command = LazyGroup(
    name="dtm",
    verbs=VERBS,
    help="""Terrain models with breaklines.

    A job goes: build → info → sample, contours … A MODEL is a file of `dtm build`, or a GeoTIFF of heights.
    """,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
