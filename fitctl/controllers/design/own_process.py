"""A design made in a process of its own, so that what it needs never comes into the supervisor's.

python-control brings matplotlib, and scipy a second linear algebra library: 150 MB that the supervisor would
lock, for a second's work at its start.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.document import design_from_json, design_json
from fitctl.controllers.pair import Design

_UNUSABLE = 2
_TIMEOUT_S = (
    60.0  # it needs two seconds, mostly for its imports; longer on a machine that is starting up
)
_running: set[subprocess.Popen[str]] = set()


def design_in_own_process(
    rig: Rig,
    loop_name: str,
    controller: str = "",
    noise_px: float | None = None,
    timeout_s: float = _TIMEOUT_S,
) -> Design:
    """As :func:`fitctl.controllers.design.choose.design_for`, bit for bit, by another process.

    Raises
    ------
    ConfigError
        As `design_for`; and if the process fails, or is not ready within `timeout_s`.
    """
    chosen = controller or rig.stellar_loops[loop_name].vernier.controller
    remedy = f"fitctl design {chosen} --loop {loop_name} shows what it does"
    asked = {"loop": loop_name, "controller": chosen, "noise_px": noise_px}
    request = json.dumps({"rig": rig.model_dump_json(), **asked})
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            start_new_session=True,  # Ctrl-C is for its parent
        )
    except OSError as error:
        msg = (
            f"controller {chosen}: the process that designs it cannot be started: {error.strerror}"
        )
        raise ConfigError(msg) from None
    _running.add(process)
    try:
        answer, complaint = process.communicate(request, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        msg = f"controller {chosen}: the process that designs it was not ready within {timeout_s:g} s; {remedy}"
        raise ConfigError(msg) from None
    finally:
        _running.discard(process)
    status = process.returncode
    if status == _UNUSABLE:
        raise ConfigError(complaint.strip())
    if status != 0:
        how = f"status {status}" if status > 0 else f"signal {-status}"
        why = complaint.strip().rpartition("\n")[2] or "it left no message"
        msg = f"controller {chosen}: the process that designs it ended with {how}: {why}; {remedy}"
        raise ConfigError(msg)
    made = json.loads(answer)
    return dataclasses.replace(design_from_json(made["design"]), file=made["file"])


def end_designs() -> None:
    """Kill all processes that make a design, whatever thread waits for them."""
    for process in list(_running):
        process.kill()


def _main() -> int:
    from fitctl.controllers.design.choose import design_for

    request = json.load(sys.stdin)
    try:
        rig = Rig.model_validate_json(request.pop("rig"))
        design = design_for(rig, request.pop("loop"), **request)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return _UNUSABLE
    print(json.dumps({"design": design_json(design), "file": design.file}))
    return 0


if __name__ == "__main__":
    sys.exit(_main())
