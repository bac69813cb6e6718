"""The page that plays a drive asks nobody for anything and says what it is."""

import pytest

from lidarpainter_models.errors import WriteError
from lidarpainter_models.export.page import FirstView, PageNotes, sealed_page

BARE = '<html><head>\n<meta charset="utf-8" />\n<title>Viser</title></head><body></body></html>'
NOTES = PageNotes(title="<b>street</b>", licence='of "somebody"', software="lidarpainter 1")
FIRST = FirstView(data_url="data:image/jpeg;base64,abc", num_splats=7)


def test_policy_comes_before_anything_that_could_load():
    page = sealed_page(BARE, NOTES, FIRST)
    policy = page.index("Content-Security-Policy")
    assert policy < page.index("<script")
    assert "default-src 'none'" in page
    assert "http" not in page.replace("http-equiv", "")


def test_names_from_datasets_are_escaped():
    page = sealed_page(BARE, NOTES, FIRST)
    assert "<title>&lt;b&gt;street&lt;/b&gt;</title>" in page
    assert 'content="of &#34;somebody&#34;"' in page
    assert "Viser</title>" not in page


def test_a_page_of_another_form_is_refused():
    with pytest.raises(WriteError, match="viser"):
        sealed_page("<html></html>", NOTES, FIRST)


def test_the_first_view_stands_before_the_scripts_of_the_client():
    page = sealed_page(BARE.replace("</head>", "<script>client()</script></head>"), NOTES, FIRST)
    assert page.index(FIRST.data_url) < page.index("client()")
    assert "count: 7" in page
