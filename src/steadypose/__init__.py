"""Clean, world-space human pose for robots and kiosks, live, from any noisy 3D skeleton source.

For arrays, use `clean`, `complete`, `fit` and `plot`. For single frames, live, use `Filter`. For messages, use
`Publisher` and `Subscriber`. `sample` gives data to try them with.
"""

# the folders beside this file link to those at the top of the repository; they are installed inside this package, so
# that they shadow nobody's own `msgs` or `launch`

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from steadypose.msgs.transport import Publisher, Subscriber
    from steadypose.msgs.types import (
        CONTACTS,
        JOINTS,
        CleanBody,
        Diagnostics,
        EventKind,
        Hand,
        JointState,
        Phase,
        Pose,
        PoseClean,
        PoseRaw,
        PoseWorld,
        RawBody,
        Tracking,
        WorldBody,
    )
    from steadypose.nodes.library.arrays import InputWarning, clean, complete, fit, plot
    from steadypose.nodes.library.filter import Filter
    from steadypose.nodes.library.poses import Poses, sample
    from steadypose.prior.body.layouts import SKELETONS

    __version__: str

__all__ = [
    "CONTACTS",
    "JOINTS",
    "PACKAGE",
    "SKELETONS",
    "CleanBody",
    "Diagnostics",
    "EventKind",
    "Filter",
    "Hand",
    "InputWarning",
    "JointState",
    "Phase",
    "Pose",
    "PoseClean",
    "PoseRaw",
    "PoseWorld",
    "Poses",
    "Publisher",
    "RawBody",
    "Subscriber",
    "Tracking",
    "WorldBody",
    "__version__",
    "clean",
    "complete",
    "fit",
    "plot",
    "sample",
]

PACKAGE = Path(__file__).parent
"""Folder of this package, which contains launch files, weights and a sample stream."""

_MESSAGES = (
    *("CONTACTS", "JOINTS", "CleanBody", "Diagnostics", "EventKind", "Hand", "JointState", "Phase", "Pose"),
    *("PoseClean", "PoseRaw", "PoseWorld", "RawBody", "Tracking", "WorldBody"),
)
_MODULES = {
    **dict.fromkeys(_MESSAGES, "msgs.types"),
    **dict.fromkeys(("Publisher", "Subscriber"), "msgs.transport"),
    **dict.fromkeys(("InputWarning", "clean", "complete", "fit", "plot"), "nodes.library.arrays"),
    "Filter": "nodes.library.filter",
    **dict.fromkeys(("Poses", "sample"), "nodes.library.poses"),
    "SKELETONS": "prior.body.layouts",
}
"""Module of each public name."""


def __getattr__(name: str) -> Any:
    # a subscriber needs `steadypose.msgs` alone, and nothing that the library imports
    if name == "__version__":
        from importlib.metadata import version

        return version("steadypose")
    if name in _MODULES:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    from steadypose.prior.settings import nearest

    hint = nearest(name, __all__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}{hint}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
