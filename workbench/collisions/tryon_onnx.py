"""6.3: the runtime's networks as ONNX.  Regressor, Subspace, corrective <-> graphs, one frame a call.

The graphs are written operator by operator (GRU, Gemm, LayerNormalization), so that nothing of torch is needed to run
them: `regressor.onnx` inputs (1,1,I), hidden (2,1,H) -> latent (1,L), next hidden; `decoder.onnx` latent -> X (1,3N);
`corrective.onnx` (see `corrective_onnx`) -> C (N,3).
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from workbench.collisions.corrective_onnx import corrective_graph
from workbench.collisions.motion_descriptor import DESCRIPTOR_SIZE
from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.regressor import HIDDEN, LAYERS, Regressor
from workbench.collisions.subspace import LATENTS, Decoder, DenseDecoder, Subspace
from workbench.collisions.tryon import Networks
from workbench.extras import require
from workbench.learning.onnx_graph import Graph
from workbench.store import atomic_write

GATES = (1, 0, 2)  # torch stores reset, update, new; ONNX update, reset, new


def regressor_graph(regressor: Regressor) -> Any:
    """The recurrent step: standardised inputs and hidden state -> latent and the next hidden state."""
    graph, source, states = Graph(), "inputs", []
    inputs = DESCRIPTOR_SIZE + regressor.shapes
    split = [f"hidden_{layer}" for layer in range(LAYERS)]
    graph.node("Split", ["hidden"], split, axis=0, num_outputs=LAYERS)
    for layer in range(LAYERS):
        weights = {
            kind: _gates(getattr(regressor.gru, f"{name}_l{layer}"))
            for kind, name in (("W", "weight_ih"), ("R", "weight_hh"), ("b", "bias_ih"), ("c", "bias_hh"))
        }
        names = [
            graph.constant(f"W{layer}", weights["W"][None]),
            graph.constant(f"R{layer}", weights["R"][None]),
            graph.constant(f"B{layer}", torch.cat([weights["b"], weights["c"]])[None]),
        ]
        outputs = [f"out_{layer}", f"state_{layer}"]
        graph.node("GRU", [source, *names, "", split[layer]], outputs, hidden_size=HIDDEN, linear_before_reset=1)
        states.append(outputs[1])
        source = graph.node(
            "Squeeze", [outputs[0], graph.constant(f"axes{layer}", np.array([1]))], [f"sequence_{layer}"]
        )
    graph.node("Concat", states, ["next"], axis=0)
    flat = graph.node("Reshape", [source, graph.constant("flat", np.array([1, HIDDEN]))], ["last_hidden"])
    graph.node("Identity", [graph.dense("dense", regressor.last, flat)], ["latent"])
    shapes = {"inputs": [1, 1, inputs], "hidden": [LAYERS, 1, HIDDEN]}
    return graph.model("regressor", shapes, {"latent": [1, LATENTS], "next": [LAYERS, 1, HIDDEN]})


def _gates(stacked: Tensor) -> Tensor:
    parts = stacked.detach().chunk(3)
    return torch.cat([parts[gate] for gate in GATES])


def decoder_graph(subspace: Subspace) -> Any:
    """latent (1,25) -> X (1,3N)."""
    graph, source = Graph(), "latent"
    for index, layer in enumerate(subspace.decoder.trunk.layers):
        name = f"trunk_{index}"
        if isinstance(layer, nn.Linear):
            source = graph.dense(name, layer, source)
        elif isinstance(layer, nn.ReLU):
            source = graph.node("Relu", [source], [name])
        else:
            assert isinstance(layer, nn.LayerNorm)
            scale, shift = graph.constant(f"{name}.scale", layer.weight), graph.constant(f"{name}.shift", layer.bias)
            source = graph.node("LayerNormalization", [source, scale, shift], [name], axis=-1, epsilon=layer.eps)
    decoder = subspace.decoder
    if isinstance(decoder, Decoder):
        learned = graph.dense("learned", decoder.amounts, source)
        beyond = decoder.amounts.out_features - LATENTS
        pads = graph.constant("pads", np.array([0, 0, 0, beyond]))
        amounts = graph.node("Add", [learned, graph.node("Pad", ["latent", pads], ["leading"])], ["amounts"])
        graph.node(
            "Gemm", [amounts, graph.constant("basis", decoder.basis), graph.constant("mean", decoder.middle)], ["X"]
        )
    else:
        assert isinstance(decoder, DenseDecoder)
        last = graph.dense("last", decoder.last, source)
        wide = graph.node("Mul", [last, graph.constant("spread", decoder.spread)], ["wide"])
        graph.node("Add", [wide, graph.constant("mean", decoder.middle)], ["X"])
    return graph.model("decoder", {"latent": [1, LATENTS]}, {"X": [1, 3 * subspace.vertex_count]})


def write_onnx(
    folder: Path, regressor: Regressor, subspace: Subspace, corrective: PosedCorrective | None = None
) -> list[Path]:
    """regressor.onnx, decoder.onnx and, where there is one, corrective.onnx in the folder, each whole or not at all."""
    models = {"regressor": regressor_graph(regressor), "decoder": decoder_graph(subspace)}
    if corrective is not None:
        models["corrective"] = corrective_graph(corrective)
    written = []
    for name, model in models.items():
        path = folder / f"{subspace.garment_name}-{name}.onnx"
        with atomic_write(path) as part:
            part.write_bytes(model.SerializeToString())
        written.append(path)
    return written


class OnnxNetworks(Networks):
    """The same two networks in onnxruntime, on one thread (two are slower when anything else runs: facts.md 5)."""

    def __init__(self, regressor: Regressor, subspace: Subspace):
        onnxruntime: Any = require("onnxruntime", extra="runtime")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3

        def session(model: Any) -> Any:
            return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])

        self.regressor, self.decoder = session(regressor_graph(regressor)), session(decoder_graph(subspace))

    def regress(
        self, inputs: Float[Tensor, "I"], hidden: Float[Tensor, "Y 1 H"]
    ) -> tuple[Float[Tensor, "L"], Float[Tensor, "Y 1 H"]]:
        given = {"inputs": inputs.numpy()[None, None], "hidden": hidden.numpy()}
        latent, following = self.regressor.run(["latent", "next"], given)
        return torch.from_numpy(latent)[0], torch.from_numpy(following)

    def decode(self, latent: Float[Tensor, "L"]) -> Float[Tensor, "N 3"]:
        return torch.from_numpy(self.decoder.run(["X"], {"latent": latent.numpy()[None]})[0]).reshape(-1, 3)
