"""The open loop, as in the paper's Fig. 8: from the commands of both stages to the measured star, one axis."""

from drawing import box, junction, picture, text, way

SIGNAL = "line"


def drawn() -> str:
    """The whole picture as SVG."""
    return picture(
        980,
        350,
        "Block diagram of the model of one axis",
        text(20, 40, "siderostat", "head"),
        text(20, 68, "motor angle"),
        way(SIGNAL, (20, 78), (128, 78)),
        box(130, 55, 120, "position servo", "45 Hz"),
        way(SIGNAL, (250, 78), (288, 78)),
        box(290, 55, 130, "play, 1.0 arcsec", "(backlash)"),
        way(SIGNAL, (420, 78), (458, 78)),
        box(460, 55, 160, "gears, arm, optics", "5.99 px/rad"),
        way(SIGNAL, (620, 78), (670, 78), (670, 157)),
        text(20, 130, "fast steering mirror", "head"),
        text(20, 158, "mirror angle"),
        way(SIGNAL, (20, 168), (128, 168)),
        box(130, 145, 120, "Eq. 1: stacks'", "voltages"),
        way(SIGNAL, (250, 168), (288, 168)),
        box(290, 145, 130, "13 plays a stack", "(hysteresis)"),
        way(SIGNAL, (420, 168), (458, 168)),
        box(460, 145, 160, "mirror on its mount", "38 083 px/rad"),
        way(SIGNAL, (620, 168), (657, 168)),
        junction(670, 168),
        text(20, 230, "air", "head"),
        text(20, 258, "white noise"),
        way(SIGNAL, (20, 268), (288, 268)),
        box(290, 245, 330, "shaping filter, Eq. 8 and 9", "0.45 / (0.517 s² + 2.5 s + 1) px"),
        way(SIGNAL, (620, 268), (670, 268), (670, 181)),
        way(SIGNAL, (681, 168), (730, 168)),
        text(686, 158, "star"),
        junction(743, 168),
        text(735, 100, "noise of the", "note-middle"),
        text(735, 116, "camera's pixels", "note-middle"),
        way(SIGNAL, (743, 122), (743, 155)),
        way(SIGNAL, (754, 168), (788, 168)),
        box(790, 145, 90, "delay", "35 ms"),
        way(SIGNAL, (880, 168), (960, 168)),
        text(890, 152, "measured"),
        text(890, 188, "star, px"),
        text(
            20,
            330,
            "Each axis has this model. The three stacks of the mirror are shared by both axes.",
        ),
    )
