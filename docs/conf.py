"""Configuration of the site, which `make docs` builds. Its pages load nothing from elsewhere."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "extensions")]

import grasp_env  # noqa: E402

project = "Grasp forces"
author = "The grasp-force authors"
release = version = grasp_env.__version__
project_copyright = "the grasp-force authors, MIT licence"

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "myst_parser",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "mathml",
    "docstrings",
    "program",
    "settings_table",
]
exclude_patterns = ["results"]
nitpicky = True
nitpick_ignore_regex = [
    # no inventories of other projects are loaded: their names are text
    (
        r"py:.*",
        r"(numpy|np|gymnasium|gym|pybullet|mujoco|pathlib|collections|enum|os|stable_baselines3|torch)\..*",
    ),
    # `code` in a docstring becomes a link if it names something; :class: and :func: must be links
    (r"py:obj", r".*"),
]

default_role = "py:word"
myst_enable_extensions = [
    "amsmath",
    "attrs_inline",
    "colon_fence",
    "deflist",
    "dollarmath",
    "fieldlist",
]
myst_heading_anchors = 3
myst_dmath_double_inline = True

autodoc_typehints = "none"  # docstrings give shapes, units and frames
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
# several names may share a line, as for arguments
napoleon_custom_sections = [("Attributes", "params_style")]

html_theme = "furo"
html_title = "Grasp forces"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_show_search_summary = False  # it would fetch pages, which browsers refuse for files on disk
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navigation_with_keys": True,
    "light_css_variables": {"color-brand-primary": "#0b5394", "color-brand-content": "#0b5394"},
    "dark_css_variables": {"color-brand-primary": "#7db8ec", "color-brand-content": "#7db8ec"},
}
pygments_style = "friendly"
pygments_dark_style = "github-dark"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

# programs write files where they run: not in the source tree
RUN = ROOT / "build" / "examples"
shutil.rmtree(RUN, ignore_errors=True)
shutil.copytree(ROOT / "examples", RUN, ignore=shutil.ignore_patterns("__pycache__", "cpp"))

sphinx_gallery_conf = {
    "examples_dirs": str(RUN),
    "gallery_dirs": "gallery",
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("grasp_env", "policies"),
    "filename_pattern": r"/(\d\d|hand)_",  # ros2_node.py needs ROS
    "download_all_examples": False,
    "notebook_extensions": set(),  # no notebooks
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "abort_on_example_error": True,
    "image_scrapers": ("matplotlib",),
    "within_subsection_order": "FileNameSortKey",
    "reference_url": {},
    "remove_config_comments": True,
}
