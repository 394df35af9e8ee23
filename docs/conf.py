"""Sphinx configuration: ``make docs``. No page needs the network, neither to build nor to read."""

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path[:0] = [str(DOCS / "_ext"), str(DOCS.parent)]

import seasonscapes  # noqa: E402

project = "seasonscapes"
copyright = "the authors of seasonscapes"
author = "the authors of seasonscapes"
version = release = seasonscapes.__version__

extensions = [
    "sphinx.ext.autodoc",
    "numpydoc",
    "myst_nb",
    "sphinx_copybutton",
    "sphinxcontrib.bibtex",
    "mathml",
    "generated_pages",
    "place_page",
]
exclude_patterns = ["_build", "_generated", "_ext", "images"]

# Notebooks are executed by `make docs-notebooks`, see docs/run_notebooks.py.
nb_execution_mode = "off"
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_dmath_double_inline = True
myst_heading_anchors = 3

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
numpydoc_show_class_members = False
numpydoc_xref_param_type = False

bibtex_bibfiles = ["references.bib"]
bibtex_reference_style = "author_year"
bibtex_default_style = "plain"

copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"
# Two dashes of a flag are two dashes.
smartquotes = False
html_theme = "furo"
html_title = "seasonscapes"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
