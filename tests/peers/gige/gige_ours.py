"""Our driver on whatever camera answers at 127.0.0.1. Prints what it found as JSON."""

import json
import sys

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.gige.discovery import discover
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.interface import DeviceError

settings = load_rig(default_rig_path(), sys.argv[1:]).camera
(seen,) = discover("255.255.255.255", 0.5, source="127.0.0.1")
camera = GigeCamera(settings)
identity = camera.open()
camera.start()
frames = [frame for _ in range(100) if (frame := camera.next_frame(2.0)) is not None]
counts = camera.counts()
found = {
    "discovered": seen.identity.serial,
    "identity": [identity.maker, identity.model, identity.serial],
    "frames": len(frames),
    "numbers": [frame.number for frame in frames],
    "shape": frames[0].image.shape,
    "lost": counts.lost,
    "packets_lost": counts.packets_lost,
    "second": "",
}
try:
    GigeCamera(settings).open()
except DeviceError as error:
    found["second"] = f"{type(error).__name__}: {error}"
camera.close()
print(json.dumps(found))
