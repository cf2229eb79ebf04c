"""Parquet and Feather files, written in batches of rows."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from boxreg_ros.errors import one_line, RecordingError

BATCH_ROWS = 10_000
"""Number of rows held in memory before they are written."""
METADATA_KEY = 'boxreg'
"""Key of the provenance in the metadata of a file."""


class Table:
    """
    Write a ``.parquet`` or ``.feather`` file row by row, with a text for its metadata.

    The types of the columns are those of pyarrow (int64, double, string). A type followed by
    ``[]`` is a list, by ``[16]`` a list of sixteen items.

    """

    def __init__(self, path: Path, columns: Mapping[str, str], provenance: str = '') -> None:
        import pyarrow
        from pyarrow import ipc, parquet

        types = [(name, _arrow_type(text)) for name, text in columns.items()]
        metadata = {METADATA_KEY: provenance} if provenance else None
        self._schema = pyarrow.schema(types, metadata=metadata)
        self._file = path.open('wb')  # pyarrow opens no path that is not UTF-8
        if path.suffix == '.parquet':
            self._writer = parquet.ParquetWriter(self._file, self._schema)
        else:
            self._writer = ipc.new_file(self._file, self._schema)
        self._rows: list[Sequence[Any]] = []
        self._names = list(columns)

    def add(self, *values: Any) -> None:
        """Add a row: its values in the order of the columns, None for null."""
        self._rows.append(values)
        if len(self._rows) == BATCH_ROWS:
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
    """Return all rows of a Parquet or Feather file; raises as `read_table`."""
    return list(read_table(path).to_pylist())


def read_table(path: Path, required: Collection[str] = (), what: str = '') -> Any:
    """
    Return the table of a Parquet or Feather file.

    Parameters
    ----------
    path : Path
        Parquet if its name ends in ``.parquet``, else Feather.
    required : collection of str
        Columns that must be there.
    what : str
        Origin of these columns, for the error.

    Returns
    -------
    table : pyarrow.Table
        With all columns of the file, in memory.

    Raises
    ------
    RecordingError
        If the file cannot be read, or lacks some of `required`.

    """
    import pyarrow
    from pyarrow import feather, parquet

    try:
        with path.open('rb') as file:
            if path.suffix == '.parquet':
                table = parquet.ParquetFile(file).read()
            else:
                table = feather.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        raise RecordingError(f'{path}: cannot be read: {one_line(error)}') from None
    missing = [name for name in required if name not in table.column_names]
    if missing:
        raise RecordingError(
            f'{path}: columns missing: {", ".join(missing)}; expected those of {what}'
        )
    return table


def _arrow_type(text: str) -> Any:
    """Return the pyarrow type of 'double', 'double[]' or 'double[16]'."""
    import pyarrow

    name, bracket, count = text.rstrip(']').partition('[')
    item = pyarrow.type_for_alias(name)
    if not bracket:
        return item
    return pyarrow.list_(item, int(count) if count else -1)
