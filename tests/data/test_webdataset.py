"""Other tools read the tars: plain webdataset, from a file and as a stream."""

import io
import json
import shlex
import subprocess
import sys
import tarfile

import cv2
import numpy as np
import pytest
import webdataset

from l3r.data.schema import decode_graph
from l3r.data.source import ShardFolder
from tests.data.graphs import make_graph, write_folder


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    graphs = [make_graph(n, 3, 32, 40) for n in range(6)]
    return write_folder(tmp_path_factory.mktemp("made") / "with spaces", graphs)


def urls(shards, form):
    tars = sorted(shards.glob("*.tar"))
    if form == "file":
        return [str(tar) for tar in tars]
    return [f"pipe:cat {shlex.quote(str(tar))}" for tar in tars]


@pytest.mark.parametrize("form", ["file", "pipe"])
def test_plain_webdataset_gives_the_same_graphs_as_the_index(shards, form):
    samples = list(webdataset.WebDataset(urls(shards, form), shardshuffle=False))
    folder = ShardFolder(shards, 3)
    assert len(samples) == len(folder) == 6
    for index, sample in enumerate(samples):
        expected = folder.read(index)
        assert expected.key.endswith(sample["__key__"])
        found = decode_graph(sample, 3)
        assert found.file == expected.graph.file
        assert np.array_equal(found.K, expected.graph.K)
        for one, two in zip(found.image, expected.graph.image, strict=True):
            assert np.array_equal(one, two)
        # And without a line of this project's code.
        meta = json.loads(sample["json"])
        depth = np.load(io.BytesIO(sample["02.depth.npy"]), allow_pickle=False)
        image = cv2.imdecode(np.frombuffer(sample["02.jpg"], np.uint8), cv2.IMREAD_COLOR)
        assert [*image.shape[:2]] == [*depth.shape] == meta["image_size"][2]


def test_webdatasets_own_decoders_know_the_members(shards):
    data = webdataset.WebDataset(urls(shards, "pipe"), shardshuffle=False).decode("rgb8")
    sample = next(iter(data))
    assert sample["00.jpg"].shape == (32, 40, 3)
    assert sample["json"]["dataset"] == "hand"
    assert sample["01.depth.npy"].dtype == np.float16


def test_a_shard_is_an_ordinary_tar(shards):
    tar = sorted(shards.glob("*.tar"))[0]
    code = f"import tarfile; print(len(tarfile.open({str(tar)!r}).getnames()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == 4 * (1 + 2 * 3)
    with tarfile.open(tar) as opened:
        assert opened.getnames()[0] == "hand-000000.json"
