"""One thread for a process whose products are small."""

from __future__ import annotations

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path

import scipy
from threadpoolctl import threadpool_limits

_USED = ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack")
"""what numba's linear algebra calls"""


def one_thread() -> None:
    """Keep the BLAS of numpy and scipy, and of torch where it is loaded, to the calling thread, from now on.

    Two threads that share the cores with other nodes wait for each other: eight bodies take a prior twice as long, and
    three times as much of the processors.
    """
    threadpool_limits(1)


def _load(name: str) -> None:
    """Load a module of scipy that compiled loops call, and nothing else: all of ``linalg`` takes 12 MB and 0.5 s."""
    spec = PathFinder.find_spec(name, [str(Path(path, "linalg")) for path in scipy.__path__])
    if spec is None or spec.loader is None:
        raise ImportError(f"this scipy ({scipy.__version__}) has no {name}", name=name)
    sys.modules[name] = module = module_from_spec(spec)
    spec.loader.exec_module(module)


for _name in _USED:
    if _name not in sys.modules:
        _load(_name)  # as this is imported, before any loop: numba would load all of it, and `one_thread` comes after
