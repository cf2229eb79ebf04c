"""
Install packages by uv, in a third of pip's time, from where pip's settings say.

``python test/uv_install.py ARGUMENT...``: arguments of ``uv pip install``, which installs into the
environment of ``--python``. uv, which does not read the settings of pip, is installed by pip.

"""

import ast
import os
from pathlib import Path
import subprocess
import sys

CONSTRAINTS = Path(__file__).parents[1] / 'constraints.txt'
VARIABLES = {
    'index-url': 'UV_DEFAULT_INDEX', 'extra-index-url': 'UV_EXTRA_INDEX_URL',
    'find-links': 'UV_FIND_LINKS', 'trusted-host': 'UV_INSECURE_HOST', 'proxy': 'ALL_PROXY',
    'cert': 'SSL_CERT_FILE',
}  # fmt: skip
"""Setting of pip -> variable of uv."""
PIP = (sys.executable, '-m', 'pip', '--disable-pip-version-check')


def variables(listed):
    """Return the variables of uv for the lines of ``pip config list``."""
    found = {'UV_INDEX_STRATEGY': 'unsafe-best-match'}  # as pip: the best version of all indexes
    # Variables go before files, and in these the section of the command before that of all.
    lines = sorted(
        listed, key=lambda line: (line.startswith(':env:'), line.startswith('install.'))
    )
    for line in lines:
        key, _, value = line.partition('=')
        variable = VARIABLES.get(key.rpartition('.')[2])
        if variable:
            separator = ',' if variable == 'UV_FIND_LINKS' else ' '
            found[variable] = separator.join(ast.literal_eval(value).split())
    return found


def main(arguments):
    """Replace this process by uv."""
    uv = Path(sys.executable).with_name('uv')
    if not uv.exists():
        quiet = ('install', '-qq', '--no-compile', '-c', str(CONSTRAINTS), 'uv')
        subprocess.run([*PIP, *quiet], check=True)
    listed = subprocess.run(
        [*PIP, 'config', 'list'], check=True, stdout=subprocess.PIPE, text=True
    )
    environment = os.environ | variables(listed.stdout.splitlines())
    command = [uv, 'pip', 'install', '--quiet', *arguments]
    os.execve(uv, command, environment)


if __name__ == '__main__':
    main(sys.argv[1:])
