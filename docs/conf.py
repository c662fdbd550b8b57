"""Configuration of the documentation; it builds without a network."""

from importlib.metadata import PackageNotFoundError, version

project = "photoplan"
author = "the photoplan authors"
copyright = "the photoplan authors"
try:
    release = version("photoplan")
except PackageNotFoundError:
    release = "0"

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 3

napoleon_numpy_docstring = True
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_preprocess_types = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True}

html_theme = "alabaster"
html_title = "photoplan"
html_static_path = ["_static"]
html_theme_options = {
    "description": "Photographs with known geometry become measurable pictures.",
    "fixed_sidebar": False,
    "page_width": "1040px",
    "sidebar_width": "230px",
    "font_family": "Georgia, 'Times New Roman', serif",
    "show_powered_by": False,
}
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}
html_show_sourcelink = False
pygments_style = "friendly"
