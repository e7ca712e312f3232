"""The options of `gsdmsr prepare`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gsdmsr_cli.ground.errors import UsageError, nearest


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(prepare)


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
    frames: Annotated[
        int | None,
        typer.Option(min=8, metavar="N", help="Most frames to take; 240, with --rig 60."),
    ] = None,
    keyframes: Annotated[
        int,
        typer.Option(min=8, metavar="N", help="Most frames that COLMAP finds cameras of."),
    ] = 60,
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
        bool, typer.Option("--auto-mask", help="Find cameras again without what moves.")
    ] = False,
    no_mark_motion: Annotated[
        bool, typer.Option("--no-mark-motion", help="Mask nothing that moves in a video.")
    ] = False,
    masks_of: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN", help="INPUT is a scene; mask what RUN, what stands still in it, lacks."
        ),
    ] = None,
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
) -> None:
    """Turn a video or pictures into a scene with cameras."""
    from gsdmsr_cli.capture.options import CAMERA_MODELS, FRAMES_OF_RIG, Options

    if masks is not None and auto_mask:
        raise UsageError("--masks and --auto-mask are both given; drop one")
    if masks_of is not None and (masks is not None or auto_mask):
        raise UsageError("--masks-of and --masks or --auto-mask are both given; drop one")
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
        frames=frames or (FRAMES_OF_RIG if rig else Options.frames),
        keyframes=keyframes,
        offsets=parse_offsets(offset or []),
        max_side=max_side,
        features=features,
        camera_model=camera_model,
        matching=matching,
        auto_mask=auto_mask,
        mark_motion=not no_mark_motion,
        mapping=mapping,
        min_registered=min_registered,
        test_every=test_every,
        seed=seed,
    )
    from gsdmsr_cli.capture.prepare import Masks
    from gsdmsr_cli.commands import prepare as command

    given_masks = None if masks is None else Masks(masks, invert_masks)
    kind = "rig" if rig else format_
    command.run(given, out, kind, given_masks, options, overwrite, keep_stages, masks_of)
