import errno
import os
import resource

import pytest

from l3r.files import append_whole, atomic_path, hidden_sibling, hidden_siblings, write_atomic


def test_a_file_is_replaced_as_a_whole(tmp_path):
    path = tmp_path / "a.txt"
    write_atomic(path, "old\n")
    write_atomic(path, "größer\n")
    assert path.read_bytes() == "größer\n".encode()
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.bin"
    write_atomic(path, b"old")

    def interrupted():
        with atomic_path(path) as temporary:
            temporary.write_bytes(b"ha")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("name", ["last.ckpt", ".hidden", "[a]*.bin"])
def test_what_a_kill_leaves_is_found_also_of_a_temporary_file(tmp_path, name):
    path = tmp_path / name
    once = hidden_sibling(path)
    left = [once, hidden_sibling(once), hidden_sibling(hidden_sibling(once))]
    for leftover in left:
        leftover.touch()
    path.touch()
    hidden_sibling(tmp_path / "b.bin").touch()
    assert hidden_siblings(path) == sorted(left)


def test_others_may_read_the_file_as_the_umask_says(tmp_path):
    before = os.umask(0o022)
    try:
        write_atomic(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o644


def test_a_line_is_added_whole_or_not_at_all(tmp_path):
    path = tmp_path / "log.csv"
    append_whole(path, "größer,1\n")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The kernel takes the first bytes of the next line and refuses the others, as a full disk does.
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 4, before[1]))
    try:
        with pytest.raises(OSError, match=r"log\.csv") as error:
            append_whole(path, "a,2\n" * 100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert error.value.errno == errno.EFBIG
    assert path.read_bytes() == "größer,1\n".encode()
    append_whole(path, "b,3\n")
    assert path.read_text() == "größer,1\nb,3\n"
