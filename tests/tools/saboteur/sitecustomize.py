"""Python imports this at its start where a test has put its folder on the path; worker processes do so too.

SABOTAGE_JOB     module:class of what makes tiles [that of orthophotos]
SABOTAGE_HOLD    a file; tiles are not made before it is there
SABOTAGE_QUICK   number of tiles that are, by their place in the product
SABOTAGE_IMAGE   the only image that is held up [all]
SABOTAGE_BEGUN   a folder; a worker that is held up has a file there, named by its process
SABOTAGE_DEADLY  image:tile whose worker kills itself whenever it gets there
SABOTAGE_ONCE    a file; the first worker that finds it removes it and kills itself
"""

import importlib
import os
import signal
import time
from pathlib import Path

_module, _, _name = (os.environ.get("SABOTAGE_JOB") or "photoplan.engine.execute:RenderJob").partition(":")
_job = getattr(importlib.import_module(_module), _name)
_call = _job.__call__
_how = {name: os.environ.get(f"SABOTAGE_{name}", "") for name in ("HOLD", "QUICK", "IMAGE", "BEGUN", "DEADLY", "ONCE")}


def _sabotaged(job, tile):  # type: ignore[no-untyped-def]
    (image,) = job.product.sources if hasattr(job, "product") else ("",)
    if _how["HOLD"] and _how["IMAGE"] in ("", image) and tile.index >= int(_how["QUICK"] or 0):
        if _how["BEGUN"]:
            (Path(_how["BEGUN"]) / str(os.getpid())).touch()
        while not Path(_how["HOLD"]).exists():
            time.sleep(0.01)
    if _how["DEADLY"] == f"{image}:{tile.index}":
        os.kill(os.getpid(), signal.SIGKILL)
    if _how["ONCE"]:
        try:
            Path(_how["ONCE"]).unlink()
        except FileNotFoundError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return _call(job, tile)


_job.__call__ = _sabotaged
