"""Shared by HG-VAE's tables: motion, names of models, and the folder of models trained for them."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from steadypose.benchmarks.bench import Bench
from steadypose.benchmarks.machine import ROOT
from steadypose.benchmarks.motion import as_set, digest
from steadypose.training.data.dataset import MotionSet

NAMES = {"default": "live", "wide-default": "wide (256 features)"}
"""Of weights, as tables have them."""


class Data:
    """Training and validation windows, of prepared motion or of the project's own people."""

    def __init__(self, bench: Bench) -> None:
        self.prepared = bench.data if bench.data.is_file() else None
        if self.prepared:
            self.train, self.val = (MotionSet.load(self.prepared, "default", s) for s in ("train", "val"))
            self.source: dict[str, Any] = {"file": self.prepared.name, "sha256": digest(self.prepared)}
        else:
            self.train, self.val = as_set(bench.training_clips()), as_set(bench.clips(90, 60))
            self.source = {"simulated people": True}
        self._kept = tempfile.TemporaryDirectory()

    def runs(self, bench: Bench) -> Path:
        """Where models trained for tables are kept; a quick run's are not."""
        if bench.quick or not self.prepared:
            return Path(self._kept.name)
        return ROOT / "runs" / f"hgvae-tables-{self.source['sha256']}"
