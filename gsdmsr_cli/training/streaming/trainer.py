"""One training of a stream: a trainer that sees one moment at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor

from gsdmsr_cli.drawing.splatting import draw_shown, show
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import NAMES, Splats, together
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.layers.newcomers import OWN, Newcomers
from gsdmsr_cli.model.model import MOTION
from gsdmsr_cli.model.motion._streamed import Streamed
from gsdmsr_cli.ops.spread import SPACING_OF, spacing
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import MASK, Scene, View
from gsdmsr_cli.training.gradients.compare import gradients_of
from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.ranks.alone import ALONE, Ranks
from gsdmsr_cli.training.resizing import Resize
from gsdmsr_cli.training.streaming.changes import Changes
from gsdmsr_cli.training.streaming.clock import StreamClock
from gsdmsr_cli.training.streaming.noticing import Look, find_places, look
from gsdmsr_cli.training.streaming.shots import Shot, first_shot, shots_of
from gsdmsr_cli.training.streaming.stiffness import Compared, Stiffness
from gsdmsr_cli.training.trainer import PENALTY_EVERY, Penalty, Trainer

PLACED_AT = 0.3
"""Progress of a moment at which newcomers are placed: until then what was there has moved on."""

_LOOKS = 12
"""Cameras of a moment whose errors are looked at."""

_KEY = "stream"

_OF_NEWCOMERS = frozenset(OWN + name for name in NAMES)


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
        self.settled, self._placed = False, False
        self._stiffness = Stiffness(preset.stream)
        self._changes = Changes(preset.stream.changed, self.views, pictures)
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
    def newcomers(self) -> Newcomers | None:
        """The layer of splats for what is new at a moment, if there is one."""
        found = (layer for layer in self.model.layers.values() if isinstance(layer, Newcomers))
        return next(found, None)

    @property
    def _newcomers_count(self) -> int:
        return 0 if self.newcomers is None else len(self.newcomers)

    @property
    def frozen(self) -> bool:
        """Whether the canonical splats stay as they are, as at all moments but the first."""
        return self.clock.moment > 0

    @property
    def learnt(self) -> frozenset[str]:
        """The names of what a moment after the first learns."""
        motion = frozenset(f"{MOTION}.{name}" for name in self.motion.learnt)
        return motion if self.newcomers is None else motion | _OF_NEWCOMERS

    def begin_next(self) -> None:
        """Let the next moment begin where the last one would go on to."""
        last, self.settled, self._placed = self.shot.time, False, False
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
            if self.newcomers is not None:
                self.newcomers.go_on(*given)
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
            if self.newcomers is not None and not self.clock.moment:
                self._make_room(self.newcomers)
        self.settled = True

    def _make_room(self, newcomers: Newcomers) -> None:
        """Let newcomers have rows of the model, the last of those that move."""
        model, moving = self.model, self.model.moving
        if not moving:
            raise GsdmsrError("all splats of the first moment stand still, and newcomers move")
        count = len(newcomers)
        moves, still = torch.arange(len(model.splats), device=model.splats.means.device).split(
            [moving, len(model.splats) - moving]
        )
        rows = torch.cat([moves, moves.new_zeros(count), still])
        fresh = torch.zeros_like(rows, dtype=torch.bool)
        fresh[moving : moving + count] = True
        first = model.splats.take(moves)
        splats = together([first, newcomers.rows_for(first), model.splats.take(still)])
        self.population.cap = max(self.population.cap, len(rows))
        self.population.resize(Resize(rows, fresh, splats))

    def _see(self) -> None:
        """Look at the present moment."""
        self.queue = []
        self._times = [shot.time for shot in self.shots[: self.clock.moment + 1]]
        before = self.shots[self.clock.moment - 1].rows if self.clock.moment else ()
        self._changes.begin(self.shot.rows, before)

    def _most_splats(self) -> int:
        return super()._most_splats() + self._newcomers_count

    def _beginning(self) -> Scene:
        return first_shot(self.scene)

    def _enter_phase(self, progress: float) -> None:
        if self.device.type == "cpu" and not self.clock.moment:
            self.population.drop_not_finite()
        self.model.advance(progress)

    def _next_row(self, progress: float) -> int:
        """Return the next view of a random order that visits all of the moment before any again.

        Views in which little has changed are left out now and then.
        """
        rows = self.shot.rows
        while True:
            if not self.queue:
                order = torch.randperm(len(rows), generator=self.generator)
                self.queue = [rows[i] for i in order.tolist()]
            row = self.queue.pop()
            if not self._changes or self._changes.wants(row, rows, self.generator):
                return row

    def _weights(self, row: int, progress: float) -> Tensor | None:
        """Return the weights of tiles: those that have not changed are left out."""
        allowed = self.renderer.tiles(self.views[row], progress, self.frozen) > 0
        if not (self._changes and self.frozen and allowed):
            return super()._weights(row, progress)
        pictures = self.renderer.pictures_at(progress)
        return self._changes.weights(row, pictures, self.generator)

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
            splats = self.motion.at(canonical, Instant(time)).splats
            return splats.map(lambda tensor: tensor[: len(tensor) - self._newcomers_count])

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
        lost = {f"{MOTION}.{name}": rows for name, rows in self.motion.mend().items()}
        if self.newcomers is not None:
            lost |= dict.fromkeys(_OF_NEWCOMERS, self.newcomers.mend())
        self._stop(lost)

    def _stop(self, lost: Mapping[str, Tensor]) -> None:
        """Let rows of parameters have no momentum."""
        for name, rows in lost.items():
            for moments in (self.optimizer.first, self.optimizer.second):
                if (own := moments.get(name)) is not None:
                    own[rows] = 0

    def _apply_events(self, tick: Tick) -> None:
        if not self.clock.moment:
            super()._apply_events(tick)
        elif self.newcomers is not None and not self._placed and tick.progress >= PLACED_AT:
            self._place(self.newcomers)

    @torch.no_grad()
    def _place(self, newcomers: Newcomers) -> None:
        """Place newcomers that have faded where something new stands."""
        free, least = newcomers.faded().nonzero().flatten(), newcomers.options.noticed
        chosen = torch.randperm(len(self.shot.rows), generator=self.generator)[:_LOOKS]
        looks = [self._look(self.views[self.shot.rows[i]]) for i in chosen.tolist()]
        found = find_places(looks, self.facts.box, least, len(free), self.generator)
        count = len(found.means)
        if count > SPACING_OF:
            free = free[:count]
            sizes = spacing(found.means).clamp(max=found.apart / 2)  # far from others it is no ball
            newcomers.appear(free, found.means, sizes.log(), found.colours)
            self._stop(dict.fromkeys(_OF_NEWCOMERS, free))
            self.population.average.clear()
        self._placed = True

    def _look(self, view: View) -> Look:
        """Draw a view of the present moment as it is by now, and compare it."""
        pictures = self.renderer.pictures
        instant, camera = self.model.instant_of_view(view.time, pictures.camera(view))
        engine, background = self.renderer.engine, self.renderer.background
        frame = draw_shown(show(self.model, instant), camera, engine, background)
        return look(camera, frame.rgb, pictures.load(view), pictures.signal(view, MASK))

    def checkpoint(self) -> Checkpoint:
        """Return all that is needed to go on from here; the moments' files are apart."""
        taken = super().checkpoint()
        own = {**self.clock.state(), "settled": self.settled, "placed": self._placed}
        return replace(taken, state={**taken.state, _KEY: own})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same preset and scene."""
        super().restore(checkpoint)
        own = checkpoint.state[_KEY]
        self.clock.restore(own)
        self.clock.measure(self.preset)
        self.settled, self._placed = bool(own["settled"]), bool(own.get("placed", False))
        queue = self.queue
        self._see()
        self.queue = queue
