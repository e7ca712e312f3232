"""What a layer promises that learns as another motion first and then takes over from it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Layer


class Distilling(Layer):
    """A layer that the event ``distil`` lets take over from its base."""

    @abstractmethod
    def distil(self, splats: Splats) -> tuple[Splats, Sequence[str]]:
        """Take over from the base, without a graph, and drop what that has learnt.

        Args:
            splats: the canonical ones that go through the layer.

        Returns:
            their canonical values from now on, and the names of the parameters that were dropped.
        """
