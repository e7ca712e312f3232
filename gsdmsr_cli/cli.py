"""The command line: options become typed arguments, errors become one line and an exit code."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Literal, cast

import typer

from gsdmsr_cli import __version__
from gsdmsr_cli.errors import GsdmsrError, UsageError, nearest

# Commands are imported in the function that runs them: torch alone would make --help slow.

app = typer.Typer(
    help="Dynamic 3D Gaussian splatting: train, render, measure and export.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
benchmark_app = typer.Typer(help="Measure speed.", no_args_is_help=True)
app.add_typer(benchmark_app, name="benchmark")

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that train wrote.")]
MovedData = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="Where the data lies now, if moved.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
Background = Literal["white", "black"]

# What the machine, not the program, is to blame for when a file cannot be read or written.
_MACHINE_ERRNOS = frozenset(
    {
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.EIO,
        errno.EMFILE,
        errno.ENAMETOOLONG,
        errno.ENOTDIR,
        errno.EISDIR,
    }
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"gsdmsr {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


@app.command()
def prepare(
    given: Annotated[
        Path, typer.Argument(metavar="INPUT", help="Video, or folder of pictures or videos.")
    ],
    out: Annotated[Path, typer.Option(metavar="SCENE", help="Scene folder to write.")],
    format_: Annotated[
        Literal["video", "images"] | None,
        typer.Option("--format", help="What INPUT is, where it is not plain."),
    ] = None,
    rig: Annotated[
        bool, typer.Option("--rig", help="The videos are those of cameras that stand still.")
    ] = False,
    offset: Annotated[
        list[str] | None,
        typer.Option(metavar="CAMERA=S", help="Seconds its clock is ahead; repeatable."),
    ] = None,
    frames: Annotated[int, typer.Option(min=8, metavar="N", help="Most frames to take.")] = 60,
    max_side: Annotated[
        int, typer.Option(min=64, metavar="N", help="Longer side of the pictures [px].")
    ] = 1600,
    features: Annotated[
        int, typer.Option(min=100, metavar="N", help="Most features of a frame.")
    ] = 2048,
    camera_model: Annotated[
        str, typer.Option(metavar="NAME", help="COLMAP's name of the lens.")
    ] = "SIMPLE_RADIAL",
    matching: Annotated[
        Literal["auto", "sequential", "exhaustive", "both"],
        typer.Option(help="Which frames are compared with one another."),
    ] = "auto",
    masks: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Pictures that are white where something moves."),
    ] = None,
    invert_masks: Annotated[
        bool, typer.Option("--invert-masks", help="Black is what moves in --masks.")
    ] = False,
    auto_mask: Annotated[
        bool, typer.Option("--auto-mask", help="Look for what moves, in a first pass.")
    ] = False,
    mapping: Annotated[
        Literal["global", "incremental"], typer.Option(help="COLMAP's mapper.")
    ] = "global",
    min_registered: Annotated[
        float, typer.Option(min=0.0, max=1.0, metavar="X", help="Share that must have cameras.")
    ] = 0.75,
    test_every: Annotated[
        int, typer.Option(min=0, metavar="N", help="Every N-th frame is for testing; 0: none.")
    ] = 8,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of random choices.")] = 0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier SCENE.")
    ] = False,
    keep_stages: Annotated[
        bool, typer.Option("--keep-stages", help="Keep them for a run with other options.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Turn a video or pictures into a scene with cameras."""
    from gsdmsr_cli.capture.options import CAMERA_MODELS, Options

    if masks is not None and auto_mask:
        raise UsageError("--masks and --auto-mask are both given; drop one")
    if invert_masks and masks is None:
        raise UsageError("--invert-masks needs --masks")
    if rig and (format_ == "images" or masks is not None or auto_mask):
        raise UsageError("--rig takes videos, and finds cameras where nothing moves: no masks")
    if offset and not rig:
        raise UsageError("--offset is for the cameras of a --rig")
    from gsdmsr_cli.capture.rig import parse_offsets

    if camera_model not in CAMERA_MODELS:
        raise UsageError(f"--camera-model {camera_model}: {nearest(camera_model, CAMERA_MODELS)}")
    options = Options(
        frames=frames,
        offsets=parse_offsets(offset or []),
        max_side=max_side,
        features=features,
        camera_model=camera_model,
        matching=matching,
        auto_mask=auto_mask,
        mapping=mapping,
        min_registered=min_registered,
        test_every=test_every,
        seed=seed,
    )
    from gsdmsr_cli.capture.prepare import Masks
    from gsdmsr_cli.commands import prepare as command

    given_masks = None if masks is None else Masks(masks, invert_masks)
    kind = "rig" if rig else format_
    command.run(given, out, kind, given_masks, options, overwrite, keep_stages, as_json)


@app.command()
def train(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Scene folder, such as a D-NeRF one.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder to write.")],
    preset: Annotated[
        str | None, typer.Option(metavar="NAME", help="Preset to start from.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="F.yaml", help="File of options over the preset.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=v", help="One option; repeatable.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(metavar="8m", help="Wall time of training: 90s, 8m, 1.5h.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Number of steps instead of a budget.")
    ] = None,
    downscale: Annotated[
        int | None, typer.Option(metavar="N", help="Divide both sides of pictures by N.")
    ] = None,
    background: Annotated[
        Background | None, typer.Option(help="Colour behind transparent pixels.")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of random choices.")] = None,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="Where to compute.")
    ] = "auto",
    threads: Annotated[
        int | None, typer.Option(metavar="N", help="CPU threads; 0 takes all cores.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from RUN's last checkpoint.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier RUN.")] = False,
) -> None:
    """Reconstruct a moving scene from its pictures."""
    if budget is not None and steps is not None:
        raise UsageError("--budget and --steps are both given; drop one")
    if resume and overwrite:
        raise UsageError("--resume and --overwrite are both given; drop one")
    from gsdmsr_cli.commands import train as command

    options = {
        "training.budget": budget,
        "training.steps": steps,
        "data.downscale": downscale,
        "data.background": background,
        "training.seed": seed,
        "training.threads": threads,
    }
    overrides = [*(set_ or []), *_overrides(options)]
    command.run(data, out, preset, config, overrides, device, resume, overwrite)


def _overrides(options: dict[str, str | int | None]) -> list[str]:
    """Return ``--set`` texts of the options that are given; steps put an end to a budget."""
    given = {key: value for key, value in options.items() if value is not None}
    no_budget = ["training.budget=null"] if "training.steps" in given else []
    return no_budget + [f"{key}={json.dumps(value)}" for key, value in given.items()]


@app.command("eval")
def evaluate(
    run_folder: RunFolder,
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "test",
    background: Annotated[
        Literal["white", "black", "both"] | None,
        typer.Option(help="Instead of the one trained with."),
    ] = None,
    downscale: Annotated[
        int | None, typer.Option(min=1, help="Instead of the one trained with.")
    ] = None,
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of LPIPS weights.")
    ] = None,
    lpips_inria: Annotated[
        bool, typer.Option("--lpips-inria", help="LPIPS on [0, 1] too, as in tables after 3DGS.")
    ] = False,
    as_json: Json = False,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write, if not RUN/eval.")
    ] = None,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="Exit with 4 if it is less; repeatable."),
    ] = None,
    fail_over: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="Exit with 4 if it is more; repeatable."),
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option(metavar="F.json", help="Exit with 4 if worse than this metrics.json."),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="How much worse it may be; repeatable."),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="F.xml", help="Write what passed as JUnit XML.")
    ] = None,
    github_summary: Annotated[
        bool, typer.Option("--github-summary", help="Append to the summary of GitHub Actions.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Write report.html and report.md too.")
    ] = False,
    data: MovedData = None,
) -> None:
    """Measure a run on views it has not seen."""
    from gsdmsr_cli.evaluation.request import Demands, Output, Request

    request = Request(split, background, downscale, lpips_weights, lpips_inria)
    demands = Demands(
        tuple(fail_under or ()), tuple(fail_over or ()), baseline, tuple(tolerance or ())
    )
    output = Output(out, as_json, junit, github_summary, report)
    from gsdmsr_cli.commands import eval as command

    command.run(run_folder, request, demands, output, data)


@app.command()
def render(
    run_folder: RunFolder,
    path: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|F.json",
            help="test, val, train, orbit, spiral, dolly, interpolate, still, or a file of "
            "keyframes; test and orbit if not given.",
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, max=100_000, metavar="N", help="Frames of a made path.")
    ] = None,
    view: Annotated[
        list[str] | None,
        typer.Option(metavar="[SPLIT/]NAME", help="View that the path begins at; repeatable."),
    ] = None,
    time: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, metavar="T", help="Stop time there, 0 to 1.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(metavar="X", help="Frames a second of videos.")
    ] = None,
    output: Annotated[
        str, typer.Option(metavar="A,B", help="Any of rgb, depth, alpha, flow, error.")
    ] = "rgb",
    video: Annotated[str, typer.Option(metavar="A,B", help="webm, mp4, or none.")] = "webm",
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures [px].")
    ] = None,
    scale: Annotated[
        float | None, typer.Option(metavar="X", help="Factor on the size of training.")
    ] = None,
    supersample: Annotated[
        int, typer.Option(min=1, max=8, metavar="N", help="Mean of N x N pixels for each.")
    ] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Draw again what is there already.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder to write.")] = None,
    data: MovedData = None,
) -> None:
    """Draw a run to pictures, numbers and videos."""
    from gsdmsr_cli.filming.request import Request, outputs_of, size_of, videos_of

    request = Request(
        path=path,
        frames=frames,
        views=tuple(view or ()),
        time=time,
        fps=fps,
        outputs=outputs_of(output),
        videos=videos_of(video),
        size=None if size is None else size_of(size),
        scale=scale,
        supersample=supersample,
        overwrite=overwrite,
    )
    from gsdmsr_cli.commands import render as command

    command.run(run_folder, request, out, data)


@app.command()
def export(
    run_folder: RunFolder,
    format_: Annotated[
        Literal["ply", "ply-sequence"], typer.Option("--format", help="Kind of file.")
    ],
    out: Annotated[Path, typer.Option(metavar="PATH", help="File or folder to write.")],
    time: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Moment of a ply, 0 to 1.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of files of a sequence.")
    ] = None,
) -> None:
    """Write a run's splats for other programs."""
    from gsdmsr_cli.commands import export as command

    command.run(run_folder, format_, time, frames, out)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")] = Path(
        "gsdmsr-demo"
    ),
) -> None:
    """Make a small moving scene, reconstruct it and show where to look."""
    from gsdmsr_cli.commands import demo as command

    command.run(out)


@app.command()
def doctor(as_json: Json = False) -> None:
    """Report what this machine offers and what is missing."""
    from gsdmsr_cli.commands import doctor as command

    command.run(as_json)


@app.command()
def weights(
    fetch: Annotated[
        list[str] | None,
        typer.Option(metavar="NET", help="Download what alex, squeeze or vgg lacks; repeatable."),
    ] = None,
    to: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to download to, if not torch's.")
    ] = None,
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to look in first.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Say which weights of LPIPS are here; download them if told to."""
    if to is not None and not fetch:
        raise UsageError("--to is where --fetch downloads to; give both or neither")
    from gsdmsr_cli.commands import weights as command

    command.run(fetch or [], to, lpips_weights, as_json)


@benchmark_app.command()
def kernels(
    yardstick: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of other kernels to compare with.")
    ] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="What to time.")] = "cpu",
    as_json: Json = False,
) -> None:
    """Time drawing and a training step, forward and backward."""
    from gsdmsr_cli.commands import benchmark_kernels as command

    command.run(yardstick, device, as_json)


@benchmark_app.command()
def scenes(
    folders: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scene folders.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the runs and the table.")],
    preset: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Preset; repeatable.")
    ] = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(metavar="F.yaml", help="File of options in place of a preset; repeatable."),
    ] = None,
    budget: Annotated[
        list[str] | None, typer.Option(metavar="8m", help="Wall time of a training; repeatable.")
    ] = None,
    steps: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Steps of a training; repeatable.")
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(metavar="N", help="Seed; repeatable.")] = None,
    downscale: Annotated[
        int, typer.Option(min=1, metavar="N", help="Divide both sides of pictures by N.")
    ] = 1,
    background: Annotated[
        Background, typer.Option(help="Colour behind transparent pixels.")
    ] = "white",
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "test",
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of LPIPS weights.")
    ] = None,
    jobs: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Trials side by side, each on its share of cores."),
    ] = 1,
    as_json: Json = False,
) -> None:
    """Train presets on scenes at equal lengths and print the table of their scores."""
    lengths: list[str | int] = [*(budget or []), *(steps or [])]
    if not lengths:
        raise UsageError("how long is a training? give --budget 8m or --steps N, or several")
    from gsdmsr_cli.benchmark.trials import Terms
    from gsdmsr_cli.commands import benchmark_scenes as command

    terms = Terms(downscale, background, split, lpips_weights, jobs)
    presets: list[str | Path] = [*(preset or []), *(config or [])]
    command.run(folders, out, presets or ["dnerf"], lengths, seed or [0], terms, as_json)


@benchmark_app.command()
def resume(
    folder: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the runs.")],
    preset: Annotated[str, typer.Option(metavar="NAME", help="Preset.")] = "dnerf",
    steps: Annotated[int, typer.Option(min=1, metavar="N", help="Steps of a training.")] = 600,
    downscale: Annotated[
        int, typer.Option(min=1, metavar="N", help="Divide both sides of pictures by N.")
    ] = 4,
    kills: Annotated[int, typer.Option(min=1, metavar="N", help="Trainings to kill.")] = 20,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the moments.")] = 0,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=v", help="One option; repeatable.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Kill trainings at random moments, resume them, and compare how they end."""
    from gsdmsr_cli.commands import benchmark_resume as command

    asked = [f"training.steps={steps}", f"data.downscale={downscale}", *(overrides or [])]
    command.run(folder, out, preset, asked, kills, seed, as_json)


@benchmark_app.command()
def still(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    below: Annotated[
        list[float] | None,
        typer.Option(metavar="X", help="Motion saliency; repeatable. [default: 0.1 0.3 1 3]"),
    ] = None,
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "val",
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the data lies now, if elsewhere.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Let what hardly moves stand still, and measure PSNR and frames a second."""
    from gsdmsr_cli.commands import benchmark_still as command

    command.run(run, below or [0.1, 0.3, 1.0, 3.0], split, data, as_json)


# The command-line errors of typer share this base, which typer does not export by name.
_CommandLineError = cast(type[typer.BadParameter], typer.BadParameter.__base__)


def main() -> None:
    """Run the command line and exit: 0 ok, 1 internal, 2 usage, 3 data, 4 threshold, 130 Ctrl-C."""
    sys.exit(_run())


def _run() -> int:
    try:
        with _ctrl_c_that_spares_imports():
            result = typer.main.get_command(app).main(prog_name="gsdmsr", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        return 130
    except BrokenPipeError:
        # the reader of our output has left, as in `gsdmsr doctor | head -1`; keep Python's own
        # flush at exit from failing on the same pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("GSDMSR_DEBUG"):
            traceback.print_exc()
        message, code = _explain(error)
        typer.echo(f"error: {' '.join(message.split())}", err=True)
        return code
    return result if isinstance(result, int) else 0


@contextmanager
def _ctrl_c_that_spares_imports() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, but not in an import: the core of torch would abort.

    SIGTERM, by which containers and schedulers end a process, does what Ctrl-C does at the time.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # where Python allows no handlers
        return
    before = signal.signal(signal.SIGINT, _interrupt), signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGTERM, before[1])


def _terminate(_number: int, _frame: FrameType | None) -> None:
    signal.raise_signal(signal.SIGINT)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            os._exit(130)  # nothing has been begun that would have to be cleared away
        frame = frame.f_back
    raise KeyboardInterrupt


def _explain(error: Exception) -> tuple[str, int]:
    """Return the one-line message and the exit code of an error."""
    if isinstance(error, GsdmsrError):
        return str(error), error.exit_code
    if isinstance(error, _CommandLineError):
        message = error.format_message().replace("Value error, ", "")
        return message or "missing command; see --help", UsageError.exit_code
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRNOS:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}; free space or choose another place", 3
    if type(error).__name__ == "OutOfMemoryError":  # torch's, which is not imported here
        return (
            "the GPU's memory is full; lower --set density.cap=..., raise --downscale, lower "
            "--set data.cache_mib=..., or use --device cpu"
        ), 3
    hint = "set GSDMSR_DEBUG=1 for the traceback"
    return f"internal: {type(error).__name__}: {error} ({hint})", 1


if __name__ == "__main__":
    main()
