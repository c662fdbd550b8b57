"""Python imports this at its start where a test has put its folder on the path; worker processes do so too.

SABOTAGE_SLOW    seconds that every tile takes longer
SABOTAGE_QUICK   number of tiles that do not, by their place in the product
SABOTAGE_DEADLY  image:tile whose worker kills itself whenever it gets there
SABOTAGE_ONCE    a file; the first worker that finds it removes it and kills itself
"""

import os
import signal
import time
from pathlib import Path

from photoplan.products.orthophoto import execution

_render = execution.render_tile


def _sabotaged(product, kernel, scene, tile):  # type: ignore[no-untyped-def]
    if tile.index >= int(os.environ.get("SABOTAGE_QUICK", "0")):
        time.sleep(float(os.environ.get("SABOTAGE_SLOW", "0")))
    if os.environ.get("SABOTAGE_DEADLY") == f"{product.image}:{tile.index}":
        os.kill(os.getpid(), signal.SIGKILL)
    once = os.environ.get("SABOTAGE_ONCE")
    if once:
        try:
            Path(once).unlink()
        except FileNotFoundError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return _render(product, kernel, scene, tile)


execution.render_tile = _sabotaged
