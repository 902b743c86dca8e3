"""The closed loop of both stages, as in the paper's Fig. 10: parallel, with feedback about the vernier."""

from drawing import bench, box, junction, picture, text, way

SIGNAL = "line"


def drawn() -> str:
    """The whole picture as SVG."""
    return picture(
        1000,
        420,
        "Block diagram of the control loop of both stages",
        bench(60, 30, 620, 290, "fitctl, at each frame"),
        bench(710, 30, 190, 290, "stages"),
        text(10, 146, "target"),
        way(SIGNAL, (10, 158), (78, 158)),
        box(80, 135, 110, "prefilter", "1 / (s + 1)²", kind="own"),
        way(SIGNAL, (190, 158), (224, 158)),
        junction(237, 158, (-14, 30, "−")),
        way(SIGNAL, (248, 158), (280, 158), arrow=False),
        text(288, 162, "error"),
        way(SIGNAL, (280, 158), (280, 93), (328, 93)),
        way(SIGNAL, (280, 158), (280, 213), (306, 213)),
        box(330, 70, 150, "coarse integrator", "0.074 Hz", kind="own"),
        way(SIGNAL, (480, 93), (728, 93)),
        text(510, 84, "motor angle"),
        box(730, 70, 150, "siderostat", "servo, backlash"),
        junction(319, 213, (-14, 30, "−")),
        way(SIGNAL, (330, 213), (348, 213)),
        box(350, 190, 150, "vernier,", "Eq. 20", kind="own"),
        way(SIGNAL, (500, 213), (548, 213)),
        box(550, 190, 110, "limit to", "the diamond", kind="own"),
        way(SIGNAL, (660, 213), (728, 213)),
        text(515, 182, "mirror angle"),
        box(730, 190, 150, "fast steering mirror", "hysteresis"),
        # The deadzone: what the mirror cannot reach goes back.
        way(SIGNAL, (524, 213), (524, 278), (502, 278)),
        box(350, 255, 150, "deadzone: the part", "beyond the diamond", kind="own"),
        way(SIGNAL, (348, 278), (319, 278), (319, 226)),
        # The star.
        way(SIGNAL, (880, 93), (925, 93), (925, 142)),
        way(SIGNAL, (880, 213), (925, 213), (925, 168)),
        junction(925, 155),
        way(SIGNAL, (990, 155), (938, 155)),
        text(966, 146, "air", "note-middle"),
        way(SIGNAL, (914, 155), (908, 155), (908, 380), (572, 380)),
        text(800, 371, "star", "note-middle"),
        box(420, 357, 150, "camera, centroid,", "35 ms"),
        way(SIGNAL, (420, 380), (237, 380), (237, 171)),
        text(330, 371, "measured star", "note-middle"),
    )
