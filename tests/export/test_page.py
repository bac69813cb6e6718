"""The page that plays a drive asks nobody for anything and says what it is."""

import pytest

from lidarpainter_models.errors import WriteError
from lidarpainter_models.export.page import PageNotes, sealed_page

BARE = '<html><head>\n<meta charset="utf-8" />\n<title>Viser</title></head><body></body></html>'
NOTES = PageNotes(title="<b>street</b>", licence='of "somebody"', software="lidarpainter 1")


def test_policy_comes_before_anything_that_could_load():
    page = sealed_page(BARE, NOTES)
    policy = page.index("Content-Security-Policy")
    assert policy < page.index("<script")
    assert "default-src 'none'" in page
    assert "http" not in page.replace("http-equiv", "")


def test_names_from_datasets_are_escaped():
    page = sealed_page(BARE, NOTES)
    assert "<title>&lt;b&gt;street&lt;/b&gt;</title>" in page
    assert 'content="of &#34;somebody&#34;"' in page
    assert "Viser</title>" not in page


def test_a_page_of_another_form_is_refused():
    with pytest.raises(WriteError, match="viser"):
        sealed_page("<html></html>", NOTES)
