import io
import shutil
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from tests.helpers.synthetic_poses import messages
from tests.nodes.sinks.test_viewer import free_port

from steadypose.nodes.sinks.viewer.layout import CONTACT_RGB, SIDE_RGB
from steadypose.nodes.sinks.viewer.scene import PoseView
from steadypose.nodes.sinks.viewer.server import ViewerServer

pytest.importorskip("rerun", reason="the optional extra `view` is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="the optional extra `dev` is not installed")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
WIDTH, HEIGHT, PANELS = 1200, 700, 450
"""pixels of the page; the three panels with bodies are side by side in its upper part, down to `PANELS`"""
TIMEOUT_S, RELOAD_S = 240.0, 45.0
"""for WebAssembly and shaders to compile, on a machine that does something else too"""


def pixels(screenshot: bytes, panel: int, colour: np.ndarray | list[int]) -> int:
    image = np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB")).astype(int)
    part = image[:PANELS, panel * WIDTH // 3 : (panel + 1) * WIDTH // 3]
    return int((np.abs(part - np.asarray(colour)).max(axis=-1) < 40).sum())


def is_drawn(screenshot: bytes) -> bool:
    sides = all(pixels(screenshot, panel, colour) > 100 for panel in range(3) for colour in SIDE_RGB[:2])
    return sides and pixels(screenshot, 2, CONTACT_RGB) > 10


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here; on Debian: apt-get install chromium")
def test_the_page_draws_three_panels_and_reaches_nobody_but_this_machine() -> None:
    with ViewerServer(free_port()) as server, playwright.sync_playwright() as play:
        recording = server.connect()
        view = PoseView(recording)
        for topic, message in messages(4.0):
            view.log(topic, message)
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE_GL])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        answered: set[str | None] = set()
        page.on("response", lambda response: answered.add(urlsplit(response.url).hostname))
        page.goto(server.url)
        began = loaded = time.monotonic()
        while not is_drawn(page.screenshot()):
            assert time.monotonic() < began + TIMEOUT_S, f"nothing drawn within {TIMEOUT_S:g} s"
            if time.monotonic() > loaded + RELOAD_S:  # as anybody would, whose browser drew nothing
                page.reload()
                loaded = time.monotonic()
            page.wait_for_timeout(500)
        browser.close()
        recording.disconnect()
    assert answered == {"127.0.0.1"}
