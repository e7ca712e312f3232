"""One training of a stream: a trainer that sees one moment at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import MOTION
from gsdmsr_cli.model.motion._streamed import Streamed
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.gradients.compare import gradients_of
from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.ranks.alone import ALONE, Ranks
from gsdmsr_cli.training.streaming.clock import StreamClock
from gsdmsr_cli.training.streaming.shots import Shot, first_shot, shots_of
from gsdmsr_cli.training.streaming.stiffness import Compared, Stiffness
from gsdmsr_cli.training.trainer import PENALTY_EVERY, Penalty, Trainer

_KEY = "stream"


class StreamTrainer(Trainer):
    """A trainer whose views are those of the present moment.

    At the first moment nothing moves, and all that is trained of splats and further layers is. At
    later ones the motion is alone; events do not happen, and there are always as many splats.

    Attributes:
        shots: of all moments.
        clock: knows the present moment.
        settled: whether the present moment is over, and its values those that stay.
    """

    clock: StreamClock

    def __init__(
        self,
        scene: Scene,
        preset: Preset,
        engine: Engine,
        pictures: Pictures,
        device: torch.device | str = "cpu",
        ranks: Ranks = ALONE,
    ) -> None:
        super().__init__(scene, preset, engine, pictures, device, ranks)
        self.shots = shots_of(self.views)
        self.clock = StreamClock(1, None, moments=len(self.shots))
        self.clock.measure(preset)
        self.settled = False
        self._stiffness = Stiffness(preset.stream)
        self._see()

    @property
    def shot(self) -> Shot:
        """The present moment."""
        return self.shots[self.clock.moment]

    @property
    def motion(self) -> Streamed:
        """The motion of the model."""
        return cast(Streamed, self.model.layers[MOTION])

    @property
    def frozen(self) -> bool:
        """Whether the canonical splats stay as they are, as at all moments but the first."""
        return self.clock.moment > 0

    @property
    def learnt(self) -> frozenset[str]:
        """The names of what a moment after the first learns."""
        return frozenset(f"{MOTION}.{name}" for name in self.motion.learnt)

    def begin_next(self) -> None:
        """Let the next moment begin where the last one would go on to."""
        last, self.settled = self.shot.time, False
        self.clock.begin(self.clock.moment + 1, self.preset)
        with self._change():
            if not self.population.moving:
                self.population.begin_moving()
                for name in self.model.trained():
                    self.optimizer.forget(name)
            for name in self.learnt:
                self.optimizer.forget(name)
            given = self.shots[0].time, last, self.shot.time
            self.motion.go_on(*given, self.preset.stream.extrapolate)
            self.population.average.clear()
        self._see()

    @torch.no_grad()
    def settle(self) -> None:
        """Let the values be those that the present moment has led to; once."""
        if self.settled:
            return
        with self._change():
            average, tensors = self.population.average, self.model.trained()
            if average.count:
                for name, tensor in tensors.items():
                    tensor.copy_(average.tensors[name])
            average.clear()
            self.motion.settle(self._moving(), first=not self.clock.moment)
        self.settled = True

    def _see(self) -> None:
        """Look at the present moment."""
        self.queue = []
        self._times = [shot.time for shot in self.shots[: self.clock.moment + 1]]

    def _beginning(self) -> Scene:
        return first_shot(self.scene)

    def _enter_phase(self, progress: float) -> None:
        if self.device.type == "cpu" and not self.clock.moment:
            self.population.drop_not_finite()
        self.model.advance(progress)

    def _next_row(self, progress: float) -> int:
        """Return the next view of a random order that visits all of the moment before any again."""
        rows = self.shot.rows
        if not self.queue:
            order = torch.randperm(len(rows), generator=self.generator)
            self.queue = [rows[i] for i in order.tolist()]
        return self.queue.pop()

    def _penalty(self, order: Order, progress: float) -> Penalty | None:
        """Return how far neighbours are from moving together, and its gradients."""
        if not (self.frozen and self._stiffness) or self.clock.step % PENALTY_EVERY:
            return None
        value = self._stiffness(self._compared(), self.generator)
        return None if value is None else (value.detach(), gradients_of(value, self.model))

    def _compared(self) -> Compared:
        """Return the splats that move at this moment, the one before and the first."""
        canonical = Moment(self._moving())

        def at(time: float) -> Splats:
            return self.motion.at(canonical, Instant(time)).splats

        with torch.no_grad():
            before, first = at(self._times[-2]), at(self._times[0])
        return Compared(at(self._times[-1]), before, first)

    def _moving(self) -> Splats:
        """Return the splats that move, as they are at the first moment, without a copy."""
        return self.model.splats.map(lambda tensor: tensor[: self.model.moving])

    def _learning(self) -> dict[str, Tensor]:
        """Return what the present moment learns; what it does not loses its gradient."""
        trained, learnt = self.model.trained(), self.learnt
        later = self.clock.moment > 0
        for name, tensor in trained.items():
            if (name in learnt) != later:
                tensor.grad = None
        return {name: tensor for name, tensor in trained.items() if (name in learnt) == later}

    def _update(self, progress: float, loss: Tensor, gated: Sequence[ViewGradients] | None) -> None:
        super()._update(progress, loss, gated)
        if self.clock.moment:
            self._mend()

    def _mend(self) -> None:
        """Let the motion mend what is not finite, which then has no momentum."""
        for name, lost in self.motion.mend().items():
            for moments in (self.optimizer.first, self.optimizer.second):
                if (own := moments.get(f"{MOTION}.{name}")) is not None:
                    own[lost] = 0

    def _apply_events(self, tick: Tick) -> None:
        if not self.clock.moment:
            super()._apply_events(tick)

    def checkpoint(self) -> Checkpoint:
        """Return all that is needed to go on from here; the moments' files are apart."""
        taken = super().checkpoint()
        own = {**self.clock.state(), "settled": self.settled}
        return replace(taken, state={**taken.state, _KEY: own})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same preset and scene."""
        super().restore(checkpoint)
        own = checkpoint.state[_KEY]
        self.clock.restore(own)
        self.clock.measure(self.preset)
        self.settled = bool(own["settled"])
        queue = self.queue
        self._see()
        self.queue = queue
