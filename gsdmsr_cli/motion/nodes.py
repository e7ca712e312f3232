"""SC-GS (Huang et al., CVPR 2024): few nodes move, and splats follow the nodes near them.

SC-GS asks a network of positional encodings where its nodes are at a time. Here they read it off a
HexPlane (4D-GS, Wu et al. 2024), which learns within minutes.

What a training knows of a moment is one view of it. A field asked by every splat can fit that view
in ways that are wrong from all other sides; one that is asked by a thousand nodes, each of which
takes its neighbourhood along as a rigid body would go, has less freedom to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli import strict
from gsdmsr_cli.fields import network, planes, skinning
from gsdmsr_cli.fields.deformation import OUTPUTS, name_tensors, time_nodes, trained
from gsdmsr_cli.motion import Facts
from gsdmsr_cli.splats import Splats

_NODES, _LOG_RADII = "nodes", "log_radii"

OPAQUE = 0.1
"""Nodes are put where splats of this opacity or more are."""

LEAST_SPACING = 1e-3
"""Least radius that nodes begin with, in units of the bound."""


@dataclass(frozen=True)
class Options:
    """Settings of the nodes, of their field and its regularisers.

    Attributes:
        count: number of nodes, 4 or more.
        neighbours: how many of them each splat follows, at most ``count``.
        levels: spatial nodes of each level of the grid along an axis.
        channels: features per level, a multiple of 16.
        time_ratio: the grid's nodes in time per distinct train time.
        width: width of the network's two hidden layers, a multiple of 16.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
        rigidity: weight of nodes' moving otherwise than as parts of a rigid body would.
    """

    count: int = 1024
    neighbours: int = 8
    levels: tuple[int, ...] = (16, 32)
    channels: int = 16
    time_ratio: float = 0.2
    width: int = 32
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4
    rigidity: float = 0.05

    def __post_init__(self) -> None:
        strict.require(self, "count", self.count > skinning.SPACING_OF, "4 or more")
        within = 1 <= self.neighbours <= self.count
        strict.require(self, "neighbours", within, f"1 to count, which is {self.count}")


class NodeMotion:
    """Nodes with radii, which splats follow; their places, turns and growth come from a grid."""

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options, self.facts = options, facts
        lower, upper = torch.tensor(facts.box)
        anywhere = torch.rand(options.count, 3, generator=generator)
        nodes = skinning.spread_nodes(lower + (upper - lower) * anywhere, options.count)
        self.nodes = torch.nn.Parameter(nodes)
        self.log_radii = torch.nn.Parameter(self._reach(nodes))
        times = time_nodes(facts.frames, options.time_ratio)
        self.levels = [
            trained(planes.new_level(resolution, times, options.channels, generator))
            for resolution in options.levels
        ]
        widths = [options.channels * len(options.levels), options.width, options.width, OUTPUTS]
        self.layers = [trained(layer) for layer in network.new_network(widths, generator)]
        self._near: Tensor | None = None
        self._found_for: Tensor | None = None
        self._pairs = torch.zeros(options.count, options.neighbours, dtype=torch.int32)

    def _reach(self, nodes: Tensor) -> Tensor:
        """Return the logarithms of the radii that nodes begin with."""
        return skinning.spacing(nodes).clamp(min=LEAST_SPACING * self.facts.bound).log()

    def at(self, splats: Splats, time: float) -> Splats:
        """Return the splats where their nodes take them; time is mapped to the whole grid."""
        transforms = self._transforms(self.nodes, time)
        near = self._neighbours(splats.means)
        return skinning.skin(splats, self.nodes, self.log_radii, transforms, near)

    def _transforms(self, nodes: Tensor, time: float) -> Tensor:
        features = planes.lookup(self.levels, nodes, 2 * time - 1, self.facts.box)
        return skinning.transforms(nodes, network.apply_network(self.layers, features))

    def _neighbours(self, means: Tensor) -> Tensor:
        """Return the nodes that splats follow.

        They are looked for anew whenever splats or nodes may have changed: always in training, and
        once for all the moments at which a finished model is drawn.
        """
        if self._near is None or len(self._near) != len(means):
            self._near = torch.zeros(len(means), self.options.neighbours, dtype=torch.int32)
            self._found_for = None
        unchanged = self._found_for is not None and self._found_for.data_ptr() == means.data_ptr()
        if torch.is_grad_enabled() or not unchanged:
            self._near = skinning.nearest_nodes(means, self.nodes, self._near.to(means.device))
            # held, so that no other splats get this memory
            self._found_for = None if torch.is_grad_enabled() else means.detach()
        return self._near

    def root(self, splats: Splats) -> Sequence[str]:
        """Spread the nodes over the splats there are, those aside that hardly show.

        What the grid says of a place stays, so splats go on as they did, nearly.
        """
        opaque = splats.means[torch.sigmoid(splats.logit_opacities) >= OPAQUE]
        places = opaque if len(opaque) >= self.options.count else splats.means
        if not len(places):
            return ()
        nodes = skinning.spread_nodes(places, self.options.count)
        self.nodes.copy_(nodes)
        self.log_radii.copy_(self._reach(nodes))
        self._found_for = None
        return _NODES, _LOG_RADII

    def take(self, rows: Tensor) -> None:
        """Let every row's nodes be looked for: nothing is held per splat."""
        self._near = self._found_for = None

    def advance(self, progress: float) -> None:
        """Have no phases; but what is found is not kept from one step to the next."""
        self._found_for = None

    def penalty(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the plane regularisers, and the nodes' rigidity at any moment, not only ``time``.

        Nodes are not drawn to where they would be more rigid: only what the grid says of them is.
        """
        o = self.options
        value = planes.penalty(self.levels, o.space_smoothness, o.time_smoothness, o.time_stillness)
        if not o.rigidity:
            return value
        nodes = self.nodes.detach()
        self._pairs = skinning.nearest_nodes(nodes, nodes, self._pairs.to(nodes.device))
        moment = float(torch.rand((), generator=generator))
        return value + o.rigidity * skinning.rigidity(
            nodes, self._transforms(nodes, moment), self._pairs
        )

    def tensors(self) -> dict[str, Tensor]:
        """Return the nodes, their radii, the grid and the network."""
        own = {_NODES: self.nodes, _LOG_RADII: self.log_radii}
        return own | name_tensors({"grid": self.levels}, {"network": self.layers})

    def groups(self) -> dict[str, str]:
        """Return which learning rate each tensor follows."""
        return {n: "planes" if n.startswith("grid") else "network" for n in self.tensors()}


def start(options: Options, facts: Facts, count: int, generator: torch.Generator) -> NodeMotion:
    """Return a motion that is the identity until its network's last layer has learnt."""
    return NodeMotion(options, facts, generator)
