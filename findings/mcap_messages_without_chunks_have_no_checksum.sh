#!/usr/bin/env bash
# guess: enable_crcs=True, the default of the writer, protects messages outside of chunks, too.
# happens: it covers chunks and the summary; a changed byte of a message passes validate_crcs=True.
#          Only enable_data_crcs=True, which is off by default, protects such a file.
# versions: mcap 1.6.0
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check mcap==1.6.0
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version
from io import BytesIO

from mcap.reader import NonSeekingReader
from mcap.writer import Writer

print('mcap', version('mcap'))


def outcome(**options):
    buffer = BytesIO()
    writer = Writer(buffer, use_chunking=False, **options)
    writer.start()
    channel = writer.register_channel('/text', 'json', 0)
    writer.add_message(channel, 1, b'"unchanged"', 1)
    writer.finish()
    changed = buffer.getvalue().replace(b'"unchanged"', b'"unchained"')
    try:
        reader = NonSeekingReader(BytesIO(changed), validate_crcs=True)
        return [message.data for _, _, message in reader.iter_messages()]
    except ValueError as error:
        return type(error).__name__


found = outcome(), outcome(enable_data_crcs=True)
print('default:', found[0])
print('enable_data_crcs:', found[1])
assert found == ([b'"unchained"'], 'CRCValidationError')
PYTHON
