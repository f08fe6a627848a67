"""6.3: the runtime's networks in kernels of our own.  Regressor, Subspace -> one step of each, float16 matrices.

A frame reads every weight once and computes little with it, so bytes are what it costs.  Files hold matrices in
float16; here they stay so, sums are in float32: torch's numbers from half the bytes, and without onnxruntime.
"""

import contextlib
import logging
import math
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor, nn

from workbench.collisions.limb_kernels import add_rectify_and_normalise, mix_patches, see_limbs, spread_patches
from workbench.collisions.limb_sight import FAR
from workbench.collisions.network_kernels import LANES, dense, gru_step, rectify_and_normalise
from workbench.collisions.posed_corrective import FEATURE_SCALE, MILLI, REACH, PosedCorrective
from workbench.collisions.posing_kernels import joint_transforms
from workbench.collisions.regressor import HIDDEN, LAYERS, Regressor
from workbench.collisions.subspace import LATENTS, Decoder, Subspace
from workbench.collisions.tryon import Networks, TryOn
from workbench.collisions.tryon_onnx import OnnxNetworks
from workbench.extras import MissingExtra
from workbench.geometry.warp_launch import Recorded, shared_array

log = logging.getLogger(__name__)

LARGE = 2.0**15  # float16 ends at nearly 2^16


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
                values = shared_array(self.outputs[None], wp.float32, 2)
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
    """C(theta, beta, x_bar) of one frame; of many at once, as torch has it.

    Layers that all patches share are matrix products of numpy, which read their weights once for all.
    """

    @torch.no_grad()
    def __init__(self, corrective: PosedCorrective):
        """Raises ValueError for networks that are not as files hold them."""
        self.corrective, sight = corrective, corrective.sight
        count, joints, rank = len(corrective.patches), corrective.joints, len(corrective.basis)
        self.rotations, self.rest = np.empty((joints, 3, 3), np.float32), np.empty((joints, 3), np.float32)
        self.anchors, self.features = np.empty((count, 3), np.float32), np.empty((count, sight.size), np.float32)
        self.unturned = np.eye(3, dtype=np.float32)
        self.shape = np.full(corrective.shapes, np.nan, np.float32)  # whose joints and anchors these are
        world, places = wp.zeros(joints, wp.mat33, device="cpu"), wp.zeros(joints, wp.vec3, device="cpu")
        transforms = wp.zeros((joints, LANES), wp.float32, device="cpu")
        starts, ends = (shared_array(bone.int().numpy(), wp.int32) for bone in sight.bones())
        parents = shared_array(np.array(sight.parents, np.int32), wp.int32)
        rest, rotations = shared_array(self.rest, wp.vec3), shared_array(self.rotations, wp.mat33)
        unmoved, weights = wp.zeros(1, wp.vec3, device="cpu"), shared_array(sight.weights.numpy(), wp.float32, 2)
        skeleton = Recorded(joint_transforms, 1, parents, rest, rotations, unmoved, world, places, transforms)
        seen = (shared_array(self.features, wp.float32, 2),)
        anchors = shared_array(self.anchors, wp.vec3)
        self.seeing = [
            skeleton,
            Recorded(see_limbs, count, anchors, weights, transforms, world, places, starts, ends, FAR, *seen),
        ]
        first, own = corrective.first.split([sight.size, len(corrective.first) - sight.size])
        self.first, self.own, self.second = first.numpy(), own.numpy(), corrective.second.numpy()
        self.hidden = [np.empty((count, self.first.shape[1]), np.float32) for _ in range(2)]
        self.common = [np.zeros(self.first.shape[1], np.float32) for _ in range(2)]
        self.rectifying: list[Recorded] = []
        layers = ((corrective.first_own, corrective.first_norm), (corrective.second_own, corrective.second_norm))
        for (shift, norm), hidden, common in zip(layers, self.hidden, self.common, strict=True):
            vectors = (shared_array(v.detach().numpy(), wp.float32) for v in (norm.weight, norm.bias))
            given = (shared_array(common, wp.float32), shared_array(shift.detach().numpy(), wp.float32, 2), *vectors)
            values = shared_array(hidden, wp.float32, 2)
            self.rectifying.append(Recorded(add_rectify_and_normalise, count, *given, norm.eps, values))
        blocks, size, scale = _patch_blocks(corrective)
        self.last, self.last_own = corrective.last.numpy() / scale, corrective.last_own.numpy() / scale
        self.amounts = np.empty((count, rank), np.float32)
        self.values = np.empty((count, size), np.float32)
        values, amounts = shared_array(self.values.reshape(-1), wp.float32), shared_array(self.amounts, wp.float32, 2)
        spread, points = corrective.patches.matrix, corrective.patches.vertices.shape[1]
        places = size * (spread.indices // points) + 3 * (spread.indices % points)
        self.offset = np.empty((corrective.vertex_count, 3), np.float32)
        self.mixing = [
            Recorded(
                mix_patches,
                blocks.size // (LANES * rank),
                size // LANES,
                shared_array(blocks, wp.float16),
                amounts,
                values,
            ),
            Recorded(
                spread_patches,
                len(self.offset),
                shared_array(spread.indptr.astype(np.int32), wp.int32),
                shared_array(places.astype(np.int32), wp.int32),
                shared_array(spread.data.astype(np.float32), wp.float32),
                values,
                shared_array(self.offset, wp.vec3),
            ),
        ]

    def __call__(
        self, rotations: Float[Tensor, "*B J 3 3"], betas: Float[Tensor, "*B K"], latent: Float[Tensor, "*B L"]
    ) -> Float[Tensor, "*B N 3"]:
        if latent.dim() > 1:
            return self.corrective(rotations, betas, latent)
        if not np.array_equal(self.shape, betas.numpy()):
            self.shape = betas.numpy().copy()
            self.rest[:], self.anchors[:] = (found.numpy() for found in self.corrective.sight.at_rest(betas))
        self.rotations[:] = rotations.numpy()
        self.rotations[0] = self.unturned
        for call in self.seeing:
            call()
        np.matmul(FEATURE_SCALE * np.concatenate([self.shape, latent.numpy()]), self.own, out=self.common[0])
        np.matmul(self.features, self.first, out=self.hidden[0])
        self.rectifying[0]()
        np.matmul(self.hidden[0], self.second, out=self.hidden[1])
        self.rectifying[1]()
        np.matmul(self.hidden[1][:, None], self.last, out=self.amounts[:, None])
        self.amounts += self.last_own
        for call in self.mixing:
            call()
        offset = self.offset
        size = math.sqrt(float(np.vdot(offset, offset)) / len(offset)) / MILLI  # metres: `within_reach` of one frame
        return torch.from_numpy(offset * np.float32(REACH / max(size, REACH) / MILLI))


def _patch_blocks(corrective: PosedCorrective) -> tuple[np.ndarray, int, np.float32]:
    """The basis as `mix_patches` reads it, the values of a patch, filled up to whole blocks, and by what power of two
    it is larger than it was: the largest that float16 holds, since of small entries it would lose digits."""
    rank, count = len(corrective.basis), len(corrective.patches)
    basis = corrective.basis.detach().unflatten(1, (count, -1))
    scale = 2.0 ** math.floor(math.log2(LARGE / max(float(basis.abs().max()), 1 / LARGE)))
    basis = scale * basis
    if not torch.equal(basis.half().float(), basis):
        raise ValueError(
            "the corrective's basis is not exact in float16, as one that was loaded from its file is; save and load it "
            "first"
        )
    size = -(-basis.shape[2] // LANES) * LANES
    padded = np.zeros((count, size, rank), np.float16)
    padded[:, : basis.shape[2]] = basis.permute(1, 2, 0).numpy()
    blocks = padded.reshape(count, size // LANES, LANES, rank).transpose(0, 1, 3, 2)
    return np.ascontiguousarray(blocks).reshape(-1), size, np.float32(scale)


def quickest(tryon: TryOn) -> TryOn:
    """The same with the quickest networks there are: these kernels, else onnxruntime, else torch as it is."""
    corrective = tryon.corrective
    if isinstance(corrective, PosedCorrective):
        try:
            corrective = KernelCorrective(corrective)
        except ValueError as why:
            log.warning("the corrective of %s runs in torch, slowly: %s", tryon.garment.name, why)
    for networks in (KernelNetworks, OnnxNetworks):
        with contextlib.suppress(ValueError, MissingExtra):
            return replace(tryon, networks=networks(tryon.regressor, tryon.subspace), corrective=corrective)
    return replace(tryon, corrective=corrective)
