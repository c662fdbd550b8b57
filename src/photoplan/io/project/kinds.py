"""The registry of image geometries: what a project may say in an ``[[images]]`` entry."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Tag

from photoplan.io.project.frame import FrameImage
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.line import LineImage
from photoplan.io.project.posed import Image
from photoplan.io.project.rpc import RpcImage

#: The entry that only images of a kind have; an image without any of them has a pose.
_BY_ENTRY: dict[str, type[ImageEntry]] = {"rpc": RpcImage, "line": LineImage, "frame": FrameImage}


def _kind(value: Any) -> str:
    if isinstance(value, dict):
        return next((kind.__name__ for entry, kind in _BY_ENTRY.items() if entry in value), Image.__name__)
    return type(value).__name__


AnyImage = Annotated[
    Annotated[Image, Tag("Image")]
    | Annotated[RpcImage, Tag("RpcImage")]
    | Annotated[LineImage, Tag("LineImage")]
    | Annotated[FrameImage, Tag("FrameImage")],
    Discriminator(_kind),
]
