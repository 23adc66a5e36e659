"""The compiler of the loops: numba's, with the cache of `loop_cache`; and what loops use in place of numpy's functions,
of which numba compiles every case for seconds."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.environment import Environment
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from steadypose.prior import loop_cache


class _LoopCache(_Cache):
    """Where a dispatcher of numba looks for what it has compiled."""

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher

    def load_overload(  # pyright: ignore[reportIncompatibleMethodOverride]  (numba's own gives one too)
        self, sig: Any, target_context: Any
    ) -> CompileResult | None:
        rtsys.initialize(target_context)  # not all that a compiler needs, which takes half a second
        key = self._key(sig, target_context.codegen())
        payload = loop_cache.load(self._name(key), key)
        if payload is None:
            loop_cache.announce()
            return None
        return CompileResult._rebuild(target_context, *payload)

    def save_overload(self, sig: Any, data: Any) -> None:
        if not data.library.has_dynamic_globals:  # addresses of this process
            key = self._key(sig, data.codegen)
            *parts, environments = data._reduce()
            kept = (*parts, tuple(map(_without_globals, environments)))
            loop_cache.save(self._name(key), dumps((key, kept)))

    @property
    def cache_path(self) -> Any:
        return str(loop_cache.writable())

    def enable(self) -> None: ...

    def disable(self) -> None: ...

    def flush(self) -> None: ...

    def _key(self, sig: Any, codegen: Any) -> tuple[object, ...]:
        return loop_cache.digest(self._dispatcher), sig, codegen.magic_tuple()

    def _name(self, key: tuple[object, ...]) -> str:
        return f"{self._dispatcher.__name__}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}"


def _without_globals(environment: Environment) -> Environment:
    """What a loop needs of a function that it calls: not its module, of which the compiler's take 0.3 s to import."""
    kept = Environment({"__name__": "numba"})
    kept.consts[:], kept.env_name = environment.consts, environment.env_name
    return kept


def njit(*signature: str, cache: bool, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit`` with a cache that a power failure, another version or a read-only disk does not stop.

    A division by zero is infinite or NaN, as numpy has it: a test and an exception at each division take a tenth of
    the time of compiling.

    Args:
        signature: of the arguments, to compile as the module is imported; none: at the first call.
        cache: as numba has it; always true.
        options: numba's.
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
    """The median of a few values (N,), N at least 1: by insertion, which leaves ``values`` as they are."""
    count = len(values)
    ordered = np.empty(count)
    for k in range(count):
        place = k
        while place > 0 and ordered[place - 1] > values[k]:
            ordered[place] = ordered[place - 1]
            place -= 1
        ordered[place] = values[k]
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
