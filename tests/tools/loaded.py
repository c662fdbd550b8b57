"""What the server of `tools.forked` loads before it forks: every command, and the libraries that they wait for."""

import importlib

from tools.command import verbs

for name in ("orthophoto.execution", "restore", "simulate", "tie", "dtm.build", "dtm.rasters", "dtm.analyses"):
    importlib.import_module(f"photoplan.products.{name}")
importlib.import_module("photoplan.project.objects")
verbs()
