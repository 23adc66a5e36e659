"""Studies of the running system, one module each, as in `benchmarks.studies`. Run them on a machine without other
load."""

from __future__ import annotations

SYSTEMS: dict[str, str] = {
    "latency": "computing time a frame, time from capture to pose/world, frames dropped",
    "scale": "streams a core of a server, recordings cleaned an hour",
    "restart": "seconds without poses at the start and after a kill",
    "soak": "faults into nodes at work for an hour, and what became of each frame",
    "events": "events of simulated people",
    "retarget": "computing time, joint limits and standing feet of a robot that follows a person",
}
"""Description of what each module of this package measures."""
