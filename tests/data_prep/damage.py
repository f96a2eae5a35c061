"""Real tars, damaged in one way each; manifest and indices follow unless that is the damage."""

import hashlib
import json
import shutil
from dataclasses import replace

import webdataset

from l3r.data.schema import (
    index_shard,
    load_index,
    read_manifest,
    read_members,
    write_index,
    write_manifest,
)


def copy(folder, out):
    """Copy a folder of shards, without what is not part of it."""
    shutil.copytree(folder, out, ignore=shutil.ignore_patterns(".build", "report.html"))
    return out


def first_tar(folder):
    return folder / read_manifest(folder).shards[0].name


def keys_of(tar):
    return [entry.key for entry in load_index(tar).graphs]


def rewrite(tar, edit):
    """Write a tar anew, each graph's members changed by ``edit(key, members)``."""
    graphs = [(entry.key, read_members(tar, entry)) for entry in load_index(tar).graphs]
    with webdataset.TarWriter(str(tar), encoder=False, mtime=0) as writer:
        for key, members in graphs:
            members.pop("__key__")
            edit(key, members)
            for name, data in members.items():
                writer.write({"__key__": key, name: data})
    write_index(tar, index_shard(tar))
    refresh_manifest(tar.parent)


def refresh_manifest(folder):
    """Let the manifest say what the tars are."""
    manifest = read_manifest(folder)
    shards = []
    for shard in manifest.shards:
        data = (folder / shard.name).read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        shards.append(replace(shard, bytes=len(data), sha256=digest))
    write_manifest(folder, replace(manifest, shards=shards))


def edit_first(tar, change):
    """Change the members of a tar's first graph; give its key."""
    first = keys_of(tar)[0]
    rewrite(tar, lambda key, members: change(members) if key == first else None)
    return first


def edit_meta(tar, change):
    """Change the JSON of a tar's first graph; give its key."""

    def edit(members):
        meta = json.loads(members["json"])
        change(meta)
        members["json"] = json.dumps(meta).encode()

    return edit_first(tar, edit)


def spoil_bytes(tar, member_suffix):
    """Overwrite 64 bytes in the middle of the first such member, in place; give its key."""
    entry = load_index(tar).graphs[0]
    name, data = next(
        (name, data)
        for name, data in read_members(tar, entry).items()
        if name.endswith(member_suffix)
    )
    whole = bytearray(tar.read_bytes())
    at = bytes(whole).index(data[200:]) + (len(data) - 200) // 2
    whole[at : at + 64] = bytes(64)
    tar.write_bytes(bytes(whole))
    return entry.key, name


def truncate(tar, share):
    data = tar.read_bytes()
    tar.write_bytes(data[: int(share * len(data))])


def spoil_header(tar, number):
    """Overwrite the header of a graph's first file; size and index stay."""
    offset = load_index(tar).graphs[number].offset
    data = bytearray(tar.read_bytes())
    data[offset : offset + 512] = b"\xff" * 512
    tar.write_bytes(bytes(data))
