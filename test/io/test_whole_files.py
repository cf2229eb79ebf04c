"""Folders on the disk itself."""

import errno

from boxreg_ros.io import whole_files
import pytest


def test_many_files_are_synchronised_at_once(tmp_path, monkeypatch):
    """Few one by one; many by their file system, or one by one where that is not possible."""
    stored = []
    monkeypatch.setattr(whole_files, 'store', stored.extend)
    (tmp_path / 'one').touch()
    whole_files.store_folder(tmp_path)
    assert stored == [tmp_path / 'one', tmp_path]
    stored.clear()
    for number in range(whole_files.MANY_FILES):
        (tmp_path / str(number)).touch()
    whole_files.store_folder(tmp_path)
    assert not stored
    monkeypatch.setattr(whole_files.ctypes, 'CDLL', lambda *_, **__: object())
    whole_files.store_folder(tmp_path)
    assert len(stored) == whole_files.MANY_FILES + 2


def test_an_error_of_the_disk_is_raised(tmp_path, monkeypatch):
    class Library:
        @staticmethod
        def syncfs(_):
            return -1

    monkeypatch.setattr(whole_files, 'MANY_FILES', 0)
    monkeypatch.setattr(whole_files.ctypes, 'CDLL', lambda *_, **__: Library)
    monkeypatch.setattr(whole_files.ctypes, 'get_errno', lambda: errno.EIO)
    with pytest.raises(OSError, match='Input/output error'):
        whole_files.store_folder(tmp_path)
