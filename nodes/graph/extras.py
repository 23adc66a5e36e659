"""The optional extras: what each is for, and the modules that it brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from steadypose.nodes.graph.settings import LaunchError


@dataclass(frozen=True)
class Extra:
    """One of ``[project.optional-dependencies]`` that a user of the nodes may want."""

    purpose: str
    """what needs it"""
    modules: tuple[str, ...]
    """which it brings, by the names they are imported by"""


EXTRAS: Mapping[str, Extra] = {
    "dev": Extra("the tests", ("pytest",)),
    "foxglove": Extra("poses live in Foxglove", ("foxglove",)),
    "oak": Extra("an OAK camera as the source, and calibrating any camera", ("depthai", "cv2")),
    "ray": Extra("steadypose clean --ray, on a cluster", ("ray",)),
    "ros2": Extra("the ROS 2 bridge, and skeletons from ROS 2 topics", ("cyclonedds",)),
    "ros2-test": Extra("the tests of ROS 2", ("rclpy",)),
    "train": Extra("steadypose train, fit and evaluate", ("torch", "roma", "sklearn")),
    "view": Extra("the picture in the browser, and steadypose plot", ("rerun", "matplotlib")),
    "webcam": Extra("a webcam as the source", ("mediapipe",)),
}
"""by the name in ``[project.optional-dependencies]``; a module that several bring stands at one of them"""


def require_extra(name: str) -> None:
    """Raises:
    LaunchError: a module of the extra is not installed.
    """
    missing = [module for module in EXTRAS[name].modules if find_spec(module) is None]
    if missing:
        raise LaunchError(f"{EXTRAS[name].purpose}: {how_to_install(missing, name)}")


def extra_of(module: str) -> str | None:
    """The extra that brings a module; None if none does."""
    return next((name for name, extra in EXTRAS.items() if module in extra.modules), None)


def how_to_install(missing: Sequence[str], extra: str) -> str:
    """What to say of modules that an extra brings and that are not installed."""
    return (
        f"needs {', '.join(missing)}, which comes with the extra {extra!r} and is not installed: "
        f"`pip install 'steadypose[{extra}]'`, or in the checkout `.uv/bin/uv sync --frozen --inexact --extra {extra}`"
    )
