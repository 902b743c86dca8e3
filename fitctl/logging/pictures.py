"""A log's frames in the order and at the pace at which they were exposed, for what plays them again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.logging.errors import LogError
from fitctl.logging.reading import LogMessage, log_info, read_records
from fitctl.logging.records import FrameRecord
from fitctl.logging.schemas import TOPICS

_TOPIC = TOPICS[FrameRecord]


class _Picture(NamedTuple):
    exposed_ns: int
    image: NDArray[np.uint16]


class LoggedPictures:
    """The picture of a time, where the first time asked for is that of the log's first frame.

    It is the frame whose exposure is the nearest, or the last one before where the log has a gap. After
    the log's end it is dark: only the bias is left. Times must not go back.

    Parameters
    ----------
    path : Path
    width_px, height_px : int
        Of every frame.
    period_s : float
        Of the frames that will be asked for.
    bias_dn : float
    on_end : callable
        Called once with why, when the log's frames are over, or what follows cannot be read.

    Raises
    ------
    LogError
        If the log cannot be read, has no frames, or its frames are of another size.
    """

    def __init__(
        self,
        path: Path,
        width_px: int,
        height_px: int,
        period_s: float,
        bias_dn: float,
        on_end: Callable[[str], None],
    ) -> None:
        if not log_info(path).counts.get(_TOPIC):
            msg = f"{path}: has no frames ({_TOPIC}) to show; name a log that a camera's frames went into"
            raise LogError(msg)
        self._path = path
        self._shape = (height_px, width_px)
        self._half_period_ns = period_s / 2 * 1e9
        self._dark = np.full(self._shape, round(bias_dn), np.uint16)
        self._on_end = on_end
        self._entries = read_records(path, [_TOPIC])
        self._shown = self._picture(next(self._entries))
        self._next: _Picture | None = self._shown
        self._first_ns = self._shown.exposed_ns
        self._first_s: float | None = None

    def __call__(self, time_s: float) -> NDArray[np.uint16]:
        """The picture, shape (height_px, width_px), of a time in s."""
        if self._first_s is None:
            self._first_s = time_s
        due_ns = self._first_ns + (time_s - self._first_s) * 1e9 + self._half_period_ns
        while self._next is not None and self._next.exposed_ns <= due_ns:
            self._shown, self._next = self._next, self._following()
        over = self._next is None and due_ns - self._shown.exposed_ns > 2 * self._half_period_ns
        return self._dark if over else self._shown.image

    def _following(self) -> _Picture | None:
        try:
            entry = next(self._entries, None)
            if entry is not None:
                return self._picture(entry)
            self._on_end(f"{self._path}: its frames are over")
        except LogError as error:  # nobody waits for it but the one who looks
            self._on_end(str(error))
        return None

    def _picture(self, entry: LogMessage) -> _Picture:
        frame: Any = entry.message
        try:
            image = self._image(frame)
        except (AttributeError, TypeError) as error:
            msg = (
                f"{self._path}: {_TOPIC} has messages of type {frame.DESCRIPTOR.full_name}, which another "
                "program wrote; name a log that a camera's frames went into"
            )
            raise LogError(msg) from error
        return _Picture(entry.publish_time_ns, image)

    def _image(self, frame: Any) -> NDArray[np.uint16]:
        if (frame.height, frame.width) != self._shape:
            height_px, width_px = self._shape
            msg = (
                f"{self._path}: has frames of {frame.width} x {frame.height} px where the rig's camera has "
                f"{width_px} x {height_px}; set camera.width_px and camera.height_px, or name another log"
            )
            raise LogError(msg)
        if len(frame.data) != 2 * frame.height * frame.width:
            msg = f"{self._path}: has a frame of {len(frame.data)} bytes, which are not two for each pixel"
            raise LogError(msg)
        return np.frombuffer(frame.data, "<u2").reshape(self._shape)
