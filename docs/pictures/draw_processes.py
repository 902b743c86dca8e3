"""The processes, the sockets between them, and the wires to the devices."""

from drawing import both_ways, box, legend, picture, text, way


def drawn() -> str:
    """The whole picture as SVG."""
    return picture(
        980,
        470,
        "Processes and the sockets between them",
        box(30, 30, 170, "consoles", "fitctl console"),
        box(30, 110, 170, "shells", "fitctl send, status"),
        box(30, 190, 170, "metrics", "for Prometheus"),
        box(30, 270, 170, "learner", "estimates the night"),
        box(30, 370, 170, "clients elsewhere", "with keys"),
        box(290, 370, 150, "gateway", "encryption, limits"),
        box(430, 30, 190, "supervisor", "fitctl run", kind="own", height=286),
        box(720, 30, 220, "camera", "GigE Vision, UDP"),
        box(720, 95, 220, "siderostat's drive", "CANopen, serial or Modbus"),
        box(720, 160, 220, "mirror's D/A", "Modbus TCP or RTU"),
        box(720, 225, 220, "piezo amplifier", "RS-232"),
        text(944, 292, "or fitctl mocks, a process that speaks the same", "note-end"),
        box(530, 370, 150, "recorder", "writes and rotates"),
        box(790, 370, 150, "log", "MCAP files"),
        # Commands and telemetry.
        *(both_ways("wire", (202, y), (428, y)) for y in (53, 133, 293)),
        way("wire", (428, 213), (202, 213)),
        text(315, 46, "commands, telemetry", "note-middle"),
        text(315, 126, "commands, telemetry", "note-middle"),
        text(315, 206, "telemetry", "note-middle"),
        text(315, 286, "telemetry, reports", "note-middle"),
        both_ways("laser", (202, 393), (288, 393)),
        text(245, 386, "TCP", "note-middle"),
        both_ways("wire", (450, 318), (450, 345), (365, 345), (365, 368)),
        text(375, 338, "envelopes", "note-middle"),
        both_ways("wire", (600, 318), (600, 368)),
        text(610, 348, "records, acknowledged"),
        way("line", (680, 393), (788, 393)),
        *(both_ways("line", (622, y), (718, y)) for y in (53, 118, 183, 248)),
        legend(
            450,
            (
                ("wire", "ZeroMQ, Unix sockets of this machine"),
                ("laser", "ZeroMQ over TCP, encrypted"),
                ("line", "wires and files"),
            ),
            step=300,
        ),
    )
