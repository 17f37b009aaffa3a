"""Videos of one camera: written frame by frame, joined without encoding again, read at any frame. PyAV's home.

H.264 in MP4 with 4:2:0 colour, which every reader decodes; one encoder thread and no B-frames, so that equal pictures
make equal bytes and frame k is packet k. A key frame at least every ten frames keeps random access cheap.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from dual_system.data.errors import DatasetError

FPS = 20
CODEC, PIXEL_FORMAT = "h264", "yuv420p"
FRAMES_PER_KEY = 10
_OPTIONS = {
    "crf": "18",
    "preset": "veryfast",
    "tune": "zerolatency",  # x264's lookahead is not quite deterministic: one in hundreds of tiny videos came out other
    "g": str(FRAMES_PER_KEY),
    "bf": "0",
    "threads": "1",
}

Frame = NDArray[np.uint8]  # (height, width, 3) RGB


def check_image_px(image_px: int) -> None:
    """Raises DatasetError unless videos can have square pictures of this side, which is an option's value."""
    if image_px < 16 or image_px % 2:
        raise DatasetError(f"--image-px {image_px}: videos need an even number of at least 16")


class VideoWriter:
    """Encodes one episode of one camera into memory: about a megabyte a minute at 256 px."""

    def __init__(self, height_px: int, width_px: int = 0, fps: int = FPS) -> None:
        """Args: width_px: 0: as high. Both must be even: colours have half as many pixels."""
        self._time_base = Fraction(1, fps)
        self._file = io.BytesIO()
        self._container = av.open(self._file, "w", format="mp4")
        self._stream: Any = self._container.add_stream("libx264", rate=fps, options=_OPTIONS)
        self._stream.height, self._stream.width = height_px, width_px or height_px
        self._stream.pix_fmt = PIXEL_FORMAT
        self._stream.codec_context.thread_count = 1
        self._num_frames = 0
        self._last: Any = None

    def add(self, frame: Frame | None) -> None:
        """Appends a picture; None repeats the last one, which costs some tens of bytes.

        Raises ValueError if there is no picture to repeat.
        """
        if frame is not None:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            self._last = picture.reformat(format=PIXEL_FORMAT)  # once, however often it is repeated
        if self._last is None:
            raise ValueError("the first frame of a video must be a picture; look at the first row of an episode")
        self._last.pts, self._last.time_base = self._num_frames, self._time_base
        self._num_frames += 1
        for packet in self._stream.encode(self._last):
            self._container.mux(packet)

    def finish(self) -> bytes:
        """Returns the finished file."""
        for packet in self._stream.encode():
            self._container.mux(packet)
        self._container.close()
        return self._file.getvalue()


class VideoJoiner:
    """Appends finished videos to one file, packet by packet."""

    def __init__(self, path: Path, fps: int = FPS) -> None:
        self._time_base = Fraction(1, fps)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(_url(path), "w", format="mp4")
        self._stream: Any = None
        self.num_frames = 0
        self.num_bytes = 0  # of what was appended

    def append(self, video: bytes) -> None:
        """Appends all frames of a file that `VideoWriter` made."""
        with av.open(io.BytesIO(video), "r") as source:
            stream = source.streams.video[0]
            if self._stream is None:
                self._stream = self._container.add_stream_from_template(stream)
                self._stream.time_base = self._time_base
            for packet in source.demux(stream):
                if packet.size == 0:  # the demuxer's way to say that it is through
                    continue
                packet.stream = self._stream
                packet.time_base = self._time_base
                packet.pts = packet.dts = self.num_frames
                packet.duration = 1
                self._container.mux(packet)
                self.num_frames += 1
        self.num_bytes += len(video)

    def close(self) -> None:
        self._container.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoHeader:
    """What a video file says of itself before anything is decoded."""

    num_frames: int  # 0: the container does not tell
    fps: float
    height_px: int
    width_px: int


def read_header(path: Path) -> VideoHeader:
    """Raises ValueError if the file cannot be opened or is no video."""
    with _opened(path) as (_, stream):
        return VideoHeader(
            num_frames=stream.frames,
            fps=float(stream.average_rate or 0),
            height_px=stream.height,
            width_px=stream.width,
        )


def read_frames(path: Path, indices: Sequence[int], *, fps: float = FPS) -> Iterator[Frame]:
    """Yields the frames with ascending numbers ``indices``, decoding from the key frame before each where that saves.

    Any codec and any distance of key frames will do; frame k is the one shown at k / ``fps``.

    Raises:
        ValueError: the file cannot be opened, is no video, or is damaged.
        IndexError: it has no frame of such a number.
    """
    with _opened(path) as (container, stream):
        stream.codec_context.thread_count = 1

        def decoded_from(index: int) -> Iterator[tuple[int, Any]]:
            container.seek(round(index / fps / stream.time_base), stream=stream)
            return ((round(frame.pts * stream.time_base * fps), frame) for frame in container.decode(stream))

        decoded: Iterator[tuple[int, Any]] = iter(())
        at, frame = -1 - FRAMES_PER_KEY, None  # number of the frame decoded last
        for index in indices:
            if index > at + FRAMES_PER_KEY:
                decoded = decoded_from(index)
                at, frame = next(decoded, (at, None))
                if at > index:  # some files lead past the key frame
                    decoded = decoded_from(0)
                    at, frame = next(decoded)
            while at < index and frame is not None:
                at, frame = next(decoded, (at, None))
            if at != index or frame is None:
                raise IndexError(f"{path} has no frame {index}; it has {stream.frames} frames")
            yield frame.to_ndarray(format="rgb24")


def _url(path: Path) -> str:
    """The name under which FFmpeg opens a file: it takes "run:1" at the beginning of a path for a protocol."""
    return str(path.absolute())


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A video's container and stream; FFmpeg's errors, also those of decoding, become ValueErrors that name it."""
    try:
        with av.open(_url(path), "r") as container:
            if not container.streams.video:
                raise ValueError(f"{path} has no video stream")
            yield container, container.streams.video[0]
    except av.FFmpegError as error:
        raise ValueError(f"{path} cannot be decoded: {error.strerror}") from None
