"""The compiler of loops: numba's, with the cache of `loop_cache`; and a median for loops.

Loops use this median, because numba takes seconds to compile numpy's with all its cases.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.environment import Environment
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from steadypose.prior import loop_cache


class _LoopCache(NullCache):
    """The cache in which a numba dispatcher looks for compiled code."""

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher

    def load_overload(  # pyright: ignore[reportIncompatibleMethodOverride]  (numba's own gives one too)
        self, sig: Any, target_context: Any
    ) -> CompileResult | None:
        rtsys.initialize(target_context)  # only this part: initialising the whole compiler takes half a second
        key = self._key(sig, target_context.codegen())
        payload = loop_cache.load(self._name(key), key)
        if payload is None:
            loop_cache.announce()
            return None
        return CompileResult._rebuild(target_context, *payload)

    def save_overload(self, sig: Any, cres: Any) -> None:
        if not cres.library.has_dynamic_globals:  # such code contains addresses of this process
            key = self._key(sig, cres.codegen)
            *parts, environments = cres._reduce()
            kept = (*parts, tuple(map(_without_globals, environments)))
            loop_cache.save(self._name(key), dumps((key, kept)))

    def _key(self, sig: Any, codegen: Any) -> tuple[object, ...]:
        return loop_cache.digest(self._dispatcher), sig, codegen.magic_tuple()

    def _name(self, key: tuple[object, ...]) -> str:
        return f"{self._dispatcher.__name__}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"


def _without_globals(environment: Environment) -> Environment:
    """Return a function's environment without its module: importing the compiler's modules takes 0.3 s."""
    kept = Environment({"__name__": "numba"})
    kept.consts[:], kept.env_name = environment.consts, environment.env_name
    return kept


def njit(*signature: str, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with a cache that survives power failures, version changes and read-only disks.

    Division by zero gives infinity or NaN, as in numpy. Tests and exceptions at each division would take a tenth of the
    compile time.

    Args:
        signature: types of the arguments, to compile on import; if omitted, compile at the first call.
        cache: numba's option; always true.
        options: numba's options.
    """
    assert cache, "a loop that is not kept would be compiled at every start"

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(error_model="numpy", **options)(function)
        if not hasattr(dispatcher, "py_func"):  # NUMBA_DISABLE_JIT
            return dispatcher
        dispatcher._cache = _LoopCache(dispatcher)  # pyright: ignore[reportAttributeAccessIssue]
        for one in signature:
            dispatcher.compile(one)
            dispatcher.disable_compile()
        return dispatcher

    return decorate


@njit(cache=True)
def median(values):
    """Return the median of a few values (N,), at least one, by insertion sort; does not change ``values``."""
    count = len(values)
    ordered = np.empty(count)
    for k in range(count):
        place = k
        while place > 0 and ordered[place - 1] > values[k]:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = values[k]
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
