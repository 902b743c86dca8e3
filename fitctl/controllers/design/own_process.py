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
        done = subprocess.run(
            [sys.executable, "-m", __name__],
            input=request,
            capture_output=True,
            encoding="utf-8",
            timeout=timeout_s,
            check=False,
            start_new_session=True,  # Ctrl-C is for its parent
        )
    except subprocess.TimeoutExpired:
        msg = f"controller {chosen}: the process that designs it was not ready within {timeout_s:g} s; {remedy}"
        raise ConfigError(msg) from None
    except OSError as error:
        msg = (
            f"controller {chosen}: the process that designs it cannot be started: {error.strerror}"
        )
        raise ConfigError(msg) from None
    if done.returncode == _UNUSABLE:
        raise ConfigError(done.stderr.strip())
    if done.returncode != 0:
        how = f"status {done.returncode}" if done.returncode > 0 else f"signal {-done.returncode}"
        why = done.stderr.strip().rpartition("\n")[2] or "it left no message"
        msg = f"controller {chosen}: the process that designs it ended with {how}: {why}; {remedy}"
        raise ConfigError(msg)
    answer = json.loads(done.stdout)
    return dataclasses.replace(design_from_json(answer["design"]), file=answer["file"])


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
