"""
The method, compiled: every formula of docs/method.md once, for one window, in plain loops.

The modules import nothing from outside of this folder but numpy and numba. In the order of a
round: `expectation`, `faces`, `weights`, `residuals`, `assemble`, `arrowhead`, `covariance`;
`round` has them in one view, `constants` every number.

"""
