"""Configuration of the site: it is made of the pages in docs/, the notebooks, the docstrings and CHANGELOG.md.

    pip install ".[docs]" && sphinx-build -W --keep-going -c docs . build/site

The source folder is the repository, so that a link of one file to another is the same here, in an
editor and wherever files are shown as they are. Nothing is fetched, neither to build nor to see it.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(HERE / "site"))

import jaxltl  # noqa: E402

project = "jaxltl"
author = "the authors of jaxltl"
project_copyright = "the authors of jaxltl, Apache-2.0"
release = version = jaxltl.__version__
language = "en"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "site_reference",
    "site_pages",
]
root_doc = "docs/index"
include_patterns = [
    "docs/**",
    "notebooks/*.ipynb",
    "notebooks/pictures/*",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
]
exclude_patterns = ["build", "out", "**/__pycache__", "**/.ipynb_checkpoints"]
nitpicky = True

# Pages are Markdown as GitHub reads it; mathematics becomes MathML, which browsers draw themselves.
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
myst_number_code_blocks: list[str] = []
myst_links_external_new_tab = False
nb_execution_mode = "off"
nb_merge_streams = True
html_math_renderer = "mathml"

default_role = "code"
highlight_language = "none"
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_param = True
napoleon_use_rtype = False
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 80
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = "jaxltl"
html_static_path = ["site/static"]
html_css_files = ["site.css"]
html_js_files = ["site.js"]
html_favicon = "site/static/icon.svg"
templates_path = ["site/templates"]
html_additional_pages = {"index": "to_front_page.html"}
html_show_sphinx = False
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": False}
