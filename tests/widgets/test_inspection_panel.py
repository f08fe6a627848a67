"""Collisions: the heat map is the inspection's, the marks are its counts, the page is the inspector's."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from widgets.inspection_panel import draw_heat_map
from widgets.view import view
from workbench.collisions.inspection import inspect_collisions
from workbench.formats.mesh_sequence import DressedSequence, MeshSequence, write_dressed_sequence
from workbench.garments import Garment
from workbench.inspector import InspectConfig, run


@pytest.fixture(scope="module")
def sequence(body):
    """The T-shirt sinks into the body from frame to frame."""
    shirt = Garment.load("tshirt")
    sunk = torch.stack([shirt.vertices + torch.tensor([0.0, 0.03 * frame, 0.0]) for frame in range(3)])
    return body.template[None].expand(3, -1, -1).contiguous(), sunk, shirt.faces


@pytest.fixture(scope="module")
def found(body, sequence):
    return inspect_collisions(sequence[0], body.faces, sequence[1], sequence[2])


def test_the_heat_map_is_the_inspection_s(found):
    figure = Figure()
    draw_heat_map(figure, found, 1)
    counts = found.heat_map.numpy()
    hit = counts.any(axis=0)
    drawn = figure.axes[0].images[0].get_array()
    assert drawn is not None
    np.testing.assert_array_equal(np.ma.filled(drawn, 0), counts[:, hit].T)
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        name for name, there in zip(found.regions.names, hit) if there
    ]
    assert f"{int(found.inside.sum()):,} of {found.inside.numel():,}" in view(found).readout


def test_a_clean_sequence_says_so(body, sequence):
    clean = inspect_collisions(body.template[None], body.faces, sequence[1][:1], sequence[2])
    figure = Figure()
    draw_heat_map(figure, clean, None)
    assert [text.get_text() for text in figure.axes[0].texts] == ["nothing collides"]


def test_a_report_is_shown_beside_its_map(tmp_path, body, sequence, found):
    bodies, garment, faces = sequence
    dressed = DressedSequence(
        MeshSequence(bodies.numpy(), body.faces.numpy(), 30.0, "body"),
        MeshSequence(garment.numpy(), faces.numpy(), 30.0, "garment"),
    )
    write_dressed_sequence(tmp_path / "a.npz", dressed)
    panel = view(run(InspectConfig(tmp_path / "a.npz", out=tmp_path / "out")))
    np.testing.assert_array_equal(panel.layer("garment").marked, found.inside.numpy())
    assert '<svg id="heat"' in panel.page(tmp_path / "page.html").read_text()  # the inspector's own page
