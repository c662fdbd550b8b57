"""The registry of camera kinds: what a project may say after ``[cameras.NAME] type =``.

A kind is one file, a `photoplan.io.camera.model.CameraEntry`, and a line here. Everything else asks the camera.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Tag

from photoplan.io.camera.film import FilmEntry
from photoplan.io.camera.frame import FrameEntry


def _kind(value: Any) -> str:
    found = value.get("type", "frame") if isinstance(value, dict) else getattr(value, "type", "frame")
    return found if isinstance(found, str) else repr(found)


Camera = Annotated[Annotated[FrameEntry, Tag("frame")] | Annotated[FilmEntry, Tag("film")], Discriminator(_kind)]
