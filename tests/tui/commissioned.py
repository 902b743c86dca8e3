"""A console that does the steps of a commissioning, whose process is answered by heart."""

from tests.instruments.fake_supervisor import FakeSupervisor
from tests.tui.fixed import FixedApp

RIG = ["--rig", "mine.toml", "--folder", "records"]
GO = "Go? (yes, no, skip) [no]: "
OUTPUT = (
    "    right.stacks: Each D/A channel moves its stack. About 12 s.\n"
    "    Moves: each stack by 0.3 V.\n"
) + GO


class CommissioningApp(FixedApp):
    """Each process that asks has printed `printed` so far."""

    printed = ""

    def start_fake(self, arguments, **options):
        job = super().start_fake(arguments, **options)
        job.printed = self.printed if job.asks else ""
        return job


def commissioning(printed="", supervisor=None):
    """A console as `fitctl commission --console` opens it, without a supervisor at first."""
    app = CommissioningApp(supervisor or FakeSupervisor(), silent_s=7.2, commissioning=RIG)
    app.printed = printed
    if supervisor is None:
        app.recorded = []
    return app
