"""Tables that grow: Parquet and Feather files, written in batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from boxreg_ros.errors import RecordingError

ROWS = 10_000
"""Rows held before they are written."""
ORIGIN = 'boxreg'
"""Key of the provenance in a file's own metadata."""


class Table:
    """
    A file of rows.

    Parameters
    ----------
    path : Path
        Ends in ``.parquet`` or ``.feather``.
    columns : mapping of str to str
        Name and type of each column, as pyarrow calls it: int64, double, string, or with ``[]``
        or ``[16]`` behind it a list of such, or of so many.
    origin : str
        Kept in the metadata of the file.

    """

    def __init__(self, path: Path, columns: Mapping[str, str], origin: str = '') -> None:
        import pyarrow
        from pyarrow import ipc, parquet

        kinds = {}
        for name, kind in columns.items():
            item, bracket, count = kind.rstrip(']').partition('[')
            kinds[name] = pyarrow.type_for_alias(item)
            if bracket:
                kinds[name] = pyarrow.list_(kinds[name], int(count or -1))
        self._schema = pyarrow.schema(kinds.items(), metadata={ORIGIN: origin} if origin else None)
        self._file = path.open('wb')  # pyarrow itself takes no name that is not UTF-8
        is_parquet = path.suffix == '.parquet'
        new = parquet.ParquetWriter if is_parquet else ipc.new_file
        self._writer = new(self._file, self._schema)
        self._rows: list[Sequence[Any]] = []
        self._names = list(columns)

    def add(self, *values: Any) -> None:
        """Add a row, its values in the order of the columns; None where there is none."""
        self._rows.append(values)
        if len(self._rows) == ROWS:
            self._flush()

    def close(self) -> None:
        """Complete the file."""
        self._flush()
        self._writer.close()
        self._file.close()

    def _flush(self) -> None:
        import pyarrow

        rows = [dict(zip(self._names, row, strict=True)) for row in self._rows]
        self._writer.write_table(pyarrow.Table.from_pylist(rows, self._schema))
        self._rows.clear()


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return all rows of a Parquet or Feather file, and raise as `read_table` does."""
    return list(read_table(path).to_pylist())


def read_table(path: Path) -> Any:
    """
    Return the pyarrow table of a Parquet or Feather file.

    Raises
    ------
    RecordingError
        If there is none, or it is broken.

    """
    import pyarrow
    from pyarrow import feather, parquet

    try:
        with path.open('rb') as file:
            if path.suffix == '.parquet':
                return parquet.ParquetFile(file).read()
            return feather.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        text = ' '.join(str(error).split())
        raise RecordingError(f'{path}: cannot be read: {text}') from None
