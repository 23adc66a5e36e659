"""Plots of results: curves over delay, noise or gap, and reliability plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogFormatter, NullLocator

COLOURS = {
    "raw": "#888888",
    "hold last": "#aaaaaa",
    "linear interpolation": "#b8a04a",
    "One-Euro": "#4c78a8",
    "Kalman, constant velocity": "#72b7b2",
    "Kalman, constant acceleration": "#54a24b",
    "Kalman, a density a joint": "#17becf",
    "held in the body frame": "#d8b5a5",
    "conditional Gaussian": "#bcbd22",
    "Gaussian + Hampel": "#b279a2",
    "bank of smoothers": "#1f6f5c",
    "whole-body bank": "#0b3d91",
    "Butterworth, offline": "#9d755d",
    "SmoothNet-style": "#f58518",
    "GRU of the whole body": "#a0522d",
    "ridge regression": "#eeca3b",
    "temporal convolution": "#ff9da6",
    "HM-VAE": "#f2a5a5",
    "steadypose": "#e45756",
    "steadypose, sensor known": "#5b2a86",
}
"""Colour of each method in every plot; other methods take matplotlib's next."""


_CENTIMETRES = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # ticks of deviations, cm


def curves(
    records: Sequence[Mapping[str, Any]], x: str, panels: Mapping[str, str], label: str, title: str, log: bool = False
) -> Figure:
    """Plot a panel for each figure, with a line for each method of the records.

    ``x`` is the records' key of the horizontal axis, ``panels`` those of the vertical axes with their labels.
    """
    figure = Figure(figsize=(4.6 * len(panels) + 1.8, 3.9), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (key, text) in zip(axes, panels.items(), strict=True):
        for method in dict.fromkeys(record["method"] for record in records):
            mine = [r for r in records if r["method"] == method and r.get(x) is not None and r.get(key) is not None]
            points = sorted((r[x], r[key]) for r in mine)
            if points:
                own = method.startswith(("steadypose", "HM-VAE"))
                axis.plot(
                    *zip(*points, strict=True), label=method, color=COLOURS.get(method), marker="o", ms=4,
                    lw=2.2 if own else 1.2, zorder=3 if own else 2,
                )  # fmt: skip
        axis.set(xlabel=label, ylabel=text)
        if log:
            axis.set(xscale="log", yscale="log")
            axis.yaxis.set_major_formatter(LogFormatter())
            axis.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.5)))
            measured = sorted({r[x] for r in records if r.get(x) is not None})
            axis.set_xticks(measured, [f"{value:g}" for value in measured])
            axis.set_xticks([], minor=True)
        axis.grid(alpha=0.3, which="both")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    return figure


def reliability(bins: Mapping[str, Sequence[tuple[float, float, int]]], title: str) -> Figure:
    """Plot the error over the predicted standard deviation, both root mean squares along an axis. The diagonal is
    calibrated. ``bins`` are (predicted, observed, count) by group, metres."""
    figure = Figure(figsize=(7.0, 4.4), layout="constrained")
    axis = figure.subplots()
    values = [v * 100 for rows in bins.values() for stated, found, _ in rows for v in (stated, found)]
    span = [0.8 * min(values), 1.25 * max(values)]
    axis.plot(span, span, color="#444444", lw=1, ls="--")
    axis.fill_between(span, [0.8 * v for v in span], [1.2 * v for v in span], color="#444444", alpha=0.1, lw=0)
    for name, rows in bins.items():
        axis.plot([100 * s for s, _, _ in rows], [100 * f for _, f, _ in rows], marker="o", ms=4, label=name)
    axis.set(
        xscale="log",
        yscale="log",
        xlim=span,
        ylim=span,
        aspect="equal",
        xlabel="standard deviation, cm",
        ylabel="error, cm",
    )
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_major_locator(FixedLocator(_CENTIMETRES))
        scale.set_major_formatter("{x:g}")
        scale.set_minor_locator(NullLocator())
    axis.set_title(title, fontsize=10)
    axis.grid(alpha=0.3)
    figure.legend(loc="outside right center", fontsize=8, frameon=False)
    return figure
