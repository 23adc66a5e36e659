"""The optional extras: the purpose of each, and the modules that it installs."""

import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from steadypose import PACKAGE
from steadypose.nodes.settings import LaunchError


class Extra(NamedTuple):
    """One entry of ``[project.optional-dependencies]``: what needs it, import names of its modules, size if large."""

    purpose: str
    modules: tuple[str, ...]
    size: str = ""


EXTRAS: Mapping[str, Extra] = {
    "dev": Extra("the tests", ("pytest",)),
    "docs": Extra("building the documentation site", ("mkdocs",)),
    "export": Extra("steadypose export to .glb and .vrma", ("pygltflib",)),
    "foxglove": Extra("live poses in Foxglove", ("foxglove",)),
    "mocap": Extra("reading .c3d", ("ezc3d",)),
    "oak": Extra("OAK cameras, and calibration of any camera", ("depthai", "cv2")),
    "ray": Extra("steadypose clean --ray, on a Ray cluster", ("ray",)),
    "ros2": Extra("the ROS 2 bridge, and skeletons from ROS 2 topics", ("cyclonedds",)),
    "ros2-test": Extra("the tests of ROS 2", ("rclpy",)),
    "train": Extra("steadypose train, fit and evaluate", ("torch", "roma", "sklearn"), "5 GB, torch with CUDA"),
    "retarget": Extra("steadypose retarget", ("mink", "mujoco", "daqp")),
    "vmc": Extra("avatars over VMC: steadypose run vmc", ("pythonosc",)),
    "view": Extra("the 3D view (run --view) and steadypose plot", ("rerun", "matplotlib")),
    "web": Extra("poses in your own web page: steadypose run web", ("websockets",)),
    "webcam": Extra("webcams and videos", ("mediapipe",)),
}
"""Extras by their name in ``[project.optional-dependencies]``. A module that several install is listed at one."""


def require_extra(name: str) -> None:
    """Check that an extra is installed. Raises LaunchError if a module of the extra is not installed."""
    missing = [module for module in EXTRAS[name].modules if find_spec(module) is None]
    if missing:
        raise LaunchError(how_to_install(missing, name))


def extra_of(module: str) -> str | None:
    """The extra that installs a module; None if none does."""
    return next((name for name, extra in EXTRAS.items() if module in extra.modules), None)


def how_to_install(missing: Sequence[str], extra: str) -> str:
    """The error text for missing modules of an extra."""
    size = f" ({EXTRAS[extra].size})" if EXTRAS[extra].size else ""
    needs = f"needs {', '.join(missing)}, which comes with the extra {extra!r}{size} and is not installed"
    return f"{needs}: {install_command(extra)}"


def upgrade_and_uninstall() -> str:
    """How to upgrade and remove this installation (docs/library.md has all cases)."""
    checkout = _checkout()
    if checkout is not None and _is_its_own(checkout):
        upgrade, uninstall = f"git -C {checkout} pull; the next call installs what changed", f"delete {checkout}"
    else:
        place = checkout or "PATH/TO/CHECKOUT"
        upgrade = f"git -C {place} pull, then pip install --upgrade {place}"
        uninstall = "pip uninstall steadypose"
    return (
        f"upgrade:   {upgrade}\n"
        f"uninstall: {uninstall}; before that, if you installed a service,\n"
        "           sudo steadypose install-service --uninstall\n\n"
        "Outside the working folder and the paths that you name, steadypose writes only\n"
        "compiled code, beside the package or to ~/.cache, and files beside its sockets.\n"
        "CHANGELOG.md in the checkout says what has changed."
    )


def _checkout() -> Path | None:
    """The checkout that this package lies in; None if it was copied into an environment."""
    root = PACKAGE.parents[1]
    return root if (root / "pyproject.toml").exists() else None


def _is_its_own(checkout: Path) -> bool:
    """Whether this Python is that of the checkout's own `.venv`, which `./steadypose` makes."""
    return Path(sys.prefix) == checkout / ".venv"


def install_command(extra: str = "") -> str:
    """The command that installs an extra, or reinstalls steadypose, for this Python, from the checkout."""
    checkout = _checkout()
    if checkout is not None and _is_its_own(checkout):
        return f"./steadypose add {extra}" if extra else "rm -f .venv/.installed-* && ./steadypose doctor"
    checkout = checkout or "PATH/TO/CHECKOUT"
    return f"pip install '{checkout}[{extra}]'" if extra else f"pip install --upgrade --force-reinstall {checkout}"
