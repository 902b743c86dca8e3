"""The schematic of the whole testbed: benches, light paths, and which loop feeds which."""

from drawing import bench, box, legend, picture, text, way

BOXES = (
    (40, 130, 140, "collector", "siderostat"),
    (190, 130, 140, "transfer mirror,", "4 photodiodes"),
    (100, 290, 170, "hexapod moves", "the whole bench"),
    (570, 130, 130, "left combiner", "siderostat"),
    (730, 130, 90, "left", "mirror"),
    (570, 290, 130, "right combiner", "siderostat"),
    (730, 290, 90, "right", "mirror"),
    (850, 210, 90, "camera", "40 x 40"),
    (570, 210, 130, "laser"),
    (120, 450, 200, "loop left", "ACQUISITION ... VERNIER"),
    (396, 450, 194, "loop metrology", "ACQUISITION ... LOCKED"),
    (670, 450, 200, "loop right", "ACQUISITION ... VERNIER"),
)
# Kind of light or signal, and the corners of its way.
WAYS = (
    ("star", (110, 30), (110, 128)),
    ("star", (180, 145), (188, 145)),
    ("star", (330, 145), (568, 145)),
    ("star", (700, 153), (728, 153)),
    ("star", (820, 153), (895, 153), (895, 208)),
    ("star", (500, 30), (500, 313), (568, 313)),
    ("star", (700, 313), (728, 313)),
    ("star", (820, 313), (880, 313), (880, 258)),
    ("laser", (635, 208), (635, 178)),
    ("laser", (568, 165), (332, 165)),
    ("wire", (260, 178), (260, 250), (450, 250), (450, 448)),
    ("wire", (530, 448), (530, 190), (590, 190), (590, 178)),
    ("wire", (396, 473), (322, 473)),
    ("wire", (140, 448), (140, 400), (70, 400), (70, 178)),
    ("wire", (925, 258), (925, 550), (220, 550), (220, 498)),
    ("wire", (280, 448), (280, 380), (836, 380), (836, 194), (775, 194), (775, 178)),
    ("wire", (908, 258), (908, 473), (872, 473)),
    ("wire", (690, 448), (690, 338)),
    ("wire", (780, 448), (780, 338)),
)
NOTES = (
    (120, 45, "starlight"),
    (510, 45, "starlight"),
    (385, 138, "link, 10 m"),
    (385, 183, "laser"),
    (323, 465, "feedforward"),
    (268, 225, "photodiodes"),
)


def drawn() -> str:
    """The whole picture as SVG."""
    return picture(
        980,
        600,
        "Schematic of the whole testbed",
        bench(20, 90, 330, 260, "Collector bench"),
        bench(550, 90, 410, 260, "Combiner bench"),
        *(way(kind, *corners) for kind, *corners in WAYS),
        *(box(*place) for place in BOXES),
        *(text(*note) for note in NOTES),
        legend(
            585,
            (("star", "starlight"), ("laser", "metrology laser"), ("wire", "measures or moves")),
        ),
    )
