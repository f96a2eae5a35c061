"""Annotations with one mistake in every record, as a reader of the wrong convention makes it."""

import copy

import numpy as np

from tests.data_prep.co3d.writer import write_jgz


def plant(root, records, change, category="apple"):
    """Write the frame annotations of a root again, each record changed."""
    records = copy.deepcopy(records)
    for record in records:
        change(record)
    write_jgz(root / category / "frame_annotations.jgz", records)


def half_a_pixel(record):
    unit = min(record["image"]["size"]) / 2
    record["viewpoint"]["principal_point"] = [
        x - 0.5 / unit for x in record["viewpoint"]["principal_point"]
    ]


def other_unit(record):
    record["viewpoint"]["intrinsics_format"] = "ndc_norm_image_bounds"


def isotropic(record):
    record["viewpoint"]["intrinsics_format"] = "ndc_isotropic"


def no_unit(record):
    """Files of the first release have no key, and mean the image's bounds."""
    del record["viewpoint"]["intrinsics_format"]


def column_vectors(record):
    record["viewpoint"]["R"] = np.transpose(record["viewpoint"]["R"]).tolist()


def opencv_axes(record):
    """Cameras whose x points right and y down already, so that the flip is one too many."""
    view = record["viewpoint"]
    view["R"] = (np.array(view["R"]) * [-1, -1, 1]).tolist()
    view["T"] = (np.array(view["T"]) * [-1, -1, 1]).tolist()


def mirrored_principal_point(record):
    view = record["viewpoint"]
    view["principal_point"] = [-x for x in view["principal_point"]]


def width_before_height(record):
    """As if the unit were half of the longer side."""
    view, (height, width) = record["viewpoint"], record["image"]["size"]
    view["focal_length"] = [f * height / width for f in view["focal_length"]]


def scale_forgotten(record):
    record["depth"]["scale_adjustment"] = 1.0
