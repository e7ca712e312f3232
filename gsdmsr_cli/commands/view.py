"""gsdmsr view: serves a page that plays a run, also while it is being trained."""

from __future__ import annotations

import os
import secrets
import signal
import threading
import time
import webbrowser
from contextlib import suppress
from pathlib import Path

import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import set_threads
from gsdmsr_cli.commands._showing import read_data, scene_facts
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.options.preset import BACKGROUNDS
from gsdmsr_cli.player.page import page
from gsdmsr_cli.runs.run import Run, open_run, open_with_model
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.loop import validation_view
from gsdmsr_cli.viewing.held_out import HeldOut
from gsdmsr_cli.viewing.server import LOOPBACK, Server
from gsdmsr_cli.viewing.showing import Showing

PICTURES = 64 << 20
"""Memory for decoded pictures [bytes]: there is one."""

WITH_PARENT = "GSDMSR_VIEW_WITH_PARENT"
"""Environment variable of a server that is to end with the process that has started it."""

WAIT, LONGEST_WAIT = 0.5, 600.0
"""Between two looks for the first checkpoint of a training, and how long there may be none [s]."""


def run(
    run_folder: Path,
    host: str = "127.0.0.1",
    port: int = 0,
    data: Path | None = None,
    opens: bool = False,
) -> None:
    """Serve the page until Ctrl-C.

    Args:
        run_folder: the run, or a file in place of one.
        host: address to listen at; one that others can reach asks for a token.
        port: to listen at; 0 takes a free one.
        data: where the data lies now, for the held-out view.
        opens: whether a browser is to be opened.

    Raises:
        UsageError: nobody may listen there.
        DataError: the run or its data cannot be used.
    """
    torch.set_num_threads(1)
    set_threads(1)  # what is drawn here is little, and a training may want the cores
    if not open_run(run_folder).preset.segments.several:  # of these all have to be there
        _wait_for_splats(run_folder)
    found, model, _ = open_with_model(run_folder)
    if model.needs_camera:
        raise UsageError(f"{run_folder}: its splats depend on the camera, which a page cannot play")
    scene = read_data(found, data)
    further = {"scene": scene_facts(found, model, scene)}
    html = page(None, "scene.dsplat", run_folder.resolve().name, live=True)
    showing = Showing(run_folder, html, further, _held_out(found, scene))
    token = None if host in LOOPBACK else secrets.token_urlsafe(16)
    try:
        server = Server(host, port, showing.pages(), token)
    except (OSError, OverflowError) as error:
        raise UsageError(
            f"cannot listen at {host}, port {port}: {error}; choose another --port or --host"
        ) from error
    document = {"run": str(run_folder), "address": server.address}
    ends = () if WITH_PARENT in os.environ else ("Ctrl-C ends it",)
    say.result(document, f"{run_folder} plays at {server.address}", *ends)
    if opens:
        webbrowser.open(server.address)
    _serve(server)


def _serve(server: Server) -> None:
    """Answer until Ctrl-C or SIGTERM, which end the command well."""
    ended = threading.Event()
    for name in ("SIGINT", "SIGTERM"):
        with suppress(ValueError):  # outside the main thread, in tests
            signal.signal(getattr(signal, name), lambda *_: ended.set())
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    parent = os.getppid() if WITH_PARENT in os.environ else None
    with suppress(KeyboardInterrupt):
        while not ended.wait(0.5) and parent in (None, os.getppid()):
            pass
    server.shutdown()
    server.server_close()


def _wait_for_splats(root: Path) -> None:
    """Wait until a training that has just begun has a checkpoint.

    Raises:
        DataError: it is no run, or has none for long.
    """
    found = open_run(root)
    began = time.monotonic()
    while not found.checkpoint_path.is_file():
        if time.monotonic() - began > LONGEST_WAIT or not found.log_path.parent.is_dir():
            raise DataError(f"{root}: the run has no checkpoint yet; try again when it has")
        time.sleep(WAIT)


def _held_out(found: Run, scene: Scene | None) -> HeldOut | None:
    """Return the view whose PSNR the training reports."""
    if scene is None:
        return None
    options = found.preset.data
    colour = BACKGROUNDS[options.background]
    pictures = Pictures(colour, options.downscale, PICTURES)
    engine = raster.best_engine("cpu")
    return HeldOut(validation_view(scene), pictures, engine, torch.tensor(colour))
