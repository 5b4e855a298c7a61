"""The experiment's report: one HTML file with everything in it, light, to be printed, read without a network."""

from collections.abc import Mapping, Sequence
from html import escape

from cairn_calib.rig.poses import Transform
from cairn_sim.experiment.box_plot import box_plot, legend
from cairn_sim.experiment.figures import ResolutionFigures, RunFigures
from cairn_sim.experiment.plan import ROBOT_COLOURS, PlanView
from cairn_sim.experiment.table_three import INCONSISTENT, codings_list, table_three
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

STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #1c2430; background: #fff; max-width: 1040px;
  margin: 2.2rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.75rem; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.2rem; margin: 2.4rem 0 .5rem; padding-top: .8rem; border-top: 1px solid #d5dae1; }
p, dl { max-width: 75ch; } .lead { color: #46505e; margin-top: 0; }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.4rem 0; }
.card { flex: 1 1 150px; border: 1px solid #d5dae1; border-radius: 6px; padding: .7rem .9rem; }
.card b { display: block; font-size: 1.5rem; font-weight: 600; } .card span { color: #46505e; font-size: .85rem; }
table { border-collapse: collapse; margin: .8rem 0; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .28rem .7rem; text-align: right; vertical-align: top; border-bottom: 1px solid #e6e9ee; }
thead th { border-bottom: 1px solid #98a2b0; text-align: center; } tbody th { text-align: left; font-weight: 500; }
th, td { white-space: nowrap; } td.means { white-space: normal; }
td.paper { color: #6b4d12; background: #fbf6ea; } td.means { text-align: left; color: #46505e; }
tr.group th { padding-top: .8rem; font-weight: 700; } tr.strong td { font-weight: 700; }
dt { font-weight: 600; } dd { margin: 0 0 .5rem 0; }
.pair { display: grid; grid-template-columns: 1fr 1fr; gap: 1rem 1.6rem; } .pair figure { margin: 0; }
figure { margin: 1rem 0; break-inside: avoid; } figcaption { color: #46505e; font-size: .88rem; }
svg { width: 100%; height: auto; } .plot text { font: 12px system-ui, "DejaVu Sans", sans-serif; fill: #46505e; }
.plot .grid { stroke: #e3e7ec; } .plan { border: 1px solid #d5dae1; }
.legend { margin: .2rem 0; font-size: .88rem; } .key { margin-right: 1.2rem; }
.key i { display: inline-block; width: .8em; height: .8em; margin-right: .4em; border-radius: 2px; }
.note { background: #f5f7fa; border-left: 3px solid #98a2b0; padding: .6rem .9rem; font-size: .92rem; }
.nowrap { white-space: nowrap; } .ramp { display: inline-block; width: 9em; height: .7em; margin: 0 .5em;
  background: linear-gradient(90deg,#140b34,#65156e,#9f2a63,#d44842,#f57d15,#fac127,#fcffa4); }
@media print { body { margin: 0; max-width: none; font-size: 11px; } h2 { break-after: avoid; }
  table { break-inside: avoid; } }
"""
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
    edge_m = done[0].side * done[0].voxel_edge_m
    parts = [
        _head(run),
        _picture(plan, stops),
        "<h2>Table 3: how small the map is</h2>",
        f"<p>A cell is a cube of {edge_m:g} m. Uncompressed, it takes 8 bytes for each of its voxels, known or not; "
        "compressed, what the coding writes. The ratio is uncompressed map to compressed map; it grows with the air in "
        "the cells, bits per occupied voxel do not.</p>",
        table_three(done),
        f'<p class="note">{escape(INCONSISTENT)}</p>',
        codings_list(names),
        _filled(done),
        _times(done, names),
        "<h2>Integration: how fast images become evidence</h2>",
        figure_table(done, rate_rows()),
        "<h2>Commits: what a stop costs on the radio</h2>",
        figure_table(done, commit_rows()),
        _truth(done),
        _about(run),
    ]
    body = "\n".join(parts)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>cairn: the mapping experiment</title><style>{STYLE}</style></head>\n<body>{body}</body></html>\n"
    )


def _head(run: RunFigures) -> str:
    done = run.resolutions
    last = done[-1]
    measurements = len(last.measurements)
    scans, rays = (sum(getattr(one, name) for one in last.measurements) for name in ("scans", "rays"))
    lead = (
        f"{measurements} measurements of {len({one.robot for one in last.measurements})} robots, {scans} scans, "
        f"{rays / 1e6:.1f} million rays; one map at {', '.join(one.title for one in done)}."
    )
    missing = [title for title in run.asked if title not in [one.title for one in done]]
    warning = (
        f'<p class="note">Not finished: {escape(", ".join(missing))} was asked for, too, and is not in this report.</p>'
        if missing
        else ""
    )
    cards = [(f"1:{shown(last.totals(name).ratio)}", f"{last.title}: {name}") for name in last.coding_names]
    cards.append((f"{shown(last.rates()['images_per_s'])} / s", f"range images mapped at {last.title}"))
    best = next((one for one in reversed(done) if one.truth), None)
    if best is not None and best.truth is not None:
        cards.append((percent(best.truth.scores.recall), f"of the visible surface found at {best.title}"))
        cards.append((percent(best.truth.scores.carved), f"of it carved away at {best.title}"))
    shown_cards = "".join(
        f'<div class="card"><b>{escape(value)}</b><span>{escape(what)}</span></div>' for value, what in cards
    )
    return (
        f'<h1>The mapping experiment</h1><p class="lead">{escape(lead)} After Kocmanova, Zalud, Burian, <em>'
        "Multispectral Data-fusion and Mapping for Reconnaissance Robotics</em>, VI.C: three laboratories, a corridor "
        f'and its extension.</p>{warning}<div class="cards">{shown_cards}</div>'
    )


def _picture(plan: PlanView, stops: Stops) -> str:
    low_c, high_c = (kelvin - ZERO_C_K for kelvin in plan.temperature_range_k())
    robots = "".join(
        f'<span class="key"><i style="background:{ROBOT_COLOURS[n % len(ROBOT_COLOURS)]}"></i>'
        f"{escape(name)}: {len(poses)} stops</span>"
        for n, (name, poses) in enumerate(stops)
    )
    return (
        f"<h2>The map from above (Fig. 20)</h2><p>Occupied voxels of {plan.geometry.voxel_edge_m * 100:g} cm up to "
        f"{plan.ceiling_m:g} m, the highest of each column; cells of {plan.geometry.cell_edge_m:g} m are outlined in "
        f'violet.</p><p class="legend">{robots}</p><div class="pair">'
        f"<figure>{plan.svg('colour', stops)}<figcaption>Colour.</figcaption></figure>"
        f"<figure>{plan.svg('temperature', stops)}<figcaption>Apparent temperature, the hottest of each column: "
        f'<span class="nowrap">{low_c:.1f} °C<span class="ramp"></span>{high_c:.1f} °C</span>; '
        "grey: no thermal camera looked.</figcaption></figure></div>"
    )


def _filled(done: Sequence[ResolutionFigures]) -> str:
    def panel(which: str) -> str:
        groups = {one.title: {which: [100 * share for share in one.filled(which)]} for one in done}
        return f"<figure>{box_plot(groups, unit=f'{which}, % of a cell')}</figure>"

    return (
        "<h2>Fig. 22: how full the cells are</h2><p>Each box is of all non-empty cells: median, quartiles, whiskers to "
        '1.5 times their distance, outliers as rings.</p><div class="pair">'
        f"{panel('occupied')}{panel('known')}</div>{figure_table(done, fill_rows())}"
    )


def _times(done: Sequence[ResolutionFigures], names: Sequence[str]) -> str:
    def panel(which: str) -> str:
        groups = {
            one.title: {name: [1e3 * getattr(cell.coded[name], which) for cell in one.cells] for name in names}
            for one in done
        }
        title = {"encode_s": "grid to octree (encode)", "decode_s": "octree to grid (decode)"}[which]
        return f"<figure>{box_plot(groups, unit=f'{title}, ms', logarithmic=True)}</figure>"

    return (
        "<h2>Fig. 23: time to store and to read a cell</h2><p>Each box is of all non-empty cells: CPU time "
        "of one thread, from packed rows of known voxels to bytes, and from bytes to rows or voxels. The table has the "
        f"step between rows and the grid in memory, too. The axes are logarithmic.</p>{legend(names)}"
        f'<div class="pair">{panel("encode_s")}{panel("decode_s")}</div>'
        f"{figure_table(done, time_rows(names))}"
    )


def _truth(done: Sequence[ResolutionFigures]) -> str:
    head = "<h2>Truth: how right the map is</h2>"
    if not any(one.truth for one in done):
        return f"{head}<p>The truth of these recordings is not known, so nothing can be said.</p>"
    return (
        f"{head}<p>The scene is known exactly. A surface voxel is one in which a beam without noise can end, a free "
        "voxel one that such a beam can pass; both from the range camera's poses, as far as its 10 m reach.</p>"
        f"{figure_table(done, truth_rows())}"
    )


def _about(run: RunFigures) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(name.replace("_s", ", s").replace("_", " "))}</th>'
        f'<td class="means">{escape(_words(value))}</td></tr>'
        for name, value in run.about.items()
    )
    return f"<h2>How it was made</h2><table><tbody>{rows}</tbody></table>"


def _words(value: object) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_words(one)}" for name, one in value.items())
    if isinstance(value, float):
        return shown(value)
    return "all" if value is None else str(value)
