"""Configuration of the documentation; `sh .ci/docs` builds it offline."""

import os
import sys
from importlib import metadata
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS / "_ext"), str(DOCS.parent)]
os.environ.setdefault("MPLBACKEND", "agg")

project = "cmmsim"
author = "the authors of cmmsim"
copyright = "the authors of cmmsim; MIT licence"
version = release = metadata.version("cmmsim")
html_title = f"cmmsim {release}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",  # Parameters, Returns and Raises as NumPy writes them
    "sphinx_gallery.gen_gallery",
    "mathml",  # formulas without a script from outside
    # commands, file formats and the API, from the code
    "generated_pages",
]
exclude_patterns = [
    "_ext",
    "_static",
    "examples",
    "generated/*.md",
    "generated/tour/*.md5",
    "generated/**/sg_execution_times.rst",
]
suppress_warnings = ["config.cache"]  # what sphinx-gallery is told cannot be pickled

myst_enable_extensions = [
    "dollarmath",
    "amsmath",
    "deflist",
    "colon_fence",
    "attrs_inline",
]
myst_heading_anchors = 4
smartquotes = False  # two dashes begin an option
default_role = "literal"  # single backquotes in docstrings are code
napoleon_use_ivar = True  # Attributes of a docstring may also be members, which autodoc documents
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Array", "NDArray")}
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"

sphinx_gallery_conf = {
    "examples_dirs": "examples",
    "gallery_dirs": "generated/tour",
    "filename_pattern": r"/plot_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "image_scrapers": ("matplotlib",),
    "reset_modules": ("matplotlib",),
    "min_reported_time": 1,
    "write_computation_times": False,
    "show_signature": False,
    "doc_module": ("cmmsim", "dynamics", "identify"),
    "reference_url": {"cmmsim": None, "dynamics": None, "identify": None},
    "backreferences_dir": None,
    "remove_config_comments": True,
    "parallel": False,
}

html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["custom.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style, pygments_dark_style = "friendly", "monokai"
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
