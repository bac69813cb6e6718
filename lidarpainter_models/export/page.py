"""The page that plays a drive, sealed: it asks nobody for anything, and says what it is.

viser's client comes with its recording inside one HTML file. Here that file gets a name, a policy
that lets the browser load nothing from anywhere, and a line for browsers without WebGL.
"""

import html
from dataclasses import dataclass
from importlib.resources import files

import jinja2

from lidarpainter_models.errors import WriteError

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src data: blob:; worker-src blob: data:; media-src data: blob:"
)
"""Scripts, pictures and the splat sorter all stand inside the page."""
_TITLE = "<title>Viser</title>"
_HEAD = '<meta charset="utf-8" />'


@dataclass(frozen=True, kw_only=True)
class PageNotes:
    """What a page says about itself."""

    title: str
    licence: str
    """Of the data that is shown."""
    software: str


def sealed_page(page: str, notes: PageNotes) -> str:
    """A page of viser's that is named and cannot load anything.

    Raises:
        WriteError: the installed viser writes pages of another form.
    """
    if _TITLE not in page or _HEAD not in page:
        raise WriteError("the installed viser writes pages of another form than viser 1.1")
    source = files("lidarpainter_models.export").joinpath("page_head.html.j2").read_text("utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    head = environment.from_string(source).render(notes=notes, policy=POLICY)
    page = page.replace(_TITLE, f"<title>{html.escape(notes.title)}</title>", 1)
    return page.replace(_HEAD, f"{_HEAD}\n{head}", 1)
