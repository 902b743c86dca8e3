"""Nothing is lost uncounted: every tick that a console was shown is in the log, or was counted as lost."""

from contextlib import suppress

from fitctl.logging.errors import LogError
from fitctl.logging.reading import log_info, tick_arrays
from fitctl.logging.verifying import verify


def settle(rig):
    """Compare what was shown with what is in all logs of a rig; the figures.

    What a killed supervisor still had is lost, and nobody is left to count it.
    """
    logged, problems, finished = set(), [], 0
    for path in sorted(rig.logs.glob("*.mcap")):
        with suppress(LogError):  # a log without a tick
            for name in rig.stellar_loops:
                logged |= set(tick_arrays(path, name)["time_s"].tolist())
        if path.stat().st_size and log_info(path).finished:
            finished += 1
            problems += [f"{path.name}: {problem}" for problem in verify(path).problems]
    missing = rig.shown - logged
    excused = {
        time_s
        for time_s in missing
        if any(from_s < time_s < dead_s for from_s, dead_s in rig.lost_s)
    }
    counted = sum(rig.lost_of.values())
    assert not problems
    assert "Traceback" not in rig.complaints()
    assert len(missing - excused) <= counted, f"{len(missing - excused)} missing, {counted} counted"
    return {
        "shown": len(rig.shown),
        "missing": len(missing - excused),
        "counted": counted,
        "with a killed supervisor": len(excused),
        "logs": finished,
    }
