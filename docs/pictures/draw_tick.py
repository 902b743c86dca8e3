"""The timing of a frame: exposure, delay, tick and hold, from the default rig; and the phases of a tick."""

from drawing import bar, both_ways, box, picture, text, way

from fitctl.config import default_rig_path, load_rig

LEFT, SCALE = 190, 11.0  # where the first millisecond is drawn, and pixels a millisecond
FIRST_MS, LAST_MS = -8, 62
ROWS = {"camera exposes": 70, "frame travels": 120, "fitctl: tick": 170, "mirror keeps": 220}
ROW_PX = 26


def drawn() -> str:
    """The whole picture as SVG."""
    rig = load_rig(default_rig_path())
    return picture(
        980,
        415,
        "Timing of a frame and of a tick",
        *_timeline(
            1000 * rig.camera.exposure_s,
            1000 / rig.camera.frame_rate_hz,
            1000 * rig.camera.frame_delay_s,
        ),
        *_tick(),
    )


def _x(time_ms):
    return LEFT + SCALE * (time_ms - FIRST_MS)


def _span(start_ms, end_ms, y, kind, words=""):
    start_ms, end_ms = max(start_ms, FIRST_MS), min(end_ms, LAST_MS)
    yield bar(_x(start_ms), y, SCALE * (end_ms - start_ms), ROW_PX, kind)
    if words:
        yield text(_x((start_ms + end_ms) / 2), y + 18, words, "")


def _timeline(exposure_ms, period_ms, delay_ms):
    yield text(20, 26, "one frame", "head")
    for row, y in ROWS.items():
        yield text(20, y + 18, row)
    exposes, travels, ticks, keeps = ROWS.values()
    middles = [period_ms * number for number in range(-3, 4)]
    for middle in middles:
        if middle + exposure_ms / 2 > FIRST_MS and middle - exposure_ms / 2 < LAST_MS:
            yield from _span(
                middle - exposure_ms / 2, middle + exposure_ms / 2, exposes, "star-box", ""
            )
        if FIRST_MS < middle + delay_ms < LAST_MS:
            yield bar(_x(middle + delay_ms), ticks, 0.6 * SCALE, ROW_PX, "busy")
    yield text(_x(0), exposes + 18, "frame A", "")
    yield text(_x(period_ms), exposes + 18, "frame B", "")
    yield from _span(exposure_ms / 2, delay_ms, travels, "box", "read out and sent: frame A")
    yield text(_x(delay_ms) + 14, ticks + 18, "with frame A")
    yield from _span(FIRST_MS, delay_ms - period_ms, keeps, "box")
    yield from _span(delay_ms - period_ms, delay_ms, keeps, "box", "command before")
    yield from _span(delay_ms, delay_ms + period_ms, keeps, "own", "command from frame A")
    yield from _span(delay_ms + period_ms, LAST_MS, keeps, "box")
    # The ruler.
    base = 275
    yield way("line", (_x(FIRST_MS), base), (_x(LAST_MS), base))
    for time_ms in range(0, LAST_MS, 10):
        yield way("line", (_x(time_ms), base - 4), (_x(time_ms), base + 4), arrow=False)
        yield text(_x(time_ms), base + 20, f"{time_ms} ms", "note-middle")
    for time_ms in (0, delay_ms, delay_ms + period_ms):
        yield way("dashed", (_x(time_ms), 46), (_x(time_ms), base - 6), arrow=False)
    yield both_ways("line", (_x(0), 50), (_x(delay_ms), 50))
    yield text(_x(delay_ms / 2), 44, f"delay {delay_ms:g} ms", "note-middle")
    yield both_ways("line", (_x(delay_ms), 50), (_x(delay_ms + period_ms), 50))
    yield text(_x(delay_ms + period_ms / 2), 44, f"hold {period_ms:g} ms", "note-middle")


def _tick():
    y = 350
    yield text(20, 335, "one tick", "head")
    phases = (
        ("sense", "star, stages"),
        ("decide", "interlocks, law"),
        ("send", "D/A, set-point"),
        ("confirm", "D/A's answer"),
        ("record", "log, telemetry"),
    )
    for number, lines in enumerate(phases):
        x = 190 + 158 * number
        yield box(x, y, 130, *lines, kind="own")
        if number:
            yield way("line", (x - 28, y + 23), (x - 2, y + 23))
    yield text(20, y + 20, "loop by loop; confirm")
    yield text(20, y + 36, "once all have sent")
