"""Sphinx's settings: scripts/build-docs builds the site into docs/_build/html, and a warning is an error."""

import re
from importlib.metadata import version as installed
from pathlib import Path

project = "imujoco_minari"
author = "The imujoco_minari authors"
copyright = "the imujoco_minari authors, Apache-2.0"
version = release = installed("imujoco-minari")

extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build"]
nitpicky = True

myst_enable_extensions = ["colon_fence", "deflist", "smartquotes"]
myst_heading_anchors = 4
# Python blocks are run as tests; what excuses one is for readers of the source.
copybutton_prompt_text = r"\$ |>>> "
copybutton_prompt_is_regexp = True
copybutton_only_copy_prompt_lines = True

# Gymnasium's and Minari's own theme, celshast, is this one under the Farama Foundation's header and menu,
# which this project has no right to.
html_theme = "furo"
html_title = "imujoco_minari"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#2a5d9f", "color-brand-content": "#2a5d9f"},
    "dark_css_variables": {"color-brand-primary": "#8ab8f0", "color-brand-content": "#8ab8f0"},
    "top_of_page_buttons": [],
}


def setup(app):
    """Leave pages that are not written yet out of the index; any other missing page is an error."""
    app.connect("source-read", _leave_out_missing)


def _leave_out_missing(app, name, source):
    if name == "index":
        pages = "pictures|original-archive|cluster|training|promises|speed|doors/\\*"
        missing = [
            page
            for page in re.findall(rf"^({pages})$", source[0], re.M)
            if not any(Path(app.srcdir).glob(f"{page}.md"))
        ]
        source[0] = "\n".join(line for line in source[0].split("\n") if line not in missing)
