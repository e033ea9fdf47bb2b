"""Curves, and what draws them: panels side by side, axes logarithmic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Curve:
    """Points, and the line through them.

    Attributes
    ----------
    x, y : sequence of float
    label : str
        For the legend; '' for none.
    style : mapping
        As matplotlib's `plot` takes it.
    along : {'', 'x', 'y'}
        Where one coordinate is a part of the panel, from 0 to 1, the axis that the other belongs to.
    """

    x: Sequence[float]
    y: Sequence[float]
    label: str = ""
    style: Mapping[str, Any] = field(default_factory=dict)
    along: Literal["", "x", "y"] = ""


@dataclass(frozen=True)
class Panel:
    """Curves with axes.

    Attributes
    ----------
    curves : sequence of Curve
    xlabel, ylabel : str
    title : str
    notes : tuple of str
        Small, above the panel, to the left and to the right.
    plain : sequence of 'x' and 'y'
        Axes with numbers written out, such as 20 and 50, beside powers of ten.
    grid : mapping
        As matplotlib's `grid` takes it.
    legend : str
        Size of letters of a legend inside of the panel; '' for none.
    direct : bool
        Names beside the panel at the heights of the last points of curves, in their colours; not in a legend. Curves
        of which no coordinate is `along` an edge and which have a line are named.
    """

    curves: Sequence[Curve]
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    notes: tuple[str, str] = ("", "")
    plain: str = ""
    grid: Mapping[str, Any] = field(default_factory=lambda: {"alpha": 0.3})
    legend: str = ""
    direct: bool = False


def draw(
    panels: Sequence[Sequence[Panel]],
    size: tuple[float, float],
    *,
    title: str = "",
    same_y: bool = False,
    legend: int = 0,
) -> Figure:
    """A figure of panels.

    Parameters
    ----------
    panels : sequence of sequence of Panel
        Row by row.
    size : tuple of float
        Inches.
    title : str
    same_y : bool
        Whether panels share their vertical axes.
    legend : int
        Columns of a legend below, with the curves of the last panel; 0 for none.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(panels), len(panels[0]), sharey=same_y, squeeze=False)
    for axes, panel in zip(grid.flat, (panel for row in panels for panel in row), strict=True):
        _fill(axes, panel)
    last = panels[-1][-1]
    named = {curve.label for curve in last.curves if last.direct and _is_line(curve)}
    handles, labels = grid.flat[-1].get_legend_handles_labels()
    kept = [k for k, label in enumerate(labels) if label not in named]
    handles, labels = [handles[k] for k in kept], [labels[k] for k in kept]
    if legend and handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=legend, fontsize=8)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def _fill(axes: Axes, panel: Panel) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    places = {"": axes.transData, "x": axes.get_xaxis_transform(), "y": axes.get_yaxis_transform()}
    for curve in panel.curves:
        given: dict[str, Any] = {"transform": places[curve.along]} if curve.along else {}
        axes.plot(curve.x, curve.y, label=curve.label or None, **given, **curve.style)
    axes.set(xscale="log", yscale="log", xlabel=panel.xlabel, ylabel=panel.ylabel)
    for name in panel.plain:
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 2e3 * low else (1.0,)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, **panel.grid)
    if panel.title:
        axes.set_title(panel.title)
    left, right = panel.notes
    if left:
        axes.set_title(left, fontsize=8, loc="left")
    if right:
        axes.set_title(right, fontsize=8, loc="right")
    if panel.legend and panel.curves:
        axes.legend(fontsize=panel.legend)
    if panel.direct:
        _name_directly(axes, [curve for curve in panel.curves if _is_line(curve)])


def _is_line(curve: Curve) -> bool:
    return bool(curve.label) and not curve.along and curve.style.get("zorder") != 0


def _name_directly(axes: Axes, curves: Sequence[Curve], least: float = 0.062) -> None:
    """Names to the right of a panel, as near to the heights of the last points as they do not cover each other."""
    if not curves:
        return
    axes.autoscale_view()
    to_panel = axes.transData + axes.transAxes.inverted()
    ends = [to_panel.transform((curve.x[-1], curve.y[-1])) for curve in curves]
    order = sorted(range(len(curves)), key=lambda k: ends[k][1])
    height = -least / 2
    heights = {}
    for k in order:
        height = max(height + least, float(ends[k][1]))
        heights[k] = height
    beyond = max(0.0, height - 1.0)
    for place, k in enumerate(order):
        at = max(heights[k] - beyond, place * least)
        colour = curves[k].style.get("color", "black")
        look = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "alpha": 0.5, "shrinkA": 0, "shrinkB": 3}
        axes.annotate(
            curves[k].label, tuple(ends[k]), (1.03, at), "axes fraction", "axes fraction", color=colour, fontsize=8,
            va="center", arrowprops=look,
        )  # fmt: skip


def say(axes: Axes, words: str) -> None:
    """Words in the middle of a panel that has nothing else."""
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center")
