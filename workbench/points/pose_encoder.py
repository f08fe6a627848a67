"""Sec. 3.2: what the pose does to clothes, for every point of the body.  I (B,3 or 6,H,W) -> P (B,64,H,W).

One UNet whose depth is a number: each level halves the map by a 4x4 convolution of stride 2, and the way up doubles it,
by transposed convolutions below and by bilinear reading and 3x3 convolutions in the last three levels (transposed ones
leave a chequer there).  Levels of the same size are joined.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2  # of the leaky rectifiers on the way down; facts.md 2
SMOOTH_LEVELS = 3  # from the top, that go up by bilinear reading; facts.md 2
WIDEST = 8  # channels of the deepest levels, in units of `width`


@dataclass(frozen=True)
class PoseEncoderConfig:
    """The UNet; the paper's by default (10.35 M parameters; facts.md 2)."""

    depth: int = 7  # levels: 128 pixels -> 1
    width: int = 32  # channels of the first level
    features: int = 64  # channels of P; section 3.2
    reach: float = 1.0  # metres that become 1 at the input; ours
    # 3: the neutral body alone, as published.  6: also the build of who wears the clothes (`PosedBodies.seen`)
    channels: int = 3


class PoseEncoder(nn.Module):
    """A position map (`PosedBodies.seen`, of which it reads the first channels) -> pose features, pixel for pixel."""

    def __init__(self, config: PoseEncoderConfig = PoseEncoderConfig(), *, generator: torch.Generator):
        super().__init__()
        if config.depth < 1:
            raise ValueError(f"the pose encoder needs at least one level, got depth={config.depth}")
        self.config = config
        down = [config.channels, *[config.width * min(2**level, WIDEST) for level in range(config.depth)]]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for level in range(config.depth):
            # neither the first nor the last level is normalised: at the bottom a map may be a single number
            normed = 0 < level < config.depth - 1
            self.down.append(_Down(down[level], down[level + 1], first=level == 0, normed=normed))
        for level in reversed(range(config.depth)):
            inputs = down[level + 1] * (1 if level == config.depth - 1 else 2)
            outputs = config.features if level == 0 else down[level]
            up = _SmoothUp if level < SMOOTH_LEVELS else _TransposedUp
            self.up.append(up(inputs, outputs, last=level == 0))
        _initialise(self, generator)
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  with bfloat16, 222 ms a step against 400 (facts.md 2)

    def forward(self, position_map: Float[Tensor, "B i H W"]) -> Float[Tensor, "B c H W"]:
        """Raises ValueError where the map cannot be halved `depth` times, or has too few channels."""
        height, width = position_map.shape[-2:]
        if height % 2**self.config.depth or width % 2**self.config.depth:
            raise ValueError(
                f"a map of {height} x {width} pixels cannot be halved {self.config.depth} times; "
                f"give sides that are multiples of {2**self.config.depth}, or lower the encoder's depth"
            )
        if position_map.shape[-3] < self.config.channels:
            raise ValueError(
                f"this pose encoder reads maps of {self.config.channels} channels, got {position_map.shape[-3]}; "
                "give it `atlas.map_of(bodies.seen)`"
            )
        x = (position_map[..., : self.config.channels, :, :] / self.config.reach).contiguous(
            memory_format=torch.channels_last
        )
        levels = []
        for down in self.down:
            x = down(x)
            levels.append(x)
        x = levels.pop()
        for up in self.up:
            x = up(x)
            if levels:
                x = torch.cat([x, levels.pop()], 1)
        return x


class _Down(nn.Module):
    def __init__(self, inputs: int, outputs: int, *, first: bool, normed: bool):
        super().__init__()
        self.first = first
        self.convolution = nn.Conv2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs, affine=False, momentum=None) if normed else nn.Identity()

    def forward(self, x: Float[Tensor, "B i H W"]) -> Float[Tensor, "B o h w"]:
        return self.norm(self.convolution(x if self.first else nn.functional.leaky_relu(x, SLOPE)))


class _TransposedUp(nn.Module):
    def __init__(self, inputs: int, outputs: int, *, last: bool):
        super().__init__()
        self.convolution = nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=False)
        self.norm = nn.Identity() if last else nn.BatchNorm2d(outputs, affine=False, momentum=None)

    def forward(self, x: Float[Tensor, "B i h w"]) -> Float[Tensor, "B o H W"]:
        return self.norm(self.convolution(torch.relu(x)))


class _SmoothUp(nn.Module):
    def __init__(self, inputs: int, outputs: int, *, last: bool):
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, padding=1, bias=last)
        self.norm = nn.Identity() if last else nn.BatchNorm2d(outputs, affine=False, momentum=None)

    def forward(self, x: Float[Tensor, "B i h w"]) -> Float[Tensor, "B o H W"]:
        larger = nn.functional.interpolate(torch.relu(x), scale_factor=2, mode="bilinear", align_corners=False)
        return self.norm(self.convolution(larger))


def _initialise(module: nn.Module, generator: torch.Generator) -> None:
    """He's initialisation for leaky rectifiers (ours)."""
    for part in module.modules():
        if isinstance(part, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.kaiming_normal_(part.weight, SLOPE, generator=generator)
            if part.bias is not None:
                nn.init.zeros_(part.bias)
