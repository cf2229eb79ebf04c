"""The file in which the node keeps what drives have shown of their detector."""

from __future__ import annotations

import os
from pathlib import Path

from boxreg_ros.core.input_statistics import Drives, joined, to_text
from boxreg_ros.errors import ConfigError
from boxreg_ros.io.input_models import disagreements, read_models
from boxreg_ros.io.whole_files import written_whole


class ModelFile:
    """
    A file of the input model, read now: `drives`, none without a file; `text` says how many.

    Raises ConfigError if it is in a folder that cannot be written to.

    """

    def __init__(self, path: str) -> None:
        self.drives: Drives = {}
        self.text = ''
        self._path = Path(path).expanduser() if path else None
        if self._path is None:
            return
        if not (self._path.parent.is_dir() and os.access(self._path.parent, os.W_OK)):
            raise ConfigError(
                f'input_model: expected a file in a folder that can be written to, where it is '
                f'written at the end, got {str(self._path)!r}; make the folder, or choose another'
            )
        if self._path.exists():
            self.drives = read_models([self._path])
            self.text = f'input_model: drives read from {self._path}: {len(self.drives)}'
        else:
            self.text = f'input_model: no file {self._path} yet: it is written at the end'

    def save(self, drive: Drives) -> str:
        """Add a drive to the file; return where drives in it differ."""
        if self._path is None:
            return ''
        drives = joined([self.drives, drive])
        with written_whole(self._path) as file:
            file.write(to_text(drives))
        return '; '.join(disagreements(drives))
