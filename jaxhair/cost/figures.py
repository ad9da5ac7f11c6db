"""What the parts of a step cost, as bars."""

import os
from typing import Any

from jaxhair.cost import table
from jaxhair.cost.measuring import Part, PhaseCost, SceneCost
from jaxhair.cost.parts import ELASTICITY, ITSELF, REST_SHAPE
from jaxhair.extras import optional
from jaxhair.figures import figure
from jaxhair.output import new_file

COLORS = {"effect": "#1f6f8b", "step without effects": "#9aa5b1", "shared or rounding": "#dd9b30"}
CUT, FAR_LONGER = 1.25, 5.0
"""A bar that is far longer than all others ends at `CUT` times the longest of them."""


def bars(
    path: str | os.PathLike[str], cost: SceneCost, *, name: str = "", overwrite: bool = False
) -> None:
    """Write time and operations of every part of every phase as a .png file.

    Arguments:
        name: of the scene, for the title.
    """
    rows = [len(phase.parts) + 1 for phase in cost.phases]
    height = 1.3 + sum(0.34 * n + 1.25 for n in rows)
    drawing, _ = figure(13, height, dpi=100, layout="constrained")
    title = f"What a step costs: {name}, " if name else "What a step costs: "
    drawing.suptitle(
        f"{title}{cost.times_real_time:.3g} times real time\n{table.title(cost)}",
        fontsize=14,
        fontweight="bold",
    )
    panels = drawing.subplots(len(rows), 2, squeeze=False, height_ratios=[n + 2 for n in rows])
    drawing.get_layout_engine().set(hspace=0.06, wspace=0.04)
    for (times, counts), phase in zip(panels, cost.phases, strict=True):
        parts = (*phase.parts, table.shared(phase))
        noise = 1e6 * phase.noise
        times.axvspan(-noise, noise, color="0.9", zorder=0)
        _panel(times, parts, [1e6 * part.seconds for part in parts])
        _panel(counts, parts, [part.operations / 1e3 for part in parts])
        counts.set_yticklabels([])
        names = ", ".join(phase.phases)
        times.set_title(f"{names}: {_whole(phase)}", loc="left", fontsize=12)
        counts.set_title(
            f"{phase.whole.operations / 1e6:,.3g} million operations", loc="left", fontsize=12
        )
    panels[-1][0].set_xlabel("time that a part adds to a step [us]; grey band: noise", fontsize=11)
    panels[-1][1].set_xlabel("floating-point operations [thousand]", fontsize=11)
    boxes = [
        optional("matplotlib.patches").Patch(color=c, label=what) for what, c in COLORS.items()
    ]
    drawing.legend(handles=boxes, loc="outside lower center", ncols=3, frameon=False, fontsize=11)
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)


def _whole(phase: PhaseCost) -> str:
    whole = f"{1e6 * phase.whole.seconds:,.0f} us"
    return whole + (f", {1e6 * phase.rest:,.0f} without {phase.first}" if phase.first else "")


def _panel(axes: Any, parts: tuple[Part, ...], values: list[float]) -> None:
    """Horizontal bars with their numbers; one that is far longer than all others is cut off."""
    *_, second, longest = sorted(abs(value) for value in values)
    end = max(CUT * second if longest > FAR_LONGER * second > 0 else longest, 1e-9)
    places = range(len(values))
    axes.barh(places, [min(v, end) for v in values], color=[_color(p) for p in parts], height=0.7)
    for place, value in zip(places, values, strict=True):
        number = f"{value:,.1f}" if abs(value) < 100 else f"{value:,.0f}"
        at = max(0.0, min(value, end)) + 0.012 * end
        cut = value > end
        axes.text(at, place, number, va="center", fontsize=11, weight="bold" if cut else "normal")
        for gap in (0.9, 0.93) if cut else ():
            ends = [(gap - 0.01) * end, (gap + 0.01) * end]
            axes.plot(ends, [place + 0.45, place - 0.45], color="white", linewidth=3)
    axes.axvline(0, color="0.3", linewidth=1)
    axes.set_yticks(places, [part.name for part in parts], fontsize=11)
    axes.set_ylim(len(values) - 0.4, -0.6)
    axes.set_xlim(min(0.0, *values) - 0.03 * end, 1.16 * end)
    axes.grid(axis="x", color="0.92")
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.tick_params(axis="y", length=0)


def _color(part: Part) -> str:
    if part.name in (ITSELF, REST_SHAPE, ELASTICITY):
        return COLORS["step without effects"]
    return COLORS.get(part.name, COLORS["effect"])
