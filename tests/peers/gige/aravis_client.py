"""Aravis' Python binding against a camera; run by the Python that has it. Prints what it found as JSON."""

import json

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

Aravis.update_device_list()
camera = Aravis.Camera.new(None)  # the first that was discovered
device = camera.get_device()
found = {
    "devices": [Aravis.get_device_id(i) for i in range(Aravis.get_n_devices())],
    "controls": device.is_controller(),
    "formats": camera.dup_available_pixel_formats_as_strings(),
    "temperature_c": device.get_float_feature_value("DeviceTemperature"),
    "images": {},
}

device.execute_command("GevTimestampControlLatch")
found["ticks"] = [device.get_integer_feature_value("GevTimestampValue")]
device.execute_command("GevTimestampControlLatch")
found["ticks"].append(device.get_integer_feature_value("GevTimestampValue"))

camera.set_region(8, 4, 16, 12)
camera.set_gain(6.0206)
camera.set_exposure_time(2000.0)
camera.set_frame_rate(100.0)
found["settings"] = [camera.get_gain(), camera.get_exposure_time(), camera.get_frame_rate()]
for name in found["formats"]:
    camera.set_pixel_format_from_string(name)
    buffer = camera.acquisition(2_000_000)
    found["images"][name] = list(buffer.get_image_data())

stream = camera.create_stream(None, None)
stream.push_buffer(Aravis.Buffer.new_allocate(camera.get_payload()))
camera.set_acquisition_mode(Aravis.AcquisitionMode.CONTINUOUS)
camera.set_trigger("Software")
camera.start_acquisition()
found["untriggered"] = stream.timeout_pop_buffer(200_000) is not None
camera.software_trigger()
found["triggered"] = stream.timeout_pop_buffer(2_000_000) is not None
camera.stop_acquisition()

try:
    camera.set_region(0, 0, 41, 40)
except gi.repository.GLib.Error as error:
    found["refused"] = error.message
print(json.dumps(found))
