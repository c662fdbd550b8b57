"""Contours as GeoPackage, Shapefile, GeoJSON or DXF, with their labels; complete files only."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.io.disk import disk_error, library_error
from photoplan.io.geopackage import write_vector
from photoplan.io.lock import FileLock, lock_of
from photoplan.io.naming import give_name, scratch, together
from photoplan.io.product import check_output

#: Ending of the name and the driver that writes it.
FORMATS = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".geojson": "GeoJSON", ".json": "GeoJSON", ".dxf": "DXF"}
#: Vertices of the lines that are handed over at once.
BATCH = 500_000


@dataclass(frozen=True, eq=False)
class ContourRow:
    """One contour."""

    xy: NDArray[np.float64]
    """Vertices, shape (n, 2), metres; of a closed line the last is the first."""
    height: float
    index: bool
    """It is an index contour."""
    depression: bool
    """It runs round lower ground."""


@dataclass(frozen=True)
class LabelRow:
    """Text on a contour."""

    X: float
    Y: float
    height: float
    angle: float
    """Degrees counter-clockwise from east."""
    text: str
    size: float
    """Height of the text, metres."""


def contour_files(path: Path, labels: bool) -> list[Path]:
    """What `write_contours` writes: the file, and for formats of one layer another one with the labels."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise UsageError(f"{path}: contours are written as {', '.join(FORMATS)}; give a name with such an ending")
    if labels and suffix not in (".gpkg", ".dxf"):
        return [path, path.with_name(f"{path.stem}_labels{path.suffix}")]
    return [path]


def write_contours(
    path: Path,
    lines: Iterable[ContourRow],
    labels: Callable[[], Sequence[LabelRow]] | None,
    crs: str,
    *,
    inputs: Sequence[Path] = (),
    overwrite: bool = False,
) -> list[Path]:
    """Write contours as 3-D lines as they come; files appear under their names only when complete.

    A GeoPackage has the layers `contours` and `labels`; Shapefile and GeoJSON have a second file `NAME_labels`; a DXF
    the CAD layers CONTOUR, CONTOUR_INDEX and CONTOUR_LABEL. Columns are `height`, `is_index`, `depression`; of labels
    `text`, `height`, `angle` (degrees counter-clockwise from east) and `size` (metres).
    """
    files = contour_files(path, labels is not None)
    for file in files:
        check_output(file, inputs, overwrite=overwrite)
    try:
        with FileLock(lock_of(path)), scratch(path.parent) as made:
            # Versions before left a folder of this name when they were killed.
            old = path.with_name(f".{path.name}.partial")
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old, ignore_errors=True)
            folder = made / "files"
            folder.mkdir()
            if path.suffix.lower() == ".dxf":
                _write_dxf(folder / path.name, lines, labels)
            else:
                _write_layers([folder / file.name for file in files], lines, labels, crs)
            # The main file comes last: where it is, its companions are.
            with together():
                for part in sorted(folder.iterdir(), key=lambda p: (p.name == path.name, p.name)):
                    give_name(part, path.with_name(part.name))
    except RuntimeError as error:
        raise library_error(path, error) from error
    except OSError as error:
        raise disk_error(path, error) from error
    return files


def _batches(rows: Iterable[ContourRow], most: float) -> Iterator[list[ContourRow]]:
    """Lines in batches of about so many vertices."""
    batch: list[ContourRow] = []
    vertices = 0
    for row in rows:
        batch.append(row)
        vertices += len(row.xy)
        if vertices >= most:
            yield batch
            batch, vertices = [], 0
    if batch:
        yield batch


def _write_layers(
    files: list[Path], lines: Iterable[ContourRow], labels: Callable[[], Sequence[LabelRow]] | None, crs: str
) -> None:
    driver = FORMATS[files[0].suffix.lower()]
    written = False
    # GDAL cannot add to a GeoJSON without reading it again.
    for batch in _batches(lines, np.inf if driver == "GeoJSON" else BATCH):
        _write_lines(files[0], driver, batch, crs, written)
        written = True
    if not written:
        _write_lines(files[0], driver, [], crs, False)
    if labels is None:
        return
    found = labels()
    points = np.array([(row.X, row.Y, row.height) for row in found]).reshape(-1, 3)
    columns = {
        "text": np.array([row.text for row in found], object),
        "height": points[:, 2],
        "angle": np.array([row.angle for row in found], float),
        "size": np.array([row.size for row in found], float),
    }
    one_file = len(files) == 1
    _write_layer(files[-1], driver, "labels", "Point Z", shapely.points(points), columns, crs, one_file)


def _write_lines(path: Path, driver: str, rows: list[ContourRow], crs: str, append: bool) -> None:
    counts = [len(row.xy) for row in rows]
    heights = np.array([row.height for row in rows], float)
    xyz = np.column_stack([np.concatenate([row.xy for row in rows]), np.repeat(heights, counts)]) if rows else None
    shapes = shapely.linestrings(xyz, indices=np.repeat(np.arange(len(rows)), counts)) if rows else np.array([], object)
    columns = {
        "height": heights,
        "is_index": np.array([row.index for row in rows], np.int16),
        "depression": np.array([row.depression for row in rows], np.int16),
    }
    _write_layer(path, driver, "contours", "LineString Z", shapes, columns, crs, append)


def _write_layer(
    path: Path,
    driver: str,
    layer: str,
    kind: str,
    shapes: Any,
    columns: dict[str, NDArray[Any]],
    crs: str,
    append: bool,
) -> None:
    write_vector(
        path,
        geometry=shapely.to_wkb(np.asarray(shapes, object), output_dimension=3),
        field_data=list(columns.values()),
        fields=list(columns),
        layer=layer if driver == "GPKG" else path.stem,
        driver=driver,
        geometry_type=kind,
        crs=crs,
        append=append,
    )


def _write_dxf(path: Path, lines: Iterable[ContourRow], labels: Callable[[], Sequence[LabelRow]] | None) -> None:
    """A DXF of release 12, which every CAD program reads: 3-D polylines, and texts turned along them."""
    with path.open("w", encoding="ascii", newline="\r\n") as file:
        file.write(
            "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1009\n0\nENDSEC\n0\nSECTION\n2\nTABLES\n0\nTABLE\n2\nLAYER\n"
        )
        file.write("70\n3\n")
        for name, colour in (("CONTOUR", 34), ("CONTOUR_INDEX", 32), ("CONTOUR_LABEL", 7)):
            file.write(f"0\nLAYER\n2\n{name}\n70\n0\n62\n{colour}\n6\nCONTINUOUS\n")
        file.write("0\nENDTAB\n0\nENDSEC\n0\nSECTION\n2\nENTITIES\n")
        for row in lines:
            closed = len(row.xy) > 3 and bool((row.xy[0] == row.xy[-1]).all())
            layer = "CONTOUR_INDEX" if row.index else "CONTOUR"
            # Flag 8: a polyline in space; 1: closed.
            file.write(f"0\nPOLYLINE\n8\n{layer}\n66\n1\n10\n0.0\n20\n0.0\n30\n0.0\n70\n{8 + closed}\n")
            tail = f"30\n{row.height:.6f}\n70\n32\n"
            for x, y in (row.xy[:-1] if closed else row.xy).tolist():
                file.write(f"0\nVERTEX\n8\n{layer}\n10\n{x:.7f}\n20\n{y:.7f}\n{tail}")
            file.write(f"0\nSEQEND\n8\n{layer}\n")
        for label in labels() if labels is not None else ():
            at = f"{{0}}\n{label.X:.4f}\n{{1}}\n{label.Y:.4f}\n{{2}}\n{label.height:.6f}\n"
            # Justified to the middle (72, 73) of its second alignment point.
            file.write(f"0\nTEXT\n8\nCONTOUR_LABEL\n{at.format(10, 20, 30)}40\n{label.size:.4f}\n1\n{label.text}\n")
            file.write(f"50\n{label.angle:.4f}\n72\n1\n{at.format(11, 21, 31)}73\n2\n")
        file.write("0\nENDSEC\n0\nEOF\n")
