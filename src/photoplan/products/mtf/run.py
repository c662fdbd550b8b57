"""Spread function and MTF of images from their edges: found or given, measured, summed up, reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from photoplan.errors import PhotoplanError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.io.mtf_file import read_mtf_table
from photoplan.io.tables import write_table
from photoplan.products.mtf.groups import group_edges
from photoplan.products.mtf.image import LightImage
from photoplan.products.mtf.measure import Measuring, measure_image
from photoplan.products.mtf.request import ENCODED, check_files, unique_names
from photoplan.products.mtf.result import EdgeGroup, ImageMtf, MtfReport
from photoplan.project.linearisation import linearisation_of
from photoplan.quality.edges.enhancement import Enhancement, enhancement_of
from photoplan.quality.edges.find import EdgeRules
from photoplan.quality.linearise import Linearisation

#: Cells of the field in each direction that a report can show.
MOST_CELLS = 50
MOST_EDGES = 5000


@dataclass(frozen=True)
class MtfRequest:
    """What is asked."""

    images: tuple[Path, ...]
    rois: tuple[tuple[int, int, int, int], ...] = ()
    """Column, row, width and height of windows with one edge each; none: edges are sought in the whole image."""
    linearisation: str | None = None
    """``linear``, ``srgb``, or the name of a table; None: linear, with a warning where that is unlikely."""
    band: str | None = None
    """Number of a band, or ``all``: luminance and every band; None: luminance, or the only band."""
    pixel_um: float | None = None
    """Distance of pixels on the sensor, micrometres."""
    lab: Path | None = None
    """MTF values of a laboratory."""
    flight: Literal["x", "y"] | None = None
    """Whether the flight direction is along the rows (x) or the columns (y) of the images."""
    grid: int = 3
    """Cells of the field in each direction."""
    most_edges: int = 60
    """Edges of an image that are measured."""
    least_length: float | None = None
    """Pixels; None: 20, in given windows 12."""
    least_snr: float = 8.0
    """Contrast over noise."""
    half_width: int = 20
    """Pixels of an edge reach at most so far to both sides."""
    csv: Path | None = None
    """A row for each edge."""
    overwrite: bool = False


def measure_mtf(request: MtfRequest, events: Events = SILENT) -> MtfReport:
    """Measure the edges of all images; one that fails does not stop the others.

    Returns
    -------
    MtfReport
        Each edge with its profile: positions, values and standard deviations, by direction, channel and place.

    Raises
    ------
    UsageError
        Options contradict each other, or an output exists.
    InputError
        The linearisation table or the laboratory values cannot be used.
    """
    _check(request)
    linearisation = linearisation_of(request.linearisation or "linear")
    lab = None if request.lab is None else read_mtf_table(request.lab)
    measuring = Measuring(
        rois=request.rois,
        band=request.band,
        rules=EdgeRules.within(
            request.half_width,
            least_length=request.least_length or (20.0 if not request.rois else 12.0),
            least_snr=request.least_snr,
        ),
        most_edges=request.most_edges,
        grid=request.grid,
        flight=request.flight,
        lab=None if lab is None else (lab.per_pixel(request.pixel_um), lab.modulation),
    )
    names = dict(zip(request.images, unique_names(request.images)))
    opened, failed = _opened(request, linearisation, names)
    if request.linearisation is None and any(image.reader.dtype == "uint8" for image in opened.values()):
        events.talk(f"note: {ENCODED}")
    results: list[ImageMtf] = []
    events.begin("edges", sum(measuring.steps(image) for image in opened.values()), "tiles")
    left = 0

    def advance(steps: int, pixels: int = 0) -> None:
        nonlocal left
        left -= steps
        events.done(steps, pixels)

    for path, image in opened.items():
        left = measuring.steps(image)
        try:
            results.append(measure_image(names[path], path, image, measuring, advance))
        except (ResourceError, UsageError):
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
            events.done(left)
    done = bool(results)
    made = MtfReport(
        tuple(results),
        failed,
        *_together(results, measuring),
        linearisation.describe(),
        request.pixel_um,
        request.flight,
        request.csv if done else None,
    )
    if made.csv is not None:
        write_table(made.csv, *made.csv_rows)
    return made


def _together(results: Sequence[ImageMtf], measuring: Measuring) -> tuple[tuple[EdgeGroup, ...], Enhancement | None]:
    """Means and edge enhancement by the edges of all images."""
    edges = [edge for image in results for edge in image.edges]
    if not edges:
        return (), None
    if len(results) == 1:
        return results[0].groups, results[0].enhancement
    sizes = {image.size for image in results}
    grid = 0 if measuring.rois else measuring.grid
    groups = group_edges(edges, sizes.pop() if len(sizes) == 1 else None, grid, measuring.lab)
    first = [edge.measured for edge in edges if edge.channel == groups[0].channel]
    return tuple(groups), enhancement_of(first)


def _opened(
    request: MtfRequest, linearisation: Linearisation, names: dict[Path, str]
) -> tuple[dict[Path, LightImage], dict[str, str]]:
    """Images that can be used, and why the others cannot."""
    opened: dict[Path, LightImage] = {}
    failed: dict[str, str] = {}
    for path in request.images:
        try:
            opened[path] = LightImage.open(path, linearisation)
        except ResourceError:
            raise
        except PhotoplanError as error:
            failed[names[path]] = str(error)
    return opened, failed


def _check(request: MtfRequest) -> None:
    """Refuse what cannot be meant before any work."""
    if not 1 <= request.grid <= MOST_CELLS:
        raise UsageError(f"`grid` {request.grid}; 1 to {MOST_CELLS} cells are allowed")
    if not 1 <= request.most_edges <= MOST_EDGES:
        raise UsageError(f"`most_edges` {request.most_edges}; 1 to {MOST_EDGES} are allowed")
    if not 6 <= request.half_width <= 60:
        raise UsageError(f"`half_width` {request.half_width}; 6 to 60 px are allowed")
    if request.pixel_um is not None and not 0.01 <= request.pixel_um <= 1e4:
        raise UsageError(f"`pixel_size` {request.pixel_um:g}; 0.01 to 10000 micrometres are allowed")
    tables = (request.linearisation, request.lab)
    check_files(request.images, tables, request.csv, request.overwrite)
