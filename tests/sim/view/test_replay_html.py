"""The page of a replay that can be sent: it is whole, holds the recording, and a browser draws it without a network."""

import base64
import json
import re
import zlib
from dataclasses import asdict

import numpy as np
import pytest

from helpers.headless_browser import PROGRAM, Chromium
from helpers.recordings import RECORD, STEPS, arrays_of, scenery
from tactip_twin.sim.view import replay_html as module
from tactip_twin.sim.view.replay_html import replay_html, write_replay_html
from tactip_twin.tactip_model.errors import TactipError
from tactip_twin.tactip_model.pins import neutral_pins
from tactip_twin.tactip_model.presets import load_design


def recording():
    """Return a record with a design, and arrays with its pins, which move."""
    design = load_design("tactip-127")
    arrays, (tips, directions) = arrays_of(), neutral_pins(design)
    arrays["pin_tips_m"] = tips + 1e-4 * np.arange(STEPS)[:, None, None]
    arrays["directions"] = np.repeat(directions[None], STEPS, 0)
    record = RECORD | {"design": json.loads(json.dumps(asdict(design))), "object": "</script><b>ball</b>"}
    return record, arrays


@pytest.fixture(scope="module")
def page():
    return replay_html(*recording(), scenery())


def content(page):
    """Return the description and the arrays of a page."""
    part = {name: re.search(rf'<script id="{name}"[^>]*>(.*?)</script>', page)[1] for name in ("description", "data")}
    description, data = json.loads(part["description"]), zlib.decompress(base64.b64decode(part["data"]))
    arrays = {n: np.frombuffer(data, f"<{kind}", size, start) for n, (kind, start, size) in description["arrays"].items()}
    return description, arrays


def test_page_names_nothing_outside_of_itself(page):
    text = page.replace("'none'", "")
    for outside in ("http:", "https:", "//cdn", "src=", "href=", "url(", "@import", "import(", "fetch(", "XMLHttpRequest"):
        assert outside not in re.sub(r'<script id="data".*?</script>', "", text)
    assert "default-src 'none'" in page
    assert len(re.findall("</script>", page)) == 3  # a name in a recording ends none


def test_page_holds_the_recording(page):
    description, packed = content(page)
    record, arrays = recording()
    assert description["title"] == f"{record['object']}, edge" and description["steps"] == list(range(STEPS))
    assert description["events"] == [7] and "9.0 N on the tip" in description["status"][7][-1]
    for name, key in (("skin", "skin_m"), ("pins", "pin_tips_m")):
        values = np.cumsum(packed[name].reshape(STEPS, -1, 3), 0, dtype=np.int16) * description["unit_m"]
        assert np.allclose(values, arrays[key], atol=0.51 * description["unit_m"])
    images = np.unpackbits(packed["images"].reshape(STEPS, 32, 4), axis=-1)
    assert np.array_equal(255 * images, arrays["images"])
    assert np.allclose(packed["poses"].reshape(STEPS, -1, 3, 4)[:, -1], arrays["T_base_tcp"][:, :3], atol=1e-6)
    depth = next(c for c in description["curves"] if c["name"] == "depth")
    assert depth["estimated"] == [None] * 2 + [-3.0] * (STEPS - 2) and depth["band"][2:] == [0.4] * (STEPS - 2)


def test_meshes_are_at_their_places(page):
    description, packed = content(page)
    scene = scenery()
    first = description["meshes"][0]
    places = first["low"] + first["unit"] * packed["mesh0/places"].reshape(-1, 3)
    corners = scene.object_vertices[scene.object_triangles]
    assert np.allclose(places[packed["mesh0/triangles"].reshape(-1, 3)], corners, atol=2e-6)
    poses = packed["poses"].reshape(STEPS, description["bodies"], 3, 4)[:, first["body"]]
    assert np.allclose(poses, arrays_of()["T_base_object"][:, :3], atol=1e-6)


def test_stride_keeps_the_last_step():
    description, _ = content(replay_html(*recording(), scenery(), stride=5))
    assert description["steps"] == [0, 5, 10, 11] and description["events"] == [2]


def test_page_too_large_to_send_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_BYTES", 1000)
    with pytest.raises(TactipError, match="give --stride 2"):
        write_replay_html(tmp_path / "a.html", *recording(), scenery())
    assert not list(tmp_path.iterdir())


def test_empty_recording_is_refused():
    with pytest.raises(TactipError, match="the recording has no steps to show"):
        replay_html(RECORD | {"steps": 0}, arrays_of(), scenery())


@pytest.mark.slow
@pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium here")
def test_browser_draws_the_page_and_its_curves_are_clicked(page, tmp_path):
    path = tmp_path / "replay.html"
    path.write_text(page)
    browser = Chromium(path.as_uri())
    try:
        browser.until(lambda: "step 0 of 11" in browser.text())
        assert browser.evaluate("document.getElementById('error').textContent") == ""
        scene = browser.screenshot()[:, 350:800].astype(int)
        assert (scene.max(2) < 130).mean() > 0.004 and len(np.unique(scene.reshape(-1, 3), axis=0)) > 100
        place = browser.evaluate("(q => [q.right - 10, q.y + 40])(document.querySelector('.curve').getBoundingClientRect())")
        browser.mouse("mousePressed", place)
        browser.mouse("mouseReleased", place)
        browser.until(lambda: "step 11 of 11" in browser.text())
        browser.key("Home", "Home")
        browser.until(lambda: "step 0 of 11" in browser.text())
        browser.key("n", "KeyN")
        browser.until(lambda: "9.0 N on the tip" in browser.text())
        for view in ("close", "inside"):
            browser.click(view)
            browser.frames()
            assert len(np.unique(browser.screenshot()[:, 350:800].reshape(-1, 3), axis=0)) > 100
    finally:
        browser.close()
