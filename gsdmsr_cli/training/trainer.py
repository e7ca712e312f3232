"""One training: its state, and what a step does with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.errors import GsdmsrError
from gsdmsr_cli.model import MOVED_BY, MOVING, STORED, STORED_AS, Model, load_model
from gsdmsr_cli.motion import start_motion
from gsdmsr_cli.pictures import Pictures
from gsdmsr_cli.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.run import Checkpoint
from gsdmsr_cli.scene import Scene, View
from gsdmsr_cli.splats import NAMES
from gsdmsr_cli.training import averaging
from gsdmsr_cli.training.density import DensityStatistics, grow_and_prune, reset_opacities
from gsdmsr_cli.training.initial import facts_of, initial_splats
from gsdmsr_cli.training.look import Look, Observer, Stage
from gsdmsr_cli.training.optimizer import Adam, Gate
from gsdmsr_cli.training.saliency import Saliency, step_saliency
from gsdmsr_cli.training.schedule import log_linear, new_clock
from gsdmsr_cli.training.sensitivity import MOST_VIEWS, most_sensitive, picture_sensitivity
from gsdmsr_cli.training.stages import Stopwatch
from gsdmsr_cli.training.state import Part, below, gather, scatter
from gsdmsr_cli.training.stillness import motion_saliency
from gsdmsr_cli.training.team import Team
from gsdmsr_cli.training.tiles import TileSampler

PENALTY_EVERY = 4
"""Regularisers are slow to change and cost a pass over all planes: every 4th step, 4 times."""

PRUNE_EVERY = 500
"""Interval of pruning alone, once growing has ended [steps]."""

PATIENCE = 20
"""Consecutive steps without a finite loss after which training gives up."""

_LAST = "last."


@dataclass(frozen=True)
class Step:
    """What one step did: the loss, (), which is not finite if the step was skipped."""

    loss: Tensor


class Trainer:
    """A model in training on the train views of a scene; a context that ends its helpers.

    Attributes:
        model: what is trained.
        clock: steps, time and progress.
        observer: how views are looked at.
        team: who looks at them; this process alone until ``hire``.
        stopwatch: what the time goes into.
    """

    def __init__(
        self,
        scene: Scene,
        preset: Preset,
        engine: Engine,
        pictures: Pictures,
        device: torch.device | str = "cpu",
    ) -> None:
        self.scene, self.preset, self.device = scene, preset, torch.device(device)
        self.views = scene.split("train")
        self.observer = Observer(preset, engine, pictures, device)
        self.team = Team(self.observer, self.views)
        self.radius = scene.radius
        self.generator = torch.Generator().manual_seed(preset.training.seed)
        background = torch.tensor(BACKGROUNDS[preset.data.background])
        splats = initial_splats(scene, preset.splats, pictures, background, self.generator)
        self.facts = facts_of(scene, splats)
        motion = start_motion(preset.motion, self.facts, len(splats), self.generator)
        precision = preset.training.precision
        self.model = Model(splats, motion, precision=precision).to(device)
        self.optimizer = Adam()
        self.saliency = Saliency(len(self.model.splats), preset.saliency, device)
        self.statistics = DensityStatistics(len(self.model.splats), device)
        self.tiles = TileSampler(preset.training.tiles_per_view)
        self.average = averaging.Average()
        self.clock = new_clock(preset.training)
        self.stopwatch = Stopwatch()
        self._queue: list[int] = []
        self._rounds = self._resets = self._thinnings = 0
        self._moving = False
        self._skipped = 0

    def __enter__(self) -> Trainer:
        return self

    def __exit__(self, *_: object) -> None:
        self.team.dismiss()

    def hire(self, prepare: Callable[[], object]) -> None:
        """Get helpers for a step's views, until the context ends; see ``Team.hire``."""
        capacity = max(self.preset.density.cap, len(self.model.splats))
        self.team.hire(self.model, capacity, self.preset.training.views_per_step, prepare)

    def step(self) -> Step:
        """Choose views, look at each, add up their gradients, learn, grow and prune."""
        progress = self.clock.progress
        self._enter_phase(progress)
        rows = [self._next_row() for _ in range(self.preset.training.views_per_step)]
        tensors = self.model.tensors()
        gated = self._is_gated(progress)
        teachers = self.saliency.teachers(self.clock.step) if gated else None
        stage = Stage(progress, self._moving, teachers)
        tile_weights = [self._choose_tiles(row, progress) for row in rows]
        penalised = self._moving and self.clock.step % PENALTY_EVERY == 0
        with self.stopwatch.of("look"):
            looks, penalty = self.team.look(
                self.model, rows, stage, tile_weights,
                lambda: self._penalise(tensors, self.views[rows[0]]) if penalised else None,
            )  # fmt: skip
        value = torch.stack([look.loss for look in looks]).mean()
        gradients = [look.gradients for look in looks]
        if penalty is not None:
            value = value + PENALTY_EVERY * penalty[0]
            weight = PENALTY_EVERY * len(looks)
            gradients.append([None if part is None else part * weight for part in penalty[1]])
        for tensor, *parts in zip(tensors.values(), *gradients, strict=True):
            tensor.grad = _sum(parts)
        self.clock.step += 1
        # a GPU is not waited for: there the optimiser looks at the loss, and `count` is told later
        if value.is_cpu and not self.count([value.item()]):
            return self._skip(value)
        for row, weights, look in zip(rows, tile_weights, looks, strict=True):
            if weights is not None and look.errors is not None:
                self.tiles.learn(row, weights, look.errors.cpu())
        if progress < self.preset.density.until:
            for look in looks:
                self.statistics.observe(look.on_screen, *look.size)
        with self.stopwatch.of("learn"):
            self._learn(tensors, progress, value, looks if gated else None)
        with self.stopwatch.of("grow"):
            self._control_density(progress)
            self._settle(progress)
        if self.clock.step % averaging.EVERY == 0:
            self._average(progress)
        return Step(value)

    def _choose_tiles(self, row: int, progress: float) -> Tensor | None:
        """Return the tile weights of a view of the next step, or None for the whole picture."""
        tiles = self.observer.tiles(self.views[row], progress)
        if not 0 < self.tiles.count < tiles:
            return None
        return self.tiles.choose(row, tiles, self.generator)

    def _average(self, progress: float) -> None:
        if progress >= self.preset.training.average_from:
            self.average.add(self.model.tensors())
        else:
            self.average.forget()  # a resumed training may have gone back in progress

    def result(self) -> Model:
        """Return the model that the training has led to: the average where there is one yet."""
        if not self.average.count:
            return self.model
        tensors = self.average.tensors | {MOVING: torch.tensor(self.model.moving)}
        return self._load(tensors, self.clock.progress)

    def _load(self, tensors: Mapping[str, Tensor], progress: float) -> Model:
        precision = self.preset.training.precision
        model = load_model(tensors, self.preset.motion, self.facts, progress, precision)
        return model.to(self.device)

    def _penalise(
        self, tensors: Mapping[str, Tensor], view: View
    ) -> tuple[Tensor | float, Sequence[Tensor | None]]:
        """Return the penalty and its gradients."""
        penalty = self.model.penalty(view.time, self.generator)
        if penalty is None:
            return 0.0, [None] * len(tensors)
        gradients = torch.autograd.grad(penalty, list(tensors.values()), allow_unused=True)
        return penalty.detach(), gradients

    def _next_row(self) -> int:
        """Return the next view of a random order that visits every view before any again."""
        if not self._queue:
            self._queue = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self._queue.pop()

    def _enter_phase(self, progress: float) -> None:
        """Start the motion after the static phase, without the momentum of what did not move."""
        options = self.preset.training
        over = progress >= options.static_until or self.clock.step >= options.static_steps
        if over and not self._moving:
            self._moving = True
            for name in STORED:
                self.optimizer.forget(name, second=False)
            self._root()
        self.model.motion.advance(progress)

    def _rates(self, progress: float) -> dict[str, float]:
        """Return each tensor's learning rate; schedules begin at ``static_until``."""
        options = self.preset.optimizer
        static = self.preset.training.static_until
        p = (progress - static) / (1 - static) if static < 1 else 0.0
        groups = {
            group: log_linear(getattr(options, group), p)
            for group in (*NAMES, "planes", "network", "embeddings")
        }
        groups["means"] *= self.radius
        rates = {STORED_AS + name: groups[name] for name in NAMES}
        moving = self.model.motion.groups()
        return rates | {MOVED_BY + name: groups[group] for name, group in moving.items()}

    def _learn(
        self,
        tensors: Mapping[str, Tensor],
        progress: float,
        loss: Tensor,
        watched: Sequence[Look] | None,
    ) -> None:
        """Let Adam step; where the splats are gated, their saliency follows what was looked at."""
        gates = {} if watched is None else self._gates(tensors)
        share = self.preset.optimizer.sh_rest
        rest = self.model.splats.sh.detach()[:, 1:]
        before = None if share == 1 else rest.clone()
        with self.team.all_threads():
            self.optimizer.step(tensors, self._rates(progress), gates, loss)
        if before is not None:
            rest.copy_(torch.lerp(before, rest, share))
        if watched is not None:
            self._attend(watched, gates)

    def _is_gated(self, progress: float) -> bool:
        options = self.preset.saliency
        return options.gate != "none" and self._moving and progress >= options.gate_from

    def _gates(self, tensors: Mapping[str, Tensor]) -> dict[str, Gate]:
        """Return what the rows of all tensors with a row per splat may do in this step."""
        multipliers = self.saliency.multipliers(self.clock.step)
        by_name = dict.fromkeys(STORED, multipliers)
        by_name |= dict.fromkeys(self.model.held_by_motion(), multipliers[: self.model.moving])
        return {name: Gate(m, torch.zeros_like(tensors[name])) for name, m in by_name.items()}

    def _attend(self, looks: Sequence[Look], gates: Mapping[str, Gate]) -> None:
        """Let the saliency follow a step."""
        steps = {name: gates[STORED_AS + name].trace for name in NAMES}
        raw = self.preset.saliency.units == "raw"
        now = step_saliency(self.model.splats, steps, raw)
        seen = torch.stack([look.on_screen for look in looks]).any(dim=2).any(dim=0)
        woken = self.saliency.observe(now, seen)
        if woken.is_cpu and not woken.any():
            return
        # what they were about to do when they fell asleep is of no use any more
        self.optimizer.calm(STORED, woken)
        self.optimizer.calm(self.model.held_by_motion(), woken[: self.model.moving])

    def _control_density(self, progress: float) -> None:
        options = self.preset.density
        if self._density_is_due(progress):
            growing = progress < options.until
            rows, fresh, grown = grow_and_prune(
                self.model.splats, self.statistics, options, self.radius, growing, self.generator
            )
            if not len(rows):
                raise GsdmsrError(
                    f"no splats are left at step {self.clock.step}; lower density.prune_opacity or "
                    "check that cameras and pictures belong together"
                )
            self.model.take(rows)
            with torch.no_grad():
                for name, tensor in self.model.splats.tensors().items():
                    tensor.copy_(getattr(grown, name))
            self._follow(rows, fresh)
            if fresh.any():
                self.average.forget()
                self._root()
        if self._resets < len(options.reset_at) and progress >= options.reset_at[self._resets]:
            self._resets += 1
            reset_opacities(self.model.splats)
            self.optimizer.forget(STORED_AS + "logit_opacities")
            self.average.forget()
            self.saliency.pardon(torch.ones_like(self.saliency.high))
        if self._thinnings < len(options.thin_at) and progress >= options.thin_at[self._thinnings]:
            self._thinnings += 1
            self._thin()

    def _thin(self) -> None:
        """Prune the splats that the training's pictures depend on least."""
        chosen = torch.randperm(len(self.views), generator=self.generator)[:MOST_VIEWS]
        views = [self.views[row] for row in chosen.tolist()]
        shots = [(self.observer.pictures.camera(view), view.time) for view in views]
        given = self.observer.engine, shots, self.observer.background, self.generator
        with self.team.all_threads():
            scores = picture_sensitivity(self.model, *given)
        rows = most_sensitive(scores, self.preset.density.thin_share)
        self.model.take(rows)
        self._follow(rows, torch.zeros_like(rows, dtype=torch.bool))

    def _root(self) -> None:
        """Tie the motion to the present splats, if it moves them and cares where they are."""
        if self._moving:
            for name in self.model.root():
                self.optimizer.forget(name)

    def _density_is_due(self, progress: float) -> bool:
        """Tell whether to grow and prune, or only to prune, after this step."""
        options, step = self.preset.density, self.clock.step
        if step < options.start:
            return False
        if progress >= options.until:
            return step % PRUNE_EVERY == 0
        if step % options.every or progress * options.rounds < self._rounds * options.until:
            return False
        self._rounds += 1
        return True

    def _follow(self, rows: Tensor, fresh: Tensor) -> None:
        """Resize what is kept beside the model, which has taken these rows."""
        held = slice(self.model.moving)
        self.optimizer.take(STORED, rows, fresh)
        self.optimizer.take(self.model.held_by_motion(), rows[held], fresh[held])
        self.average.take(STORED, rows)
        self.average.take(self.model.held_by_motion(), rows[held])
        self.statistics = DensityStatistics(len(rows), self.device)
        self.saliency.take(rows, fresh)

    def _settle(self, progress: float) -> None:
        """Let splats stand still that hardly move; not while splats are grown or averaged."""
        options = self.preset.saliency
        first = max(options.still_from, self.preset.density.until)
        if not first <= progress < self.preset.training.average_from:
            return
        if self.clock.step % options.still_every == 0:
            saliency, mean = motion_saliency(self.model)
            order = self.model.settle(saliency < options.still_below, mean)
            self._follow(order, torch.zeros_like(order, dtype=torch.bool))

    def count(self, losses: Sequence[float]) -> bool:
        """Take note of the losses of steps, and return whether the last is finite.

        Raises:
            GsdmsrError: too many in a row are not.
        """
        for loss in losses:
            self._skipped = 0 if math.isfinite(loss) else self._skipped + 1
            if self._skipped >= PATIENCE:
                raise GsdmsrError(
                    f"the loss is not finite for {PATIENCE} steps up to step {self.clock.step}; "
                    "the last checkpoint is kept; lower the learning rates with --set optimizer..."
                )
        return not self._skipped

    def _skip(self, loss: Tensor) -> Step:
        """Drop a step whose loss is not finite."""
        for tensor in self.model.tensors().values():
            tensor.grad = None
        return Step(loss)

    def _parts(self) -> dict[str, Part]:
        """Return what is kept beside the model, by the prefix of its tensors in a checkpoint."""
        return {
            "adam.": self.optimizer,
            "density.": self.statistics,
            "saliency.": self.saliency,
            "tiles.": self.tiles,
        }

    def checkpoint(self) -> Checkpoint:
        """Return the result so far and everything needed to go on from here."""
        tensors = dict(self.model.tensors())
        if self.average.count:
            tensors = {_LAST + name: tensor for name, tensor in tensors.items()}
            tensors |= self.average.tensors
        if self.model.moving < len(self.model.splats):
            tensors[MOVING] = torch.tensor(self.model.moving)
        tensors |= gather(self._parts())
        tensors["generator"] = self.generator.get_state()
        state = {
            "queue": self._queue,
            "rounds": self._rounds,
            "resets": self._resets,
            "thinnings": self._thinnings,
            "moving": self._moving,
            "adam_steps": self.optimizer.steps,
            "averaged": self.average.count,
        }
        clock = self.clock
        return Checkpoint(clock.step, clock.progress, clock.elapsed, tensors, state)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint of the same preset and scene."""
        state = checkpoint.state
        tensors = {name: tensor.to(self._home(name)) for name, tensor in checkpoint.tensors.items()}
        self.average = averaging.Average()
        self.average.count = int(state["averaged"])
        last = dict(tensors)
        if self.average.count:
            last = below(_LAST, tensors)
            self.average.tensors = {name: tensors[name] for name in last}
            if MOVING in tensors:
                last[MOVING] = tensors[MOVING]
        self.model = self._load(last, checkpoint.progress)
        self.statistics = DensityStatistics(len(self.model.splats))
        scatter(self._parts(), tensors)
        self.optimizer.steps = {name: int(count) for name, count in state["adam_steps"].items()}
        self.generator.set_state(tensors["generator"])
        self._queue = list(state["queue"])
        self._rounds, self._resets = int(state["rounds"]), int(state["resets"])
        self._thinnings = int(state.get("thinnings", 0))  # absent before there was such a thing
        self._moving = bool(state["moving"])
        self.clock.step, self.clock.before = checkpoint.step, checkpoint.elapsed

    def _home(self, name: str) -> torch.device:
        """Return where a checkpoint's tensor belongs: chance and tiles are matters of the CPU."""
        return torch.device("cpu") if name.startswith(("generator", "tiles.")) else self.device


def _sum(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Return the sum of the parts that are there, in this order, or None.

    Adam does not care whether it gets the sum or the mean over a step's views.
    """
    total: Tensor | None = None
    for part in parts:
        if part is not None:
            total = part if total is None else total + part
    return total
