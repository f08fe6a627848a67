"""6.3: the runtime's networks in kernels of our own.  Regressor, Subspace -> one step of each, float16 matrices.

A frame reads every weight once and computes little with it, so bytes are what it costs.  Files hold matrices in
float16; here they stay so, sums are in float32: torch's numbers from half the bytes, and without onnxruntime.
"""

import contextlib
import math
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor, nn

from workbench.collisions.network_kernels import LANES, dense, gru_step, rectify_and_normalise
from workbench.collisions.posed_corrective import FEATURE_SCALE, MILLI, REACH, PosedCorrective
from workbench.collisions.regressor import HIDDEN, LAYERS, Regressor
from workbench.collisions.subspace import LATENTS, Decoder, Subspace
from workbench.collisions.tryon import Networks, TryOn
from workbench.collisions.tryon_onnx import OnnxNetworks
from workbench.extras import MissingExtra
from workbench.geometry.warp_launch import Recorded, shared_array


class Dense:
    """y = W x + b on fixed arrays: `inputs` (i) in, `outputs` (o) out."""

    def __init__(self, name: str, weight: Float[Tensor, "o i"], bias: Float[Tensor, "o"], inputs: np.ndarray):
        """Raises ValueError for a matrix that float16 cannot hold exactly."""
        if not torch.equal(weight.half().float(), weight):
            raise ValueError(
                f"{name} is not exact in float16, as a network that was loaded from its file is; save and load it first"
            )
        count, width = weight.shape
        padded = np.zeros((-(-count // LANES) * LANES, width), np.float16)
        padded[:count] = weight.numpy()
        blocks = np.ascontiguousarray(padded.reshape(-1, LANES, width).transpose(0, 2, 1)).reshape(-1)
        shift = np.zeros(len(padded), np.float32)
        shift[:count] = bias.numpy()
        every = np.zeros(len(padded), np.float32)
        self.outputs: Float[np.ndarray, "o"] = every[:count]
        self.call = Recorded(
            dense,
            len(padded) // LANES,
            shared_array(blocks, wp.float16),
            shared_array(shift, wp.float32),
            shared_array(inputs, wp.float32),
            shared_array(every, wp.float32),
        )


class Trunk:
    """Dense layers, each perhaps with ReLU and LayerNorm, on fixed arrays."""

    def __init__(self, name: str, layers: nn.Sequential, inputs: np.ndarray):
        """Raises ValueError for a matrix that float16 cannot hold exactly."""
        self.calls: list[Recorded] = []
        self.outputs = inputs
        for index, layer in enumerate(layers):
            if isinstance(layer, nn.Linear):
                made = Dense(f"{name} layer {index}", layer.weight, layer.bias, self.outputs)
                self.calls.append(made.call)
                self.outputs = made.outputs
            elif isinstance(layer, nn.LayerNorm):  # the ReLU before it comes with it
                scale, shift = (shared_array(p.detach().numpy(), wp.float32) for p in (layer.weight, layer.bias))
                values = shared_array(self.outputs, wp.float32)
                self.calls.append(Recorded(rectify_and_normalise, 1, scale, shift, layer.eps, values))


class KernelNetworks(Networks):
    """The GRU and a decoder of low rank."""

    @torch.no_grad()
    def __init__(self, regressor: Regressor, subspace: Subspace):
        """Raises ValueError for networks that are not as files hold them, or a dense last layer (`paper_size`)."""
        decoder = subspace.decoder
        if not isinstance(decoder, Decoder):
            raise ValueError("these kernels have no dense last layer: run such a decoder in torch or onnxruntime")
        gru = dict(regressor.gru.named_parameters())
        self.inputs = np.zeros(gru["weight_ih_l0"].shape[1], np.float32)
        self.hidden = np.zeros((LAYERS, HIDDEN), np.float32)
        self.regressing: list[Recorded] = []
        source = self.inputs
        for layer in range(LAYERS):
            state = self.hidden[layer]
            gates = [
                Dense(f"the regressor's {weight}", gru[weight], gru[weight.replace("weight", "bias")], array)
                for weight, array in ((f"weight_ih_l{layer}", source), (f"weight_hh_l{layer}", state))
            ]
            arrays = [*(gate.outputs for gate in gates), state]
            step = Recorded(gru_step, HIDDEN, *(shared_array(array, wp.float32) for array in arrays))
            self.regressing += [*(gate.call for gate in gates), step]
            source = state
        last = Dense("the regressor's last layer", regressor.last.weight, regressor.last.bias, source)
        self.regressing.append(last.call)
        self.found = last.outputs

        self.latent = np.zeros(LATENTS, np.float32)
        trunk = Trunk("the decoder's", decoder.trunk.layers, self.latent)
        self.decoding = trunk.calls
        amounts = Dense("the decoder's amounts", decoder.amounts.weight, decoder.amounts.bias, trunk.outputs)
        self.decoding.append(amounts.call)
        self.amounts = amounts.outputs
        self.spread = Dense("the decoder's basis", decoder.basis.T, decoder.middle, self.amounts)

    def regress(
        self, inputs: Float[Tensor, "I"], hidden: Float[Tensor, "Y 1 H"]
    ) -> tuple[Float[Tensor, "L"], Float[Tensor, "Y 1 H"]]:
        self.inputs[:] = inputs.numpy()
        self.hidden[:] = hidden.numpy()[:, 0]
        for call in self.regressing:
            call()
        return torch.from_numpy(self.found.copy()), torch.from_numpy(self.hidden.copy())[:, None]

    def decode(self, latent: Float[Tensor, "L"]) -> Float[Tensor, "N 3"]:
        self.latent[:] = latent.numpy()
        for call in self.decoding:
            call()
        self.amounts[:LATENTS] += self.latent
        self.spread.call()
        return torch.from_numpy(self.spread.outputs.copy()).reshape(-1, 3)


class KernelCorrective:
    """C(theta, beta, x_bar) of one frame; of many at once, as torch has it."""

    @torch.no_grad()
    def __init__(self, corrective: PosedCorrective):
        """Raises ValueError for networks that are not as files hold them."""
        self.corrective = corrective
        first = corrective.layers[0]
        assert isinstance(first, nn.Linear)
        self.inputs = np.zeros(first.in_features, np.float32)
        self.trunk = Trunk("the corrective's", corrective.layers, self.inputs)
        basis = corrective.basis.T
        self.spread = Dense("the corrective's basis", basis, basis.new_zeros(len(basis)), self.trunk.outputs)

    def __call__(
        self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"], latent: Float[Tensor, "*B L"]
    ) -> Float[Tensor, "*B N 3"]:
        if latent.dim() > 1:
            return self.corrective(rotations, betas, latent)
        pose = (rotations.numpy()[1:] - np.eye(3, dtype=np.float32)).reshape(-1)
        np.concatenate([pose, FEATURE_SCALE * betas.numpy(), FEATURE_SCALE * latent.numpy()], out=self.inputs)
        for call in (*self.trunk.calls, self.spread.call):
            call()
        flat = self.spread.outputs
        size = math.sqrt(3 * float(flat @ flat) / len(flat)) / MILLI  # metres: `within_reach` of one frame
        return torch.from_numpy(flat * np.float32(REACH / max(size, REACH) / MILLI)).reshape(-1, 3)


def quickest(tryon: TryOn) -> TryOn:
    """The same with the quickest networks there are: these kernels, else onnxruntime, else torch as it is."""
    corrective = tryon.corrective
    if isinstance(corrective, PosedCorrective):
        with contextlib.suppress(ValueError):
            corrective = KernelCorrective(corrective)
    for networks in (KernelNetworks, OnnxNetworks):
        with contextlib.suppress(ValueError, MissingExtra):
            return replace(tryon, networks=networks(tryon.regressor, tryon.subspace), corrective=corrective)
    return replace(tryon, corrective=corrective)
