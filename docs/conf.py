"""Configuration of the documentation; it builds without a network."""

from importlib import metadata

project = "photoplan"
author = "the photoplan authors"
copyright = "the photoplan authors"
try:
    release = metadata.version("photoplan")
except metadata.PackageNotFoundError:
    release = "0"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 3

napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_preprocess_types = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}

# In docstrings a single backtick marks code.
default_role = "code"

# The theme that comes with Sphinx; `_static/custom.css` makes wide tables and output scroll.
html_theme = "alabaster"
html_title = "photoplan"
html_static_path = ["_static"]
html_theme_options = {
    "description": "Orthophotos, mosaics, terrain models and views from images, with their accuracy.",
    "fixed_sidebar": False,
    "page_width": "940px",
    "sidebar_width": "250px",
    "show_powered_by": False,
}
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}
html_show_sourcelink = False
pygments_style = "friendly"


def hide_colons(app, what, name, obj, options, lines):
    """Before napoleon: it would take what stands before a colon in the docstring of a field for its type."""
    if what == "attribute":
        lines[:] = [line.replace(":", "\ue000") for line in lines]


def show_colons(app, what, name, obj, options, lines):
    """After napoleon."""
    lines[:] = [line.replace("\ue000", ":") for line in lines]


def setup(app):
    app.connect("autodoc-process-docstring", hide_colons, priority=400)
    app.connect("autodoc-process-docstring", show_colons, priority=600)
