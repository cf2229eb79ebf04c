"""
The method, compiled: every formula of docs/method.md once, for one window, in plain loops.

The modules import nothing from outside of this folder but numpy and numba. In the order of a
round: `expectation`, `faces`, `weights`, `residuals`, `assemble`, `arrowhead`, `covariance`;
`round` has them in one view, `constants` every number.

"""

import os

# Numba makes thousands of errors that it catches itself, and formats each for a terminal where
# colorama is installed: a twentieth of the time to compile. It reads this when it is imported.
os.environ.setdefault('NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING', '1')
