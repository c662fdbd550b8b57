"""A road in a cut with a retaining wall, and the bridge of a motorway across it: as planes, and as a survey of them.

The scene that is rendered consists of polygons alone. Products know it as their user does: by points and breaklines, of
which `photoplan dtm build` makes a terrain model, and by the polygon of the deck.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from photoplan.io.vector_layer import VectorLayer, write_geopackage
from tools.command import inside
from tools.rendered_block import Flight, write_project

CRS, X0, Y0, TOP = "EPSG:32633", 500_300.0, 5_300_200.0, 100.0
#: Offsets from the axis: top of the cut, edges of the carriageway, the wall; depth of the cut, slope along the road.
SHOULDER, EDGE, WALL, DEPTH, RISE = -8.5, 4.0, 6.0, 3.0, 0.02
#: The map: half its sides, and the direction of the road, so that no edge lies along rows or columns of pixels.
HALF, TURN = (60.0, 75.0), 0.16
#: The deck: half its length and width, its heights at both ends, its thickness, and its direction against the road.
DECK = (48.0, 5.0, (7.5, 6.5), 1.2, 0.25)


def placed(points: ArrayLike, turn: float = TURN) -> NDArray[np.float64]:
    """From offsets, distances along the road and heights above `TOP` (..., 3) to the map."""
    u, v, z = np.moveaxis(np.asarray(points, float), -1, 0)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([X0 + c * u - s * v, Y0 + s * u + c * v, TOP + z + RISE * v], axis=-1)


def _strip(left: tuple[float, float], right: tuple[float, float]) -> NDArray[np.float64]:
    """A plane between two lines along the road, each at an offset and a height."""
    a, b = -1.6 * HALF[1], 1.6 * HALF[1]
    return placed([(left[0], a, left[1]), (right[0], a, right[1]), (right[0], b, right[1]), (left[0], b, left[1])])


def ground_faces() -> dict[str, NDArray[np.float64]]:
    """Faces of the ground by their names."""
    far = 1.6 * HALF[0]
    return {
        "west": _strip((-far, 0.0), (SHOULDER, 0.0)),
        "embankment": _strip((SHOULDER, 0.0), (-EDGE, -DEPTH)),
        "carriageway": _strip((-EDGE, -DEPTH), (EDGE, -DEPTH)),
        "verge": _strip((EDGE, -DEPTH), (WALL, -DEPTH)),
        "wall": _strip((WALL, -DEPTH), (WALL, 0.0)),
        "east": _strip((WALL, 0.0), (far, 0.0)),
    }


def deck_faces() -> list[NDArray[np.float64]]:
    """The deck, its sides and its underside."""
    length, width, (west, east), thick, turn = DECK
    c, s = np.cos(TURN + turn), np.sin(TURN + turn)
    corner = np.array([(-length, -width), (length, -width), (length, width), (-length, width)])
    XY = np.stack([X0 + c * corner[:, 0] - s * corner[:, 1], Y0 + s * corner[:, 0] + c * corner[:, 1]], axis=-1)
    top = np.c_[XY, TOP + np.array([west, east, east, west])]
    low = top - (0, 0, thick)
    sides = [np.array([top[k], top[k - 1], low[k - 1], low[k]]) for k in range(4)]
    return [top, low, *sides]


def lines() -> dict[str, NDArray[np.float64]]:
    """Edges by their names, on the map and in space, (2, 3): those of the ground, then those of the deck."""
    a, b = -1.2 * HALF[1], 1.2 * HALF[1]
    along = {
        "shoulder": (SHOULDER, 0.0),
        "left edge": (-EDGE, -DEPTH),
        "right edge": (EDGE, -DEPTH),
        "wall": (WALL, 0.0),
    }
    found = {name: placed([(u, a, z), (u, b, z)]) for name, (u, z) in along.items()}
    top = deck_faces()[0]
    return found | {f"deck {k}": top[[k, (k + 1) % 4]] for k in range(4)}


def survey(path: Path) -> None:
    """Points every 4 m, and breaklines with a vertex every 5 m, without errors, as a table."""
    rows, number = ["name,east,north,height,code,line,z_right"], 0

    def add(xyz: NDArray[np.float64], code: int, line: object = "", right: object = "") -> None:
        nonlocal number
        number += 1
        rows.append(f"{number},{xyz[0]:.4f},{xyz[1]:.4f},{xyz[2]:.4f},{code},{line},{right}")

    for v in np.arange(-110.0, 110.1, 4.0):
        for u in np.arange(-90.0, 90.1, 4.0):
            if SHOULDER + 1 < u < WALL + 1:
                continue
            add(placed((u, v, 0.0)), 101)
        add(placed((0.0, v, -DEPTH)), 101)
    for line, (u, z) in enumerate([(SHOULDER, 0.0), (-EDGE, -DEPTH), (EDGE, -DEPTH)], 1):
        for v in np.arange(-110.0, 110.1, 5.0):
            add(placed((u, v, z)), 201, line)
    for v in np.arange(-110.0, 110.1, 5.0):
        low, high = placed((WALL, v, -DEPTH)), placed((WALL, v, 0.0))
        add(low, 301, 9, f"{high[2]:.4f}")
    path.write_text("\n".join(rows) + "\n")


CODES = """[codes]
101 = { kind = "mass", sigma = 0.005 }
201 = { kind = "breakline", sigma = 0.002 }
301 = { kind = "breakline", sigma = 0.002 }
"""


@dataclass(frozen=True)
class Motorway:
    """Projects of one scene and its images."""

    scene: Path
    """What is rendered."""
    road: Path
    """The scene without the deck's colours: what lies below it."""
    product: Path
    """Terrain model and deck, as the user has them; the deck is shown."""
    below: Path
    """The same; the deck only hides."""
    bounds: tuple[float, float, float, float]


def write_motorway(folder: Path, part: float = 1.0, pixel: float = 0.2) -> Motorway:
    """All projects and files but the images; `part`: of the sides of images and map."""
    ground, deck = ground_faces(), deck_faces()
    files = {"ground": (list(ground.values()), list(ground)), "deck": (deck, ["deck"] * len(deck))}
    for name, (faces, names) in files.items():
        shapes = [shapely.Polygon(face) for face in faces]
        layer = VectorLayer(name, "Polygon Z", shapes, {"name": np.array(names, object)})
        write_geopackage(folder / f"{name}.gpkg", [layer], CRS)
    survey(folder / "survey.csv")
    (folder / "codes.toml").write_text(CODES)
    words = ["--codes", folder / "codes.toml", "--crs", CRS, "--no-report", "-q", "-o", folder / "model.gpkg"]
    said = inside("dtm", "build", folder / "survey.csv", *words)
    assert said.code == 0, said.err
    size = round(900 * part), round(675 * part)
    flight = Flight((X0, Y0), TOP + 500 * pixel, (46.0 * part, 44.0 * part), (3, 2), size, 500.0, 1.0)

    def project(name: str, terrain: str, *objects: tuple[str, str]) -> Path:
        entries = "".join(
            f'\n[[objects]]\nfile = "{file}.gpkg"\nheight_system = "same"\nrole = "{role}"\n' for file, role in objects
        )
        return write_project(folder, CRS, terrain, entries, flight, name)

    deep, model = f"height = {TOP - 40}", 'file = "model.gpkg"'
    return Motorway(
        scene=project("scene", deep, ("ground", "paint"), ("deck", "paint")),
        road=project("road", deep, ("ground", "paint"), ("deck", "occluder")),
        product=project("product", model, ("deck", "paint")),
        below=project("below", model, ("deck", "occluder")),
        bounds=(X0 - HALF[0] * part, Y0 - HALF[1] * part, X0 + HALF[0] * part, Y0 + HALF[1] * part),
    )
