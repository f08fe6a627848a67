"""The collision inspector to look at: InspectionResult -> a page that works offline, a heat map (SVG), a Scene."""

import html
import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from numpy import ndarray

from widgets.frontend_bundle import NotBundled
from widgets.page import page
from widgets.scene import CLOTH, SKIN, Camera, Mesh, Regions, Scalars, Scene, View
from workbench.collisions.blame import CAUSES, FREE
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import face_normals
from workbench.inspector import InspectionResult, summary
from workbench.store import atomic_write

log = logging.getLogger(__name__)

HERE = Path(__file__).parent
PAGE_BYTES = 8e6  # what the 3-D part may add to a page that is sent to a colleague
BYTES_A_VERTEX = 3.0  # of a frame: positions, depth, cause and marks, deflated, in base64 (measured: 1.2 to 2.7)
MOST_VERTICES = 300_000  # more than a page should make a browser turn
MOST_COLUMNS = 360  # of the heat map; beyond it neighbouring frames share a column
CAUSE_COLOURS = dict(zip(CAUSES, ("#0072b2", "#009e73", "#e69f00", "#d55e00", "#cc79a7", "#777777")))
ONE_CAUSE = "#b5003c"
VIEW_ANGLE = 24.0  # degrees, of a close-up
RAMP = ((255, 224, 150), (240, 100, 40), (120, 0, 40))  # shallow to deep: light to dark, also without colour vision

LEFT, RIGHT, ROW, CURVE, GAP, WIDTH = 112, 58, 18, 64, 12, 500  # of the chart, in its own units


def write_inspection(result: InspectionResult, path: Path) -> Path:
    """Write the page, whole or not at all."""
    document = inspection_page(result)
    with atomic_write(path) as part:
        part.write_text(document, encoding="utf-8")
    return path


def inspection_page(result: InspectionResult) -> str:
    """One HTML document: what was found, where and when, beside the dressed body.

    Without the 3-D part where it was not wanted, cannot be bundled or is too large for a browser.
    """
    frames = shown_frames(result)
    files = dict.fromkeys(Path(result.report[side]["file"]).name for side in ("garment", "body"))
    title = f"Collisions: {' on '.join(files)}"
    chart = f"{_cell_readout()}{heat_map(result)}{_legend(result)}"
    above = f'<div id="charts">{_summary(result, len(frames))}{_how_to_read()}{chart}{_incidents(result)}</div>'
    data = json.dumps(page_data(result, frames)).replace("<", "\\u003c")
    below = f'{_tables(result)}<script type="application/json" id="inspection">{data}</script>'
    style, script = _beside("inspector_page.css"), _beside("inspector_page.js")
    if result.flat:
        return _flat(title, above, below, style, script, "The 3-D view was left out, as asked (--flat).")
    if not len(frames):
        count = result.body.vertices.shape[1] + result.garment.vertices.shape[1]
        return _flat(
            title, above, below, style, script,
            f"The 3-D view is left out: {count:,} vertices are more than a page can turn ({MOST_VERTICES:,}). "
            "All figures are of the full meshes; to look at it, decimate both meshes and inspect them again.",
        )  # fmt: skip
    try:
        return page(inspection_scene(result, frames), title, above=above, below=below, style=style, script=script)
    except NotBundled as reason:
        log.warning("report.html has no 3-D view: %s", reason)
        return _flat(title, above, below, style, script, f"The 3-D view is left out: {reason}.")


def shown_frames(result: InspectionResult) -> Int[ndarray, "K"]:
    """The frames that the 3-D view holds: all where they fit, else evenly thinned, with the worst of each incident that
    the page lists."""
    count = result.body.vertices.shape[1] + result.garment.vertices.shape[1]
    frames = len(result.garment)
    if count > MOST_VERTICES:
        return np.zeros(0, np.int64)
    most = max(int(PAGE_BYTES / (BYTES_A_VERTEX * count)), 1)
    if frames <= most:
        return np.arange(frames)
    worst = list(dict.fromkeys(incident["worst_frame"] for incident in result.report["incidents"]))[:most]
    spread = np.linspace(0, frames - 1, most - len(worst)).round().astype(int)
    return np.unique(np.concatenate([np.array(worst, int), spread]))


def inspection_scene(result: InspectionResult, frames: Int[ndarray, "K"] | None = None) -> Scene:
    """Body and garment over time; vertices inside the body are marked, their depth and cause can be shown by colour."""
    found = result.found
    keep = np.arange(len(result.garment)) if frames is None else frames
    names = found.regions.names
    body = result.body.vertices if len(result.body) == 1 else result.body.vertices[keep]
    depth = 1e3 * found.depth.numpy()
    limits = (0.0, max(float(depth.max()), 1e-3))
    choices = (Scalars(depth[keep], "depth inside the body", "mm", limits, "YlOrRd"),)
    if result.blame is not None:
        cause = result.blame.cause.numpy()[keep]
        named = np.where(cause == FREE, 0, cause + 1).astype(np.float32)
        choices += (Scalars(named, "made by", categories=("outside", *CAUSES)),)
    return Scene(
        (
            View(
                (
                    Mesh(
                        body[0] if len(result.body) == 1 else body,
                        result.body.faces,
                        SKIN,
                        name="body",
                        regions=Regions(found.regions.of_vertex.numpy(), names),
                    ),
                    Mesh(
                        result.garment.vertices[keep],
                        result.garment.faces,
                        CLOTH,
                        name="garment",
                        marked=found.inside.numpy()[keep],
                        choices=choices,
                        regions=Regions(garment_regions(result).numpy(), names),
                    ),
                )
            ),
        ),
        fps=result.garment.fps * len(keep) / len(result.garment),
    )


def close_up(result: InspectionResult, frame: int, vertex: int, reach: float = 0.3) -> Scene:
    """One frame, looked at from outside onto one garment vertex, through a ghost of the body; `reach` metres around it.

    Errors: ValueError for a frame or vertex that is not there.
    """
    frames, count = result.garment.vertices.shape[:2]
    if not (0 <= vertex < count and 0 <= frame < frames):
        raise ValueError(f"there is no vertex {vertex} in frame {frame}: the garment has {count} in {frames} frames")
    scene = inspection_scene(result, np.array([frame])).at(0)
    body, faces = result.body.vertices[frame if len(result.body) > 1 else 0], result.body.faces
    target = result.garment.vertices[frame, vertex]
    skin = int(ClosestPoint(body, faces).query(target[None]).face[0])
    outwards = face_normals(torch.from_numpy(body), torch.from_numpy(faces[skin : skin + 1]))[0].numpy()
    position = target + reach / np.tan(np.radians(VIEW_ANGLE / 2)) * outwards
    camera = Camera(_triple(position), _triple(target), view_angle=VIEW_ANGLE)
    layers = [
        replace(x, opacity=0.35) if isinstance(x, Mesh) and x.name == "body" else x for x in scene.views[0].layers
    ]
    return replace(scene, views=(replace(scene.views[0], layers=tuple(layers)),), camera=camera)


def _triple(vector: ndarray) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def page_data(result: InspectionResult, frames: Int[ndarray, "K"]) -> dict[str, Any]:
    """What the page's script needs: every cell with its worst vertex, and which frames the 3-D view holds."""
    return {
        "shown": frames.tolist(),
        "frames": len(result.garment),
        "fps": result.garment.fps,
        "first": result.report["first_frame"],
        "every": result.report["every"],
        "regions": list(result.found.regions.names),
        "inside": result.report["per_frame"]["inside"],
        "deepest": result.report["per_frame"]["deepest_mm"],
        "cells": cells(result),
        "left": LEFT,
        "width": WIDTH,
    }


def garment_regions(result: InspectionResult) -> Int[torch.Tensor, "N"]:
    """One region for each garment vertex, to isolate: where it collides most often, else where it is most often."""
    found, names = result.found, result.found.regions.names
    frame, vertex = found.inside.nonzero(as_tuple=True)
    cell = vertex * len(names) + found.region[frame, vertex]
    often = torch.bincount(cell, minlength=found.inside.shape[1] * len(names)).reshape(-1, len(names))
    return torch.where(often.any(dim=1), often.argmax(dim=1), found.region_of_vertex)


def cells(result: InspectionResult) -> list[list[int | float]]:
    """[frame, region, vertices inside, deepest mm, its vertex, 1 where the garment's region holds all of them] of every
    cell with a collision."""
    found = result.found
    heat, region, depth, of_vertex = found.heat_map, found.region, found.depth, garment_regions(result)
    made = []
    for frame, r in heat.nonzero().tolist():
        here = (region[frame] == r) & found.inside[frame]
        vertex = int(torch.where(here, depth[frame], -1.0).argmax())
        whole = int((of_vertex[here] == r).all())
        made.append([frame, r, int(heat[frame, r]), round(1e3 * float(depth[frame, vertex]), 2), vertex, whole])
    return made


# --- the chart


def heat_map(result: InspectionResult) -> str:
    """SVG: above, the vertices inside of each frame (by cause, where it is known); below, the deepest vertex of each
    region and frame."""
    names = result.found.regions.names
    frames = len(result.garment)
    columns = np.array_split(np.arange(frames), min(frames, MOST_COLUMNS))
    heat, deepest = result.found.heat_map.numpy(), 1e3 * result.found.depth_map.numpy()
    rows = [r for r in range(len(names)) if heat[:, r].any()]
    top = CURVE + GAP
    height = top + ROW * max(len(rows), 1) + 34
    step = WIDTH / len(columns)
    parts = [
        f'<svg id="heat" viewBox="0 0 {LEFT + WIDTH + RIGHT} {height}" role="img" xmlns="http://www.w3.org/2000/svg" '
        'font-family="system-ui, sans-serif" font-size="11" fill="#222">'
        "<title>Collisions of each frame, and of each body region in each frame</title>"
    ]
    parts += _curve(result, columns, step)
    limit = max(float(deepest.max()), 1e-6)
    for row, r in enumerate(rows):
        y = top + ROW * row
        label = html.escape(names[r] if len(names[r]) < 22 else names[r][:20] + "…")
        parts.append(f'<text x="{LEFT - 6}" y="{y + 13}" text-anchor="end">{label}</text>')
        parts.append(f'<text x="{LEFT + WIDTH + 6}" y="{y + 13}">{deepest[:, r].max():.1f} mm</text>')
        parts.append(f'<rect x="{LEFT}" y="{y}" width="{WIDTH}" height="{ROW - 1}" fill="#ecebe8"/>')
        for column, of in enumerate(columns):
            frame = int(of[deepest[of, r].argmax()])
            if heat[frame, r]:
                shade = _shade(float(deepest[frame, r]) / limit)
                parts.append(
                    f'<rect class="cell" x="{LEFT + column * step:.2f}" y="{y}" width="{max(step, 0.8):.2f}" '
                    f'height="{ROW - 1}" fill="{shade}" data-f="{frame}" data-r="{r}">'
                    f"<title>{html.escape(names[r])}, frame {frame}: {heat[frame, r]} vertices inside, at most "
                    f"{deepest[frame, r]:.1f} mm deep</title></rect>"
                )
    bottom = top + ROW * max(len(rows), 1)
    if not rows:
        parts.append(f'<text x="{LEFT + 8}" y="{top + 12}">no vertex of the garment is inside the body</text>')
    parts += _frame_axis(frames, bottom, result.garment.fps)
    parts.append(f'<line id="now" x1="-9" x2="-9" y1="0" y2="{bottom}" stroke="#000" stroke-width="1.2"/>')
    parts.append("</svg>")
    silent = len(names) - len(rows)
    if silent and rows:
        parts.append(f'<p class="quiet">{silent} regions of the body without a collision are not listed.</p>')
    return "".join(parts)


def _curve(result: InspectionResult, columns: list[ndarray], step: float) -> list[str]:
    """Bars of vertices inside, stacked by cause."""
    inside = np.array(result.report["per_frame"]["inside"])
    most = max(int(inside.max()), 1)
    told = result.report["blame"]
    stacks = {None: inside} if told is None else {name: np.array(counts) for name, counts in told["by_frame"].items()}
    parts = [
        f'<text x="{LEFT - 6}" y="12" text-anchor="end">{most}</text>'
        f'<text x="{LEFT - 6}" y="{CURVE / 2 + 4}" text-anchor="end" font-weight="600">vertices inside</text>'
        f'<text x="{LEFT - 6}" y="{CURVE}" text-anchor="end">0</text>'
        f'<rect x="{LEFT}" y="0" width="{WIDTH}" height="{CURVE}" fill="#f4f3f0"/>'
    ]
    for column, of in enumerate(columns):
        frame = int(of[inside[of].argmax()])
        y = float(CURVE)
        for name, counts in stacks.items():
            tall = counts[frame] / most * (CURVE - 3)
            if tall:
                y -= tall
                colour = ONE_CAUSE if name is None else CAUSE_COLOURS[name]
                parts.append(
                    f'<rect class="bar" x="{LEFT + column * step:.2f}" y="{y:.2f}" width="{max(0.9 * step, 0.7):.2f}" '
                    f'height="{tall:.2f}" fill="{colour}" data-f="{frame}"><title>frame {frame}: {inside[frame]} '
                    f"vertices inside</title></rect>"
                )
    return parts


def _frame_axis(frames: int, y: int, fps: float) -> list[str]:
    ticks = _round_steps(frames)
    parts = [f'<text x="{LEFT - 6}" y="{y + 13}" text-anchor="end" fill="#666">frame</text>']
    parts.append(f'<text x="{LEFT - 6}" y="{y + 27}" text-anchor="end" fill="#666">seconds</text>')
    for frame in ticks:
        x = LEFT + (frame + 0.5) * WIDTH / frames
        parts.append(
            f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y}" y2="{y + 3}" stroke="#888"/>'
            f'<text x="{x:.1f}" y="{y + 13}" text-anchor="middle" fill="#666">{frame}</text>'
            f'<text x="{x:.1f}" y="{y + 27}" text-anchor="middle" fill="#666">{frame / fps:.2g}</text>'
        )
    return parts


def _round_steps(frames: int) -> list[int]:
    """About eight frames at round numbers."""
    rough = max(frames / 8, 1)
    power = 10 ** int(np.floor(np.log10(rough)))
    step = next(power * n for n in (1, 2, 5, 10) if power * n >= rough)
    return list(range(0, frames, int(step)))


def _shade(share: float) -> str:
    """The ramp's colour at 0..1."""
    at = min(max(share, 0.0), 1.0) * (len(RAMP) - 1)
    low = min(int(at), len(RAMP) - 2)
    mixed = [round(a + (at - low) * (b - a)) for a, b in zip(RAMP[low], RAMP[low + 1])]
    return "#{:02x}{:02x}{:02x}".format(*mixed)


# --- words


def _summary(result: InspectionResult, shown: int) -> str:
    report = result.report
    where = f"{report['frames']} frames, garment of {report['garment']['vertices']:,} vertices, body of "
    where += f"{report['body']['vertices']:,}"
    if 0 < shown < report["frames"]:
        where += f"; the 3-D view holds {shown} of the frames, with the worst of each listed incident"
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in report["notes"])
    listed = f'<ul class="notes">{notes}</ul>' if notes else ""
    return f'<p class="found">{html.escape(summary(report))}.</p><p class="quiet">{where}.</p>{listed}'


def _how_to_read() -> str:
    return (
        "<details><summary>How to read this page</summary><ul><li>A vertex is <b>inside</b> where the body's exact "
        "winding number is at least 1. <b>Depth</b> is its distance to the closest skin, in millimetres.</li>"
        "<li>Each <b>row</b> of the chart is a region of the body, each <b>column</b> a frame; the darker, the deeper. "
        "Click a cell: the view jumps to that frame, flies to the deepest vertex and shows that region alone "
        "(⟲ or r: back).</li>"
        "<li>In the view, pink dots are vertices inside the body, drawn through whatever hides them. Drag to turn.</li>"
        "<li>An edge can cross the body although both its ends are outside; such edges are counted apart.</li>"
        "<li>A vertex in two layers of the body at once could not be free; such vertices are counted apart, too.</li>"
        "<li>Where the file holds the garment after each stage of a try-on, the <b>bars</b> are coloured by the "
        "stage after which a vertex was first inside, or by <i>body overlap</i> where this pose leaves no room: "
        "the skin under the vertex is buried in another limb.</li></ul>"
        "</details>"
    )


def _cell_readout() -> str:
    return (
        '<p id="readout" role="status"><span id="told">Click a cell or a bar of the chart.</span> '
        '<button type="button" id="all" hidden>show the whole body</button></p>'
    )


def _legend(result: InspectionResult) -> str:
    limit = result.report["totals"]["depth_mm"]["max"]
    stops = ",".join(_shade(k / 6) for k in range(7))
    parts = []
    if limit > 0:
        parts.append(
            '<span>cells: depth of the deepest vertex, 0 <i class="ramp" '
            f'style="background:linear-gradient(90deg,{stops})"></i> {limit:.1f} mm</span>'
        )
    told = result.report["blame"]
    if told is not None:
        for name, count in told["by_cause"].items():
            share = told["by_cause_percent"][name]
            parts.append(
                f'<span><i class="swatch" style="background:{CAUSE_COLOURS[name]}"></i>'
                f"{name}: {count:,} ({share:.0f} %)</span>"
            )
    return f'<div class="legend">{"".join(parts)}</div>'


def _incidents(result: InspectionResult) -> str:
    report = result.report
    listed, total = len(report["incidents"]), report["totals"]["incidents"]
    if not listed:
        return ""
    rows = "".join(
        f'<tr class="go" data-f="{i["worst_frame"]}" data-v="{i["worst_vertex"]}" data-n="{html.escape(i["region"])}">'
        f"<td>{html.escape(i['region'])}</td><td>{i['first_frame']}–{i['last_frame']}</td><td>{i['vertices']}</td>"
        f"<td>{i['depth_mm']:.2f}</td><td>{i['worst_frame']}</td></tr>"
        for i in report["incidents"]
    )
    which = f"{total} in all" if listed == total else f"the deepest {listed} of {total}"
    return (
        f"<section><h2>Incidents <small>patches of cloth inside the body; {which}; click one to see it</small></h2>"
        "<table><tr><th>where</th><th>frames</th><th>vertices</th><th>mm deep</th><th>worst frame</th></tr>"
        f"{rows}</table></section>"
    )


def _tables(result: InspectionResult) -> str:
    report, totals = result.report, result.report["totals"]
    rows = [
        ("vertices inside, of all vertices of all frames", f"{totals['inside']:,} ({totals['inside_percent']:.3f} %)"),
        ("of them, in two layers of the body at once", f"{totals['of_it_where_the_body_overlaps_itself']:,}"),
        ("different vertices that are ever inside", f"{totals['vertices_ever_inside']:,}"),
        ("depth: median, largest", f"{totals['depth_mm']['median']:.2f}, {totals['depth_mm']['max']:.2f} mm"),
        ("edges that cross the body", f"{totals['crossing_edges']:,} ({totals['crossing_edges_percent']:.3f} %)"),
        ("of them, with both ends outside", f"{totals['crossing_edges_with_both_ends_outside']:,}"),
        ("faces that cross the body", f"{totals['crossing_faces']:,} ({totals['crossing_faces_percent']:.3f} %)"),
        ("of them, with all corners outside", f"{totals['crossing_faces_with_all_corners_outside']:,}"),
        ("body vertices that poke through", f"{totals['body_vertices_poking_through']:,}"),
    ]
    counted = "".join(f"<tr><td>{name}</td><td>{value}</td></tr>" for name, value in rows)
    worst = "".join(
        f'<tr class="go" data-f="{w["frame"]}" data-v="{w["vertex"]}" data-n="{html.escape(w["region"])}">'
        f"<td>{w['vertex']}</td><td>{html.escape(w['region'])}</td><td>{w['frame']}</td><td>{w['depth_mm']:.2f}</td>"
        f"<td>{w['frames_inside']}</td></tr>"
        for w in report["worst_vertices"]
    )
    return (
        '<div id="tables">'
        f"<section><h2>Worst vertices</h2><table><tr><th>vertex</th><th>where</th><th>frame</th><th>mm deep</th>"
        f"<th>frames inside</th></tr>{worst}</table></section>"
        f"<section><h2>All counts</h2><table>{counted}</table></section></div>"
    )


def _beside(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def _flat(title: str, above: str, below: str, style: str, script: str, why: str) -> str:
    """The page without its 3-D part."""
    style = f"body{{font:14px/1.4 system-ui,sans-serif;color:#222;background:#f7f7f5}}{style}"
    view = f'<div id="view" class="absent"><p>{html.escape(why)}</p></div>'
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
        f"<style>{style}</style></head><body><h1>{html.escape(title)}</h1>{above}{view}{below}"
        f"<script>{script}</script></body></html>"
    )
