"""Spots on logged frames, each followed from frame to frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, Camera, Loop, Range
from fitctl.controllers.centroid import Star, StarSensor
from fitctl.identify.errors import IdentifyError
from fitctl.identify.record import tick_columns
from fitctl.logging.reading import clock_of, log_info, read_records, tick_arrays
from fitctl.logging.records import AnyRecord, FrameRecord, Tick
from fitctl.logging.schemas import TOPICS
from fitctl.messages.modes import Mode

Floats = NDArray[np.float64]

_ANY_FLUX = Range(low=1e-6, high=1e9)
_MOST_SPOTS = 6
_MOST_FILLED = 0.02  # of all frames; more, and what is filled in would show in the spectra
_SETTLE_S = 0.2  # from the last command until the stages have followed it
_CLOCK_S = 1e-5  # the log rounds times since 1970; frames are much farther apart
_STACKS = ("stack1_v", "stack2_v", "stack3_v")
_SETPOINTS = ("siderostat_setpoint_az_rad", "siderostat_setpoint_el_rad")


class TimedImage(NamedTuple):
    """One frame: mid-exposure, host's monotonic clock, and DN, shape (height, width)."""

    time_s: float
    image: NDArray[np.uint16]


@dataclass(frozen=True)
class Tracks:
    """Spots over time, brightest first, on the frames' own grid.

    Attributes
    ----------
    period_s : float
    px : array, shape (frames, spots, 2)
        Centroids (az, el) of Eq. 7, global pixel coordinates.
    flux_dn : array, shape (spots,)
        Medians.
    filled : float
        Part of the frames that were missing or had no such spot; there `px` is interpolated.
    """

    period_s: float
    px: Floats
    flux_dn: Floats
    filled: float

    @property
    def duration_s(self) -> float:
        """From the first frame to the end of the last one's period."""
        return len(self.px) * self.period_s


def find_spots(image: NDArray[np.uint16], camera: Camera, loop: Loop) -> list[Star]:
    """Every spot on a frame, brightest first; hot pixels and spots that the edge cuts are none."""
    sensor = StarSensor(camera, loop.model_copy(update={"flux_range": _ANY_FLUX}))
    left = image.copy()
    spots: list[Star] = []
    while len(spots) < _MOST_SPOTS and (star := sensor.find(left)) is not None:
        spots.append(star)
        az, el = star.window_az_px, star.window_el_px
        left[
            el - HALF_WINDOW_PX : el + HALF_WINDOW_PX + 1,
            az - HALF_WINDOW_PX : az + HALF_WINDOW_PX + 1,
        ] = round(camera.bias_dn)
    return sorted(spots, key=lambda star: -star.flux_dn)


def track_spots(frames: Iterable[TimedImage], camera: Camera, loop: Loop) -> Tracks:
    """Find the spots on the first frame that has any, and follow them.

    Raises
    ------
    IdentifyError
        If there is no spot, or one is missing on too many frames.
    """
    times_s: list[float] = []
    found: list[list[tuple[float, float, float]]] = []
    places: list[Star] = []
    sensors: list[StarSensor] = []
    for time_s, image in frames:
        if not places:
            places = find_spots(image, camera, loop)
            sensors = [
                StarSensor(camera, loop.model_copy(update={"star_flux_dn": spot.flux_dn}))
                for spot in places
            ]
            if not places:
                continue
        stars = [
            sensor.measure(image, place.az_px, place.el_px)
            for sensor, place in zip(sensors, places, strict=True)
        ]
        places = [star or place for star, place in zip(stars, places, strict=True)]
        times_s.append(time_s)
        found.append(
            [
                (np.nan, np.nan, np.nan) if star is None else (star.az_px, star.el_px, star.flux_dn)
                for star in stars
            ]
        )
    if not found:
        msg = "no spot on any frame; expected the star in the field; find it (mode COARSE) and record again"
        raise IdentifyError(msg)
    values = np.array(found)
    return _on_grid(
        np.array(times_s), values[..., :2], np.nanmedian(values[..., 2], axis=0), camera.period_s
    )


def frames_of_log(path: Path, loop_name: str, camera: Camera) -> Iterator[TimedImage]:
    """Frames of a log, as :func:`frames_of_records`.

    Raises
    ------
    IdentifyError
        If the log has no frames, none from stages at rest, or one of another size than the camera's.
    LogError
        If the log cannot be read, has no ticks of this loop, or does not say what its times are.
    """
    start_s, end_s = longest_rest(tick_arrays(path, loop_name))
    info = log_info(path)
    topic = TOPICS[FrameRecord]
    if not info.counts.get(topic):
        msg = f"the log has no frames; expected topic {topic}; record with the camera on"
        raise IdentifyError(msg)
    offset_s = clock_of(path, info.metadata).wall_minus_monotonic_s
    for entry in read_records(path, [topic]):
        time_s = entry.publish_time_ns / 1e9 - offset_s
        if start_s - _CLOCK_S <= time_s <= end_s + _CLOCK_S:
            raw: Any = entry.message  # RawImage
            yield TimedImage(time_s, _image(raw.data, raw.height, camera))


def frames_of_records(
    records: Iterable[AnyRecord], loop_name: str, camera: Camera
) -> Iterator[TimedImage]:
    """Frames from the longest stretch in which the loop's stages were commanded to stand still.

    Raises
    ------
    IdentifyError
        If there is no such stretch, or a frame's size is not the camera's.
    """
    kept = list(records)
    ticks = [record for record in kept if isinstance(record, Tick) and record.loop == loop_name]
    start_s, end_s = longest_rest(tick_columns(ticks))
    for record in kept:
        if isinstance(record, FrameRecord) and start_s <= record.time_s <= end_s:
            yield TimedImage(record.time_s, _image(record.data, record.height_px, camera))


def longest_rest(ticks: dict[str, NDArray[Any]]) -> tuple[float, float]:
    """First and last mid-exposure of the longest stretch without a new command to either stage.

    Over a link, the siderostat always undoes what the link turns: in open loop it counts as standing still.

    Raises
    ------
    IdentifyError
        If the stages never stood still with frames coming.
    """
    is_linked = bool(np.isfinite(ticks.get("link_az_rad", np.nan)).any())  # logs of 0.1.0 lack it
    names = (*_STACKS, "mode_number") if is_linked else (*_STACKS, *_SETPOINTS)
    commands = np.column_stack([ticks[name] for name in names])
    moved = np.flatnonzero(np.any(np.diff(commands, axis=0) != 0, axis=1)) + 1
    edges = np.concatenate([[0], moved, [len(commands)]])
    lengths = np.diff(edges)
    if is_linked:
        lengths = lengths * (ticks["mode_number"][edges[:-1]] == Mode.EXPERIMENT)
    longest = int(np.argmax(lengths))
    stretch = slice(edges[longest], edges[longest + 1])
    exposed_s = ticks["mid_exposure_s"][stretch]
    still_s = exposed_s[exposed_s > ticks["time_s"][stretch][:1] + _SETTLE_S]
    if lengths[longest] == 0 or len(still_s) == 0:
        msg = (
            "the stages never stood still with frames coming; expected a minute in open loop: "
            "`fitctl identify airpath` on a running rig records one"
        )
        raise IdentifyError(msg)
    return float(still_s[0]), float(still_s[-1])


def _image(data: bytes, height_px: int, camera: Camera) -> NDArray[np.uint16]:
    if height_px != camera.height_px or len(data) != 2 * camera.width_px * camera.height_px:
        msg = (
            f"a frame has {len(data)} bytes in {height_px} rows; expected {camera.width_px} x "
            f"{camera.height_px} pixels of two bytes, as in the rig file; name the rig of the log with --rig"
        )
        raise IdentifyError(msg)
    return np.frombuffer(data, dtype="<u2").reshape(camera.height_px, camera.width_px)


def _on_grid(time_s: Floats, px: Floats, flux_dn: Floats, period_s: float) -> Tracks:
    """Frames at their numbers, what is missing filled by straight lines."""
    usable = np.isfinite(time_s) & np.all(np.isfinite(px), axis=(1, 2))
    if np.count_nonzero(usable) < 2:
        msg = "no two frames with all spots; expected the star in the field; record again"
        raise IdentifyError(msg)
    since_s = time_s[usable] - time_s[usable][0]
    number = np.rint(since_s / period_s).astype(int)
    count = int(number[-1]) + 1
    filled = 1 - len(np.unique(number)) / count
    if filled > _MOST_FILLED:
        msg = (
            f"{filled:.1%} of the frames are missing or without all spots; expected at most "
            f"{_MOST_FILLED:.0%}; keep the spots in the field and record again"
        )
        raise IdentifyError(msg)
    flat = px[usable].reshape(len(number), -1)
    grid = np.column_stack([np.interp(np.arange(count), number, column) for column in flat.T])
    return Tracks(period_s, grid.reshape(count, *px.shape[1:]), flux_dn, filled)
