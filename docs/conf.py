"""Sphinx's settings: scripts/build-docs builds the site into docs/_build/html, and a warning is an error."""

from importlib.metadata import version as installed

project = "imujoco_minari"
author = "The imujoco_minari authors"
copyright = "the imujoco_minari authors, Apache-2.0"
version = release = installed("imujoco-minari")

extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_build"]
# The toctrees glob, so that a page shows as soon as it is there.
suppress_warnings = ["toc.empty_glob"]
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
