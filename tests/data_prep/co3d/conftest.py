"""A small CO3D root that tests copy or spoil."""

import shutil

import numpy as np
import pytest

from data_prep.converters.co3d import read
from data_prep.problems import Problems
from data_prep.roundtrip import measure_graph, median
from l3r.data.schema import GraphSample, PairTable
from tests.data_prep.co3d.writer import Recipe, write_category, write_sequence


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """A root with one sequence of four frames, and its annotations; not to be changed."""
    root = tmp_path_factory.mktemp("co3d")
    records = write_sequence(root, Recipe())
    return write_category(root, records), records


@pytest.fixture
def root(written, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(written[0], tmp_path / "root")


@pytest.fixture
def problems():
    return Problems()


@pytest.fixture
def scene_of(problems):
    """Read the one scene of a root."""

    def read_one(root, split="train", **options):
        (scene,) = read(root, split, problems=problems, **options)
        return scene

    return read_one


@pytest.fixture(scope="session")
def agreement():
    """Measure how well frames of a scene agree: round trip [px], depth, share seen."""

    def measure(scene, frames=slice(None)):
        frames = scene.frames[frames]
        number = len(frames)
        zeros = np.zeros((number, number))
        table = PairTable(
            **dict.fromkeys(("iou", "covisible", "score"), zeros),
            **dict.fromkeys(("rotation", "axis", "parallax"), zeros),
        )
        sample = GraphSample(
            dataset="co3d",
            scene=scene.name,
            is_metric=False,
            file=[frame.name for frame in frames],
            image=[frame.read_image().copy() for frame in frames],
            depth=[frame.read_depth() for frame in frames],
            K=np.stack([frame.K for frame in frames]),
            cam_from_world=np.linalg.inv(np.stack([frame.world_from_cam for frame in frames])),
            pairs=table,
        )
        found = measure_graph(sample)
        return (
            median([pair.pixels for pair in found]),
            median([pair.depth for pair in found]),
            median([pair.share for pair in found]),
        )

    return measure
