"""The page of a build's report: HTML without scripts, its lines drawn over the slices as SVG."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from ... import __version__
from ..evaluation import compactness
from ..mesh import FloatArray
from .bootstrapping import Cell
from .results import BuildResult, ScanResult
from .settings import settings_toml
from .slicesheet import Sheet
from .truthcomparison import ScanComparison, TruthComparison, in_short

SURFACES = {
    "initial": "tongue, first matching",
    "final": "tongue, after bootstrapping",
    "palate": "palate, brought here",
    "truth": "true tongue",
}
STAGES = {
    "scans": "surfaces of the scans",
    "palates": "palates",
    "aligned": "palates brought to all scans",
    "clouds": "contact restored",
    "matched": "tongues, first matching",
    "tongues": "bootstrapping, completion",
}
TRUTH_NOTE = (
    "Distances are exact, from surface to surface, and means over area. Parts of the true tongue that lie against other "
    "soft tissue show no edge in a scan, and are counted apart."
)
MANY = 2.0  # times the usual error or residual: full colour in the overview
STYLE = """
:root { --initial: #ff8c1a; --final: #19d3ff; --palate: #ffe14d; --truth: #ff5ad1; }
body { margin: 0; font: 15px/1.45 system-ui, sans-serif; color: #1c2126; background: #f3f4f6; }
main { max-width: 1500px; margin: 0 auto; padding: 1.2rem 1.6rem 4rem; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; } h2 { font-size: 1.12rem; margin: 1.6rem 0 .5rem; }
p { margin: .3rem 0; max-width: 75em; } .quiet { color: #5c6670; }
.boxes { display: flex; flex-wrap: wrap; gap: 0 3rem; align-items: flex-start; }
table { border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums; }
th, td { padding: .16rem .6rem; border: 1px solid #dde1e5; text-align: right; font-weight: normal; }
th { background: #eceef1; } th:first-child, td.name { text-align: left; white-space: nowrap; }
.overview td:not(.name) { padding: 0; min-width: 3.1rem; text-align: center; } .overview a { display: block; padding: .16rem .4rem; }
.overview td.gone { background: #d6d9dd; color: #5c6670; } a { color: inherit; text-decoration: none; }
.overview a:hover, .back:hover { text-decoration: underline; }
.met { color: #15703a; } .missed { color: #b3202a; font-weight: 600; }
.wrong { color: #b3202a; } ul { margin: .3rem 0; padding-left: 1.2rem; }
.legend { position: sticky; top: 0; z-index: 2; background: #f3f4f6ee; padding: .5rem 0; display: flex; flex-wrap: wrap;
  gap: .3rem 1.4rem; border-bottom: 1px solid #dde1e5; }
.legend label { cursor: pointer; white-space: nowrap; } .legend i { display: inline-block; width: 1.6rem; height: 0;
  border-top: 4px solid; vertical-align: middle; margin: 0 .35rem; }
article { background: #fff; border: 1px solid #dde1e5; border-radius: 6px; margin: 1rem 0; padding: .7rem .9rem;
  scroll-margin-top: 3rem; }
article.doubtful { border-left: 5px solid #b3202a; } article:target { box-shadow: 0 0 0 3px #19a3ff88; }
article h3 { font-size: 1rem; margin: 0; display: inline; } article .numbers { max-width: none; color: #3f4952; margin: .15rem 0 .5rem; }
.back { float: right; color: #5c6670; }
.sheet { position: relative; } .sheet img { display: block; width: 100%; }
.sheet svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.sheet path { fill: none; stroke-width: 1.6px; vector-effect: non-scaling-stroke; stroke-linejoin: round; }
.initial { stroke: var(--initial); } .final { stroke: var(--final); } .palate { stroke: var(--palate); }
.truth { stroke: var(--truth); stroke-dasharray: 5 3; }
.sheet text { fill: #fff; font-size: 270px; paint-order: stroke; stroke: #000a; stroke-width: 50px; }
""" + "\n".join(f"body:has(#show-{name}:not(:checked)) path.{name} {{ display: none; }}" for name in SURFACES)


def page(
    result: BuildResult,
    names: Mapping[Cell, str],
    comparison: TruthComparison | None,
    ablations: Mapping[str, TruthComparison],
    blocks: Sequence[str],
) -> str:
    """All of it. names: of each scan in links; blocks: `scan_block` of every scan, in the order to be shown."""
    shown = [name for name in SURFACES if name != "truth" or comparison is not None]
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{escape(result.source.name)}: tongues from MRI</title><style>{STYLE}</style></head><body><main>",
        *_summary(result),
        *_problems(result, comparison),
        *([] if comparison is None else _truth(comparison)),
        *_ablations(ablations),
        *_overview(result, names, comparison),
        *_model(result),
        f"<h2>Scans, what looks wrong first</h2>{_legend(shown)}",
        *blocks,
        "</main></body></html>",
    ]
    return "\n".join(parts) + "\n"


def scan_block(
    scan: ScanResult, moved_mm: float, name: str, shown: str, compared: ScanComparison | None
) -> str:
    """One scan: shown is its `sheet`, or `missing_sheet`."""
    rounds = " &rarr; ".join(f"{value:.2f}" for value in scan.residual_mm)
    facts = [
        f"mean distance to its points {rounds} mm",
        f"vertices with a point nearby {scan.valid[0]:.0%} &rarr; {scan.valid[-1]:.0%}",
        f"moved {moved_mm:.2f} mm by bootstrapping",
        f"correlation of the palate's profiles {scan.alignment_score:.2f}",
    ]
    lines = [" &middot; ".join(facts)]
    if compared is not None:
        first, last = compared.initial, compared.final
        against = [
            f"true tongue to extracted {first.mean:.2f} &rarr; <b>{last.mean:.2f}</b> mm (95 %: {last.high:.2f})"
        ]
        if not math.isnan(last.contact):
            against.append(f"in contact {first.contact:.2f} &rarr; {last.contact:.2f} mm")
        if not math.isnan(compared.motion_mm):
            against.append(f"palate off by {compared.motion_mm:.2f} mm, {compared.turn_deg:.2f}&deg;")
        lines.append("Against the truth: " + " &middot; ".join(against))
    notes = "".join(f"<li>{escape(note)}</li>" for note in scan.notes)
    return "\n".join(
        [
            f'<article id="{escape(name)}"{" class=doubtful" if scan.notes else ""}>',
            f'<a class="back" href="#overview">overview</a><h3>{_called(scan.speaker, scan.phone)}</h3>',
            f'<ul class="wrong">{notes}</ul>' if notes else "",
            f'<p class="numbers">{"<br>".join(lines)}</p>{shown}</article>',
        ]
    )


def sheet(drawn: Sheet, picture: str) -> str:
    """The slices with the lines over them. picture: where the slices lie, from the page."""
    paths = []
    for panel in drawn.panels:
        paths += [f'<path class="{name}" d="{_path(lines)}"/>' for name, lines in panel.lines.items()]
        paths.append(f'<text x="{100 * panel.left_mm + 120:.0f}" y="360">{escape(panel.title)}</text>')
    size = f"{100 * drawn.width_mm:.0f} {100 * drawn.height_mm:.0f}"
    return (
        f'<div class="sheet"><img loading="lazy" src="{escape(picture)}" alt="slices" '
        f'style="aspect-ratio: {size.replace(" ", " / ")}">'
        f'<svg viewBox="0 0 {size}" preserveAspectRatio="none">{"".join(paths)}</svg></div>'
    )


def missing_sheet(reason: str) -> str:
    return f'<p class="wrong">No picture: {escape(reason)}</p>'


def _path(lines: Iterable[FloatArray]) -> str:
    """Steps in hundredths of a mm: short, for there are many."""
    parts = []
    for line in lines:
        places = np.rint(100.0 * line).astype(int)
        steps = " ".join(f"{x},{y}" for x, y in np.diff(places, axis=0))
        parts.append(f"M{places[0, 0]},{places[0, 1]}l{steps}")
    return "".join(parts)


# Above the scans -------------------------------------------------------------------------------------


def _summary(result: BuildResult) -> list[str]:
    shapes, scans = result.shapes, list(result.scans.values())
    data = shapes.provenance.get("data", "")
    doubtful = sum(bool(scan.notes) for scan in scans)
    text = (
        f"{len(shapes.speakers)} speakers, {len(shapes.prompts)} phones; {len(scans)} scans, of which "
        f"{sum(scan.used for scan in scans)} are in the model; {len(shapes.filled)} cells filled by "
        f"{escape(result.settings.completion)}."
    )
    return [
        f"<h1>{escape(result.source.name)}: tongues from MRI scans</h1>",
        f'<p class="quiet">{escape(data)}{"; " if data else ""}report by tonguetrack {__version__}</p>',
        f"<p>{text} {doubtful or 'None'} of the scans {'are' if doubtful > 1 else 'is'} worth a look.</p>",
    ]


def _problems(result: BuildResult, comparison: TruthComparison | None) -> list[str]:
    sentences = [problem.sentence for problem in result.problems]
    if comparison is not None:
        sentences += [f"Not compared with the truth: {problem.sentence}" for problem in comparison.problems]
    if not sentences:
        return []
    items = "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)
    return [f'<h2>Left out</h2><ul class="wrong">{items}</ul>']


def _truth(comparison: TruthComparison) -> list[str]:
    rows = []
    for row in comparison.rows():
        aim, verdict = "", ""
        if row.most is not None:
            aim, verdict = f"{row.most:g}", "met" if row.final <= row.most else "missed"
        cells = [_number(row.initial), f'<span class="{verdict}">{_number(row.final)}</span>']
        rows.append([f"{escape(row.name)}, {row.unit}", *cells, _number(row.worst), aim])
    return [
        f"<h2>Against the truth, {len(comparison.scans)} scans</h2>",
        _table(["mean over the scans", "first matching", "last round", "worst scan", "aim"], rows),
        f'<p class="quiet">{TRUTH_NOTE}</p>',
    ]


def _ablations(found: Mapping[str, TruthComparison]) -> list[str]:
    if not found:
        return []
    heads = [
        "build",
        "tongue, first matching, mm",
        "last round, mm",
        "in contact, mm",
        "palate's place, mm",
        "turn, deg",
    ]
    rows = [[escape(name), *map(_number, in_short(comparison))] for name, comparison in found.items()]
    return ["<h2>What the steps bring</h2>", _table(heads, rows)]


def _overview(
    result: BuildResult, names: Mapping[Cell, str], comparison: TruthComparison | None
) -> list[str]:
    """Speakers down, phones across; darker where more is wrong."""
    if comparison is None:
        of, values = "to its points", {cell: scan.residual_mm[-1] for cell, scan in result.scans.items()}
    else:
        of, values = "to the truth", {cell: one.final.mean for cell, one in comparison.scans.items()}
    usual = float(np.median(list(values.values()))) if values else 1.0
    speakers = list(dict.fromkeys([*result.shapes.speakers, *(cell[0] for cell in result.scans)]))
    phones = list(dict.fromkeys([*result.shapes.prompts, *(cell[1] for cell in result.scans)]))
    rows = []
    for speaker in speakers:
        cells = [f'<td class="name">{escape(speaker)}</td>']
        for phone in phones:
            cell = speaker, phone
            if cell not in result.scans:
                cells.append('<td class="gone" title="no scan, or left out">&ndash;</td>')
                continue
            value = values.get(cell, math.nan)
            share = 0.0 if math.isnan(value) else min(max((value / max(usual, 1e-9) - 1.0) / MANY, 0.0), 1.0)
            star = "*" if result.scans[cell].notes else ""
            cells.append(
                f'<td style="background: rgb(255 120 60 / {0.85 * share:.2f})"><a href="#{escape(names[cell])}">'
                f"{_number(value)}{star}</a></td>"
            )
        rows.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(f"<th>{escape(phone)}</th>" for phone in phones)
    return [
        f'<h2 id="overview">Mean distance of the last tongue {of}, mm</h2>',
        f'<table class="overview"><tr><th></th>{head}</tr>{"".join(rows)}</table>',
        '<p class="quiet">* something was noticed; &ndash; no scan, or left out. A number leads to its scan.</p>',
    ]


def _model(result: BuildResult) -> list[str]:
    found = compactness(result.shapes)
    count = max(len(shares) for shares in found.values())
    rows = [
        [f"{mode} mode", *(f"{share:.1%}" for share in shares), *[""] * (count - len(shares))]
        for mode, shares in found.items()
    ]
    residuals = np.array([scan.residual_mm for scan in result.scans.values()])
    rounds = [["to its points, mm", *map(_number, np.nanmean(residuals, axis=0))]]
    heads = ["all scans", "first matching", *(f"round {number}" for number in range(1, residuals.shape[1]))]
    seconds = [[STAGES.get(name, name), f"{value:.1f}"] for name, value in result.seconds.items()]
    seconds.append(["together", f"{sum(result.seconds.values()):.1f}"])
    completion = [[escape(name), _number(value)] for name, value in result.held_out_mm.items()]
    weights = f"{result.model.speaker.size} speaker and {result.model.pose.size} pose weights"
    parts = [
        f"<h2>The model: {weights}, {result.model.vertex_count} vertices</h2>",
        _table(["share of the variance with", *map(str, range(1, count + 1))], rows),
        '<div class="boxes"><div><h2>Matching</h2>',
        _table(heads, rounds),
        "</div>",
    ]
    if completion:
        parts += [
            "<div><h2>Missing cells</h2>",
            _table(["way of filling", "mean error in cells held out, mm"], completion),
            "</div>",
        ]
    return [
        *parts,
        f"<div><h2>Time</h2>{_table(['stage', 's, in the last run'], seconds)}",
        '<p class="quiet">Hardly any where results were kept.</p></div></div>',
        f"<details><summary>Settings</summary><pre>{escape(settings_toml(result.settings))}</pre></details>",
    ]


def _legend(shown: Sequence[str]) -> str:
    labels = [
        f'<label><input type="checkbox" id="show-{name}" checked><i style="border-color: var(--{name})"></i>'
        f"{SURFACES[name]}</label>"
        for name in shown
    ]
    return (
        f'<div class="legend">{"".join(labels)}<span class="quiet">x to the left, y back, z up</span></div>'
    )


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells are HTML."""
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        f'<tr><td class="name">{row[0]}</td>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>'
        for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _called(speaker: str, phone: str) -> str:
    return escape(f"{speaker} [{phone}]")


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.2f}"
