import dataclasses
import io
import json
import tarfile

import numpy as np
import pytest
import webdataset

from l3r.data import schema
from l3r.data.schema.graph import check_cameras
from l3r.errors import DataError

VIEWS = 3
SIZE = (24, 32)


def turned(angle):
    camera = np.eye(4)
    camera[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    camera[:3, 3] = [angle, 0.1, -0.2]
    return camera if angle else np.eye(4)


def make_sample(seed=0):
    rng = np.random.default_rng(seed)
    height, width = SIZE
    table = rng.random((VIEWS, VIEWS))
    ramp = np.linspace(0, 200, height * width).reshape(height, width, 1)
    depth = rng.uniform(0.5, 20, (height, width)).astype(np.float32)
    depth[0, :3] = 0
    parallax = table.copy()
    parallax[0, 2] = parallax[2, 0] = np.nan
    pairs = dict.fromkeys(["iou", "covisible", "score", "rotation", "axis"], table)
    return schema.GraphSample(
        dataset="toy",
        scene="a/b.c",
        is_metric=True,
        file=[f"{view}.png" for view in range(VIEWS)],
        image=[(ramp + np.array([0, 20, 55])).astype(np.uint8)] * VIEWS,
        depth=[depth] * VIEWS,
        K=np.tile([[30.0, 0, 16], [0, 31, 12], [0, 0, 1]], (VIEWS, 1, 1)),
        cam_from_world=np.stack([turned(0.3 * view) for view in range(VIEWS)]),
        pairs=schema.PairTable(**pairs, parallax=parallax),
    )


@pytest.fixture
def members():
    return schema.encode_graph(make_sample(), "toy-0")


def write_shard(path, keys=("toy-0", "toy-1")):
    with webdataset.TarWriter(str(path), encoder=False, mtime=0) as writer:
        for key in keys:
            for name, data in list(schema.encode_graph(make_sample(), key).items())[1:]:
                writer.write({"__key__": key, name: data})
    return path


def with_meta(members, **changes):
    meta = {**json.loads(members["json"]), **changes}
    return {**members, "json": json.dumps(meta).encode()}


def test_a_graph_comes_back_as_it_was_stored(members):
    sample, back = make_sample(), schema.decode_graph(members, VIEWS)
    np.testing.assert_array_equal(back.K, sample.K)
    np.testing.assert_array_equal(back.cam_from_world, sample.cam_from_world)
    np.testing.assert_allclose(back.pairs.iou, sample.pairs.iou, atol=5e-7)
    np.testing.assert_allclose(back.pairs.parallax, sample.pairs.parallax, atol=5e-7)
    assert (back.file, back.scene, back.is_metric) == (sample.file, sample.scene, True)
    for view in range(VIEWS):
        np.testing.assert_allclose(back.depth[view], sample.depth[view], rtol=2**-11)
        assert np.array_equal(back.depth[view] == 0, sample.depth[view] == 0)
        error = np.abs(back.image[view].astype(int) - sample.image[view])
        assert error.max() <= 6  # JPEG at quality 95 on a ramp


def test_members_stand_in_greedy_order_after_the_meta(members):
    images = [f"{view:02d}.{end}" for view in range(VIEWS) for end in ("jpg", "depth.npy")]
    assert list(members) == ["__key__", "json", *images]


def test_the_first_images_decode_without_the_others(members):
    first = {name: data for name, data in members.items() if not name.startswith("02")}
    back = schema.decode_graph(first, 2)
    assert back.num_views == 2
    assert back.pairs.iou.shape == (2, 2)
    np.testing.assert_array_equal(back.K, make_sample().K[:2])


@pytest.mark.parametrize("name", ["json", "00.jpg", "01.depth.npy"])
def test_a_missing_member_is_named(members, name):
    del members[name]
    with pytest.raises(DataError, match=rf"toy-0\.{name}: missing"):
        schema.decode_graph(members, VIEWS)


@pytest.mark.parametrize("name", ["json", "00.jpg", "01.depth.npy"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_member_cut_off_is_named(members, name, share):
    members[name] = members[name][: int(share * len(members[name]))]
    with pytest.raises(DataError, match=rf"toy-0\.{name}"):
        schema.decode_graph(members, VIEWS)


def test_another_schema_version_is_refused(members):
    with pytest.raises(DataError, match="schema version 99, expected 1"):
        schema.decode_graph(with_meta(members, schema_version=99), VIEWS)


def test_more_images_than_stored_are_refused(members):
    with pytest.raises(DataError, match="3 images, 4 asked"):
        schema.decode_graph(members, VIEWS + 1)


def test_pixels_of_another_size_are_refused(members):
    wrong = with_meta(members, image_size=[[24, 32], [24, 31], [24, 32]])
    with pytest.raises(DataError, match=r"01\.jpg: \(height, width\) \(24, 32\)"):
        schema.decode_graph(wrong, VIEWS)


def broken_cameras():
    reflected, sheared, nan, moved = (make_sample().cam_from_world for _ in range(4))
    reflected[1, :3, 0] *= -1
    sheared[2, 0, 0] += 1e-3
    nan[1, 0, 3] = np.nan
    moved[0, 0, 3] = 1
    return {
        "off a rotation": reflected,
        "image 02: cam_from_world is off": sheared,
        "NaN": nan,
        "not the identity": moved,
    }


@pytest.mark.parametrize("words", list(broken_cameras()))
def test_cameras_no_reader_could_use_are_refused(members, words):
    wrong = with_meta(members, cam_from_world=broken_cameras()[words].tolist())
    with pytest.raises(DataError, match=words):
        schema.decode_graph(wrong, VIEWS)


def test_a_meta_that_lacks_a_field_is_refused(members):
    meta = json.loads(members["json"])
    del meta["K"]
    with pytest.raises(DataError, match="field missing"):
        schema.decode_graph({**members, "json": json.dumps(meta).encode()}, VIEWS)


@pytest.mark.parametrize("bad", [70000.0, -1.0, np.nan, 1e-6])
def test_depth_that_half_floats_cannot_hold_is_refused(bad):
    sample = make_sample()
    sample.depth[0][5, 5] = bad
    with pytest.raises(DataError, match=r"depth\.npy: depth"):
        schema.encode_graph(sample, "toy-0")


@pytest.mark.parametrize("key", ["", "a.b", "a/b"])
def test_a_key_that_a_tar_would_split_is_refused(key):
    with pytest.raises(DataError, match="without dots"):
        schema.encode_graph(make_sample(), key)


def test_pickled_depth_is_refused(members):
    stream = io.BytesIO()
    np.save(stream, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(DataError, match="no whole array"):
        schema.decode_graph({**members, "00.depth.npy": stream.getvalue()}, VIEWS)


def test_the_index_gives_each_graph_in_one_read(tmp_path):
    shard = write_shard(tmp_path / "toy.tar")
    index = schema.index_shard(shard)
    schema.write_index(shard, index)
    assert schema.read_index(shard) == index
    assert [entry.key for entry in index.graphs] == ["toy-0", "toy-1"]
    for entry in index.graphs:
        assert entry.num_views == VIEWS
        members = schema.read_members(shard, entry)
        assert members == schema.encode_graph(make_sample(), entry.key)


def test_an_index_that_is_absent_or_of_another_tar_is_made_again(tmp_path):
    shard = write_shard(tmp_path / "toy.tar")
    assert len(schema.load_index(shard).graphs) == 2
    schema.write_index(shard, schema.index_shard(shard))
    write_shard(shard, keys=("a", "b", "c"))
    with pytest.raises(DataError, match="made of a tar of"):
        schema.read_index(shard)
    assert [entry.key for entry in schema.load_index(shard).graphs] == ["a", "b", "c"]


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_a_tar_cut_off_is_named(tmp_path, share):
    shard = write_shard(tmp_path / "toy.tar")
    entry = schema.index_shard(shard).graphs[1]
    data = shard.read_bytes()
    shard.write_bytes(data[: int(share * len(data)) + 7])
    with pytest.raises(DataError, match=r"toy\.tar"):
        schema.index_shard(shard)
    with pytest.raises(DataError, match=r"toy\.tar:toy-1: .*cut off"):
        schema.read_members(shard, entry)


def test_a_range_that_is_off_is_refused(tmp_path):
    shard = write_shard(tmp_path / "toy.tar")
    entry = schema.index_shard(shard).graphs[0]
    with shard.open("rb") as stream:
        stream.seek(entry.offset + 100)
        data = stream.read(entry.size)
    with pytest.raises(DataError, match="delete the shard's index"):
        schema.members_from_bytes(data, "here", entry.key)


def test_members_that_do_not_stand_together_are_refused(tmp_path):
    with tarfile.open(tmp_path / "toy.tar", "w") as tar:
        for name in ("a.json", "b.json", "a.00.jpg"):
            tar.addfile(tarfile.TarInfo(name))
    with pytest.raises(DataError, match="members of a do not stand together"):
        schema.index_shard(tmp_path / "toy.tar")


def make_manifest():
    entries = [
        schema.ShardEntry(name=f"{n}.tar", num_graphs=n, bytes=10 * n, sha256="0" * 64)
        for n in (3, 4)
    ]
    return schema.Manifest(dataset="toy", min_views=8, max_views=10, shards=entries)


def test_a_manifest_comes_back_with_its_totals(tmp_path):
    schema.write_manifest(tmp_path, make_manifest())
    assert schema.read_manifest(tmp_path) == make_manifest()
    plain = json.loads((tmp_path / schema.MANIFEST_NAME).read_bytes())
    assert (plain["num_graphs"], plain["num_bytes"]) == (7, 70)
    assert [path.name for path in tmp_path.iterdir()] == [schema.MANIFEST_NAME]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "no such file"),
        ("{", "no manifest"),
        ("[]", "no manifest"),
        ('{"schema_version": 1}', "no manifest"),
        ('{"schema_version": 2}', "schema version 2, expected 1"),
    ],
)
def test_a_manifest_that_cannot_be_used_is_refused(tmp_path, text, words):
    if text is not None:
        (tmp_path / schema.MANIFEST_NAME).write_text(text)
    with pytest.raises(DataError, match=words):
        schema.read_manifest(tmp_path)


def test_usable_cameras_are_let_through():
    sample = make_sample()
    check_cameras(sample.K, sample.cam_from_world, "here")


@pytest.mark.parametrize(
    "change", [{(0, 0): 0.0}, {(1, 1): -30.0}, {(2, 2): 2.0}, {(0, 2): np.inf}]
)
def test_intrinsics_no_reader_could_use_are_refused(change):
    sample = make_sample()
    for (row, column), value in change.items():
        sample.K[1, row, column] = value
    with pytest.raises(DataError, match="here: image 01: K "):
        check_cameras(sample.K, sample.cam_from_world, "here")


BAD_ENTRIES = {
    "offset is -512": {"offset": -512},
    "offset is 1.5": {"offset": 1.5},
    "offset is True": {"offset": True},
    "multiples of 512": {"offset": 7},
    "size is 0": {"size": 0},
    "the tar at": {"size": 512 * 10**6},
    "size is 9223372036854775808": {"size": 2**63},
    "num_views is 0": {"num_views": 0},
    "num_views is 'many'": {"num_views": "many"},
    "expected a printable name": {"key": ""},
    "printable name without": {"key": 5},
    "overlaps that of": {"offset": 512},
    "a key stands there twice": {"key": "toy-0"},
}


@pytest.mark.parametrize("words", list(BAD_ENTRIES))
def test_an_index_that_no_tar_has_is_refused_by_its_entry_and_made_again(tmp_path, words):
    shard = write_shard(tmp_path / "toy.tar")
    index = schema.index_shard(shard)
    schema.write_index(shard, index)
    path = schema.index_path(shard)
    plain = json.loads(path.read_bytes())
    plain["graphs"][1].update(BAD_ENTRIES[words])
    path.write_text(json.dumps(plain))
    with pytest.raises(DataError, match=rf"toy\.index\.json: no index \(.*{words}"):
        schema.read_index(shard)
    assert schema.load_index(shard) == index


def test_an_index_that_swaps_two_graphs_is_found_when_one_is_read(tmp_path):
    shard = write_shard(tmp_path / "toy.tar")
    one, two = schema.index_shard(shard).graphs
    swapped = dataclasses.replace(one, offset=two.offset, size=two.size)
    with pytest.raises(DataError, match="the index says toy-0, the tar holds 'toy-1'; delete"):
        schema.read_members(shard, swapped)


@pytest.mark.parametrize(
    "change",
    [
        {"name": "../3.tar"},
        {"name": ".3.tar"},
        {"name": "/3.tar"},
        {"name": "3.zip"},
        {"name": "4.tar"},
        {"name": 3},
        {"num_graphs": -1},
        {"num_graphs": "3"},
        {"bytes": 1e9},
        {"bytes": 2**63},
        {"sha256": "0" * 63},
        {"sha256": "z" * 64},
    ],
)
def test_a_manifest_that_nobody_wrote_is_refused(tmp_path, change):
    schema.write_manifest(tmp_path, make_manifest())
    path = tmp_path / schema.MANIFEST_NAME
    plain = json.loads(path.read_bytes())
    plain["shards"][0].update(change)
    path.write_text(json.dumps(plain))
    with pytest.raises(DataError, match=r"manifest\.json: no manifest"):
        schema.read_manifest(tmp_path)
