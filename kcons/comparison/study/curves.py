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
    """

    curves: Sequence[Curve]
    xlabel: str = ""
    ylabel: str = ""
    title: str = ""
    notes: tuple[str, str] = ("", "")
    plain: str = ""
    grid: Mapping[str, Any] = field(default_factory=lambda: {"alpha": 0.3})
    legend: str = ""


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
    handles, labels = grid.flat[-1].get_legend_handles_labels()
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


def say(axes: Axes, words: str) -> None:
    """Words in the middle of a panel that has nothing else."""
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center")
