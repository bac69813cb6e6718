"""The gallery holds every asset, opens from the disk, asks nobody and believes no name."""

import json
import re
from pathlib import Path

import pytest
from chromium import NO_WEBGL, Chromium, found_browser, until
from drawn_gallery import write_drawn_gallery

from lidarpainter_models.export.gallery import write_gallery

HOSTILE = "</script><img src=x onerror=\"document.title='taken'\">'\u2028{{ 7 * 7 }}"
COUNT = 10_000
IN_PAGE = "document.querySelectorAll('.card').length"
HAS_PICTURE = "[...document.querySelectorAll('.stage img')].some(one => one.naturalWidth)"
SHOWN = "document.getElementById('count').textContent"
LAST_IN_VIEW = (
    "[...document.querySelectorAll('.card')].at(-1).getBoundingClientRect().bottom <= innerHeight"
)


def library(folder):
    text = (folder / "assets.js").read_text("utf-8")
    found = json.loads(text.removeprefix("const LIBRARY = ").removesuffix(";\n"))
    return [dict(zip(found["fields"], row, strict=True)) for row in found["rows"]]


def test_every_asset_is_there_with_its_own_picture(tmp_path):
    picture = tmp_path / "any.webp"
    picture.write_bytes(b"picture")
    assets = [
        {"asset_id": "a", "kind": "actor", "name": HOSTILE, "score": 0.123456, "sides": ["front"]},
        {"asset_id": "b", "kind": "sky", "score": float("nan"), "licence": None},
        {"asset_id": "c", "kind": "street", "folder": "not for the page"},
    ]
    pictures = {"a": picture, "b": None, "c": tmp_path / "gone.webp"}
    folder = tmp_path / "gallery"
    assert write_gallery(folder, assets, lambda asset: pictures[asset["asset_id"]]) == 1
    first, second, third = library(folder)
    assert first["name"] == HOSTILE
    assert (first["score"], first["sides"]) == (0.1235, ["front"])
    assert (folder / first["picture"]).read_bytes() == b"picture"
    assert second["score"] is second["picture"] is third["picture"] is None
    assert "folder" not in third


def test_the_page_loads_what_lies_beside_it_and_no_name_is_html(tmp_path):
    write_gallery(tmp_path, [{"asset_id": HOSTILE, "kind": "sky"}], lambda _: None)
    page, script = ((tmp_path / name).read_text("utf-8") for name in ("index.html", "gallery.js"))
    assert "default-src 'none'; script-src 'self' file:" in page
    assert re.findall(r'(?:src|href)="([^"]*)"', page) == ["assets.js", "gallery.js"]
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval|http", script)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    found_browser()
    folder = tmp_path_factory.mktemp("library")
    names = {"name": HOSTILE, "category": HOSTILE, "style": HOSTILE, "licence": HOSTILE}
    return write_drawn_gallery(
        folder / "gallery", folder / "strips", COUNT, **names, scene_ids=[HOSTILE], score=2.0
    )


@pytest.fixture(params=[1400, 400])
def browser(request, page, tmp_path):
    folder = tmp_path / "profile"
    with Chromium(folder, width_px=request.param, height_px=850, words=NO_WEBGL) as browser:
        browser.call("Runtime.enable")
        browser.open(page.as_uri())
        until(lambda: browser.value(HAS_PICTURE))
        yield browser
        faults = [one for one in browser.events if one["method"] == "Runtime.exceptionThrown"]
        assert faults == []
        assert all(Path(address[7:]).exists() for address in files_asked(browser))


def files_asked(browser):
    asked = browser.requested()
    assert all(address.startswith("file:///") for address in asked), asked
    return asked


@pytest.mark.slow
def test_ten_thousand_assets_scroll_and_filter(browser):
    assert browser.value(SHOWN) == "10,000 of 10,000"
    assert browser.value(IN_PAGE) < 60  # what is in view, and no more
    browser.value("scrollTo(0, 1e9)")
    until(lambda: browser.value(LAST_IN_VIEW))
    assert browser.value(IN_PAGE) < 60
    assert len(files_asked(browser)) < 150
    browser.value("document.querySelector('#category [data-value=Bus]').click()")
    buses = int(browser.value(SHOWN).split(" ")[0])
    assert 0 < buses < 2000
    browser.value("document.querySelector('#sides [data-value=front]').click()")
    assert 0 < int(browser.value(SHOWN).split(" ")[0]) < buses
    search = "document.getElementById('text')"
    browser.value(f"{search}.value = 'no such car'; {search}.dispatchEvent(new Event('input'))")
    assert browser.value(SHOWN) == "0 of 10,000"
    assert "Nothing" in browser.value("document.getElementById('empty').textContent")


@pytest.mark.slow
def test_names_from_outside_stay_text(browser):
    browser.value("document.querySelector('.card').click()")
    shown = browser.value("document.getElementById('detail').textContent")
    assert shown.count(HOSTILE) >= 4
    assert browser.value("document.title") == "Asset library"
    assert browser.value("document.querySelectorAll('img[onerror]').length") == 0
    assert browser.value("document.querySelector('#category button').dataset.value.length") > 0


@pytest.mark.slow
def test_an_asset_turns_when_it_is_dragged(browser):
    strip = "document.querySelector('.stage img').style.transform"
    before = browser.value(strip)
    box = browser.value(
        "(() => { const box = document.querySelector('.stage').getBoundingClientRect();"
        "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
    )
    for kind, moved in (("mousePressed", 0), ("mouseMoved", 40), ("mouseReleased", 40)):
        browser.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=box[0] + moved,
            y=box[1],
            button="left",
            buttons=1,
            clickCount=1,
        )
    assert browser.value(strip) != before
    assert not browser.value("document.getElementById('detail').open")  # a drag is no click


@pytest.mark.slow
def test_nothing_is_wider_than_the_screen(browser):
    assert browser.value("document.documentElement.scrollWidth <= innerWidth")
