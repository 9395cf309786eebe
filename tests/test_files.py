"""Files that are written whole: their permissions, and what is not written again."""

import os
import stat
from pathlib import Path

import pytest

from jcr.files import write_new, write_text, written_whole


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_a_file_has_the_users_permissions_and_the_umask_of_the_process_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, umask: int
):
    """Files that another thread makes meanwhile must not be open to everybody."""
    before = os.umask(umask)
    try:
        with monkeypatch.context() as patched:
            patched.setattr(os, "umask", lambda mask: pytest.fail("the umask of the process is changed"))
            write_text(tmp_path / "calibration.json", "{}")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "calibration.json").stat().st_mode) == 0o666 & ~umask
    assert [file.name for file in tmp_path.iterdir()] == ["calibration.json"]


def test_a_file_that_has_the_bytes_already_keeps_its_time(tmp_path: Path):
    file = tmp_path / "depth.png"
    write_new(file, b"one")
    os.utime(file, (1, 1))
    write_new(file, b"one")
    assert file.stat().st_mtime == 1
    write_new(file, b"two")
    assert file.read_bytes() == b"two" and file.stat().st_mtime > 1


def test_a_file_that_is_not_written_whole_leaves_the_old_one_and_nothing_beside_it(tmp_path: Path):
    (tmp_path / "map.bin").write_text("old")
    with pytest.raises(KeyboardInterrupt), written_whole(tmp_path / "map.bin") as temporary:
        temporary.write_text("new")
        raise KeyboardInterrupt
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("map.bin", "old")]
