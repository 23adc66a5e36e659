"""A subscriber needs `steadypose.msgs` alone: light to import, of few packages, and without torch."""

import json
import os
import subprocess
import sys
from pathlib import Path

MEASURE = """
import json, re, sys, time
before = set(sys.modules)
from steadypose.msgs import codec, security, topics, transport, types
subscriber = sorted(set(sys.modules) - before)
from steadypose.msgs import recording
# not getrusage: its maximum begins with that of the process which started this one
rss_kib = int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
modules = sorted(set(sys.modules) - before)
print(json.dumps({"subscriber": subscriber, "all": modules, "cpu_s": time.process_time(), "rss_mib": rss_kib / 1024}))
"""


def packages(modules: list[str]) -> set[str]:
    """Of all these, those that something was installed for."""
    return {name.partition(".")[0] for name in modules} - set(sys.stdlib_module_names) - {"cython_runtime"}


def test_msgs_is_light(tmp_path: Path) -> None:
    # bytecode of its own, so that the second run is the usual one wherever the tests run
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    run = [sys.executable, "-c", MEASURE]
    subprocess.run(run, env=environment, capture_output=True, check=True)
    measured = json.loads(subprocess.run(run, env=environment, capture_output=True, check=True).stdout)
    public = {name for name in packages(measured["subscriber"]) if not name.startswith("_")}
    assert public == {"steadypose", "numpy", "rosbags", "zmq"}
    assert packages(measured["all"]) >= {"mcap"}
    ours = {name for name in measured["all"] if name.startswith("steadypose.")}
    assert all(name.startswith("steadypose.msgs") for name in ours)
    assert not {"torch", "scipy", "numba", "asyncio"} & set(measured["all"])
    assert measured["rss_mib"] < 100
    assert measured["cpu_s"] < 5, "0.3 s on an idle machine; the bound is 0.5 s"
