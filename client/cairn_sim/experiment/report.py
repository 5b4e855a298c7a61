"""Report of the paper's experiment: one HTML file with everything in it, to be read without a network and printed."""

from collections.abc import Mapping, Sequence

from cairn_calib.report.charts import box_plot, series_keys
from cairn_calib.report.page import page
from cairn_calib.rig.poses import Transform
from cairn_sim.experiment.codings import CODINGS
from cairn_sim.experiment.figures import ResolutionFigures, RunFigures
from cairn_sim.experiment.plan import HEAT, ROBOT_COLOURS, PlanView
from cairn_sim.experiment.table_three import INCONSISTENT, table_three
from cairn_sim.experiment.tables import (
    commit_rows,
    figure_table,
    fill_rows,
    percent,
    rate_rows,
    shown,
    time_rows,
    truth_rows,
)
from cairn_sim.scene.scene_format import ZERO_C_K

Stops = Sequence[tuple[str, Sequence[Transform]]]


def report_page(run: RunFigures, plan: PlanView, stops: Stops) -> str:
    """The whole page.

    Args:
        run: at least one finished resolution.
        plan: the map from above.
        stops: of each robot: its name, and `T_map_rig` at its stops.
    """
    done = run.resolutions
    names = done[0].coding_names
    return page(
        "experiment.html",
        package="cairn_sim.experiment",
        lead=_lead(run),
        missing=[title for title in run.asked if title not in [one.title for one in done]],
        cards=_cards(done),
        edge_m=done[0].side * done[0].voxel_edge_m,
        plan=_plan(plan, stops),
        table_three=table_three(done),
        inconsistent=INCONSISTENT,
        codings=[coding for coding in CODINGS if coding.name in names],
        filled=[_fill_boxes(done, which) for which in ("occupied", "known")],
        fill=figure_table(done, fill_rows()),
        keys=series_keys(names),
        times=[_time_boxes(done, names, which) for which in ("encode_s", "decode_s")],
        time=figure_table(done, time_rows(names)),
        rates=figure_table(done, rate_rows()),
        commits=figure_table(done, commit_rows()),
        truth=figure_table(done, truth_rows()) if any(one.truth for one in done) else None,
        about=[(name.replace("_s", ", s").replace("_", " "), _words(value)) for name, value in run.about.items()],
    )


def _lead(run: RunFigures) -> str:
    last = run.resolutions[-1]
    scans, rays = (sum(getattr(one, name) for one in last.measurements) for name in ("scans", "rays"))
    return (
        f"{len(last.measurements)} measurements of {len({one.robot for one in last.measurements})} robots, {scans} "
        f"scans, {rays / 1e6:.1f} million rays; one map at {', '.join(one.title for one in run.resolutions)}."
    )


def _cards(done: Sequence[ResolutionFigures]) -> list[tuple[str, str]]:
    """The run in a handful of numbers, each with its meaning."""
    last = done[-1]
    cards = [(f"1:{shown(last.totals(name).ratio)}", f"{last.title}: {name}") for name in last.coding_names]
    cards.append((f"{shown(last.rates()['images_per_s'])} / s", f"range images mapped at {last.title}"))
    best = next((one for one in reversed(done) if one.truth), None)
    if best is not None and best.truth is not None:
        cards.append((percent(best.truth.scores.recall), f"of the visible surface found at {best.title}"))
        cards.append((percent(best.truth.scores.carved), f"of it carved away at {best.title}"))
    return cards


def _plan(plan: PlanView, stops: Stops) -> dict[str, object]:
    """Fig. 20: the map from above, by colour and by temperature."""
    low_c, high_c = (kelvin - ZERO_C_K for kelvin in plan.temperature_range_k())
    return {
        "voxel_cm": f"{plan.geometry.voxel_edge_m * 100:g}",
        "ceiling_m": f"{plan.ceiling_m:g}",
        "cell_m": f"{plan.geometry.cell_edge_m:g}",
        "robots": [
            (ROBOT_COLOURS[n % len(ROBOT_COLOURS)], f"{name}: {len(poses)} stops")
            for n, (name, poses) in enumerate(stops)
        ],
        "colour": plan.svg("colour", stops),
        "temperature": plan.svg("temperature", stops),
        "low": f"{low_c:.1f}",
        "high": f"{high_c:.1f}",
        "ramp": ",".join(f"rgb({r},{g},{b})" for r, g, b in HEAT.tolist()),
    }


def _fill_boxes(done: Sequence[ResolutionFigures], which: str) -> str:
    groups = {one.title: {which: [100 * share for share in one.filled(which)]} for one in done}
    return box_plot(groups, unit=f"{which}, % of a cell")


def _time_boxes(done: Sequence[ResolutionFigures], names: Sequence[str], which: str) -> str:
    groups = {
        one.title: {name: [1e3 * getattr(cell.coded[name], which) for cell in one.cells] for name in names}
        for one in done
    }
    title = {"encode_s": "grid to octree (encode)", "decode_s": "octree to grid (decode)"}[which]
    return box_plot(groups, unit=f"{title}, ms", logarithmic=True)


def _words(value: object) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_words(one)}" for name, one in value.items())
    if isinstance(value, float):
        return shown(value)
    return "all" if value is None else str(value)
