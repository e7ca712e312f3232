"""One training of a model: its state, and what each step does."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Tensor

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.building import check_layers, load_model, start_model
from gsdmsr_cli.model.model import MOVING, Model
from gsdmsr_cli.ops.finite import all_finite, not_finite
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import MOVING as MOVES
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training import averaging, snapshot
from gsdmsr_cli.training.gating import gates_of, observe_step
from gsdmsr_cli.training.gradients.compare import gradients_of, sum_of
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.renderer import TrainingRenderer
from gsdmsr_cli.training.gradients.tiles import TileSampler
from gsdmsr_cli.training.gradients.workers import WorkerPool
from gsdmsr_cli.training.losses import start_term
from gsdmsr_cli.training.optimizer import Adam
from gsdmsr_cli.training.population import Tick, start_events
from gsdmsr_cli.training.ranks.alone import ALONE, Ranks, RanksDifferError, most_of
from gsdmsr_cli.training.rates import learning_rates
from gsdmsr_cli.training.resizing import Population
from gsdmsr_cli.training.saliency import Saliency
from gsdmsr_cli.training.schedule import new_clock
from gsdmsr_cli.training.starting.initial import facts_of, initial_splats
from gsdmsr_cli.training.streaming.shots import check_options
from gsdmsr_cli.training.timings import Stopwatch
from gsdmsr_cli.training.window import start_window

PENALTY_EVERY = 4
"""Regularisers are slow to change and cost a pass over all planes: every 4th step, 4 times."""

PATIENCE = 20
"""Consecutive steps without a finite loss after which training gives up."""

Penalty = tuple[Tensor, Sequence[Tensor | None]]
"""Regularisers, (), and their gradients by every trained tensor."""


@dataclass(frozen=True)
class Step:
    """What one step did: the loss, (), which is not finite if the step was skipped."""

    loss: Tensor


class Trainer:
    """A model in training on the train views of a scene; a context that ends its workers.

    Attributes:
        population: the model and what is kept for each of its splats.
        clock: steps, time and progress.
        renderer: renders views and goes backward.
        ranks: the processes that make the steps together, perhaps on other machines.
        views_per_step: how many views a step has.
        workers: the processes that take gradients; this one alone until ``start_workers``.
        events: what changes the splats after a step, by name, in their order.
        stopwatch: adds up what the time goes into.
        queue: rows of the views that come next, the last one first.
        window: which of them may be seen yet.
        notes: what to say to who trains.
        changing: whether a step is changing the model, or an error has ended such a change.
    """

    def __init__(
        self,
        scene: Scene,
        preset: Preset,
        engine: Engine,
        pictures: Pictures,
        device: torch.device | str = "cpu",
        ranks: Ranks = ALONE,
    ) -> None:
        self.ranks = ranks
        self.scene, self.preset, self.device = scene, preset, torch.device(device)
        self.views = scene.split("train")
        self.renderer = TrainingRenderer(preset, engine, pictures, self.views, device)
        self.workers = WorkerPool(self.renderer)
        self.generator = torch.Generator().manual_seed(preset.training.seed)
        background = torch.tensor(BACKGROUNDS[preset.data.background])
        splats, times = initial_splats(
            self._beginning(),
            preset.splats,
            pictures,
            background,
            self.generator,
            preset.density.cap,
        )
        self.facts = facts_of(scene, splats)
        model = start_model(
            splats, preset.motion, preset.layers, self.facts, self.generator,
            precision=preset.training.precision, times=times,
            views=[(view.camera, view.time) for view in self.views],
        )  # fmt: skip
        at_once = self.renderer.renders_at_once(model)
        self.views_per_step = preset.training.views_on(self.device.type, at_once)
        self.optimizer = Adam()
        self.saliency = Saliency(len(splats), preset.saliency, device)
        self.events = start_events(preset)
        self.tiles = TileSampler(preset.training.tiles_per_view)
        self.population = self.populate(model.to(device))
        self.clock = new_clock(preset.training)
        self.stopwatch = Stopwatch()
        self.queue: list[int] = []
        self.window = start_window(scene, pictures, background, preset.training)
        told = [self.window.note, *(event.begin(self.views) for event in self.events.values())]
        self.notes = [*self.renderer.notes, *filter(None, told)]
        self._times = scene.train_times
        self.changing = False
        self._skipped = 0

    def populate(self, model: Model) -> Population:
        """Return a model with what is kept for each of its splats, which begins anew."""
        given = self.optimizer, self.saliency, self.scene.radius, self.preset.density.cap
        drawing = self.renderer.engine, self.renderer.background
        return Population(
            model, *given, self.generator, *drawing, self._shots, self._marked,
            self.workers.all_threads,
        )  # fmt: skip

    @property
    def model(self) -> Model:
        """What is trained."""
        return self.population.model

    @property
    def frozen(self) -> bool:
        """Whether the canonical splats stay as they are, and the motion alone is learnt."""
        return False

    def _beginning(self) -> Scene:
        """Return the scene in whose views the initial splats are looked for."""
        return self.scene

    def _learning(self) -> dict[str, Tensor]:
        """Return the tensors that the optimiser moves, by name."""
        return self.model.trained()

    def __enter__(self) -> Trainer:
        return self

    def __exit__(self, *_: object) -> None:
        self.workers.stop()

    def start_workers(self, prepare: Callable[[], object]) -> None:
        """Get workers for a step's views, until the context ends; see ``WorkerPool.start``."""
        capacity = self._most_splats()
        views = most_of(self.views_per_step, self.ranks.size)
        self.workers.start(self.model, capacity, views, prepare)

    def _most_splats(self) -> int:
        """Return how many splats there will be at most."""
        return max(self.preset.density.cap, len(self.model.splats))

    def step(self) -> Step:
        """Choose views, take their gradients, let Adam step, let events change the splats."""
        progress = self.clock.progress
        with self._change():
            self._enter_phase(progress)
        gated = self._is_gated(progress)
        mask = self.saliency.gradient_mask(self.clock.step) if gated else None
        screens = gated or progress < self.preset.density.until
        moving, step = self.population.moving, self.clock.step
        phase = Phase(progress, moving, mask, self.frozen, screens, step)
        with self._choices_that_count():
            orders = self._choose_views(progress)
            with self.stopwatch.of("gradients"):
                own, penalty = self.workers.gradients(
                    self.model, self.ranks.share(orders), phase,
                    lambda: self._penalty(orders[0], progress),
                )  # fmt: skip
                views = self.ranks.gather(self.model, orders, own, screens)
        loss = _set_gradients(self.model, views, penalty)
        self.clock.step += 1
        loss = self._checked(loss)
        if loss.is_cpu and not self.count([loss.item()]):
            return self._skip(loss)
        with self._change():
            self._record(orders, views, progress, loss)
            with self.stopwatch.of("optimizer"):
                self._update(progress, loss, views if gated else None)
            with self.stopwatch.of("population"):
                self._apply_events(Tick(self.clock.step, progress))
            if self.clock.step % averaging.EVERY == 0:
                self._average(progress)
        return Step(loss)

    def meet(self, end_wanted: bool) -> bool:
        """Agree with the other ranks on the time; return whether any of them wants to end.

        Raises:
            RanksDifferError: they hold different models, of which none is to be saved.
            GsdmsrError: the connection to another rank is lost.
        """
        try:
            return self.ranks.meet(self.clock, self.model, self.generator, end_wanted)
        except RanksDifferError:
            self.changing = True
            raise

    @property
    def is_sound(self) -> bool:
        """Whether a checkpoint can be taken: no step was cut short, and the last loss is finite."""
        return not (self.changing or self._skipped)

    @contextmanager
    def _change(self) -> Iterator[None]:
        """Know that the model is not what whole steps have made of it if the block fails."""
        self.changing = True
        yield
        self.changing = False

    @contextmanager
    def _choices_that_count(self) -> Iterator[None]:
        """Take random choices back if the block fails, such as for a picture that is damaged.

        So a resumed training makes the same choices as one that has not failed.
        """
        queue, state = list(self.queue), self.generator.get_state()
        try:
            yield
        except BaseException:
            self.queue = queue
            self.generator.set_state(state)
            raise

    def _enter_phase(self, progress: float) -> None:
        """Drop splats that are not finite, start the motion, hold what has not been seen."""
        if self.device.type == "cpu":  # a GPU is not waited for: there it is done at reports
            self.population.drop_not_finite()
        options = self.preset.training
        over = progress >= options.static_until or self.clock.step >= options.static_steps
        if over and not self.population.moving:
            self.population.begin_moving()
        self.model.advance(progress)
        if extent := self.window.extent(progress):
            self.model.hold_outside(*extent)

    def _choose_views(self, progress: float) -> list[Order]:
        """Return the views of a step, with all random choices that each needs."""
        rows = [self._next_row(progress) for _ in range(self.views_per_step)]
        return [self._order(row, progress) for row in rows]

    def _next_row(self, progress: float) -> int:
        """Return a view that the window wants, or else the next one of a random order.

        That order visits every view before any again.
        """
        if (newest := self.window.draw_newest(progress, self.generator)) is not None:
            return newest
        while True:
            if not self.queue:
                self.queue = torch.randperm(len(self.views), generator=self.generator).tolist()
            row = self.queue.pop()
            if self.window.shows(row, progress):
                return row

    def _order(self, row: int, progress: float) -> Order:
        view, jitter = self.views[row], 0.0
        weights = self._weights(row, progress)
        if self.model.needs_jitter:
            jitter = float(torch.randn((), generator=self.generator))
        others = self.renderer.other_times(view, self._times, self.generator)
        return Order(row, weights, jitter, others, self.renderer.seed(self.generator))

    def _weights(self, row: int, progress: float) -> Tensor | None:
        """Return the weights of a view's tiles, None for the whole picture."""
        tiles = self.renderer.tiles(self.views[row], progress, self.frozen)
        if 0 < self.tiles.count < tiles:
            return self.tiles.choose(row, tiles, self.generator)
        return None

    def _penalty(self, order: Order, progress: float) -> Penalty | None:
        """Return the layers' regularisers, evaluated for one view, and their gradients."""
        if not self.population.moving or self.clock.step % PENALTY_EVERY:
            return None
        view = self.views[order.row]
        instant = self.model.instant(view.time, self.renderer.camera(view, progress), order.jitter)
        value = self.model.penalty(instant, self.generator)
        if value is None:
            return None
        return value.detach(), gradients_of(value, self.model)

    def _checked(self, loss: Tensor) -> Tensor:
        """Return the loss, made NaN if a gradient of what all splats share is not finite."""
        parameters = self.model.parameters()
        shared = [p.tensor.grad for p in parameters if not p.per_splat]
        gradients = [gradient for gradient in shared if gradient is not None]
        if not gradients:
            return loss
        if not loss.is_cpu:
            return loss + not_finite(gradients)
        return loss if all_finite(gradients) else torch.full_like(loss, math.nan)

    def _record(
        self, orders: Sequence[Order], views: Sequence[ViewGradients], progress: float, loss: Tensor
    ) -> None:
        """Give the errors of tiles and the gradients on the screen to those who choose by them.

        On a GPU, which is not waited for, gradients of a loss () that is not finite become NaN,
        which does not count.
        """
        for order, view in zip(orders, views, strict=True):
            weights, errors = order.tile_weights, view.tile_errors
            if not self.tiles.count or weights is None or errors is None:
                continue
            if bool(loss.isfinite()):  # errors are waited for, so the loss may be as well
                self.tiles.learn(order.row, weights, errors.cpu())
        if progress < self.preset.density.until:
            self._observe(views, loss)

    def _observe(self, views: Sequence[ViewGradients], loss: Tensor) -> None:
        statistics, sizes = self.population.statistics, {view.size for view in views}
        if loss.is_cpu:
            for view in views:
                statistics.observe(view.on_screen, *view.size)
        elif len(sizes) == 1:
            together = torch.stack([view.on_screen for view in views]) * (loss * 0 + 1)
            statistics.observe_views(together, *sizes.pop())
        else:
            for view in views:
                statistics.observe(view.on_screen * (loss * 0 + 1), *view.size)

    def _is_gated(self, progress: float) -> bool:
        options = self.preset.saliency
        moving = self.population.moving
        return options.gate != "none" and moving and progress >= options.gate_from

    def _update(self, progress: float, loss: Tensor, gated: Sequence[ViewGradients] | None) -> None:
        """Let Adam step; where splats are gated, given the views, update their saliency by it."""
        gates = {} if gated is None else gates_of(self.population, self.clock.step)
        static = self.preset.training.static_until
        rates = learning_rates(
            self.model.parameters(), self.preset.optimizer, progress, static, self.scene.radius
        )
        share = self.preset.optimizer.sh_rest
        rest = self.model.splats.sh.detach()[:, 1:]
        before = None if share == 1 else rest.clone()
        with self.workers.all_threads():
            self.optimizer.step(self._learning(), rates, gates, loss)
        if before is not None:
            rest.copy_(torch.lerp(before, rest, share))
        if gated is not None:
            observe_step(self.population, gated, gates, loss)

    def _apply_events(self, tick: Tick) -> None:
        """Apply every event that is due."""
        for event in self.events.values():
            if event.due(tick):
                change = event.apply(self.population, tick)
                if change is not None:
                    self.population.resize(change)

    def _average(self, progress: float) -> None:
        if progress >= self.preset.training.average_from:
            self.population.average.add(self.model.parameters())
        else:
            self.population.average.clear()  # a resumed training may have gone back in progress

    def _shots(self, most: int) -> list[tuple[Camera, float]]:
        """Return up to so many cameras of train views and their times, chosen at random."""
        chosen = torch.randperm(len(self.views), generator=self.generator)[:most]
        views = [self.views[row] for row in chosen.tolist()]
        return [(self.renderer.pictures.camera(view), view.time) for view in views]

    def _marked(self, most: int) -> list[tuple[Camera, float, Tensor]]:
        """Return up to so many train views that may be seen by now, with masks of what moves."""
        progress, pictures = self.clock.progress, self.renderer.pictures
        rows = torch.randperm(len(self.views), generator=self.generator).tolist()
        views = [self.views[row] for row in rows if self.window.shows(row, progress)]
        marked = ((view, pictures.signal(view, MOVES)) for view in views)
        with_masks = ((view, mask) for view, mask in marked if mask is not None)
        return [(pictures.camera(view), view.time, mask) for view, mask in islice(with_masks, most)]

    def result(self) -> Model:
        """Return the model that the training has led to: the average where there is one yet."""
        average = self.population.average
        if not average.count:
            return self.model
        tensors = average.tensors | {MOVING: torch.tensor(self.model.moving)}
        return self.load(tensors, self.clock.progress)

    def load(self, tensors: Mapping[str, Tensor], progress: float) -> Model:
        """Return the model of saved tensors, on the device."""
        preset = self.preset
        given = preset.motion, preset.layers, self.facts, progress, preset.training.precision
        return load_model(tensors, *given).to(self.device)

    def count(self, losses: Sequence[float]) -> bool:
        """Count the losses in a row that are not finite; return whether the last is finite.

        Raises:
            GsdmsrError: too many in a row are not.
        """
        for loss in losses:
            self._skipped = 0 if math.isfinite(loss) else self._skipped + 1
            if self._skipped >= PATIENCE:
                raise GsdmsrError(
                    "the loss, or a gradient of what all splats share, is not finite for "
                    f"{PATIENCE} steps up to step {self.clock.step}; the last checkpoint is kept; "
                    "lower the learning rates with --set optimizer..."
                )
        return not self._skipped

    def _skip(self, loss: Tensor) -> Step:
        """Drop a step whose loss is not finite."""
        for tensor in self.model.tensors().values():
            tensor.grad = None
        return Step(loss)

    def checkpoint(self) -> Checkpoint:
        """Return the result so far and everything needed to go on from here."""
        return snapshot.take(self)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same preset and scene."""
        snapshot.restore(self, checkpoint)


def check_plugins(preset: Preset) -> None:
    """Raise UsageError unless there are the motion, layers, events and terms that a preset names.

    Their options are checked as well; no data is needed.
    """
    check_layers(preset.motion, preset.layers)
    check_options(preset)
    start_events(preset)
    for settings in preset.losses.terms:
        start_term(settings)


def _set_gradients(model: Model, views: Sequence[ViewGradients], penalty: Penalty | None) -> Tensor:
    """Give the trained tensors the sums of their gradients; return the loss ().

    The loss is the mean over the views. Adam does not care whether it gets a sum or a mean.
    """
    loss = torch.stack([view.loss for view in views]).mean()
    parts = [view.gradients for view in views]
    if penalty is not None:
        value, gradients = penalty
        loss = loss + PENALTY_EVERY * value
        weight = PENALTY_EVERY * len(views)
        parts.append([None if part is None else part * weight for part in gradients])
    for tensor, *own in zip(model.trained().values(), *parts, strict=True):
        tensor.grad = sum_of(own)
    return loss
