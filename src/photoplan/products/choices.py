"""Names that users choose from."""

from typing import Literal

Kernel = Literal["nearest", "bilinear", "bicubic", "bicubic-1", "lanczos3"]
Compression = Literal["deflate", "zstd", "lzw", "jpeg", "none"]
