"""Work-precision diagrams and the stretch of a hanging strand, as pictures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxhair.accuracy.grid import expression
from jaxhair.accuracy.measuring import Cost, Row
from jaxhair.accuracy.problem import Problem, Reference
from jaxhair.accuracy.stretch import Stretch
from jaxhair.accuracy.table import pareto
from jaxhair.extras import optional
from jaxhair.figures import figure
from jaxhair.output import new_file

COLORS = {"PositionBased": "#d1495b", "Compliant": "#dd9b30", "Direct": "#1f6f8b"}
NAMES = {"PositionBased": "PositionBased (paper)", "Compliant": "Compliant (XPBD)"}
MARKERS = {
    "base": "o",
    "iterations": "^",
    "Newton steps": "*",
    "substeps": "s",
    "time step": "v",
    "points": "D",
    "frames": "h",
    "dtype": "p",
    "both": "P",
}
LEGENDS = {
    "base": "base: 33 points, 360/s, 5 iterations",
    "frames": "weight of frames turned",
    "both": "several turned",
}


def accuracy(
    path: Path, rows: Sequence[Row], problem: Problem, reference: Reference, *, overwrite: bool
) -> None:
    """Write the two work-precision diagrams, of the shape and of the gradient."""
    drawing, _ = figure(16, 12, dpi=100, layout="constrained")
    drawing.suptitle(
        f"Error against time: a perm, {problem.seconds:g} s after its release from a rod of "
        f"{1e3 * problem.rod_diameter:g} mm, {problem.strands} strands of "
        f"{100 * problem.length:g} cm",
        fontsize=17,
        fontweight="bold",
    )
    panels = drawing.subplots(1, 2)
    drawing.get_layout_engine().set(wspace=0.04)
    shape, gradient = panels
    shape.set_title("Shape", fontsize=15)
    shape.set_ylabel("RMS distance from the reference, over the length", fontsize=13)
    gradient.set_title("Gradient of the mean height, reverse mode", fontsize=15)
    gradient.set_ylabel("distance from the reference's gradient, over its norm", fontsize=13)
    _diagram(shape, rows, False, reference.bound)
    _diagram(gradient, rows, True, reference.gradient_bound)
    for axes in panels:
        axes.set_xlabel(
            f"wall seconds per simulated second, {problem.strands} strands", fontsize=13
        )
    drawing.legend(
        handles=_handles(), loc="outside lower center", ncols=5, frameon=False, fontsize=12
    )
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)


def _handles() -> list[Any]:
    line = optional("matplotlib.lines").Line2D
    plain: dict[str, Any] = {"linestyle": "", "markersize": 9}
    return [
        *(
            line([], [], color=color, marker="o", label=NAMES.get(name, name), **plain)
            for name, color in COLORS.items()
        ),
        *(
            line([], [], color="0.35", marker=m, label=LEGENDS.get(t, f"{t} turned"), **plain)
            for t, m in MARKERS.items()
        ),
        line([], [], color="0.1", linewidth=2, label="Pareto front"),
        line([], [], color="0.85", linewidth=10, label="reference's own error"),
        line([], [], color="0.35", marker="x", label="failed", **plain),
    ]


def _diagram(axes: Any, rows: Sequence[Row], gradient: bool, bound: float) -> None:
    """One panel: all settings that were measured; the front is numbered, and listed below."""
    shown = [(row, cost) for row in rows if (cost := row.cost(gradient)) is not None]
    fine = [(row, cost) for row, cost in shown if cost.ok]
    failed = [(row, cost) for row, cost in shown if not cost.ok]
    top = 1.0 if gradient else 0.5
    low = min([bound, *(cost.error for _, cost in fine)]) / 2
    axes.set(xscale="log", yscale="log", ylim=(low, 3 * top))
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.axhspan(low, bound, color="0.87", zorder=0)
    axes.axhline(top, color="0.6", linewidth=1, linestyle=":")
    at_right = {"transform": axes.get_yaxis_transform(), "color": "0.35", "fontsize": 11}
    axes.text(
        0.99, low * 1.06, f"the reference's own error, below {bound:.2%}",
        ha="right", va="bottom", **at_right,
    )  # fmt: skip
    axes.text(
        0.99, 2.9 * top, f"failed: above {top:.0%}, or not finite ({len(failed)})",
        ha="right", va="top", **at_right,
    )  # fmt: skip
    for row, cost in fine:
        _point(axes, row, cost)
    for row, cost in failed:
        if cost.seconds_per_second > 0:  # NaN where the program did not run
            color = _color(row)
            axes.plot(cost.seconds_per_second, 1.5 * top, "x", color=color, markersize=9,
                      markeredgewidth=2)  # fmt: skip
    _front(axes, pareto(rows, gradient=gradient), gradient)
    ticks = optional("matplotlib.ticker")
    for axis, form in ((axes.xaxis, "{:g}"), (axes.yaxis, "{:.3g} %")):
        scale = 100 if axis is axes.yaxis else 1
        axis.set_major_locator(ticks.LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(
            lambda value, _, form=form, scale=scale: form.format(scale * value)
        )
        axis.set_minor_formatter(ticks.NullFormatter())
    axes.tick_params(labelsize=11)


def _front(axes: Any, front: Sequence[Row], gradient: bool) -> None:
    """The Pareto front as stairs with numbers, and what the numbers mean below the panel."""
    costs = [cost for row in front if (cost := row.cost(gradient)) is not None]
    x, y = [cost.seconds_per_second for cost in costs], [cost.error for cost in costs]
    axes.plot(x, y, color="0.1", linewidth=1.6, drawstyle="steps-post", zorder=1.5)
    lines = ["Pareto front, from the cheapest"]
    for number, (row, here, there) in enumerate(zip(front, x, y, strict=True), 1):
        axes.annotate(
            str(number), (here, there), xytext=(-6, -5), textcoords="offset points",
            ha="right", va="top", fontsize=12, fontweight="bold",
        )  # fmt: skip
        setting = row.setting
        lines.append(
            f"{number:2d} {expression(setting.solver)[3:]}, {setting.points} points, "
            f"{setting.steps_per_second}/s, {setting.dtype}: {there:.2%}"
        )
    axes.text(0.0, -0.1, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=11)


def _color(row: Row) -> str:
    return COLORS[type(row.setting.solver).__name__]


def _point(axes: Any, row: Row, cost: Cost) -> None:
    base = row.setting.turned == "base"
    axes.plot(
        cost.seconds_per_second,
        cost.error,
        marker=MARKERS[row.setting.turned],
        color=_color(row),
        markersize={"base": 13, "Newton steps": 16}.get(row.setting.turned, 9),
        markeredgecolor="black" if base else "white",
        linestyle="",
        zorder=3 if base else 2,
    )


def theory(path: Path, stretches: Sequence[Stretch], *, overwrite: bool) -> None:
    """Write the stretch of a hanging strand against iterations and against substeps."""
    drawing, _ = figure(13, 6, dpi=100, layout="constrained")
    drawing.suptitle(
        "How much too long the paper's solver lets a strand hang: "
        "33 points 5 mm apart, 360 steps/s, after 2 s",
        fontsize=15,
        fontweight="bold",
    )
    swept = next((s.iterations for s in stretches if s.substeps > 1), stretches[0].iterations)
    panels = drawing.subplots(1, 2, sharey=True)
    _stretches(panels[0], "iterations n, with 1 substep", -1,
               {s.iterations: s for s in stretches if s.substeps == 1})  # fmt: skip
    _stretches(panels[1], f"substeps m, with {swept} iterations in each", -2,
               {s.substeps: s for s in stretches if s.iterations == swept})  # fmt: skip
    panels[0].set_ylabel("stretch, over the length", fontsize=13)
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)


def _stretches(axes: Any, what: str, order: int, by: dict[int, Stretch]) -> None:
    """One panel: stretch against a count, with the theory's line."""
    at = sorted(by)
    law = "(1 + 4 W) N² g dt² / (2 n L)" + ("" if order == -1 else ", dt = 1/360 s / m")
    axes.loglog(at, [by[n].theory for n in at], color="0.55", linewidth=1.5,
                label=f"theory, order {order}:\n{law}")  # fmt: skip
    axes.loglog(at, [by[n].measured for n in at], "o", color=COLORS["PositionBased"],
                markersize=9, label="measured")  # fmt: skip
    axes.set_xlabel(what, fontsize=13)
    axes.set_xticks(at, [str(n) for n in at])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
    axes.grid(color="0.92")
    axes.tick_params(labelsize=12)
    axes.legend(fontsize=12, frameon=False)
