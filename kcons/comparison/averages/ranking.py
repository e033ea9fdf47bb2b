"""Which thermostat? Of those whose configurations have the right temperature, the one that knows it soonest."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from kcons.comparison.progress import duration
from kcons.comparison.report import columns

if TYPE_CHECKING:
    from kcons.comparison.averages.sampling import SamplingComparison

#: Deviation of the temperature, as a fraction, that is right enough; a deviation counts with twice its standard error.
RIGHT = 0.01
#: Times to a goal follow from correlation times, which are known to a third.
SAME = 1 / 3


def text(comparison: SamplingComparison) -> str:
    """A sentence and the ranking; '' where nothing can be ranked."""
    unit = comparison.scene["units"]["time"]
    rows = pd.DataFrame(
        {
            "title": m.title,
            "at": f"{m.setting:.4g} {unit}",
            "off": abs(m.temperature_error) + 2 * (m.temperature_standard_error or 0.0),
            "seconds": m.seconds_to_goal,
        }
        for m in comparison.measurements
        if m.status == "ok" and m.temperature_error is not None and m.seconds_to_goal
    )
    if not len(rows):
        return ""
    goal = "the temperature of the configurations"
    right = rows[rows.off <= RIGHT].sort_values("seconds").drop_duplicates("title")
    other = rows[~rows.title.isin(right.title)].sort_values("off").drop_duplicates("title")
    if len(right):
        first = right.iloc[0]
        words = (
            f"Use {first.title} at {first['at']}: {goal} is right within {RIGHT:.0%} (deviation plus two standard "
            f"errors), and known to 1 % after {duration(first.seconds)}, the least time"
        )
        ties = right.iloc[1:][right.iloc[1:].seconds <= first.seconds * (1 + SAME)]
        words += f"; as soon within what such times are known to: {', '.join(ties.title)}." if len(ties) else "."
    else:
        words = (
            f"No thermostat has {goal} right within {RIGHT:.0%} (deviation plus two standard errors): the least is "
            f"{other.iloc[0].off:.2g}, by {other.iloc[0].title} at {other.iloc[0]['at']}. Longer runs (--budget) make "
            "errors smaller."
        )
    shown = pd.concat([right, other])
    cells = {
        "thermostat": shown.title,
        "at": shown["at"],
        "off by": [f"{off:.1%}" for off in shown.off],
        "time to 1 %": [duration(seconds) for seconds in shown.seconds],
    }
    return f"{words}\n\n{columns(pd.DataFrame(cells), left=('thermostat',))}"
