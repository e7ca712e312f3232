"""Every option of a training run, as frozen dataclasses per topic, and how a preset is loaded.

Schedules are functions of progress in [0, 1]: step / steps or, with a budget, elapsed / budget, to
the power of ``budget_power``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from gsdmsr_cli.backends.cuda.compiler import MOST_VIEWS
from gsdmsr_cli.options import preset_files, strict
from gsdmsr_cli.options.durations import require_duration
from gsdmsr_cli.options.sequences import SegmentOptions, StreamOptions
from gsdmsr_cli.options.strict import (
    PROGRESS,
    require,
    require_at_least,
    require_positive,
    require_progress,
    require_rates,
)

EVENTS = ("density", "opacity_reset", "thinning", "stillness")
"""Events that every training asks after a step, unless the preset says otherwise."""

VIEWS, VIEWS_AT_ONCE = 2, 8
"""Views of a step, where options do not say: usually, and where a GPU draws all of them at once.

docs/gpu.md has the evidence.
"""

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}
"""The colours that pictures may be laid on."""


@dataclass(frozen=True)
class DataOptions:
    """How pictures are read.

    Attributes:
        background: colour behind transparent pixels, in training and evaluation.
        downscale: both sides of every picture are divided by this whole number, by area.
        between: times of the capture, 0 to 1, outside of which views are left out; the rest counts
            from 0 to 1.
        cache_mib: memory for decoded pictures, halved pictures and masks that are kept, of all
            processes together [MiB]; 0 keeps none. On a GPU as much again for copies there.
    """

    background: Literal["white", "black"] = "white"
    downscale: int = 1
    between: tuple[float, float] = (0.0, 1.0)
    cache_mib: int = 4096

    def __post_init__(self) -> None:
        require_at_least(self, 1, "downscale")
        require_at_least(self, 0, "cache_mib")
        first, last = self.between
        require(self, "between", 0 <= first < last <= 1, "[start, end], 0 <= start < end <= 1")


@dataclass(frozen=True)
class SplatOptions:
    """The splats to start from.

    Attributes:
        count: number of splats where the scene brings no points or, with the start "surfaces",
            fewer than that.
        start: where they lie: "box" evenly in the scene's box, "silhouettes" where the silhouettes
            of the train views overlap, "surfaces" where neighbouring train views agree.
        start_around: the same where train cameras stand around what they see, which
            ``scene.around`` decides; null makes no difference.
        moving_share: share of these, 0 to 1, that lie on what moves, at the times at which it is
            there, which cameras that stand still tell by their medians over time, see
            ``training.starting.changing``.
        of_run: folder of a run whose canonical splats are taken as they are in place of all that;
            null takes none.
        opacity: their opacity, between 0 and 1.
        sh_degree: highest degree of the spherical harmonics, 0 to 3.
        sh_start: progress at which degree 1 joins; higher degrees follow.
    """

    count: int = 2500
    start: Literal["box", "silhouettes", "surfaces"] = "silhouettes"
    start_around: Literal["box", "silhouettes", "surfaces"] | None = None
    moving_share: float = 0.0
    of_run: str | None = None
    opacity: float = 0.1
    sh_degree: int = 1
    sh_start: float = 0.3

    def __post_init__(self) -> None:
        require_at_least(self, 1, "count")
        require(self, "moving_share", 0.0 <= self.moving_share <= 1.0, "0 to 1")
        require(self, "opacity", 0.0 < self.opacity < 1.0, "a number between 0 and 1, neither")
        require(self, "sh_degree", 0 <= self.sh_degree <= 3, "0 to 3")
        require_progress(self, "sh_start")


@dataclass(frozen=True)
class TrainingOptions:
    """How long to train, and in which phases.

    Attributes:
        steps: length of the training [steps], unless there is a budget.
        budget: length of the training as wall time, such as "8m"; null counts steps.
        budget_power: power of the share of the budget that progress is. Steps take longer and
            longer as splats grow: below 1 the early phases, whose steps are fast, have less of the
            time, as they have where steps count.
        static_until: progress up to which nothing moves.
        static_steps: most steps for which nothing moves.
        views_per_step: pictures drawn and compared per step, 1 to 16; null is what suits the
            device, see ``views_on``.
        tiles_per_view: tiles of 16 x 16 px that are chosen of each, once SSIM does not count any
            more; 0 is all.
        low_resolution_until: progress up to which pictures of half the size are drawn; 0 is never.
        window: share of the train views that are seen at first, those nearest in time to
            ``window_at``; from ``static_until`` on it grows evenly to all of them; 1 sees all from
            the start.
        window_if: when that is so: always, or if something lies apart in the train views from all
            that stands, see ``training.starting.apart``.
        window_until: progress at which all are seen.
        window_at: the time about which they lie, 0 to 1.
        window_newest: share of the views of steps that are drawn, as long as not all are seen, from
            the tenth of all views that has come last, 0 to 1.
        average_from: progress from which the result is the mean of the steps' values; 1 is never.
        checkpoint_minutes: time between checkpoints [min].
        keep: how many of the last checkpoints are kept.
        seed: seed of every random choice.
        threads: number of CPU threads; 0 takes all cores.
        precision: what the motion's grids and networks are read and computed in on a GPU; values
            that are trained, and their gradients, are float32 all the same.
        cuda_graphs: whether a GPU replays the launches of a step where the motion lets it.
    """

    steps: int = 10000
    budget: str | None = None
    budget_power: float = 1.0
    static_until: float = 0.04
    static_steps: int = 300
    views_per_step: int | None = None
    tiles_per_view: int = 0
    low_resolution_until: float = 0.3
    window: float = 1.0
    window_if: Literal["always", "apart"] = "always"
    window_until: float = 0.3
    window_at: float = 0.5
    window_newest: float = 0.0
    average_from: float = 0.9
    checkpoint_minutes: float = 2.0
    keep: int = 1
    seed: int = 0
    threads: int = 0
    precision: Literal["float32", "bf16", "fp16"] = "float32"
    cuda_graphs: bool = True

    def __post_init__(self) -> None:
        require_at_least(self, 1, "steps", "keep")
        # the limit of a GPU is that of the CPU as well: a training may go on on the other
        within = self.views_per_step is None or 1 <= self.views_per_step <= MOST_VIEWS
        require(self, "views_per_step", within, f"1 to {MOST_VIEWS}")
        require_duration(self, "budget")
        require(self, "budget_power", 0.1 <= self.budget_power <= 10, "0.1 to 10")
        require_progress(self, "static_until", "low_resolution_until", "average_from")
        require_progress(self, "window_until")
        require(self, "window", 0 < self.window <= 1, "a share above 0, up to 1")
        require(self, "window_at", 0 <= self.window_at <= 1, "a time from 0 to 1")
        require(self, "window_newest", 0 <= self.window_newest <= 1, "a share from 0 to 1")
        require_positive(self, "checkpoint_minutes")
        require(self, "seed", 0 <= self.seed < 2**32, "0 to 4294967295")
        require_at_least(self, 0, "static_steps", "threads", "tiles_per_view")

    def views_on(self, device: str, at_once: bool = True) -> int:
        """Return how many views a step has on a device such as "cpu".

        A CPU takes twice as long for twice as many. A GPU waits for the next launch most of the
        time, so that further views cost it little, where they are drawn ``at_once``.
        """
        if self.views_per_step is not None:
            return self.views_per_step
        return VIEWS_AT_ONCE if device != "cpu" and at_once else VIEWS

    @property
    def progress_power(self) -> float:
        """Power of the share of the length that progress is: of steps always 1."""
        return 1.0 if self.budget is None else self.budget_power


@dataclass(frozen=True)
class LossOptions:
    """How a drawn picture is compared with the true one.

    Attributes:
        ssim: weight w of (1 - w) L1 + w (1 - SSIM), 0 to 1.
        ssim_until: progress up to which the SSIM term counts; later w is 0.
        quadratic: differences of colours up to which they count by their squares, see ``Measure``;
            0 is L1.
        quadratic_from: progress from which they do.
        inliers: share of a picture's pixels whose errors are taken to be normal; areas with larger
            ones are left out, such as people who walk by; 1 leaves out nothing.
        moving_weight: by how much more those pixels count of which a view's mask says that they
            move; 0 is as much as others.
        terms: further terms, each a "name" and the options that its own file declares, see
            ``training.losses``.
    """

    ssim: float = 0.2
    ssim_until: float = 0.3
    quadratic: float = 0.0
    quadratic_from: float = 0.5
    inliers: float = 1.0
    moving_weight: float = 0.0
    terms: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        named = all(isinstance(entry.get("name"), str) for entry in self.terms)
        require(self, "terms", named, "a list of mappings, each with the name of a term")
        require(self, "ssim", 0.0 <= self.ssim <= 1.0, "a weight from 0 to 1")
        require_progress(self, "ssim_until", "quadratic_from")
        require(self, "inliers", 0.0 < self.inliers <= 1.0, "a share above 0, up to 1")
        require_at_least(self, 0, "quadratic", "moving_weight")


@dataclass(frozen=True)
class OptimizerOptions:
    """Learning rates of Adam as (start, end), log-linear in progress.

    Attributes:
        means: of the centres, in units of the scene's radius.
        log_scales: of the logarithms of the scales.
        quats: of the rotations.
        logit_opacities: of the logits of the opacities.
        sh: of the colours' coefficients.
        sh_rest: rate of all coefficients but the constant ones, in units of that; 3DGS has 0.05.
        planes: of the motion's plane grids.
        network: of the motion's networks.
        embeddings: of the features that a motion holds for each splat.
    """

    means: tuple[float, float] = (2.5e-4, 5e-6)
    log_scales: tuple[float, float] = (5e-3, 2e-3)
    quats: tuple[float, float] = (1e-3, 5e-4)
    logit_opacities: tuple[float, float] = (0.05, 0.01)
    sh: tuple[float, float] = (2.5e-3, 1e-3)
    sh_rest: float = 1.0
    planes: tuple[float, float] = (8e-3, 5e-4)
    network: tuple[float, float] = (8e-4, 1e-4)
    embeddings: tuple[float, float] = (5e-3, 2e-3)

    def __post_init__(self) -> None:
        require_positive(self, "sh_rest")
        require_rates(self, *(rate.name for rate in fields(self) if rate.name != "sh_rest"))


@dataclass(frozen=True)
class DensityOptions:
    """When and where splats are cloned, split, pruned and reset (3DGS, Kerbl et al. 2023).

    Attributes:
        every: least interval of growing and pruning [steps].
        rounds: most times that splats grow, spread evenly over progress: a longer training has
            more steps in between, not more rounds.
        start: first step at which it happens [steps].
        until: progress at which it ends.
        gradient: mean norm of the screen-space gradient above which a splat grows [1 / NDC unit].
        long_from: steps of a training beyond which it is lower, see
            ``training.population.density.gradient_at``; 0 is never.
        split_scale: a growing splat is split above this scale and cloned below [scene radii].
        prune_scale: a splat above this scale is pruned as long as splats grow [scene radii].
        prune_opacity: a splat below this opacity is pruned.
        reset_at: progress of each opacity reset.
        reset_opacity: what opacities are lowered to then.
        cap: most splats there may be.
        thin_at: progress of each thinning, after which the splats that the pictures depend on least
            are gone, see ``training.population.thinning``.
        thin_share: share of the splats that a thinning takes.
    """

    every: int = 100
    rounds: int = 1000
    start: int = 300
    until: float = 0.35
    gradient: float = 9e-4
    long_from: int = 0
    split_scale: float = 0.01
    prune_scale: float = 1.0
    prune_opacity: float = 0.005
    reset_at: tuple[float, ...] = (0.12,)
    reset_opacity: float = 0.05
    cap: int = 100000
    thin_at: tuple[float, ...] = ()
    thin_share: float = 0.3

    def __post_init__(self) -> None:
        require_at_least(self, 1, "every", "rounds", "cap")
        require_at_least(self, 0, "start", "long_from")
        require_progress(self, "until")
        require_positive(self, "gradient", "split_scale", "prune_scale")
        require(self, "prune_opacity", 0.0 <= self.prune_opacity < 1.0, "0 or more, below 1")
        require(self, "reset_opacity", 0.0 < self.reset_opacity < 1.0, "above 0, below 1")
        require(self, "thin_share", 0.0 <= self.thin_share < 1.0, "0 or more, below 1")
        for key in ("reset_at", "thin_at"):
            ok = all(0.0 <= progress <= 1.0 for progress in getattr(self, key))
            require(self, key, ok, f"a list, each item {PROGRESS}")


@dataclass(frozen=True)
class SaliencyOptions:
    """Which splats are spared the optimiser and the motion (GS-DMSR, Lu et al. 2026, section 4.1).

    Attributes:
        gate: what becomes of a step of a splat of low saliency: "none" leaves it; "scale" it is
            multiplied by ``low_rate``; "freeze" it is left out, moments and all; "sparse" it is
            taken every 8th time.
        gate_from: progress from which the gate works, once the motion has begun.
        threshold: saliency above which a splat is high, see ``training.saliency.step_saliency``.
        quantile: if above 0, the threshold is instead the saliency below which this share of all
            splats lies.
        release: share of the threshold below which a splat is low; between the two it stays what
            it is.
        low_rate: learning rate of low splats in units of the others'.
        units: "drawn" weighs components by what they do to the picture, "raw" adds them up.
        smoothing: weight of the past in the mean of a splat's saliency; 0 takes the last step's.
        hold: least time between two changes of class [steps].
        grace: time for which new splats are high, and all of them after a reset [steps].
        field_every: interval at which low splats have gradients for shared fields [steps]; 1 is
            always, 0 never.
        still_from: progress from which splats that hardly move are let stand still, after growing
            has ended; 1 is never.
        still_every: interval of the search for them [steps].
        still_below: motion saliency below which a splat stands still, see
            ``training.population.stillness.motion_saliency``.
    """

    gate: Literal["none", "scale", "freeze", "sparse"] = "none"
    gate_from: float = 0.35
    threshold: float = 1e-3
    quantile: float = 0.0
    release: float = 0.5
    low_rate: float = 0.01
    units: Literal["drawn", "raw"] = "drawn"
    smoothing: float = 0.9
    hold: int = 50
    grace: int = 500
    field_every: int = 1
    still_from: float = 1.0
    still_every: int = 500
    still_below: float = 0.05

    def __post_init__(self) -> None:
        require_progress(self, "gate_from", "still_from")
        require_positive(self, "threshold", "low_rate", "still_below")
        require(self, "quantile", 0.0 <= self.quantile <= 1.0, "0 to 1")
        require(self, "release", 0.0 < self.release <= 1.0, "above 0, at most 1")
        require(self, "smoothing", 0.0 <= self.smoothing < 1.0, "0 or more, below 1")
        require_at_least(self, 0, "hold", "grace", "field_every")
        require_at_least(self, 1, "still_every")


@dataclass(frozen=True)
class Preset:
    """All options of one training run.

    Attributes:
        motion: "name" of the motion and the options that its own file declares.
        layers: further layers of the model after the motion, each likewise, see ``model.layers``.
        events: what may change the splats after a step, in this order: names of files of
            ``training.population``, or mappings of a "name" and the file's own options.
    """

    data: DataOptions = field(default_factory=DataOptions)
    splats: SplatOptions = field(default_factory=SplatOptions)
    training: TrainingOptions = field(default_factory=TrainingOptions)
    losses: LossOptions = field(default_factory=LossOptions)
    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    density: DensityOptions = field(default_factory=DensityOptions)
    saliency: SaliencyOptions = field(default_factory=SaliencyOptions)
    stream: StreamOptions = field(default_factory=StreamOptions)
    segments: SegmentOptions = field(default_factory=SegmentOptions)
    motion: dict[str, Any] = field(default_factory=lambda: {"name": "multiscale"})
    layers: tuple[dict[str, Any], ...] = ()
    events: tuple[str | dict[str, Any], ...] = EVENTS

    def __post_init__(self) -> None:
        named = isinstance(self.motion.get("name"), str)
        require(self, "motion", named, "a mapping with the name of a motion")
        for key, kind in (("layers", "layer"), ("events", "event")):
            entries = [e for e in getattr(self, key) if not isinstance(e, str)]
            named = all(isinstance(entry.get("name"), str) for entry in entries)
            require(self, key, named, f"a list of mappings, each with the name of a {kind}")


def load_preset(name: str | None, config: Path | None, overrides: Sequence[str]) -> Preset:
    """Load preset ``name``, overridden by the YAML file ``config``, then by ``a.b=value`` texts.

    ``motion`` stays a ``strict.Located``: the motion's own options are checked where it starts.

    Raises:
        UsageError: a preset or key is unknown, or a value has the wrong type or range; the message
            names the file and line, or the override.
    """
    mapping = preset_files.resolve(name, config, overrides)
    return strict.build(Preset, mapping, str(config or name or "default"))
