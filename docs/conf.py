"""Builds the documentation: ``python -m sphinx -W docs site``."""

import importlib.metadata
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "hybrid-rig"
author = "the hybrid-rig developers"
release = importlib.metadata.version("hybrid-rig")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "plain_docstrings",
]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_extensions"]

html_theme = "furo"
html_title = "hybrid-rig"
html_static_path = ["_static"]
html_css_files = ["equations.css"]
# Pages must open offline: equations are MathML, and nothing is fetched.
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # signatures have them; shapes and units stand in the text
autodoc_preserve_defaults = True
