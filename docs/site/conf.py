"""Settings of the documentation's site for Sphinx; `docs/build.py` stages the pages and calls it."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "Loopwright"
author = project_copyright = "The Loopwright authors"
version = release = installed_version("loopwright")
html_title = "Loopwright"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "docstrings",
    "links",
    "mathml",
    "navigation",
    "search_words",
]

# Pages
myst_enable_extensions = ["colon_fence", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # the tests execute the notebooks; the site shows what is stored
nb_merge_streams = True
nb_ipywidgets_js: dict[str, dict[str, str]] = {}  # scripts of widgets would come from a network
suppress_warnings = [
    "misc.highlighting_failure",  # examples with "…" are no JSON
    "ref.python",  # attributes of one name in several classes
]

# Reference
default_role = "literal"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
add_module_names = False
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_custom_sections = [
    (name, "params_style") for name in ("Inputs", "Outputs", "States", "Events", "Guards", "Methods")
]

# Theme: all of it is local; nothing is asked of a network.
html_theme = "furo"
html_static_path = ["static"]
html_css_files = ["loopwright.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_last_updated_fmt = None
templates_path = []
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
html_show_search_summary = False  # browsers don't let a page that is opened as a file read others
