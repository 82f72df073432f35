"""Messages that no page sends: the server logs a line about each, and serves on."""

import asyncio
import logging

import msgspec
import numpy as np
import pytest
import viser
import websockets

from helpers.recordings import RECORD, arrays_of, scenery
from tactip_twin.sim.view.replay_page import ReplayPage

PROTOCOL = f"viser-v{viser.__version__}"


def packed(**values):
    return msgspec.msgpack.encode(values)


def update(page, **updates):
    """Return an update of the page's slider."""
    return packed(type="GuiUpdateMessage", uuid=page._slider._impl.uuid, updates=updates)


FRAMES = {
    "text": lambda page: "hello",
    "empty": lambda page: b"",
    "noise": lambda page: np.random.default_rng(0).bytes(1000),
    "truncated": lambda page: update(page, value=3)[:-3],
    "nested": lambda page: 100_000 * b"\x91",
    "no object": lambda page: msgspec.msgpack.encode([1, 2]),
    "no type": lambda page: packed(uuid="x"),
    "unknown type": lambda page: packed(type="NoMessage"),
    "wrong type": lambda page: packed(type=7),
    "missing fields": lambda page: packed(type="GuiUpdateMessage"),
    "more fields": lambda page: packed(type="GuiUpdateMessage", uuid="x", updates={}, more=1),
    "wrong fields": lambda page: packed(type="GuiUpdateMessage", uuid=[1], updates=7),
    "wrong value": lambda page: update(page, value="far"),
    "unknown property": lambda page: update(page, no_such_property=1),
    "camera of texts": lambda page: packed(type="ViewerCameraMessage", wxyz="a", position="b", fov="c"),
    "upload of nothing": lambda page: packed(type="FileTransferPart", source_component_uuid="x", content=b"x"),
}


@pytest.fixture(scope="module")
def page():
    page = ReplayPage(RECORD, arrays_of(), scenery(), port=8451)
    yield page
    page.close()


async def connect(page, protocol=PROTOCOL):
    port = page._server.get_port()
    return await websockets.connect(
        f"ws://127.0.0.1:{port}", origin=f"http://127.0.0.1:{port}", subprotocols=[protocol], max_size=None
    )


async def send(page, frame):
    """Send a frame, and wait until it is dealt with; return what a page that connects afterwards gets first."""
    async with await connect(page) as socket:
        await asyncio.wait_for(socket.recv(), 20)
        await socket.send(frame)
        await asyncio.sleep(0.3)
    async with await connect(page) as socket:
        return await asyncio.wait_for(socket.recv(), 20)


@pytest.mark.parametrize("name", FRAMES)
def test_malformed_message_is_one_line_and_page_is_served_on(page, capfd, caplog, name):
    with caplog.at_level(logging.WARNING):
        assert len(asyncio.run(send(page, FRAMES[name](page)))) > 0
    output = "".join(capfd.readouterr())
    assert "Traceback" not in output and "Error" not in output
    assert len(caplog.records) <= 1
    assert all(record.exc_info is None and "\n" not in record.getMessage() for record in caplog.records)


def test_malformed_message_is_logged(page, caplog):
    asyncio.run(send(page, b"noise"))
    (record,) = caplog.records
    assert record.getMessage().startswith("a message of the page was refused: ")


def test_page_of_another_version_is_refused_without_output(page, capfd):
    with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
        asyncio.run(connect(page, "viser-v0.0.1"))
    assert capfd.readouterr() == ("", "")
