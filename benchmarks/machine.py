"""On what a figure was measured: without it, a time in milliseconds says nothing."""

from __future__ import annotations

import datetime
import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def describe() -> dict[str, str | int | float]:
    """CPU, cores, memory, load, versions, and the commit that was measured ("-dirty" where it is `uncommitted`)."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0,
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1),
        "load_1min": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": version("torch"),
        "numpy": version("numpy"),
        "commit": _git("rev-parse", "--short=10", "HEAD") + ("-dirty" if uncommitted() else ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }


def uncommitted() -> list[str]:
    """Files that differ from the commit, except results and documents, which do not change what is measured."""
    changed = _git("diff", "--name-only", "HEAD", "--", ".", ":!benchmarks/results", ":!docs", ":!*.md")
    return [] if changed == "unknown" else changed.split()


def _cpu() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()
