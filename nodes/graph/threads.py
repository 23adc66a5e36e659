"""One thread for a process whose products are small."""

from __future__ import annotations

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path

import scipy
from threadpoolctl import threadpool_limits

_BLAS = "scipy.linalg.cython_blas"


def one_thread() -> None:
    """Keep the BLAS of numpy and scipy, and of torch where it is loaded, to the calling thread, from now on.

    Two threads that share the cores with other nodes wait for each other: eight bodies take a prior twice as long, and
    three times as much of the processors.
    """
    threadpool_limits(1)


def _load_blas() -> None:
    """Load the BLAS that compiled loops call, and of scipy nothing else: the rest of its ``linalg`` takes 12 MB."""
    spec = PathFinder.find_spec(_BLAS, [str(Path(path, "linalg")) for path in scipy.__path__])
    if spec is None or spec.loader is None:
        raise ImportError(f"this scipy ({scipy.__version__}) has no {_BLAS}", name=_BLAS)
    sys.modules[_BLAS] = module = module_from_spec(spec)
    spec.loader.exec_module(module)


if _BLAS not in sys.modules:
    _load_blas()  # as this is imported, before any loop: numba would load all of it, and `one_thread` comes after
