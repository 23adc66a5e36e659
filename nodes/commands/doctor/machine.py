"""The machine: processor, memory, clock, cameras."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

from steadypose.nodes.commands.doctor.finding import Finding, Verdict

NEEDED_GB, LUXONIS_USB = 1.0, "03e7"
UDEV_RULE = (
    f"""echo 'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{LUXONIS_USB}", MODE="0666"' | """
    "sudo tee /etc/udev/rules.d/80-movidius.rules && sudo udevadm control --reload-rules && sudo udevadm trigger"
)

DEVICES = Path("/dev")
VIDEO_GROUP = 'sudo usermod -aG video "$USER", then log out and in again'


def check_processor() -> Iterator[Finding]:
    """Cores that are free, and whether they run at full speed."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    busy = load > max(cores - 1, 0.5)
    yield Finding(
        "processor",
        Verdict.NOTE if busy else Verdict.GOOD,
        f"{cores} cores, load {load:.1f}",
        "stop what else is running: frames will be late. `top` shows what it is" if busy else "",
    )
    settings = Path("/sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")
    governors = {path.read_text().strip() for path in settings}
    if governors:
        slow = "powersave" in governors
        yield Finding(
            "processor speed",
            Verdict.NOTE if slow else Verdict.GOOD,
            f"governor {', '.join(sorted(governors))}",
            "for steady latency: sudo cpupower frequency-set -g performance" if slow else "",
        )


def check_memory() -> Iterator[Finding]:
    file = Path("/proc/meminfo")
    if not file.exists():
        return
    lines = dict(line.split(":") for line in file.read_text().splitlines())
    free = int(lines["MemAvailable"].split()[0]) / 1e6
    short = free < NEEDED_GB
    fix = f"free some: the nodes take about {NEEDED_GB:g} GB" if short else ""
    yield Finding("memory", Verdict.NOTE if short else Verdict.GOOD, f"{free:.1f} GB available", fix)


def check_clock() -> Iterator[Finding]:
    """Stamps are of capture, so the wall clock must be set, and intervals need a fine monotonic clock."""
    clock = time.get_clock_info("monotonic")
    coarse = clock.resolution > 1e-3
    year = time.gmtime().tm_year
    found = f"monotonic to {clock.resolution * 1e9:.0f} ns, the year is {year}"
    fix = "set the clock: sudo timedatectl set-ntp true" if year < 2025 else ""
    yield Finding("clock", Verdict.NOTE if coarse or fix else Verdict.GOOD, found, fix)


def check_camera() -> Iterator[Finding]:
    """OAK cameras: none is fine."""
    # its own warnings are about what is said here better
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    try:
        import depthai
    except ImportError:  # the extra that brings it is told of above
        return
    devices = depthai.Device.getAllAvailableDevices()
    plugged = [file for file in Path("/sys/bus/usb/devices").glob("*/idVendor") if _reads(file, LUXONIS_USB)]
    if devices:
        names = ", ".join(device.getDeviceId() for device in devices)
        yield Finding("OAK cameras", Verdict.GOOD, names)
    elif plugged:
        yield Finding("OAK cameras", Verdict.NOTE, f"{len(plugged)} plugged in that cannot be opened", UDEV_RULE)
    else:
        yield Finding("OAK cameras", Verdict.GOOD, f"none; depthai {depthai.__version__} is ready for one")


def check_webcam() -> Iterator[Finding]:
    """Cameras that the system knows: none is fine."""
    cameras = sorted(DEVICES.glob("video*"))
    closed = [camera.name for camera in cameras if not os.access(camera, os.R_OK | os.W_OK)]
    if closed:
        yield Finding("webcams", Verdict.NOTE, f"{', '.join(closed)} may not be used by you", VIDEO_GROUP)
    else:
        yield Finding("webcams", Verdict.GOOD, ", ".join(camera.name for camera in cameras) or "none")


def _reads(file: Path, text: str) -> bool:
    try:
        return file.read_text().strip() == text
    except OSError:
        return False
