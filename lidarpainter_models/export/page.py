"""The page that plays a drive, sealed: it asks nobody for anything, and says what it is.

viser's client comes with its recording inside one HTML file. Here that file gets a name, a policy
that lets the browser load nothing from anywhere, a picture of the first view that stands until the
client has sorted its splats, and a line for browsers without WebGL.
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
    """The licence of the data that is shown."""
    software: str


@dataclass(frozen=True, kw_only=True)
class FirstView:
    """What stands on the page until the client can draw."""

    data_url: str
    """A picture of the first view; its middle is shown, as high as the window."""
    num_splats: int
    """How many splats the client has to sort before it can take over."""


def sealed_page(page: str, notes: PageNotes, first_view: FirstView) -> str:
    """A page of viser's that is named, cannot load anything, and shows its first view at once.

    Raises:
        WriteError: the installed viser writes pages of another form.
    """
    if _TITLE not in page or _HEAD not in page:
        raise WriteError("the installed viser writes pages of another form than viser 1.1")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    known = {"notes": notes, "policy": POLICY, "first_view": first_view}
    # what stands before the client's scripts is painted while these are still being read
    head, poster = (
        environment.from_string(
            files("lidarpainter_models.export").joinpath(f"{name}.html.j2").read_text("utf-8")
        ).render(known)
        for name in ("page_head", "page_first_view")
    )
    page = page.replace(_TITLE, f"<title>{html.escape(notes.title)}</title>\n{poster}", 1)
    return page.replace(_HEAD, f"{_HEAD}\n{head}", 1)
