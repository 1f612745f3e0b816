"""Writes small VRS files as Project Aria's glasses do: a camera and an IMU, with the calibration of the device.

https://facebookresearch.github.io/vrs/docs/FileStructure describes the container. It is written without index and
without compression, which readers allow.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.recordings.geometry import Array

SHAPE = 480, 640
"""Rows and columns of cameras for SLAM."""
_CAMERA, _IMU, _DESCRIPTION = 1201, 1202, 2
_CONFIGURATION, _DATA, _TAGS = 2, 3, 3
_GREY8 = 1
_ALWAYS_FIRST, _NO_TIME = 5e-324, float(np.finfo(np.float64).max)
_FILE_HEADER = struct.Struct("<8sQIIqqq24s8s")
_RECORD_HEADER = struct.Struct("<IIiIdHBBI")
_TYPES = {"u4": "uint32_t", "u8": "uint64_t", "i8": "int64_t", "f8": "double", "f4": "float", "?": "Bool"}

_CAMERA_CONFIGURATION = {
    "camera_id": "u4", "nominal_rate": "f8", "image_width": "u4", "image_height": "u4", "image_stride": "u4",
    "image_pixel_format": "u4", "exposure_duration.min": "f8", "exposure_duration.max": "f8", "gain.min": "f8",
    "gain.max": "f8", "gamma_factor": "f8",
}  # fmt: skip
_CAMERA_TEXTS = (
    "device_type", "device_version", "device_serial", "sensor_model", "sensor_serial", "factory_calibration",
    "online_calibration", "description",
)  # fmt: skip
_CAMERA_DATA = {
    "group_id": "u8", "group_mask": "u8", "frame_number": "u8", "frame_tag": "u4", "exposure_duration_s": "f8",
    "gain": "f8", "capture_timestamp_ns": "i8", "capture_timestamp_in_processing_clock_domain_ns": "i8",
    "arrival_timestamp_ns": "i8", "processing_start_timestamp_ns": "i8", "temperature_deg_c": "f8",
}  # fmt: skip
_IMU_CONFIGURATION = {
    "stream_index": "u4", "device_id": "u8", "nominal_rate": "f8", "has_accelerometer": "?", "has_gyroscope": "?",
    "has_magnetometer": "?",
}  # fmt: skip
_IMU_TEXTS = (
    "device_type", "device_version", "device_serial", "sensor_model", "factory_calibration", "online_calibration",
    "description",
)  # fmt: skip
_IMU_DATA = {
    "accelerometer_valid": "?", "gyroscope_valid": "?", "magnetometer_valid": "?", "temperature_deg_c": "f8",
    "capture_timestamp_ns": "i8", "capture_timestamp_in_processing_clock_domain_ns": "i8", "arrival_timestamp_ns": "i8",
    "processing_start_timestamp_ns": "i8", "accelerometer": "3f4", "gyroscope": "3f4", "magnetometer": "3f4",
}  # fmt: skip


@dataclass(frozen=True)
class Glasses:
    """What a recording has: images (n, 480, 640) of the left camera and samples (k, 6) of the right IMU, as measured.

    ``rectify`` (3, 3) and ``bias`` (3,) correct them, angular rates and accelerations alike. ``fisheye`` is one focal
    length, the centre, and four coefficients of Kannala and Brandt.
    """

    image_times_ns: Array
    images: Array
    imu_times_ns: Array
    samples: Array
    fisheye: tuple[float, ...]
    camera_offset_s: float
    imu_offsets_s: tuple[float, float]
    rectify: Array
    bias: Array
    imu_position_m: tuple[float, float, float]

    def write(self, path: Path) -> None:
        """Write the recording; raises OSError."""
        camera, imu = (_CAMERA, 1), (_IMU, 1)
        layouts = {
            camera: (_CAMERA_CONFIGURATION, _CAMERA_TEXTS, _CAMERA_DATA, "+image/raw"),
            imu: (_IMU_CONFIGURATION, _IMU_TEXTS, _IMU_DATA, ""),
        }
        streams = struct.pack("<I", len(layouts))
        for (kind, number), (stated, texts, measured, image) in layouts.items():
            size = _dtype(measured).itemsize
            streams += struct.pack("<iH", kind, number) + _map({"device_type": "Aria"})
            streams += _map(
                {
                    "DL:Configuration:2:0": _layout(stated, texts),
                    "DL:Data:2:0": _layout(measured),
                    "RF:Configuration:2": "data_layout",
                    "RF:Data:2": f"data_layout/size={size}{image}",
                    "VRS_Original_Recordable_Name": "Camera Data (SLAM)" if image else "IMU Data (SLAM)",
                    "VRS_Recordable_Flavor": "device/aria",
                }
            )
        tags = {"calib_json": json.dumps(self._calibration()), "device_type": "Aria", "hardware_version": "DVT-S"}
        records = [((_DESCRIPTION, 0), _TAGS, _NO_TIME, streams + _map(tags))]
        height, width = SHAPE
        grey = {"image_width": width, "image_height": height, "image_stride": width, "image_pixel_format": _GREY8}
        has = {"has_accelerometer": True, "has_gyroscope": True}
        records += [
            (camera, _CONFIGURATION, _ALWAYS_FIRST, _packed(_CAMERA_CONFIGURATION, grey, len(_CAMERA_TEXTS))),
            (imu, _CONFIGURATION, _ALWAYS_FIRST, _packed(_IMU_CONFIGURATION, has, len(_IMU_TEXTS))),
        ]
        data: list[tuple[tuple[int, int], int, float, bytes]] = []
        for time_ns, image in zip(self.image_times_ns.tolist(), self.images, strict=True):
            content = _packed(_CAMERA_DATA, {"capture_timestamp_ns": time_ns}) + image.tobytes()
            data.append((camera, _DATA, time_ns / 1e9, content))
        for time_ns, sample in zip(self.imu_times_ns.tolist(), self.samples, strict=True):
            valid = {"accelerometer_valid": True, "gyroscope_valid": True, "capture_timestamp_ns": time_ns}
            content = _packed(_IMU_DATA, {**valid, "gyroscope": sample[:3], "accelerometer": sample[3:]})
            data.append((imu, _DATA, time_ns / 1e9, content))
        records += sorted(data, key=lambda record: record[2])
        written, before = bytearray(), 0
        for (kind, number), what, time_s, content in records:
            size_bytes = _RECORD_HEADER.size + len(content)
            written += _RECORD_HEADER.pack(size_bytes, before, kind, 2, time_s, number, what, 0, 0) + content
            before = size_bytes
        start = _FILE_HEADER.size
        first = start + _RECORD_HEADER.size + len(records[0][3])
        head = _FILE_HEADER.pack(b"VisionRe", 1, start, _RECORD_HEADER.size, 0, start, first, bytes(24), b"cordVRS2")
        path.write_bytes(head + written)

    def _calibration(self) -> dict[str, Any]:
        """The JSON that the factory stores in a device."""
        focal_px, cx, cy, *k = self.fisheye
        corrected = {
            "Bias": {"Name": "Constant", "Offset": self.bias.tolist()},
            "Model": {"Name": "Linear", "RectificationMatrix": self.rectify.tolist()},
        }
        level = [1.0, [0.0, 0.0, 0.0]]
        return {
            "CameraCalibrations": [
                {
                    "Calibrated": True,
                    "Label": "camera-slam-left",
                    "Projection": {"Name": "FisheyeRadTanThinPrism", "Params": [focal_px, cx, cy, *k, *[0.0] * 8]},
                    "SerialNumber": "1",
                    "T_Device_Camera": {"Translation": [0.0, 0.0, 0.0], "UnitQuaternion": level},
                    "TimeOffsetSec_Device_Camera": self.camera_offset_s,
                }
            ],
            "DeviceClassInfo": {"BuildVersion": "DVT-S", "DeviceClass": "Aria"},
            "FileFormat": {"Tags": [], "Version": 3},
            "ImuCalibrations": [
                {
                    "Accelerometer": {**corrected, "TimeOffsetSec_Device_Accel": self.imu_offsets_s[1]},
                    "Gyroscope": {**corrected, "TimeOffsetSec_Device_Gyro": self.imu_offsets_s[0]},
                    "Calibrated": True,
                    "Label": "imu-right",
                    "SerialNumber": "2",
                    "T_Device_Imu": {"Translation": list(self.imu_position_m), "UnitQuaternion": level},
                }
            ],
            "OriginSpecification": {"ChildLabel": "camera-slam-left", "Type": "Custom"},
            "Serial": "3",
        }


def _dtype(fields: dict[str, str]) -> np.dtype[Any]:
    return np.dtype([(name, f"{kind[:-2]}<{kind[-2:]}" if kind != "?" else "?") for name, kind in fields.items()])


def _packed(fields: dict[str, str], values: dict[str, Any], texts: int = 0) -> bytes:
    """A row with zeros for what has no value, and as many empty texts: of each, where it begins and how long it is."""
    row = np.zeros(1, _dtype(fields))
    for name, value in values.items():
        row[name] = value
    return row.tobytes() + bytes(8 * texts)


def _layout(fields: dict[str, str], texts: tuple[str, ...] = ()) -> str:
    places: dict[str, Any] = dict(_dtype(fields).fields or {})
    pieces: list[dict[str, Any]] = []
    for name, kind in fields.items():
        many = kind[:-2] if kind != "?" else ""
        group = "Array" if many else "Value"
        piece = {"name": name, "type": f"DataPiece{group}<{_TYPES[kind[-2:]]}>", "offset": places[name][1]}
        pieces.append({**piece, "size": int(many)} if many else piece)
    pieces += [{"name": name, "type": "DataPieceString", "index": index} for index, name in enumerate(texts)]
    return json.dumps({"data_layout": pieces})


def _map(entries: dict[str, str]) -> bytes:
    texts = [text.encode() for entry in entries.items() for text in entry]
    return struct.pack("<I", len(entries)) + b"".join(struct.pack("<I", len(text)) + text for text in texts)
