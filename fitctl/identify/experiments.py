"""What can be identified, and how: one table."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from fitctl.config import Rig
from fitctl.identify import airpath, backlash, delay, hysteresis, response, spot
from fitctl.identify.frames import TimedImage, frames_of_log, frames_of_records, track_spots
from fitctl.identify.link import ambient, beam, feedforward
from fitctl.identify.link.step_record import TickKind, gather_step_log
from fitctl.identify.record import gather, gather_log
from fitctl.logging.copying import merge
from fitctl.logging.reading import Columns
from fitctl.logging.records import AnyRecord, MetrologyTick, Tick
from fitctl.mocks.detector import DetectorBench
from fitctl.model.drives import Drive

Finding = (
    hysteresis.HysteresisResult
    | backlash.BacklashResult
    | delay.DelayResult
    | airpath.AirPathResult
    | spot.SpotResult
    | response.ResponseResult
    | feedforward.FeedforwardResult
    | beam.PhotodiodesResult
    | beam.LinkDelayResult
    | ambient.AmbientResult
)
"""Each has `fragment`, to lay over the rig file, `lines`, for an operator, and `draw`, a figure."""


class Identification(NamedTuple):
    """One thing that can be identified.

    Attributes
    ----------
    plan : callable or None
        The motions, of a rig's loop; None for what is measured on the detector bench, or by a sequence's step.
    from_log : callable
        From a log that has the experiment, or from a bench's file.
    from_records : callable or None
        The same from records in hand.
    step : str
        The step of a sequence that records the data; empty where :attr:`plan` or a bench does.
    """

    plan: Callable[[Rig, str], list[Drive]] | None
    from_log: Callable[[Rig, str, Path], Finding]
    from_records: Callable[[Rig, str, list[AnyRecord]], Finding] | None
    step: str = ""

    def from_logs(self, rig: Rig, loop_name: str, paths: list[Path]) -> Finding:
        """From all logs that were written meanwhile: another may have begun within the experiment."""
        if len(paths) == 1:
            return self.from_log(rig, loop_name, paths[0])
        with tempfile.TemporaryDirectory(prefix="fitctl-identify-") as folder:
            whole = Path(folder) / "whole.mcap"
            merge(paths, whole)
            return self.from_log(rig, loop_name, whole)


def _of_stages(
    name: str,
    plan: Callable[[Rig, str], list[Drive]],
    analyse: Callable[..., Finding],
) -> Identification:
    """An identification from a loop's own ticks and voltages."""
    return Identification(
        plan=plan,
        from_log=lambda rig, loop, path: analyse(rig, gather_log(path, loop, name)),
        from_records=lambda rig, loop, records: analyse(rig, gather(records, loop, name)),
    )


def _of_step(
    step: str, kind: TickKind, analyse: Callable[[Rig, str, Columns], Finding]
) -> Identification:
    """An identification from one loop's ticks during a step of a sequence."""
    return Identification(
        plan=None,
        from_log=lambda rig, loop, path: analyse(
            rig, loop, gather_step_log(path, kind, loop, step)
        ),
        from_records=None,
        step=step,
    )


def _air_path(rig: Rig, loop_name: str, frames: Iterable[TimedImage]) -> airpath.AirPathResult:
    tracks = track_spots(frames, rig.camera, rig.stellar_loops[loop_name])
    return airpath.analyse(rig, loop_name, tracks)


def _response_from_file(rig: Rig, loop_name: str, path: Path) -> Finding:
    return response.analyse(
        [response.read_bench(path, rig.stellar_loops[loop_name].fsm)], loop_name
    )


def response_on_mock_bench(
    rig: Rig, loop_name: str, seed: int, on_axis: Callable[[str], None]
) -> Finding:
    """Drive the mock of the detector bench with the paper's chirps."""
    bench = DetectorBench(rig, loop_name, seed)
    return response.analyse(response.measure(bench, on_axis), loop_name)


EXPERIMENTS: dict[str, Identification] = {
    "hysteresis": _of_stages("hysteresis", hysteresis.plan, hysteresis.analyse),
    "backlash": _of_stages("backlash", backlash.plan, backlash.analyse),
    "delay": _of_stages("delay", delay.plan, delay.analyse),
    "airpath": Identification(
        airpath.plan,
        lambda rig, loop, path: _air_path(rig, loop, frames_of_log(path, loop, rig.camera)),
        lambda rig, loop, records: _air_path(
            rig, loop, frames_of_records(records, loop, rig.camera)
        ),
    ),
    "spot": Identification(
        spot.plan,
        lambda rig, loop, path: spot.analyse(rig, loop, frames_of_log(path, loop, rig.camera)),
        lambda rig, loop, records: spot.analyse(
            rig, loop, frames_of_records(records, loop, rig.camera)
        ),
    ),
    "response": Identification(None, _response_from_file, None),
    "feedforward": _of_step(feedforward.STEP, Tick, feedforward.analyse),
    "photodiodes": _of_step(
        beam.STEP,
        MetrologyTick,
        lambda rig, loop, ticks: beam.analyse(rig, loop, ticks, beam.PhotodiodesResult),
    ),
    "link_delay": _of_step(
        beam.STEP,
        MetrologyTick,
        lambda rig, loop, ticks: beam.analyse(rig, loop, ticks, beam.LinkDelayResult),
    ),
    "ambient": _of_step(ambient.STEP, MetrologyTick, ambient.analyse),
}
