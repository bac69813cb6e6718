"""How `make docs` builds the site: Markdown pages by MyST, the API from docstrings."""

import re
import sys
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from lidarpainter_models import __version__  # noqa: E402 - from this checkout

project = "LidarPainter"
author = "the LidarPainter authors"
version = release = __version__
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_site"]
suppress_warnings = ["myst.header"]  # headings of lower levels where a page has no chapters
default_role = "literal"  # docstrings write `names` as Markdown does
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes in types are no text that links
autodoc_class_signature = "separated"
autodoc_default_options = {"exclude-members": "__init__"}
add_module_names = False
html_theme = "furo"
html_title = f"LidarPainter {version}"
html_static_path = ["site"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True, "top_of_page_buttons": []}
html_show_copyright = False
pygments_style = "friendly"

WHOLE = {"contributing": ROOT / "CONTRIBUTING.md", "changelog": ROOT / "CHANGELOG.md"}
"""Pages of the site that are files beside `docs`."""
ELSEWHERE = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
PIPELINE = "![The way of the data](pictures/pipeline.svg)"
"""Stands for the diagram that GitHub draws by itself."""


def as_page(_app: Sphinx, name: str, source: list[str]) -> None:
    """Make what is beside `docs` a page, or words without a link."""
    text = source[0]
    if name in WHOLE:
        text = WHOLE[name].read_text("utf-8").replace("](docs/", "](")
    text = re.sub(r"```mermaid\n.*?```", PIPELINE, text, flags=re.DOTALL)
    up = "../" * (name.count("/") + 1)
    for file, page in ELSEWHERE.items():
        text = text.replace(f"]({up}{file}", f"]({up[3:]}{page}")
    source[0] = re.sub(rf"\[([^\]]+)\]\({re.escape(up)}[^)]*\)", r"\1", text)


def setup(app: Sphinx) -> None:
    """Let Sphinx read pages as GitHub shows them."""
    app.connect("source-read", as_page)
