"""What a shard holds: the contract between ``data_prep``, which writes it, and the loader.

A folder of shards is ``manifest.json``, tars and beside each tar its index. One graph is one
webdataset sample: its members stand together in the tar, under a key without dots, in this order::

    KEY.json                          meta: names, sizes, K, cam_from_world, pair tables
    KEY.00.jpg  KEY.00.depth.npy      first image in greedy order: RGB; float16 z [m], 0 = unknown
    KEY.01.jpg  KEY.01.depth.npy      ...

So the first N images of a stored graph are the greedy graph of N images.
"""

from l3r.data.schema.codec import decode_graph, encode_graph
from l3r.data.schema.graph import SCHEMA_VERSION, GraphSample, PairTable
from l3r.data.schema.index import (
    IndexEntry,
    ShardIndex,
    index_path,
    index_shard,
    load_index,
    members_from_bytes,
    parse_index,
    read_index,
    read_members,
    read_range,
    write_index,
)
from l3r.data.schema.manifest import (
    MANIFEST_NAME,
    Manifest,
    ShardEntry,
    parse_manifest,
    read_manifest,
    write_manifest,
)

__all__ = [
    "MANIFEST_NAME",
    "SCHEMA_VERSION",
    "GraphSample",
    "IndexEntry",
    "Manifest",
    "PairTable",
    "ShardEntry",
    "ShardIndex",
    "decode_graph",
    "encode_graph",
    "index_path",
    "index_shard",
    "load_index",
    "members_from_bytes",
    "parse_index",
    "parse_manifest",
    "read_index",
    "read_manifest",
    "read_members",
    "read_range",
    "write_index",
    "write_manifest",
]
