"""The schematic of the instrument: the light's way through its parts, and what is wired to what."""

from drawing import bench, both_ways, box, legend, picture, text, way


def drawn() -> str:
    """The whole picture as SVG."""
    return picture(
        980,
        430,
        "Schematic of the instrument",
        bench(20, 60, 940, 120, ""),
        text(125, 82, "the light's way", "head"),
        way("star", (105, 20), (105, 98)),
        text(115, 34, "starlight"),
        box(40, 100, 130, "siderostat", "(coarse stage)"),
        way("star", (170, 123), (228, 123)),
        box(230, 100, 130, "compressor", "4 x"),
        way("star", (360, 123), (418, 123)),
        box(420, 100, 150, "fast steering mirror", "(fine stage)"),
        way("star", (570, 123), (628, 123)),
        box(630, 100, 130, "parabolic mirror", "f = 0.457 m"),
        way("star", (760, 123), (818, 123)),
        box(820, 100, 130, "camera", "40 x 40, 50 Hz"),
        text(115, 166, "degrees of reach, 0.37 px of backlash"),
        text(495, 166, "three piezo stacks, ±6.75 px", "note-middle"),
        # Electronics.
        box(40, 230, 130, "drive,", "two axes"),
        both_ways("wire", (105, 228), (105, 148)),
        text(113, 205, "motors, encoders"),
        box(420, 230, 150, "piezo amplifier", "MDT693"),
        way("wire", (495, 228), (495, 172)),
        text(503, 205, "0 to 150 V"),
        box(650, 230, 130, "D/A converter", "three channels"),
        way("wire", (648, 253), (572, 253)),
        text(611, 244, "0 to 10 V", "note-middle"),
        box(20, 340, 940, "fitctl: the supervisor", kind="own", height=40),
        both_ways("wire", (105, 338), (105, 278)),
        text(113, 303, "velocities and angles, 500 Hz"),
        text(113, 319, "CANopen, Ensemble or analogue"),
        both_ways("wire", (495, 338), (495, 278)),
        text(503, 303, "limits, voltages, 1 Hz"),
        text(503, 319, "RS-232"),
        way("wire", (715, 338), (715, 278)),
        text(723, 303, "voltages, 50 Hz"),
        text(723, 319, "Modbus"),
        way("wire", (880, 148), (880, 338)),
        text(888, 303, "frames"),
        text(888, 319, "GigE"),
        legend(410, (("star", "starlight"), ("wire", "measures or moves"))),
    )
