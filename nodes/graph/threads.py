"""Single-threaded BLAS for a process whose matrices are small."""

import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path

import scipy
from threadpoolctl import threadpool_limits

_USED = ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack")
"""Modules of scipy that numba's linear algebra calls."""


def one_thread() -> None:
    """Limit the BLAS of numpy and scipy, and of torch if it is loaded, to one thread.

    Two threads that share the cores with other nodes wait for each other: the prior then takes twice the time for eight
    bodies, and three times the processor time.
    """
    threadpool_limits(1)


def _load(name: str) -> None:
    """Load one module of ``scipy.linalg`` alone, because importing the whole package takes 12 MB and 0.5 s."""
    spec = PathFinder.find_spec(name, [str(Path(path, "linalg")) for path in scipy.__path__])
    if spec is None or spec.loader is None:
        raise ImportError(f"this scipy ({scipy.__version__}) has no {name}", name=name)
    sys.modules[name] = module = module_from_spec(spec)
    spec.loader.exec_module(module)


for _name in _USED:
    if _name not in sys.modules:
        # at import, because the loops are loaded before `one_thread` is called, and numba would import all of linalg
        _load(_name)
