"""Writes version 2's files: one Parquet table for each component."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

F32, F64, I8, I32, I64 = pa.float32(), pa.float64(), pa.int8(), pa.int32(), pa.int64()
CAMERA_TEXT = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
LASER_TEXT = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}


def transform_type(width):
    return pa.list_(width, 16)


def write_v2(root, segment, *, old=False, row_group_size=256, compression="brotli"):
    """Write all components below ``root``.

    ``old`` writes names of sensors as text and transforms in single precision.
    """
    precision = F32 if old else F64
    tables = {
        **_camera_tables(segment, precision, old),
        **_lidar_tables(segment, precision, old),
    }
    draw = np.random.default_rng(0)
    for component, (rows, types) in tables.items():
        rows = [rows[i] for i in draw.permutation(len(rows))]
        columns = {
            name: pa.array([row[name] for row in rows], kind) for name, kind in types.items()
        }
        path = root / component / f"{segment.context}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(
            pa.table(columns), path, row_group_size=row_group_size, compression=compression
        )
    return root


def _keys(segment, frame=None, **sensor):
    keys = {"key.segment_context_name": segment.context}
    if frame is not None:
        keys["key.frame_timestamp_micros"] = frame.timestamp
    return {**keys, **{f"key.{name}": value for name, value in sensor.items()}}


def _key_types(*names, old=False):
    kinds = {
        "segment_context_name": pa.string(),
        "frame_timestamp_micros": I64,
        "camera_name": pa.string() if old else I8,
        "laser_name": pa.string() if old else I8,
    }
    return {f"key.{name}": kinds[name] for name in names}


def _camera_tables(segment, precision, old):
    images, calibrations, poses = [], [], []
    for number, camera in segment.cameras.items():
        name = CAMERA_TEXT[number] if old else number
        prefix = "[CameraCalibrationComponent]"
        row = _keys(segment, camera_name=name)
        for part, value in zip(LENS_PARTS, camera["lens"], strict=True):
            row[f"{prefix}.intrinsic.{part}"] = value
        row[f"{prefix}.extrinsic.transform"] = camera["mount"].ravel()
        row[f"{prefix}.width"], row[f"{prefix}.height"] = camera["size"][1], camera["size"][0]
        row[f"{prefix}.rolling_shutter_direction"] = 2
        calibrations.append(row)
    for frame in segment.frames:
        poses.append(
            {
                **_keys(segment, frame),
                "[VehiclePoseComponent].world_from_vehicle.transform": frame.pose.ravel(),
            }
        )
        for number, (jpeg, pose) in frame.images.items():
            images.append(
                {
                    **_keys(segment, frame, camera_name=CAMERA_TEXT[number] if old else number),
                    "[CameraImageComponent].image": jpeg,
                    "[CameraImageComponent].pose.transform": pose.ravel(),
                    "[CameraImageComponent].pose_timestamp": frame.timestamp / 1e6,
                }
            )
    time, camera, context = "frame_timestamp_micros", "camera_name", "segment_context_name"
    calibration_types = {
        **_key_types(context, camera, old=old),
        **{f"[CameraCalibrationComponent].intrinsic.{part}": F64 for part in LENS_PARTS},
        "[CameraCalibrationComponent].extrinsic.transform": transform_type(precision),
        "[CameraCalibrationComponent].width": I32,
        "[CameraCalibrationComponent].height": I32,
        "[CameraCalibrationComponent].rolling_shutter_direction": I8,
    }
    image_types = {
        **_key_types(context, time, camera, old=old),
        "[CameraImageComponent].image": pa.binary(),
        "[CameraImageComponent].pose.transform": transform_type(precision),
        "[CameraImageComponent].pose_timestamp": F64,
    }
    pose_types = {
        **_key_types(context, time),
        "[VehiclePoseComponent].world_from_vehicle.transform": transform_type(precision),
    }
    return {
        "camera_image": (images, image_types),
        "camera_calibration": (calibrations, calibration_types),
        "vehicle_pose": (poses, pose_types),
    }


LENS_PARTS = ["f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"]


def _lidar_tables(segment, precision, old):
    calibrations = []
    for number, laser in segment.lasers.items():
        prefix = "[LiDARCalibrationComponent]"
        calibrations.append(
            {
                **_keys(segment, laser_name=LASER_TEXT[number] if old else number),
                f"{prefix}.extrinsic.transform": laser["mount"].ravel(),
                f"{prefix}.beam_inclination.min": laser["low"],
                f"{prefix}.beam_inclination.max": laser["high"],
                f"{prefix}.beam_inclination.values": laser["inclinations"] or None,
            }
        )
    types = {
        **_key_types("segment_context_name", "laser_name", old=old),
        "[LiDARCalibrationComponent].extrinsic.transform": transform_type(precision),
        "[LiDARCalibrationComponent].beam_inclination.min": F64,
        "[LiDARCalibrationComponent].beam_inclination.max": F64,
        "[LiDARCalibrationComponent].beam_inclination.values": pa.list_(F64),
    }
    return {
        "lidar_calibration": (calibrations, types),
        "lidar": _matrices(segment, "LiDARComponent", 0, old),
        "lidar_camera_projection": _matrices(segment, "LiDARCameraProjectionComponent", 1, old),
        "lidar_pose": _matrices(segment, "LiDARPoseComponent", 2, old),
        "lidar_box": _boxes(segment),
    }


def _matrices(segment, component, part, old):
    rows = []
    values, shape = (f"[{component}].range_image_return1.{end}" for end in ("values", "shape"))
    for frame in segment.frames:
        for number, parts in frame.lasers.items():
            if parts[part] is not None:
                row = _keys(segment, frame, laser_name=LASER_TEXT[number] if old else number)
                row[values] = parts[part].ravel().astype(np.float32)
                row[shape] = list(parts[part].shape)
                rows.append(row)
    names = _key_types("segment_context_name", "frame_timestamp_micros", "laser_name", old=old)
    return rows, {**names, values: pa.list_(F32), shape: pa.list_(I32, 3)}


def _boxes(segment):
    rows, prefix = [], "[LiDARBoxComponent]"
    for frame in segment.frames:
        for index, label in enumerate(frame.labels):
            row = {**_keys(segment, frame), "key.laser_object_id": f"object{index}"}
            for part in ("center", "size"):
                for axis, value in zip("xyz", label[part], strict=True):
                    row[f"{prefix}.box.{part}.{axis}"] = value
            row[f"{prefix}.box.heading"] = label["heading"]
            row[f"{prefix}.type"] = label["type"]
            speed = label["speed"] or (None, None)
            row[f"{prefix}.speed.x"], row[f"{prefix}.speed.y"] = speed
            rows.append(row)
    types = {
        **_key_types("segment_context_name", "frame_timestamp_micros"),
        "key.laser_object_id": pa.string(),
        **{f"{prefix}.box.{p}.{a}": F64 for p in ("center", "size") for a in "xyz"},
        f"{prefix}.box.heading": F64,
        f"{prefix}.type": I8,
        f"{prefix}.speed.x": F64,
        f"{prefix}.speed.y": F64,
    }
    return rows, types
