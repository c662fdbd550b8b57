"""Figures of a terrain file, whatever its kind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photoplan.errors import InputError
from photoplan.io.terrain.model_read import ModelReader, is_terrain_model
from photoplan.products.describe.model import describe_model, model_figures
from photoplan.products.describe.run import describe


@dataclass(frozen=True)
class TerrainFacts:
    """What is known of a terrain file."""

    facts: dict[str, Any]
    """In words, by name; lists have a line each."""
    figures: dict[str, Any]
    """Plain values, as JSON takes them."""
    gross: list[dict[str, Any]]
    """Measurements flagged as gross errors, the largest normalised residual first."""


def dtm_info(path: Path) -> TerrainFacts:
    """Facts of a model or of a raster of heights.

    Raises
    ------
    InputError
        The file is missing, damaged or no terrain.
    """
    if not is_terrain_model(path):
        if path.is_file() and path.suffix.lower() in (".gpkg", ".toml", ".json"):
            raise InputError(f"{path}: no terrain model; `photoplan info` shows other files")
        facts = describe(path)
        return TerrainFacts(facts, facts, [])
    reader = ModelReader(path)
    gross = [
        {
            "name": g.name,
            "kind": g.kind,
            "x": g.xyz[0],
            "y": g.xyz[1],
            "z": g.xyz[2],
            "residual": g.residual,
            "redundancy": g.redundancy,
            "normalised": g.normalised,
        }
        for g in sorted(reader.gross(), key=lambda g: -abs(g.normalised))
    ]
    return TerrainFacts(describe_model(reader), model_figures(reader), gross)
