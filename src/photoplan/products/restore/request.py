"""What `photoplan restore` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from photoplan.errors import UsageError
from photoplan.io.storage import COMPRESSIONS
from photoplan.quality.colour.model import ChromaticModel
from photoplan.quality.restoration.filters import RestorationFilter

#: What `dtype` may be; grey values keep their scale in all of them.
TYPES = ("same", "float32", "uint16")


@dataclass(frozen=True)
class RestoreRequest:
    """What is asked."""

    images: tuple[Path, ...]
    filter: RestorationFilter | Path
    """The filter, or its file."""
    output: Path | None = None
    """Folder of the results; None: `restored` beside the first image."""
    bands: tuple[int, ...] = ()
    """Bands that are restored, from 1; all if empty. The others stay as they are."""
    linearisation: str = "linear"
    """``linear``, ``srgb`` or a file with a table."""
    dtype: str = "same"
    """Type of the results: ``same``, ``float32`` or ``uint16``."""
    chromatic: ChromaticModel | Path | Literal["measure"] | None = None
    """Lateral chromatic aberration, which is corrected before the filter: a model, its file, or ``measure``: every
    image's own discs or edges; None: the bands stay where they are."""
    fall_off: Path | None = None
    """A correction of light fall-off, which comes before all others."""
    compress: str = "deflate"
    workers: int = 1
    memory: int | None = None
    """Bytes the run should stay under; None: no bound but the tiles in flight."""
    overwrite: bool = False
    quicklook: bool = True

    def __post_init__(self) -> None:
        if not self.images:
            raise UsageError("no image is given")
        if self.dtype not in TYPES:
            raise UsageError(f"dtype {self.dtype!r}; allowed are {', '.join(TYPES)}")
        if self.compress not in COMPRESSIONS:
            raise UsageError(f"compression {self.compress!r}; allowed are {', '.join(COMPRESSIONS)}")
        if self.workers < 1:
            raise UsageError(f"{self.workers} workers; at least one is needed")

    @property
    def folder(self) -> Path:
        """Where the results are written."""
        return self.images[0].parent / "restored" if self.output is None else self.output

    @property
    def settings(self) -> dict[str, Any]:
        """What decides the results beside images and filter, as plain values."""
        return {
            "bands": list(self.bands),
            "linearisation": self.linearisation,
            "dtype": self.dtype,
            "chromatic": "a model"
            if isinstance(self.chromatic, ChromaticModel)
            else self.chromatic and str(self.chromatic),
            "fall_off": self.fall_off and str(self.fall_off),
            "compress": self.compress,
        }
