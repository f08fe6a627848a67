# pyright: reportArgumentType=false, reportCallIssue=false, reportOptionalMemberAccess=false
"""Laws of workbench.garments: what ships is usable, and every unusable garment gets its one line."""

import numpy as np
import pytest
import torch
import trimesh

from workbench.garments import Garment, shipped_garments
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import boundary_loops, edge_lengths, unique_edges


@pytest.mark.parametrize(("name", "least"), [("tshirt", 4500), ("dress", 5700)])
def test_what_ships_is_one_sheet_with_four_openings_off_the_body(name, least, body):
    garment = Garment.load(name)
    garment.require_fits(body)
    assert len(garment.vertices) >= least
    assert len(boundary_loops(garment.faces)) == 4  # neck, hem, two sleeves
    lengths = edge_lengths(garment.rest_vertices, unique_edges(garment.faces))
    assert lengths.min() > 0.003
    assert lengths.mean() < 0.016
    surface = ClosestPoint(body.template.numpy(), body.faces.numpy())
    assert surface.query(garment.vertices.numpy()).distance.min() > 0.003
    belly = garment.vertices[(garment.vertices[:, 2] > 1.0) & (garment.vertices[:, 2] < 1.12)]
    if name == "tshirt":
        assert 0.015 < surface.query(belly.numpy()).distance.mean() < 0.030  # loose enough to fold


def test_names_are_listed():
    assert shipped_garments() == ("dress", "tshirt")


def export(garment, path, faces=None, vertices=None):
    vertices = garment.vertices if vertices is None else vertices
    faces = garment.faces if faces is None else faces
    trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False).export(path)
    return path


@pytest.mark.parametrize("kind", ["obj", "ply", "npz"])
def test_a_file_comes_back_as_it_was(tmp_path, body, kind):
    garment, path = Garment.load("tshirt"), tmp_path / f"mine.{kind}"
    if kind == "npz":
        garment.save(path)
    else:
        export(garment, path)
    back = Garment.load(path, body)
    assert torch.allclose(back.vertices, garment.vertices, atol=1e-6)
    assert torch.equal(back.faces, garment.faces)
    assert torch.equal(back.rest_vertices, garment.rest_vertices if kind == "npz" else back.vertices)


def test_texture_seams_do_not_tear_a_garment(tmp_path, body):
    garment, path = Garment.load("tshirt"), tmp_path / "seams.obj"
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in garment.vertices.tolist()]
    lines += [f"vt {i % 7 / 7} 0" for i in range(3 * len(garment.faces))]
    corner = iter(range(1, 3 * len(garment.faces) + 1))
    lines += ["f " + " ".join(f"{v + 1}/{next(corner)}" for v in face) for face in garment.faces.tolist()]
    path.write_text("\n".join(lines))
    assert torch.equal(Garment.load(path, body).faces, garment.faces)


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("inside out", r"inside out, \d+ % of its area faces the body"),
        ("inside the body", r"\d+ of 4630 vertices are inside the body at frame 0"),
        ("centimetres", r"nearest vertex is \d+\.\d m away from the body; expected metres"),
        ("nan", "1 of 4630 vertices are NaN"),
        ("two parts", "expected one connected part, got 2"),
        ("non-manifold", "1 edges have more than two faces"),
    ],
)
def test_every_unusable_garment_gets_its_one_line(tmp_path, body, what, says):
    garment = Garment.load("tshirt")
    vertices, faces = garment.vertices.clone(), garment.faces.clone()
    if what == "inside out":
        faces = faces.flip(1)
    elif what == "inside the body":
        vertices = vertices * torch.tensor([0.8, 0.8, 1.0])
    elif what == "centimetres":
        vertices = vertices * 100
    elif what == "nan":
        vertices[7] = float("nan")
    elif what == "two parts":
        faces = torch.cat([faces, faces + len(vertices)])
        vertices = torch.cat([vertices, vertices + 3])
    elif what == "non-manifold":
        faces = torch.cat([faces, faces[:1].roll(1, 1)])
        edge = faces[0, :2]
        faces[-1] = torch.tensor([int(edge[1]), int(edge[0]), int(faces[2000, 0])])
    path = export(garment, tmp_path / "bad.ply", faces, vertices)
    with pytest.raises(ValueError, match=says) as caught:
        Garment.load(path, body)
    assert "\n" not in str(caught.value)


def test_unreadable_files_get_one_line(tmp_path):
    with pytest.raises(FileNotFoundError, match="no garment 'robe': expected dress, tshirt, or an OBJ"):
        Garment.load("robe")
    (tmp_path / "shirt.stl").write_text("solid")
    with pytest.raises(ValueError, match=r"expected a garment as \.obj, \.ply or \.npz, got \.stl"):
        Garment.load(tmp_path / "shirt.stl")
    (tmp_path / "half.ply").write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    with pytest.raises(ValueError, match=r"half\.ply"):
        Garment.load(tmp_path / "half.ply")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(ValueError, match=r"points\.obj"):
        Garment.load(tmp_path / "points.obj")
    np.savez(tmp_path / "foreign.npz", a=np.zeros(1))
    with pytest.raises(ValueError, match="is not a garment: it lacks"):
        Garment.load(tmp_path / "foreign.npz")
    other = {key: np.zeros(1) for key in ("name", "vertices", "rest_vertices", "faces")}
    np.savez(tmp_path / "other.npz", format=np.array("garment-9"), **other)
    with pytest.raises(ValueError, match="has format 'garment-9'; expected 'garment-1'"):
        Garment.load(tmp_path / "other.npz")
