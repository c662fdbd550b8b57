"""Bundle block adjustment."""

from __future__ import annotations

from photoplan.orientation.block import Adjusted, AdjustSettings, Block

__all__ = ["adjust_block"]


def adjust_block(block: Block, settings: AdjustSettings | None = None) -> Adjusted:
    """Least-squares adjustment of all observations of a block; to be written."""
    raise NotImplementedError
