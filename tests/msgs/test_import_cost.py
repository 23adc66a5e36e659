"""A subscriber needs `msgs` alone: light to import, and without torch."""

import json
import os
import subprocess
import sys
from pathlib import Path

MEASURE = """
import json, re, sys, time
import steadypose.msgs.codec, msgs.keys, msgs.recording, msgs.topics, msgs.transport, msgs.types
# not getrusage: its maximum begins with that of the process which started this one
rss_kib = int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
print(json.dumps({"modules": list(sys.modules), "cpu_s": time.process_time(), "rss_mib": rss_kib / 1024}))
"""


def test_msgs_is_light(tmp_path: Path):
    # bytecode of its own, so that the second run is the usual one wherever the tests run
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(tmp_path)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    run = [sys.executable, "-c", MEASURE]
    subprocess.run(run, env=environment, capture_output=True, check=True)
    measured = json.loads(subprocess.run(run, env=environment, capture_output=True, check=True).stdout)
    assert not {"torch", "scipy", "prior", "nodes", "asyncio"} & set(measured["modules"])
    assert measured["rss_mib"] < 100
    assert measured["cpu_s"] < 5, "0.3 s on an idle machine; the bound is 0.5 s"
