"""Sphinx's settings: scripts/build-docs builds the site into docs/_build/html, and a warning is an error."""

import importlib
import pkgutil
import re
from importlib.metadata import version as installed
from pathlib import Path
from types import ModuleType

from sphinx.util import logging

import imujoco_minari

project = "imujoco_minari"
author = "The imujoco_minari authors"
copyright = "the imujoco_minari authors, Apache-2.0"
version = release = installed("imujoco-minari")

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "results/*"]
nitpicky = True
# Names of other libraries. Links to them would need the network.
nitpick_ignore_regex = [
    ("py:class", r"(?!imujoco_minari\.).*"),
    ("py:.*", r"(minari|gymnasium|mujoco|numpy|h5py|torch|joblib|ray)\b.*"),
]
# Names that no longer exist. Delete a line when the docstring is corrected.
nitpick_ignore = [
    ("py:func", "content.attributes"),
]

# One parameter a line, with its type.
maximum_signature_line_length = 80
autodoc_member_order = "bysource"
# The fields of a named tuple are members already.
napoleon_use_ivar = True
# `Datasets` is a union that would fill the line.
autodoc_type_aliases = {"Array": "numpy.ndarray", "Datasets": "Datasets"}

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


# The command line has its own page, docs/cli.md.
WITHOUT_REFERENCE = {"imujoco_minari.cli"}


def setup(app):
    """Leave pages that are not written yet out of the index; any other missing page is an error.

    Link each name to the entry of its object, and report public names that have no entry.
    """
    app.connect("source-read", _leave_out_missing)
    app.connect("autodoc-process-signature", _shorten)
    app.connect("missing-reference", _link_by_object)
    app.connect("env-check-consistency", _report_undocumented)


def _shorten(app, what, name, found, options, signature, returns):
    """Show the default of a dataclass's factory as ``...``, and a nested type alias as its name."""
    if signature:
        signature = re.sub(r"TypeAliasForwardRef\('(.*?)'\)", r"\1", signature).replace("<factory>", "...")
    return signature, returns


def _link_by_object(app, env, node, text):
    """Link a name to the entry of the same object under its public name; a private object gets no link."""
    if node.get("refdomain") == "py":
        for name in (node["reftarget"], f"{node.get('py:module')}.{node['reftarget']}"):
            if name.startswith("imujoco_minari.") and (found := _object(name)) is not None:
                public = _documented(env).get(_identity(name, found), "")
                python = env.domains.python_domain
                return (
                    python.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, text) or text
                )
    return None


def _report_undocumented(app, env):
    """Warn of names in the ``__all__`` of a package without an entry, and of constants that do not exist."""
    warn = logging.getLogger(__name__).warning
    documented = _documented(env)
    modules = pkgutil.walk_packages(imujoco_minari.__path__, "imujoco_minari.")
    packages = {info.name for info in modules if info.ispkg} - WITHOUT_REFERENCE | {"imujoco_minari"}
    for package in sorted(packages):
        for name in getattr(importlib.import_module(package), "__all__", ()):
            if _identity(name, _object(f"{package}.{name}")) not in documented:
                warn("docs/reference has no entry for %s.%s", package, name)
    for name, entry in env.domains.python_domain.objects.items():
        if entry.objtype == "data" and _object(name) is None:
            warn("docs/reference describes %s, which does not exist", name)


def _documented(env):
    """Return the identity of each documented object, with the name of its entry."""
    names = env.domains.python_domain.objects
    return {_identity(name, found): name for name in names if (found := _object(name)) is not None}


def _identity(name, found):
    # Equal constants may be one object.
    return (
        id(found),
        "" if isinstance(found, type | ModuleType) or callable(found) else name.rpartition(".")[2],
    )


def _object(name):
    """Return the object of a dotted name, None where it does not exist."""
    try:
        return pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError):
        return None


def _leave_out_missing(app, name, source):
    if name == "index":
        pages = "pictures|original-archive|cluster|training|promises|speed|doors/\\*"
        missing = [
            page
            for page in re.findall(rf"^({pages})$", source[0], re.M)
            if not any(Path(app.srcdir).glob(f"{page}.md"))
        ]
        source[0] = "\n".join(line for line in source[0].split("\n") if line not in missing)
