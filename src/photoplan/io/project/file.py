"""Reading and writing project files, and defaults of options that they state (``[defaults.COMMAND]``)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from photoplan.errors import InputError
from photoplan.geometry.crs import require_projected_metres
from photoplan.geometry.heights import check_height_system, require_metric_heights
from photoplan.io.camera.model import CameraEntry
from photoplan.io.disk import received
from photoplan.io.files import explain, read_toml, resolve_input
from photoplan.io.project.model import (
    Adjustment,
    ImageEntry,
    Objects,
    ObservationsEntry,
    Orientation,
    OrthoDefaults,
    Project,
    StatedTarget,
    StatedTerrain,
)
from photoplan.io.raster_info import read_info
from photoplan.io.store import write_atomically


def toml_key(name: str) -> str:
    """A key as TOML wants it: bare where possible, else quoted."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A value as TOML. Floats are written so that reading gives the same number again."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's; DEL is the one character that JSON leaves bare and TOML forbids.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items()) + " }"
    return "[" + ", ".join(toml_value(v) for v in value) + "]"


def project_text(project: Project) -> str:
    """The whole file as text."""
    lines = [
        "# Project of photoplan. Relative paths start at the folder of this file.",
        "# Lengths are metres unless the name of an entry says otherwise. Pixel positions are [column, row];",
        "# [0, 0] is the centre of the upper-left pixel.",
        "format = 1",
        "",
        "# Horizontal CRS of everything in this file and of the products: projected, in metres.",
        f"crs = {toml_value(project.crs)}",
        *(["beyond_area = true  # places far outside its area of use are meant"] if project.beyond_area else []),
        "",
        *(_terrain(project.terrain) if project.terrain is not None else ["# [terrain] is needed for products.", ""]),
        *(line for objects in project.objects for line in _objects(objects)),
        *_orientation(project.orientation),
        *_observations(project.observations),
        *_adjustment(project.adjustment),
        *_ortho(project.ortho),
        *(line for name, target in project.targets.items() for line in _target(name, target)),
        *(line for verb, options in project.defaults.items() for line in _defaults(verb, options)),
    ]
    for name, camera in project.cameras.items():
        lines += camera_lines(name, camera)
    lines += [
        "# One entry per image: `name` is what products are called after, `center` is X0, Y0, Z0 of the projection",
        "# centre, `angles` are in the sequence and unit of [orientation].",
    ]
    for image in project.images:
        lines += _image(image)
    return "\n".join(lines) + "\n"


def _entries(rows: Iterable[tuple[str, Any, str]]) -> list[str]:
    """Lines `key = value  # comment`; entries without a value are shown commented out."""
    lines = []
    for key, value, comment in rows:
        entry = f"# {key} =" if value is None else f"{toml_key(key)} = {toml_value(value)}"
        lines.append(f"{entry}  # {comment}" if comment else entry)
    return lines


def _terrain(terrain: StatedTerrain) -> list[str]:
    return [
        "[terrain]",
        *_entries(
            [
                ("file", terrain.file, "heights: GeoTIFF, ASC, or a terrain model (.gpkg)"),
                ("height", terrain.height, "or one height everywhere"),
                ("sigma", terrain.sigma, "standard deviation of heights, or a raster of it"),
                ("crs", terrain.crs, "its CRS, where the file does not state one"),
            ]
        ),
        '# Height system: "ellipsoidal", a vertical CRS such as "EPSG:5773", or "same" = that of the other input.',
        *_entries([("height_system", terrain.height_system, "")]),
        "",
    ]


def _objects(objects: Objects) -> list[str]:
    comments = {
        "file": "CityJSON, polygons in space (.gpkg, .geojson, .shp, .dxf), or a mesh (.obj, .ply)",
        "role": '"paint": true orthophotos show them; "occluder": they only hide',
        "layer": "type of CityJSON's objects, or layer",
        "crs": "where the file does not state it",
        "height_system": "where the file does not state it",
        "offset": "added to X, Y, Z of the file",
    }
    return ["[[objects]]", *_given(objects, comments), ""]


def _target(name: str, target: StatedTarget) -> list[str]:
    comments = {
        "frame": "wall:X,Y,Z,AZIMUTH[,TILT], vault:…, column:… or image:NAME[,DISTANCE]",
        "relief": "offset of the surface from the frame, metres, or a raster of offsets",
        "sigma": "standard deviation of the offsets, or a raster of it",
        "bounds": "lowest u, v and highest u, v, metres",
    }
    return [f"[targets.{toml_key(name)}]", *_given(target, comments), ""]


def _orientation(orientation: Orientation) -> list[str]:
    return [
        "[orientation]",
        *_entries(
            [
                ("height_system", orientation.height_system, "of every Z0 below"),
                ("angle_unit", orientation.angle_unit, '"deg", "gon" or "rad"'),
                ("rotation", orientation.rotation, "o = about X, p = about Y, k = about Z; the first is the primary"),
                ("scene", orientation.scene, '"z < 0", or "z > 0" if angles and marks are stated with the scene there'),
                ("earth_curvature", orientation.earth_curvature, '"none", "correction" (of image points) or "strict"'),
                ("refraction", orientation.refraction, "correct image points for a standard atmosphere"),
            ]
        ),
        "",
    ]


def _given(section: BaseModel, comments: Mapping[str, str]) -> list[str]:
    """Entries of a section that are stated, with their comments."""
    values = section.model_dump(exclude_none=True)
    return _entries((key, value, comments[key]) for key, value in values.items() if value != ())


def _observations(observations: ObservationsEntry) -> list[str]:
    if observations == ObservationsEntry():
        return []
    comments = {
        "image_points": "measured image points: point, image, column, row",
        "control": "ground points, control and check",
        "image_points_columns": "their columns, where no header names them",
        "control_columns": "their columns, where no header names them",
        "decimal_comma": "whether both write numbers as 1,5",
        "positions": "table of observed projection centres, with or without attitudes",
        "sigma_image": "standard deviation of an image coordinate, pixels",
        "sigma_control": "[horizontal, height], metres, where the file does not state it",
        "sigma_position": "[horizontal, height], metres",
        "sigma_attitude": "in the unit of [orientation]; attitudes are observations only with it",
    }
    return [
        "# Measurements from which `photoplan resect` and `photoplan adjust` determine orientations.",
        "[observations]",
        *_given(observations, comments),
        "",
    ]


def _adjustment(adjustment: Adjustment) -> list[str]:
    if adjustment == Adjustment():
        return []
    comments = {
        "calibrate": "parameters of each camera that are unknowns: c, x0, y0, k1 …",
        "prior_sigma": "standard deviations with which they are known beforehand",
        "lever_arm": "antenna minus projection centre in camera axes, metres",
        "lever_arm_sigma": "its standard deviation; 0: held fixed",
        "datum": '"observations" or "orientations": what places the block',
        "drift": '"none", "shift" or "linear" for each strip',
        "boresight": "whether rotations between observed attitudes and camera are unknowns",
        "rpc": "correction of rational polynomials, and what is known of it beforehand",
        "strips": "what is unknown of trajectories of line cameras, as standard deviations",
    }
    return [
        "# What `photoplan adjust` estimates besides orientations and points.",
        "[adjustment]",
        *_given(adjustment, comments),
        "",
    ]


def _ortho(ortho: OrthoDefaults) -> list[str]:
    return [
        "# Defaults of `photoplan ortho`; options of the command override them.",
        "[ortho]",
        *_entries(
            [
                ("resolution", ortho.resolution, "side of a ground pixel; default: the images' mean, to two figures"),
                ("bounds", ortho.bounds, "[xmin, ymin, xmax, ymax]; default: all that the images see"),
                ("kernel", ortho.kernel, "interpolation of grey values"),
                ("tolerance", ortho.tolerance, "largest error of a source position, pixels"),
                ("true", ortho.true, "whether objects are where they stand, and hidden ground is left empty"),
                ("hidden", ortho.hidden, 'ground behind other ground: "show", "nodata" or "mark"'),
                ("nodata", ortho.nodata, 'a number, "mask" or "auto"'),
                ("compress", ortho.compress, "compression of the products"),
                ("overviews", ortho.overviews, "whether products hold overviews"),
            ]
        ),
        "",
    ]


def _defaults(verb: str, options: Mapping[str, Any]) -> list[str]:
    return [f"[defaults.{toml_key(verb)}]", *_entries((name, value, "") for name, value in options.items()), ""]


def camera_lines(name: str, camera: CameraEntry) -> list[str]:
    """The ``[cameras.NAME]`` table of a camera."""
    comments = {**camera.comments, "restore": "filter that its images are restored with", "lens": "", "sigma": ""}
    rows = [(entry, _stated(entry, getattr(camera, entry)), comment) for entry, comment in comments.items()]
    return [f"[cameras.{toml_key(name)}]", *_entries(r for r in rows if r[1] is not None), ""]


def _stated(entry: str, value: Any) -> Any:
    """A value with its inner entries as a table."""
    if not isinstance(value, BaseModel):
        return value
    return value.model_dump(exclude_none=True, exclude_defaults=entry == "marks")


def _image(image: ImageEntry) -> list[str]:
    given = image.model_dump(exclude_none=True)
    return ["", "[[images]]", *_entries((key, value, "") for key, value in given.items())]


def load_project(path: str | Path) -> Project:
    """Read and check a project file; a folder stands for the `project.toml` in it.

    Inputs that it names are not opened here, except film scans whose size the project does not state; their paths, the
    CRS and the height systems are checked.

    Raises
    ------
    InputError
        The file or an entry is wrong; the message names the entry and its line.
    """
    path = Path(path)
    if (path / "project.toml").is_file():
        path = path / "project.toml"
    data, text = read_toml(path)
    if "target" in data:
        raise InputError(f"{path}: unknown entry 'target'; a target is stated as [targets.NAME], and set by `target`")
    folder = path.resolve().parent
    return parse_project(_with_sizes(data, folder), folder, str(path), text)


def stated_defaults(path: Path) -> tuple[Path, dict[str, dict[str, Any]]]:
    """Return the folder of a project file, and the options that it states by command; of a file with faults none."""
    try:
        if (path / "project.toml").is_file():
            path = path / "project.toml"
        tables, folder = read_toml(path)[0].get("defaults"), path.resolve().parent
    except (InputError, OSError, RuntimeError):  # names that no file can have, links that lead to themselves
        return Path(), {}
    found = tables if isinstance(tables, dict) else {}
    return folder, {verb: dict(each) for verb, each in found.items() if isinstance(each, dict)}


def _with_sizes(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Entries of a project with the sizes of measured film scans that only the files state."""
    images, cameras = data.get("images"), data.get("cameras")
    if not isinstance(images, list) or not isinstance(cameras, dict):
        return data
    sized = []
    for image in images:
        name, file = (image.get("camera"), image.get("file")) if isinstance(image, dict) else (None, None)
        camera = cameras.get(name) if isinstance(name, str) and isinstance(file, str) else None
        if isinstance(camera, dict) and image.get("fiducials") and "size" not in {**camera, **image}:
            # What is wrong with the file is said where it is opened.
            with suppress(InputError):
                image = {**image, "size": [*read_info(resolve_input(folder, str(file))).size]}
        sized.append(image)
    return {**data, "images": sized}


def parse_project(data: dict[str, Any], folder: Path, source: str, text: str = "") -> Project:
    """Project of the plain contents of a project file; `source` and `text` are for messages."""
    received(folder)
    if "folder" in data:
        raise InputError(f"{source}: unknown entry 'folder'")
    try:
        project = Project.model_validate({**data, "folder": folder})
    except ValidationError as error:
        raise InputError(explain(error, data, source, text)) from None
    project = project.in_standard_axes()
    require_projected_metres(project.crs, f"{source}: crs")
    terrain = None if project.terrain is None else project.terrain.height_system
    if terrain is not None:
        check_height_system(terrain, f"{source}: [terrain] height_system")
    if project.orientation.height_system is not None:
        # Every Z of the project, of control and of positions refers to it, and all are metres.
        require_metric_heights(project.orientation.height_system, f"{source}: [orientation] height_system")
    for objects in project.objects:
        if objects.height_system is not None:
            check_height_system(objects.height_system, f"{source}: [[objects]] {objects.file} height_system")
    return project


def write_project(path: str | Path, project: Project) -> None:
    """Write a project file with a comment for every entry; `load_project` gives an equal project again.

    The file appears complete or not at all.
    """
    write_atomically(Path(path), project_text(project).encode())


def project_schema() -> str:
    """JSON Schema of the project file, as text."""
    return json.dumps(Project.model_json_schema(), indent=2, ensure_ascii=False)
