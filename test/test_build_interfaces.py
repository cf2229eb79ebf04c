"""Which message packages the build of type support takes as built."""

import build_interfaces
import pytest


def test_a_build_leaves_environments_alone_that_share_files_by_hard_links(tmp_path, monkeypatch):
    package = tmp_path / 'sources' / 'some_msgs'
    package.mkdir(parents=True)
    monkeypatch.setattr(build_interfaces, 'SITE', tmp_path / 'environment')
    monkeypatch.setattr(build_interfaces, 'FOLDERS', (package.parent,))
    monkeypatch.setenv('CXX', 'no-such-compiler')
    stamp = build_interfaces.stamp(package)
    stamp.parent.mkdir(parents=True)
    stamp.write_text('an earlier build')
    other = tmp_path / 'other'
    other.hardlink_to(stamp)
    with pytest.raises(SystemExit, match='no-such-compiler'):
        build_interfaces.main()
    assert not stamp.exists()
    assert other.read_text() == 'an earlier build'
