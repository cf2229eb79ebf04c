"""
`measure renew`: run the command of each stored measurement again, and store its output.

A stored measurement is a file ``docs/results/NAME.json``; it names the command that wrote it. Data
are folders of recordings with known truth: ``DATA/street`` has one recording and ``truth.csv``.

"""

import json
from pathlib import Path
import shlex
import subprocess
import sys

from boxreg_ros.errors import RecordingError
from measure import MEASURE
from measure.common import PROGRAM
from paths import ROOT

STORE = ROOT / 'docs' / 'results'
ARGUMENTS = {
    'data': (Path, 'folder with the recordings'),
    '--only': ('*', "pattern, such as 'tracks_*' (default: all)", {'metavar': 'NAMES'}),
}


def run(args):
    """Write each chosen file anew, whole or not at all."""
    for path in sorted(STORE.glob(f'{args.only}.json')):
        command = json.loads(path.read_text(encoding='utf-8'))['command']
        print(command, file=sys.stderr)
        done = subprocess.run(
            resolved(command), cwd=args.data, stdout=subprocess.PIPE, encoding='utf-8'
        )
        if done.returncode:
            raise RecordingError(f'{command}: ended with exit status {done.returncode}')
        document = json.loads(done.stdout) | {'command': command}
        path.write_text(f'{json.dumps(document)}\n', encoding='utf-8')


def resolved(command):
    """Return a stored command as words that run in any folder, by the Python of this process."""
    words = shlex.split(command.removeprefix(PROGRAM))
    return [*MEASURE, *(str(ROOT / word) if (ROOT / word).is_file() else word for word in words)]
