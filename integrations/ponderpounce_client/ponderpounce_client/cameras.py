"""Cameras by OpenCV (pip install ponderpounce-client[cameras]): a device, a file or an RTSP stream, each in its thread.

A camera never makes the loop wait: ``read`` gives the newest picture and its instant, however old it is. What is too
old is for the schedule to say.
"""

from __future__ import annotations

import threading
import time
from typing import Any

import cv2
import numpy as np

_AGAIN_S = 0.5


class Camera:
    """One camera's newest picture.

    Args:
        source: a device's number, a file, or a URL such as rtsp://HOST/STREAM.
        size: (height, width) to resize to; None: as it comes.
        first_s: longest wait for the first picture.

    Raises:
        OSError: no picture came.
    """

    def __init__(self, source: int | str, size: tuple[int, int] | None = None, first_s: float = 10.0) -> None:
        self._source, self._size = source, size
        self._lock, self._has_picture, self._is_closed = threading.Lock(), threading.Event(), threading.Event()
        self._newest: Any = None
        self._thread = threading.Thread(target=self._watch, name=f"camera {source}", daemon=True)
        self._thread.start()
        if not self._has_picture.wait(first_s):
            self.close()
            raise OSError(f"camera {source}: no picture within {first_s:g} s")

    def read(self) -> tuple[np.ndarray, int]:
        """The newest picture, (height, width, 3) uint8 RGB, and when it came (``time.monotonic_ns``)."""
        with self._lock:
            image, at_ns = self._newest
        return image, at_ns

    def close(self) -> None:
        self._is_closed.set()
        self._thread.join(2)

    def _watch(self) -> None:
        while not self._is_closed.is_set():
            capture = cv2.VideoCapture(self._source)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a queue of pictures would make each of them old
            while not self._is_closed.is_set() and self._take(capture):
                pass
            capture.release()
            self._is_closed.wait(_AGAIN_S)  # a stream that broke off is opened again; a file begins anew

    def _take(self, capture: Any) -> bool:
        begun_s = time.monotonic()
        is_there, image = capture.read()
        at_ns = time.monotonic_ns()
        if not is_there:
            return False
        if self._size is not None:
            image = cv2.resize(image, (self._size[1], self._size[0]), interpolation=cv2.INTER_AREA)
        with self._lock:
            self._newest = (cv2.cvtColor(image, cv2.COLOR_BGR2RGB), at_ns)
        self._has_picture.set()
        if self._is_file(capture):  # a file is read at its own rate
            rate_hz = capture.get(cv2.CAP_PROP_FPS) or 30.0
            self._is_closed.wait(max(0.0, 1 / rate_hz - (time.monotonic() - begun_s)))
        return True

    def _is_file(self, capture: Any) -> bool:
        return isinstance(self._source, str) and "://" not in self._source and not self._source.startswith("/dev/")
