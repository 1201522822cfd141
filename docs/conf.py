"""How Sphinx builds the manual: python -m sphinx -W --keep-going -b html docs OUT"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import uwsfm

project = "uwsfm"
author = "The uwsfm authors"
copyright = author
version = release = uwsfm.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "api_docstrings",
    "mathtext_svg",
    "notebook_pages",
    "reference_tables",
]
exclude_patterns = ["_build", "_ext"]
source_suffix = {".md": "markdown"}
myst_enable_extensions = ["attrs_block", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
html_math_renderer = "mathtext"
default_role = "py:obj"
smartquotes_action = "qe"

autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True
python_display_short_literal_types = True
maximum_signature_line_length = 60

html_theme = "furo"
html_title = f"uwsfm {version}"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_show_sphinx = False
html_copy_source = False
# No page needs the network: no icons, fonts or scripts from elsewhere.
html_theme_options = {"footer_icons": [], "top_of_page_buttons": []}
copybutton_exclude = ".linenos, .gp, .go"
