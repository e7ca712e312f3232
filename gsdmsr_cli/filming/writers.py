"""A pool of threads that write files and encode videos while the next frame is drawn."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.limits import cores

T = TypeVar("T")
Pixels = NDArray[np.uint8]
WriteVideo = Callable[[Path, Iterable[Pixels], float], None]

MOST_THREADS = 8


class WriterPool:
    """A pool of threads for jobs, and one thread for each video, with bounded queues.

    An exception of a job or a video is raised again in the thread that draws, at the next frame.

    Args:
        most_jobs: most jobs that wait or run; ``submit`` blocks beyond.
    """

    def __init__(self, most_jobs: int) -> None:
        self._free = threading.BoundedSemaphore(most_jobs)
        self._pool = ThreadPoolExecutor(min(MOST_THREADS, cores()), "write")
        self._jobs: deque[Future[Any]] = deque()
        self._videos: list[VideoWriter] = []
        self._most_jobs = most_jobs

    def __enter__(self) -> WriterPool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        """Finish everything, or, after an error, whatever is being written, and drop the rest."""
        try:
            if kind is None:
                self._finish()
        finally:
            self._pool.shutdown(cancel_futures=True)
            for video in self._videos:
                video.cancel()

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Have a job done; wait while there are too many.

        Raises:
            Exception: what an earlier job has raised.
        """
        while self._jobs and self._jobs[0].done():
            self._jobs.popleft().result()
        self._free.acquire()
        try:
            future = self._pool.submit(job)
        except BaseException:
            self._free.release()
            raise
        future.add_done_callback(lambda _: self._free.release())
        self._jobs.append(future)
        return future

    def video(self, path: Path, write: WriteVideo, fps: float) -> VideoWriter:
        """Begin a video, which is written in the background from the pictures given to it."""
        self._videos.append(VideoWriter(path, write, fps, self._most_jobs))
        return self._videos[-1]

    def _finish(self) -> None:
        for job in self._jobs:
            job.result()
        for video in self._videos:
            video.finish()


class VideoWriter:
    """A video that is written on a thread of its own, from pictures in order.

    Args:
        path: where to.
        write: writes pictures that it takes one after the other.
        fps: frames a second.
        most_waiting: most pictures that wait.
    """

    def __init__(self, path: Path, write: WriteVideo, fps: float, most_waiting: int) -> None:
        self._waiting: queue.Queue[Callable[[], Pixels] | None] = queue.Queue(most_waiting)
        self._cancelled = threading.Event()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(path, write, fps), name="video")
        self._thread.start()

    def add(self, picture: Callable[[], Pixels] | None) -> None:
        """Add a picture, that is, what returns it, perhaps after waiting; None ends the video.

        Raises:
            Exception: what has kept the video from being written.
        """
        while self._thread.is_alive():
            with suppress(queue.Full):
                self._waiting.put(picture, timeout=0.1)
                return
        if self._error is not None:
            raise self._error

    def finish(self) -> None:
        """Wait until the video is written."""
        self.add(None)
        self._thread.join()
        if self._error is not None:
            raise self._error

    def cancel(self) -> None:
        """End at once; a video that has not been finished leaves nothing behind."""
        self._cancelled.set()
        self._thread.join()

    def _run(self, path: Path, write: WriteVideo, fps: float) -> None:
        try:
            write(path, self._pictures(), fps)
        except BaseException as error:  # raised again in the thread that draws
            self._error = error

    def _pictures(self) -> Iterator[Pixels]:
        while True:
            if self._cancelled.is_set():
                raise CancelledError
            with suppress(queue.Empty):
                picture = self._waiting.get(timeout=0.1)
                if picture is None:
                    return
                yield picture()
