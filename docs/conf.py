"""Settings of the documentation site: `make docs` builds it into docs/_build/html."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE / "_ext"), str(HERE.parent)]

import torchsar  # noqa: E402

project = "torchsar"
author = "the torchsar developers"
release = version = torchsar.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "api",  # pages of the public names, and docstrings as reStructuredText
    "mathml",  # formulas without scripts
    "offline",  # nothing is loaded from a network
    "tutorials",  # each tutorial as a notebook for download
    "records",  # figures and tables from docs/sweeps, docs/trade, docs/requires and docs/reproduce
]
exclude_patterns = ["_build", "sweeps", "trade", "requires", "reproduce"]
nitpicky = True
suppress_warnings = ["ref.python"]  # a type such as `bytes` that is also the name of two attributes
default_role = "py:obj"  # of docstrings: a name in backticks is a link where it is public

html_theme = "furo"
html_title = f"torchsar {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_copyright = False
html_copy_source = html_show_sourcelink = False
html_math_renderer = "mathml"

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

add_module_names = False
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Reference"]
