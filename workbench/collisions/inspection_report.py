"""Sec. 6: an inspection as figures for people and programs.  Inspection -> a dictionary ready for JSON."""

from dataclasses import asdict
from typing import Any

from torch import Tensor

from workbench.collisions.incidents import Incident, incidents
from workbench.collisions.inspection import Inspection

WORST = 20  # vertices and incidents that the report lists


def inspection_report(found: Inspection, fps: float) -> dict[str, Any]:
    """The figures of an inspection, ready for JSON; depths in millimetres, frames and vertices counted from 0."""
    inside, depth, surfaces = found.inside, 1e3 * found.depth, found.surfaces
    frames, count = inside.shape
    per_frame = inside.sum(dim=1)
    colliding = depth[inside]
    together = incidents(found)
    heat, deepest = found.heat_map, 1e3 * found.depth_map
    return {
        "frames": frames,
        "fps": fps,
        "garment_vertices": count,
        "totals": {
            "inside": int(inside.sum()),
            "inside_percent": 100 * float(inside.float().mean()),
            "of_it_where_the_body_overlaps_itself": int(found.overlap.sum()),
            "vertices_ever_inside": int(inside.any(dim=0).sum()),
            "incidents": len(together),
            "frames_with_collisions": int((per_frame > 0).sum()),
            "depth_mm": {
                "mean": _rounded(colliding.mean()) if len(colliding) else 0.0,
                "median": _rounded(colliding.median()) if len(colliding) else 0.0,
                "max": _rounded(colliding.max()) if len(colliding) else 0.0,
            },
            "crossing_edges_percent": 100 * surfaces.edge_share,
            "crossing_faces_percent": 100 * surfaces.face_share,
            "crossing_edges": int(surfaces.crossing_edges.sum()),
            "crossing_edges_with_both_ends_outside": int(surfaces.hidden_edges.sum()),
            "crossing_faces": int(surfaces.crossing_faces.sum()),
            "crossing_faces_with_all_corners_outside": int(surfaces.hidden_faces.sum()),
            "body_vertices_poking_through": int(surfaces.poking.sum()),
        },
        "regions": {"names": list(found.regions.names), "source": found.regions.source},
        "per_frame": {
            "inside": per_frame.tolist(),
            "overlap": found.overlap.sum(dim=1).tolist(),
            "deepest_mm": [_rounded(value) for value in depth.amax(dim=1)],
            "crossing_edges": surfaces.crossing_edges.sum(dim=1).tolist(),
            "hidden_edges": surfaces.hidden_edges.sum(dim=1).tolist(),
            "crossing_faces": surfaces.crossing_faces.sum(dim=1).tolist(),
            "poking": surfaces.poking.sum(dim=1).tolist(),
        },
        "inside_by_frame_and_region": heat.tolist(),
        "deepest_mm_by_frame_and_region": [[_rounded(value) for value in row] for row in deepest],
        "incidents": [_told(incident) for incident in together[:WORST]],
        "worst_vertices": worst_vertices(found),
    }


def worst_vertices(found: Inspection, count: int = WORST) -> list[dict[str, Any]]:
    """The vertices that go deepest, each with the frame where it does."""
    deepest, frame = found.depth.max(dim=0)
    order = deepest.argsort(descending=True, stable=True)[:count]
    return [
        {
            "vertex": int(vertex),
            "frame": int(frame[vertex]),
            "depth_mm": _rounded(1e3 * deepest[vertex]),
            "region": found.regions.names[int(found.region[frame[vertex], vertex])],
            "frames_inside": int(found.inside[:, vertex].sum()),
        }
        for vertex in order
        if deepest[vertex] > 0
    ]


def _told(incident: Incident) -> dict[str, Any]:
    told = asdict(incident)
    told["depth_mm"] = round(1e3 * told.pop("depth"), 3)
    return told


def _rounded(value: Tensor) -> float:
    return round(float(value), 3)
