"""Clean, world-space human pose for robots and kiosks, live, from any noisy 3D skeleton source.

In the repository the rooms `msgs`, `prior`, `nodes`, `launch` and `benchmarks` stand at the top; they are installed in
here, so that nobody's own package of such a name is shadowed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from steadypose.nodes.library import clean

__all__ = ["PACKAGE", "clean"]

PACKAGE = Path(__file__).parent
"""Where this package lies, with launch files, weights and a sample stream inside."""


def __getattr__(name: str) -> Any:
    # a subscriber needs `steadypose.msgs` alone, and nothing that the library imports
    if name == "clean":
        from steadypose.nodes.library import clean

        return clean
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
