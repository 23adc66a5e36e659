"""The web page with four bodies at 30 Hz in a headless Chromium: pictures a second, and how its memory grows.

Bodies move, and events and health come as in a run. The heap is measured after a forced collection; an hour's growth is
the slope of a line through its sizes once the page has settled, given with its standard error.
"""

from __future__ import annotations

import shutil
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console

from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.provenance import require_committed
from steadypose.benchmarks.results import RESULTS, Table, save, show
from steadypose.msgs.recording import RecordingReader
from steadypose.msgs.topics import DIAGNOSTICS, POSE_EVENTS, POSE_TRUTH, POSE_WORLD
from steadypose.msgs.types import Diagnostics, Event, EventKind, Hand, Level, Phase, PoseEvents, PoseWorld
from steadypose.nodes.sinks.web.form import to_json
from steadypose.nodes.sinks.web.server import WebServer
from steadypose.prior.timing.rate import FPS

BODIES = 4
SAMPLE_S, SETTLED = 20.0, 0.3
"""seconds between two looks at the heap, and the share of the time after which it counts"""
COUNT_PICTURES = """
  globalThis.pictures = 0;
  const clear = CanvasRenderingContext2D.prototype.clearRect;
  CanvasRenderingContext2D.prototype.clearRect = function (...area) { pictures += 1; return clear.apply(this, area); };
"""


@dataclass(frozen=True)
class Args:
    """Rate and memory of the web page."""

    minutes: float = 5.0
    out: Path = RESULTS
    """folder for the JSON file"""


def crowd() -> list[tuple[str, str]]:
    """(topic, JSON) of each frame of four people who walk side by side, with their events and the nodes' health."""
    with RecordingReader(ROOT / "sim_data" / "walk_turn") as recording:
        walk = [r.message for r in recording.messages([POSE_TRUTH]) if isinstance(r.message, PoseWorld)]
    told: list[tuple[str, str]] = []

    def tell(topic: str, message: Any) -> None:
        told.append((topic, to_json(message) or ""))

    for number, frame in enumerate(frame for frame in walk if frame.bodies):
        body, bodies = frame.bodies[0], []
        for k in range(BODIES):
            aside = np.array([0.0, 1.2 * k, 0.0])
            bodies.append(
                replace(body, id=k, positions=body.positions + aside, root_position=body.root_position + aside)
            )
        tell(POSE_WORLD, replace(frame, bodies=bodies))
        if number % 15 == 0:
            phase = Phase.BEGINS if number % 30 else Phase.ENDS
            event = Event(number % BODIES, EventKind.HAND_RAISED, phase, Hand.LEFT, 0.9, np.zeros(3), frame.stamp_ns)
            tell(POSE_EVENTS, PoseEvents(frame.stamp_ns, "world", "walk", [event]))
        if number % 30 == 0:
            values = {"rate.pose/world": "30.0", "latency_ms.p50": f"{number % 7}"}
            tell(DIAGNOSTICS, Diagnostics(frame.stamp_ns, "trajectory", Level.OK, "", values))
    return told


def play(server: WebServer, told: list[tuple[str, str]], over: threading.Event) -> None:
    """Send it again and again at 30 Hz, until it is over."""
    next_s = time.monotonic()
    while not over.is_set():
        for topic, text in told:
            server.send(topic, text, replaces=topic != POSE_EVENTS)
            if topic == POSE_WORLD:
                next_s += 1.0 / FPS
                if over.wait(max(next_s - time.monotonic(), 0.0)):
                    return


def measure(minutes: float) -> dict[str, Any]:
    """Pictures a second, and (seconds, bytes) of the heap."""
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        raise FileNotFoundError("no Chromium here; on Debian: apt-get install chromium")
    server, over = WebServer("127.0.0.1", 0, [], "a-token-of-this-benchmark"), threading.Event()
    sender = threading.Thread(target=play, args=(server, crowd(), over))
    with sync_playwright() as play_wright:
        browser = play_wright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--enable-precise-memory-info"]
        )
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.add_init_script(COUNT_PICTURES)
        page.goto(server.url)
        sender.start()
        page.wait_for_timeout(1e3 * SAMPLE_S)
        began, before, heap = time.monotonic(), page.evaluate("pictures"), []
        while (passed := time.monotonic() - began) < 60 * minutes:
            page.request_gc()
            heap.append((passed, float(page.evaluate("performance.memory.usedJSHeapSize"))))
            page.wait_for_timeout(1e3 * SAMPLE_S)
        rate = (page.evaluate("pictures") - before) / (time.monotonic() - began)
        over.set()
        sender.join()
        browser.close()
    server.close()
    return {"pictures_hz": round(rate, 2), "heap": [(round(at, 1), size) for at, size in heap]}


def slope(heap: list[tuple[float, float]]) -> tuple[float, float]:
    """MB an hour, and its standard error, of the heap once it has settled."""
    at, size = np.array(heap).T
    at, size = at[at >= SETTLED * at[-1]] / 3600, size[at >= SETTLED * at[-1]] / 1e6
    (rate, _), covariance = np.polyfit(at, size, 1, cov=True)
    return float(rate), float(np.sqrt(covariance[0, 0]))


def main(args: Args) -> None:
    """Measure, print, write."""
    require_committed(args.out)
    found = measure(args.minutes)
    rate, error = slope(found["heap"])
    sizes = [size / 1e6 for _, size in found["heap"]]
    table = Table(
        name="web-page",
        title=f"The web page, {BODIES} bodies at 30 Hz for {args.minutes:g} minutes, headless Chromium",
        columns=["pictures a second", "heap at first, MB", "at last, MB", "growth, MB an hour"],
        rows=[[f"{found['pictures_hz']:.1f}", f"{sizes[0]:.2f}", f"{sizes[-1]:.2f}", f"{rate:.2f} ± {error:.2f}"]],
        note="Growth is extrapolated: the slope of the heap's size over the last seven tenths of the time.",
    )
    console = Console()
    show(table, console)
    found |= {"growth_mb_per_hour": round(rate, 3), "growth_error": round(error, 3)}
    console.print(f"wrote {save('web_page', sys.argv[1:], [table], found, (), args.out)}")


if __name__ == "__main__":
    main(tyro.cli(Args))
