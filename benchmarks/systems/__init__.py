"""Studies of the running system, one module each, as in `benchmarks.studies`. Run them on a machine without other
load."""

from __future__ import annotations

SYSTEMS = ("latency", "scale", "restart", "soak", "events", "retarget")
