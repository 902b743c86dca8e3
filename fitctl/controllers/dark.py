"""What each pixel reads without light is subtracted; bad pixels are filled in from their neighbours."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera, ConfigError
from fitctl.files import read_regular

Floats = NDArray[np.float64]
_MOST_BYTES = 64 << 20
_MOST_BAD = 0.1  # of the pixels
_MEASURE = "measure it again: fitctl sequence run dark"


class Dark:
    """A camera's dark frame; without a file, its bias everywhere.

    Parameters
    ----------
    camera : Camera

    Raises
    ------
    ConfigError
        If its file cannot be used.
    """

    def __init__(self, camera: Camera) -> None:
        shape = (camera.height_px, camera.width_px)
        self._full_dn = camera.full_scale_dn
        if camera.dark_file is None:
            self._dark_dn = np.full(shape, float(camera.bias_dn))
        else:
            self._dark_dn = read_dark(Path(camera.dark_file), shape)
        bad = np.isnan(self._dark_dn)
        self._bad = [
            (row, column, *_good_about(bad, row, column)) for row, column in np.argwhere(bad)
        ]

    def light(
        self, image: NDArray[np.uint16], top: int, left: int, height: int, width: int
    ) -> Floats:
        """The light on a part of a frame, shape (height, width), in DN.

        A bad pixel gets the mean of the good ones next to it.
        """
        part = (slice(top, top + height), slice(left, left + width))
        light_dn: Floats = image[part] - self._dark_dn[part]  # pyrefly: ignore[bad-assignment]
        for row, column, rows, columns in self._bad:
            if top <= row < top + height and left <= column < left + width:
                near_dn = image[rows, columns] - self._dark_dn[rows, columns]
                light_dn[row - top, column - left] = near_dn.mean()
        return light_dn

    def without_measurement(
        self, image: NDArray[np.uint16], top: int, left: int, height: int, width: int
    ) -> tuple[int, ...]:
        """Pixels of a part that are bad or saturated, counted row by row."""
        numbers = [
            (row - top) * width + column - left
            for row, column, *_ in self._bad
            if top <= row < top + height and left <= column < left + width
        ]
        part_dn = image[top : top + height, left : left + width].ravel()
        if part_dn.item(part_dn.argmax()) >= self._full_dn:
            full = np.flatnonzero(part_dn >= self._full_dn).tolist()
            numbers = sorted({*numbers, *full})
        return tuple(numbers)


def read_dark(path: Path, shape: tuple[int, int]) -> Floats:
    """A dark frame's file (.npy), of that shape: DN, and NaN where a pixel is bad.

    Raises
    ------
    ConfigError
        If it cannot be read, has another shape, or lacks too many pixels.
    """
    try:
        dark_dn = np.load(io.BytesIO(dark_bytes(path)), allow_pickle=False)
    except (ValueError, EOFError):  # numpy's own words advise to unpickle it
        msg = f"camera.dark_file {path}: cannot be read: it is no NumPy file (.npy) of numbers; {_MEASURE}"
        raise ConfigError(msg) from None
    if not isinstance(dark_dn, np.ndarray) or dark_dn.dtype.kind != "f" or dark_dn.shape != shape:
        msg = f"camera.dark_file {path}: must hold {shape[0]} x {shape[1]} floats; {_MEASURE}"
        raise ConfigError(msg)
    bad = np.isnan(dark_dn)
    if np.isinf(dark_dn).any() or bad.mean() > _MOST_BAD:
        msg = f"camera.dark_file {path}: {bad.sum()} pixels are bad; up to {_MOST_BAD:.0%} may be; {_MEASURE}"
        raise ConfigError(msg)
    lonely = [place for place in np.argwhere(bad) if not len(_good_about(bad, *place)[0])]
    if lonely:
        row, column = lonely[0]
        msg = (
            f"camera.dark_file {path}: no pixel about az {column}, el {row} px is good; {_MEASURE}"
        )
        raise ConfigError(msg)
    return dark_dn.astype(np.float64)


def dark_bytes(path: Path) -> bytes:
    """All of a dark frame's file, as a log keeps it.

    Raises
    ------
    ConfigError
        If it cannot be read.
    """
    try:
        return read_regular(path, _MOST_BYTES)
    except OSError as error:
        msg = f"camera.dark_file {path}: cannot be read: {error.strerror}; {_MEASURE}"
        raise ConfigError(msg) from None


def _good_about(
    bad: NDArray[np.bool_], row: int, column: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of a pixel's good neighbours: the pixels at its edges, or else at its corners."""
    beside: list[tuple[int, int]] = []
    corners: list[tuple[int, int]] = []
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            place = (row + down, column + across)
            on_frame = 0 <= place[0] < bad.shape[0] and 0 <= place[1] < bad.shape[1]
            if on_frame and not bad[place]:
                (beside if 0 in {down, across} else corners).append(place)
    rows, columns = np.array(beside or corners, dtype=np.int64).reshape(-1, 2).T
    return rows, columns
