"""Defines the convolutional networks of LPIPS, with torchvision's names of their weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Architecture:
    """One network that LPIPS can stand on.

    Attributes:
        build: makes the trunk up to its last tap, ``features`` of torchvision's network.
        taps: indices of the layers (all ReLUs or Fire modules) whose outputs are compared.
        channels: channels at each tap.
        checkpoint: name of torchvision's weights file.
        smallest: smallest height and width that the trunk accepts [px].
    """

    build: Callable[[], nn.Sequential]
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    checkpoint: str
    smallest: int


def _alex() -> nn.Sequential:
    """AlexNet (Krizhevsky 2014)."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(64, 192, 5, padding=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, stride=2),
        nn.Conv2d(192, 384, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, padding=1),
        nn.ReLU(inplace=True),
    )


def _vgg() -> nn.Sequential:
    """VGG-16 (Simonyan and Zisserman 2015): five blocks of 3 x 3 convolutions, pooling between."""
    layers: list[nn.Module] = []
    before = 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        if layers:
            layers.append(nn.MaxPool2d(2))
        for after in block:
            layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(inplace=True)]
            before = after
    return nn.Sequential(*layers)


class _Fire(nn.Module):
    """SqueezeNet's module: 1 x 1 squeeze, then 1 x 1 and 3 x 3 expansions side by side."""

    def __init__(self, before: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(before, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, before, H, W) to (B, 2 expanded, H, W)."""
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x), self.expand3x3(x)], 1).relu()


def _squeeze() -> nn.Sequential:
    """SqueezeNet 1.1 (Iandola et al. 2016)."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 3, stride=2),
        nn.ReLU(inplace=True),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(64, 16, 64),
        _Fire(128, 16, 64),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(128, 32, 128),
        _Fire(256, 32, 128),
        nn.MaxPool2d(3, stride=2, ceil_mode=True),
        _Fire(256, 48, 192),
        _Fire(384, 48, 192),
        _Fire(384, 64, 256),
        _Fire(512, 64, 256),
    )


ARCHITECTURES = {
    "alex": Architecture(
        _alex, (1, 4, 7, 9, 11), (64, 192, 384, 256, 256), "alexnet-owt-7be5be79.pth", 31
    ),
    "squeeze": Architecture(
        _squeeze,
        (1, 4, 7, 9, 10, 11, 12),
        (64, 128, 256, 384, 384, 512, 512),
        "squeezenet1_1-b8a52dc0.pth",
        17,
    ),
    "vgg": Architecture(
        _vgg, (3, 8, 15, 22, 29), (64, 128, 256, 512, 512), "vgg16-397923af.pth", 16
    ),
}
"""The networks by the name that LPIPS gives them."""
