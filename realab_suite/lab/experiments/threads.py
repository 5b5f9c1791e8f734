"""Limits numerical libraries to one thread, before they are imported.

On two cores, two processes with one thread each are faster than one with two
threads. Sums also do not depend on the number of threads.
"""

import os

from realab_suite import errors

_ONE = {
    'OMP_NUM_THREADS': '1',
    'OPENBLAS_NUM_THREADS': '1',
    'MKL_NUM_THREADS': '1',
    'VECLIB_MAXIMUM_THREADS': '1',
    'NUMEXPR_NUM_THREADS': '1',
}
_XLA_FLAGS = 'XLA_FLAGS'
_XLA_ONE = '--xla_cpu_multi_thread_eigen=false'


def use_one() -> None:
  """Sets environment variables of this process and its child processes.

  Raises:
    SpecError: If XLA_FLAGS contains anything except flags. XLA would ignore the
      flags after it, or end the process.
  """
  os.environ.update(_ONE)
  flags = os.environ.get(_XLA_FLAGS, '').split()
  for flag in flags:
    if not flag.startswith('--'):
      raise errors.SpecError(
          f'{_XLA_FLAGS}: {flag!r:.80}; must begin with --,'
          f' such as {_XLA_ONE}'
      )
  os.environ[_XLA_FLAGS] = ' '.join([*xla_flags(), _XLA_ONE])


def xla_flags() -> list[str]:
  """Returns the flags of XLA, except those that `use_one` sets."""
  flags = os.environ.get(_XLA_FLAGS, '').split()
  return [flag for flag in flags if flag != _XLA_ONE]
