"""What the doctor looks at: the machine, and what the nodes need."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

from steadypose import PACKAGE
from steadypose.msgs.security import TransportError, make_private
from steadypose.nodes.extras import install_command

if TYPE_CHECKING:
    from steadypose.msgs.types import PoseRaw


PROJECT = PACKAGE.parents[1] / "pyproject.toml"  # of a checkout; an installed wheel has none
INSTALL = install_command()


class Verdict(Enum):
    """The result of a check: the word that is printed, and its style."""

    GOOD = ("ok", "green")
    NOTE = ("note", "yellow")  # works, but not as well as it could, or for want of something optional
    BAD = ("missing", "bold red")  # `steadypose run` cannot work


@dataclass(frozen=True)
class Finding:
    """The result of one check, and what to type to change it."""

    what: str
    verdict: Verdict
    found: str
    fix: str = ""


def noted(what: str, found: str, fix: str = "") -> Finding:
    """Good, unless there is something to fix."""
    return Finding(what, Verdict.NOTE if fix else Verdict.GOOD, found, fix)


def restored(what: str) -> str:
    """What to type to restore files that came with steadypose."""
    return f"git checkout -- {what}" if PROJECT.exists() else INSTALL


NEEDED_GB, LUXONIS_USB = 1.0, "03e7"
UDEV_RULE = (
    f"""echo 'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{LUXONIS_USB}", MODE="0666"' | """
    "sudo tee /etc/udev/rules.d/80-movidius.rules && sudo udevadm control --reload-rules && sudo udevadm trigger"
)
DEVICES = Path("/dev")


def check_processor() -> Iterator[Finding]:
    """Cores that are free, and whether they run at full speed."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    busy = "frames will be late: stop other programs, which `top` lists" if load > max(cores - 1, 0.5) else ""
    yield noted("processor", f"{cores} cores, load {load:.1f}", busy)
    settings = Path("/sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")
    if governors := {path.read_text().strip() for path in settings}:
        slow = "for steady latency: sudo cpupower frequency-set -g performance" if "powersave" in governors else ""
        yield noted("processor speed", f"governor {', '.join(sorted(governors))}", slow)


def check_memory() -> Iterator[Finding]:
    file = Path("/proc/meminfo")
    if not file.exists():
        return
    lines = dict(line.split(":") for line in file.read_text().splitlines())
    free = int(lines["MemAvailable"].split()[0]) / 1e6
    fix = f"free memory: expected {NEEDED_GB:g} GB; the nodes take 0.3 GB, compiling takes more"
    yield noted("memory", f"{free:.1f} GB available", fix if free < NEEDED_GB else "")


def check_clock() -> Iterator[Finding]:
    """Stamps are of capture, so the wall clock must be set."""
    year = time.gmtime().tm_year
    yield noted("clock", f"year {year}", "set the clock: sudo timedatectl set-ntp true" if year < 2025 else "")


def check_camera() -> Iterator[Finding]:
    """OAK cameras: none is fine."""
    # its own warnings are about what is printed here, in other words
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    try:
        import depthai
    except ImportError:  # `check_packages` names the extra that installs it
        return
    devices = depthai.Device.getAllAvailableDevices()
    plugged = [file for file in Path("/sys/bus/usb/devices").glob("*/idVendor") if LUXONIS_USB in file.read_text()]
    if plugged and not devices:
        yield noted("OAK cameras", f"{len(plugged)} plugged in that cannot be opened", UDEV_RULE)
    else:
        names = ", ".join(device.getDeviceId() for device in devices)
        yield noted("OAK cameras", names or f"none; depthai {depthai.__version__} is ready for one")


def check_webcam() -> Iterator[Finding]:
    """Cameras that the system knows: none is fine."""
    cameras = sorted(DEVICES.glob("video*"))
    closed = [camera.name for camera in cameras if not os.access(camera, os.R_OK | os.W_OK)]
    if closed:
        fix = 'sudo usermod -aG video "$USER", then log out and in again'
        yield noted("webcams", f"{', '.join(closed)} may not be opened by you", fix)
    else:
        yield noted("webcams", ", ".join(camera.name for camera in cameras) or "none")


MODELS = ("mixture", "hgvae", "occlusion", "trajectory", "contacts")
FRAMES, WARM_UP = 100, 20
FRAME_NS = 1_000_000_000 / 30
TARGET_MS, BUDGET_MS = 10.0, 1000 / 30


def check_messages() -> Iterator[Finding]:
    """The directory of the ipc sockets, and a message there and back."""
    import zmq

    from steadypose.nodes.graph.topology import TransportSettings

    directory = TransportSettings().ipc_directory
    if len(os.fsencode(directory / "trajectory")) > zmq.IPC_PATH_MAX_LEN:
        fix = "set XDG_RUNTIME_DIR, or [transport] directory in the launch file, to a shorter path"
        yield Finding("messages", Verdict.BAD, f"{directory} is too long a path for sockets", fix)
        return
    try:
        make_private(directory)
        with tempfile.TemporaryDirectory(dir=directory, prefix="") as folder:
            took_ms = _round_trip(f"ipc://{folder}/s") * 1e3
    except TransportError as error:
        yield Finding("messages", Verdict.BAD, str(error))
        return
    except OSError as error:
        fix = f"sudo chown {os.getuid()} {directory}; or set [transport] directory in the launch file"
        yield Finding("messages", Verdict.BAD, f"cannot write to {directory}: {error.strerror}", fix)
        return
    yield Finding("messages", Verdict.GOOD, f"latency {took_ms:.1f} ms, sockets in {directory}")


def _round_trip(endpoint: str) -> float:
    """Seconds that a message takes from a publisher to a subscriber."""
    from steadypose.msgs.topics import POSE_RAW
    from steadypose.msgs.transport import Publisher, Subscriber

    name = "doctor"
    with Publisher(endpoint) as publisher, Subscriber(endpoint, POSE_RAW, name=name) as subscriber:
        if not publisher.wait_for_subscribers({name}, timeout_s=5.0):
            raise TimeoutError(f"no connection over {endpoint} within 5 s")
        started = time.perf_counter()
        publisher.publish(POSE_RAW, _standing(0))
        if subscriber.receive(5.0) is None:
            raise TimeoutError(f"no message over {endpoint} within 5 s")
        return time.perf_counter() - started


def check_loops() -> Iterator[Finding]:
    """The compiled loops, as the nodes load them, and where they are kept."""
    from steadypose.nodes.graph.loops import compile_missing
    from steadypose.prior import loop_cache

    lines: list[str] = []
    damaged = loop_cache.remove_damaged()
    compile_missing(lines.append)
    from steadypose.nodes.graph.trajectory_node import make_trajectory

    make_trajectory({})
    folder = loop_cache.writable()
    if folder is None or not loop_cache.is_complete():
        fix = "export XDG_CACHE_HOME=FOLDER, one that only you may write to"
        yield noted("compiled loops", " ".join(lines[-1:]), fix)
    else:
        mended = f"; {damaged} were damaged, and are compiled anew" if damaged else ""
        yield noted("compiled loops", f"in {folder}{mended}")


def check_models() -> Iterator[Finding]:
    """The weights that the nodes load, and what a frame costs with them."""
    from steadypose.prior.models.weights import load_weights

    whole = True
    for model in MODELS:
        try:
            state, _ = load_weights("default", model)
        except (OSError, ValueError, KeyError) as error:
            whole = False
            fix = f"{restored('prior/weights')}, or steadypose train {model}"
            yield Finding(f"weights of {model}", Verdict.BAD, str(error).split(". ")[0], fix)
        else:
            numbers = sum(array.size for array in state.values())
            yield Finding(f"weights of {model}", Verdict.GOOD, f"default, {numbers:,} parameters")
    if whole:
        yield _self_test()


def _self_test() -> Finding:
    """A body that stands for a hundred frames, through the prior."""
    import numpy as np

    from steadypose.nodes.graph.threads import one_thread
    from steadypose.prior.clean.pipeline import PriorPipeline
    from steadypose.prior.clean.settings import PriorSettings

    one_thread()
    pipeline = PriorPipeline(PriorSettings())
    spent_ms, bodies = [], []
    for frame in range(FRAMES):
        raw = _standing(frame)
        started = time.perf_counter()
        for clean in pipeline.process(raw):
            bodies += clean.bodies
        spent_ms.append((time.perf_counter() - started) * 1e3)
    p50, p99 = np.percentile(spent_ms[WARM_UP:], (50, 99))
    found = f"{p50:.1f} ms a frame, p99 {p99:.1f} ms; {BUDGET_MS:.0f} ms are available"
    if not bodies or not all(np.isfinite(body.positions).all() for body in bodies):
        return Finding("prior", Verdict.BAD, "returned no pose for a standing body", restored("prior"))
    if p99 > BUDGET_MS:
        return noted("prior", found, "too slow for 30 Hz at the moment: free the processor")
    slow = f"keeps up, but one frame in 100 takes more than {TARGET_MS:g} ms: see what else uses the processor"
    return noted("prior", found, slow if p99 > TARGET_MS else "")


def _standing(frame: int) -> PoseRaw:
    """A body in a T-pose, two metres in front of the world's origin, that sways a little."""
    import numpy as np

    from steadypose.msgs.types import Pose, PoseRaw, RawBody
    from steadypose.prior.body.layouts import CANONICAL
    from steadypose.prior.body.skeleton import REST_POSITIONS

    positions = REST_POSITIONS + [2.0, 0.02 * np.sin(frame / 10), 0.95]
    body = RawBody(0, positions, np.ones(len(positions)))
    stamp_ns = round(frame * FRAME_NS)
    return PoseRaw(stamp_ns, "world", "doctor", CANONICAL.name, Pose.identity(), True, [body])


def check_streams() -> Iterator[Finding]:
    """What the default launch file plays."""
    from steadypose.msgs.recording import RecordingReader
    from steadypose.nodes.graph.launch import Launch, bundled
    from steadypose.nodes.sources.recording import open_recording
    from steadypose.nodes.sources.registry import InputSettings

    try:
        open_recording(Path(Launch.read("replay").settings(InputSettings).recording).resolve())
    except (OSError, ValueError) as error:
        fix = f"{restored('sim_data launch')}, or play your own: steadypose run --input RECORDING"
        yield Finding("bundled streams", Verdict.BAD, str(error), fix)
        return
    seconds = []
    for stream in sorted({file.parent for file in bundled("sim_data").rglob("*.mcap")}):
        with RecordingReader(stream) as reader:
            seconds.append(reader.duration_s)
    yield noted("bundled streams", f"{len(seconds)} recordings, {sum(seconds):.0f} s in all")


MACHINE = (
    *(check_processor, check_memory, check_clock, check_messages, check_loops),
    *(check_models, check_streams, check_camera, check_webcam),
)
