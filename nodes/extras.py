"""The optional extras: what each is for, and the modules that it brings."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from steadypose import PACKAGE
from steadypose.nodes.settings import LaunchError


@dataclass(frozen=True)
class Extra:
    """One of ``[project.optional-dependencies]`` that a user of the nodes may want."""

    purpose: str
    """what needs it"""
    modules: tuple[str, ...]
    """which it brings, by the names they are imported by"""
    size: str = ""
    """what it downloads, where that is much"""


EXTRAS: Mapping[str, Extra] = {
    "dev": Extra("the tests", ("pytest",)),
    "docs": Extra("the documentation as a site", ("mkdocs",)),
    "export": Extra("steadypose export to .glb and .vrma", ("pygltflib",)),
    "foxglove": Extra("poses live in Foxglove", ("foxglove",)),
    "mocap": Extra("reading .c3d", ("ezc3d",)),
    "oak": Extra("an OAK camera as the source, and calibrating any camera", ("depthai", "cv2")),
    "ray": Extra("steadypose clean --ray, on a cluster", ("ray",)),
    "ros2": Extra("the ROS 2 bridge, and skeletons from ROS 2 topics", ("cyclonedds",)),
    "ros2-test": Extra("the tests of ROS 2", ("rclpy",)),
    "train": Extra("steadypose train, fit and evaluate", ("torch", "roma", "sklearn"), "5 GB, torch with CUDA"),
    "retarget": Extra("steadypose retarget: motion for a robot or an avatar", ("mink", "mujoco", "daqp")),
    "vmc": Extra("avatars by the VMC protocol: steadypose run vmc", ("pythonosc",)),
    "view": Extra("the picture in the browser, and steadypose plot", ("rerun", "matplotlib")),
    "web": Extra("poses in the browser: steadypose run web", ("websockets",)),
    "webcam": Extra("a webcam as the source", ("mediapipe",)),
}
"""by the name in ``[project.optional-dependencies]``; a module that several bring stands at one of them"""


def require_extra(name: str) -> None:
    """Raises:
    LaunchError: a module of the extra is not installed.
    """
    missing = [module for module in EXTRAS[name].modules if find_spec(module) is None]
    if missing:
        raise LaunchError(how_to_install(missing, name))


def extra_of(module: str) -> str | None:
    """The extra that brings a module; None if none does."""
    return next((name for name, extra in EXTRAS.items() if module in extra.modules), None)


def how_to_install(missing: Sequence[str], extra: str) -> str:
    """What to say of modules that an extra brings and that are not installed."""
    size = f" ({EXTRAS[extra].size})" if EXTRAS[extra].size else ""
    return (
        f"needs {', '.join(missing)}, which comes with the extra {extra!r}{size} and is not installed: "
        f"{install_command(extra)}"
    )


def install_command(extra: str = "") -> str:
    """What to type to install an extra, or steadypose itself anew, where this Python looks for packages.

    The name is not on the package index yet, so it is the checkout that is named.
    """
    if (PACKAGE.parents[1] / "pyproject.toml").exists():
        checkout = str(PACKAGE.parents[1])
        if Path(sys.prefix) == Path(checkout, ".venv"):
            return f"./steadypose add {extra}" if extra else "rm -f .venv/.installed-* && ./steadypose doctor"
    else:
        checkout = "PATH/TO/CHECKOUT"
    return f"pip install '{checkout}[{extra}]'" if extra else f"pip install --upgrade --force-reinstall {checkout}"
